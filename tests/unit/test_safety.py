"""The last resort and the exact penalty: what cohesion can never buy."""

from __future__ import annotations

import numpy as np
import pytest

from sumo_cohesion.planning.cohesive import CohesivePlanner
from sumo_cohesion.planning.dynamics import step
from sumo_cohesion.planning.safety import ONCOMING_BRAKING, checked, safe_distance
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.social.memory import new_history
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import Control, Observation, Plan, RoadState

SETTINGS = PlannerSettings()


def scene(
    ego: tuple[float, float, float, float], *cars: tuple[float, float, float, float]
) -> Observation:
    """Make an observation of an ego and cars, each s, d, heading, speed."""
    return Observation(
        time=0.0,
        ego=RoadState(*ego),
        ego_size=(5.0, 1.8),
        ids=tuple(f"car_{i}" for i in range(len(cars))),
        states=np.array(cars, dtype=float).reshape(-1, 4),
        sizes=np.tile([5.0, 1.8], (len(cars), 1)),
        curvature=np.zeros(len(cars)),
        voter=(True,) * len(cars),
    )


def planned(observation: Observation, curvature: float, acceleration: float) -> Plan:
    ego = observation.ego
    control = Control(curvature, acceleration + SETTINGS.friction * ego.speed)
    after = step(ego, control, 0.1, SETTINGS.friction)
    return Plan((control,), np.array((ego, after)), "solved")


def test_a_safe_plan_is_left_alone(highway: Road) -> None:
    observation = scene((100.0, 0.0, 0.0, 25.0), (140.0, 0.0, 0.0, 25.0), (100.0, 3.5, 0.0, 25.0))
    plan = planned(observation, 0.0, 0.0)
    assert checked(plan, observation, highway, SETTINGS) is plan


def test_too_close_behind_a_car_the_ego_brakes_with_its_most(highway: Road) -> None:
    observation = scene((100.0, 0.0, 0.0, 25.0), (115.0, 0.0, 0.0, 15.0))
    plan = checked(planned(observation, 0.0, 1.0), observation, highway, SETTINGS)
    assert plan.intervened
    assert "too close behind car_0" in plan.status
    change = plan.states[1, 3] - plan.states[0, 3]
    assert change == pytest.approx(-0.1 * SETTINGS.max_braking)
    # A car in the next lane is nobody's business.
    beside = scene((100.0, 0.0, 0.0, 25.0), (115.0, 3.5, 0.0, 15.0))
    assert not checked(planned(beside, 0.0, 1.0), beside, highway, SETTINGS).intervened


def test_the_safe_distance_is_enough_when_the_car_ahead_brakes_its_hardest() -> None:
    for speed, ahead in ((25.0, 25.0), (30.0, 20.0), (10.0, 0.0), (20.0, 30.0)):
        gap = safe_distance(speed, ahead, SETTINGS)
        v, f, g = speed, ahead, gap
        v_next = v + 0.1 * SETTINGS.max_acceleration  # one more step of the worst plan
        f_next = max(f - 0.8, 0.0)
        g += 0.05 * (f + f_next) - 0.05 * (v + v_next)
        v, f, least = v_next, f_next, g
        while v > 0.0:
            v_next, f_next = max(v - 0.8, 0.0), max(f - 0.8, 0.0)
            g += 0.05 * (f + f_next) - 0.05 * (v + v_next)
            v, f, least = v_next, f_next, min(least, g)
        assert least >= -0.05 * SETTINGS.max_braking  # within one step's rounding


def test_before_an_oncoming_car_both_can_still_stop(highway: Road) -> None:
    ego, other = (100.0, 0.0, 0.0, 20.0), (300.0, 0.0, np.pi, 15.0)
    began, braking = 0.0, 0
    while ego[3] > 0.0 or other[3] > 0.0:
        observation = scene(ego, other)
        plan = checked(planned(observation, 0.0, 0.0), observation, highway, SETTINGS)
        if plan.intervened and not began:
            assert "too close before car_0" in plan.status
            began = other[0] - ego[0]
        ego = tuple(max(float(v), 0.0) for v in step(ego, plan.controls[0], 0.1, 0.1))  # type: ignore[assignment]
        # The other sees the ego as late as one step after the ego has seen it.
        speed, braking = other[3], braking + bool(began)
        slower = max(speed - 0.1 * ONCOMING_BRAKING, 0.0) if braking > 1 else speed
        other = (other[0] - 0.05 * (speed + slower), 0.0, np.pi, slower)
    gap = other[0] - ego[0] - 5.0
    # No sooner than needed: what is left is what the ego would have accelerated, and rounding.
    assert 0.0 <= gap < 5.0
    # In its own lane it is nobody's business.
    beside = scene((100.0, 0.0, 0.0, 20.0), (130.0, 3.5, np.pi, 20.0))
    assert not checked(planned(beside, 0.0, 0.0), beside, highway, SETTINGS).intervened


def test_beside_a_car_the_ego_does_not_move_closer(highway: Road) -> None:
    observation = scene((100.0, 1.2, 0.05, 25.0), (101.0, 3.3, 0.0, 25.0))
    plan = checked(planned(observation, 0.005, 0.0), observation, highway, SETTINGS)
    assert plan.intervened
    assert "too close beside car_0" in plan.status
    assert plan.controls[0].curvature < 0.0


@pytest.mark.parametrize(
    ("ego", "cars", "curvature", "better"),
    [
        # The ego turns towards a car beside it.
        ((100.0, 1.0, 0.0, 25.0), [(100.0, 3.2, 0.0, 25.0)], 0.01, True),
        # The nearest lane's centre, 3.5, is on the other car's side; the plan is straight on.
        ((100.0, 1.9, 0.0, 25.0), [(100.0, 3.8, 0.0, 25.0)], 0.0, False),
        # Between two cars.
        (
            (100.0, -1.0, 0.0, 25.0),
            [(100.0, -3.05, 0.0, 25.0), (100.0, 1.1, 0.0, 25.0)],
            0.0,
            False,
        ),
        # The plan already evades as hard as it can.
        ((100.0, -1.2, 0.05, 25.0), [(100.0, 1.1, 0.0, 25.0)], -0.01, False),
        # A human merges into the ego, which evades.
        ((100.0, 0.0, 0.0, 25.0), [(100.0, 2.1, -0.03, 25.0)], -0.01, False),
    ],
)
def test_beside_a_car_a_plan_is_made_better_or_left_alone(
    highway: Road,
    ego: tuple[float, float, float, float],
    cars: list[tuple[float, float, float, float]],
    curvature: float,
    better: bool,
) -> None:
    def least_gap(*, last_resort: bool) -> float:
        state, others, least = ego, list(cars), np.inf
        for _ in range(8):
            observation = scene(state, *others)
            plan = planned(observation, curvature, 0.0)
            if last_resort:
                plan = checked(plan, observation, highway, SETTINGS)
            after = step(state, plan.controls[0], 0.1, SETTINGS.friction)
            state = tuple(float(v) for v in after)  # type: ignore[assignment]
            others = [
                (s + 0.1 * v * np.cos(h), d + 0.1 * v * np.sin(h), h, v) for s, d, h, v in others
            ]
            sides = [
                abs(d - state[1])
                - 1.8 / 2 * (np.cos(h) + np.cos(state[2]))
                - 2.5 * (abs(np.sin(h)) + abs(np.sin(state[2])))
                for _, d, h, _ in others
            ]
            least = min(least, *sides)
        return float(least)

    with_it, without = least_gap(last_resort=True), least_gap(last_resort=False)
    assert with_it > without + 0.1 if better else with_it == without


def test_braking_with_its_most_already_is_no_intervention(highway: Road) -> None:
    for speed in np.linspace(10.0, 35.0, 200):
        observation = scene((100.0, 0.0, 0.0, speed), (100.0 + 10.0, 0.0, 0.0, 5.0))
        plan = planned(observation, 0.0, -SETTINGS.max_braking)
        assert not checked(plan, observation, highway, SETTINGS).intervened


@pytest.mark.parametrize("beta", [0.09, 10.0, 1e4])
def test_no_beta_buys_a_collision(highway: Road, beta: float) -> None:
    """Follow nobody into a car: all who passed here moved left, but a car stands there."""
    cohesion = CohesionSettings(beta=beta)
    planner = CohesivePlanner(SETTINGS, cohesion)
    planner.reset(highway)
    ego = (300.0, 0.0, 0.0, 20.0)
    history = new_history(cohesion, 0.1)
    for k in range(60):
        t = 0.1 * k
        cars = [
            (s + 20.0 * t, max(0.1 * (s + 20.0 * t - 300.0), 0.0), 0.0, 20.0)
            for s in (255.0, 245.0, 235.0)
        ]
        seen = scene((300.0 - 20.0 * (6.0 - t), 0.0, 0.0, 20.0), *cars, (315.0, 2.6, 0.0, 0.0))
        history.push(seen)
    nearest = np.inf
    for _ in range(15):
        seen = scene(ego, (315.0, 2.6, 0.0, 0.0))
        plan = planner.plan(seen, history)
        after = step(ego, plan.controls[0], 0.1, SETTINGS.friction)
        ego = tuple(float(v) for v in after)  # type: ignore[assignment]
        if abs(ego[0] - 315.0) < 5.0:
            nearest = min(nearest, abs(ego[1] - 2.6) - 1.8)
    assert 0.0 < nearest < np.inf  # it came past
