"""Whatever the world shows and whatever the solver does, there is a plan that can be driven."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sumo_cohesion.perception.history import History
from sumo_cohesion.planning.cohesive import CohesivePlanner
from sumo_cohesion.planning.problem import Instance, Solution
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers import mpc
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.car import ask, drive
from sumo_cohesion.social.memory import new_history
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import (
    RESCUED,
    CartesianState,
    Control,
    FloatArray,
    Observation,
    Plan,
    RoadState,
)

SETTINGS = PlannerSettings()
COHESION = CohesionSettings()


def observed(time: float, ego: RoadState, cars: np.ndarray) -> Observation:
    n = len(cars)
    return Observation(
        time=time,
        ego=ego,
        ego_size=(5.0, 1.8),
        ids=tuple(f"car_{i}" for i in range(n)),
        states=cars,
        sizes=np.tile([5.0, 1.8], (n, 1)),
        curvature=np.zeros(n),
        voter=(True,) * n,
    )


def assert_can_be_driven(plan: Plan, ego: RoadState) -> None:
    curvature, acceleration = plan.controls[0]
    assert np.isfinite([curvature, acceleration]).all()
    assert abs(curvature) <= SETTINGS.max_curvature + 1e-6
    drag = SETTINGS.friction * ego.speed
    assert drag - SETTINGS.max_braking - 1e-4 <= acceleration
    assert acceleration <= drag + SETTINGS.max_acceleration + 1e-4
    after = ego.speed + 0.1 * (acceleration - drag)
    assert after >= -1e-6  # no car reverses
    assert after**2 * abs(curvature) <= SETTINGS.max_lateral_acceleration * (1.0 + 1e-3)
    assert plan.status


WORLDS = {
    "ordinary": lambda rng, n: rng.uniform((0, -4, -0.1, 0), (200, 4, 0.1, 35), (n, 4)),
    "identical": lambda rng, n: np.tile(rng.uniform((95, -4, 0, 0), (125, 4, 0, 35)), (n, 1)),
    "on top of the ego": lambda rng, n: np.tile((100.0, 0.0, 0.0, rng.uniform(0, 35)), (n, 1)),
    "standing": lambda rng, n: rng.uniform((100, -4, -3, 0), (130, 4, 3, 0), (n, 4)),
    "wild": lambda rng, n: rng.uniform((-50, -50, -3.1, 0), (400, 50, 3.1, 90), (n, 4)),
}


@pytest.fixture(scope="module")
def planner(highway: Road) -> CohesivePlanner:
    return CohesivePlanner(SETTINGS, COHESION)


@pytest.mark.slow
@settings(max_examples=settings().max_examples * 4)
@given(
    world=st.sampled_from(sorted(WORLDS)),
    n=st.integers(0, 30),
    seed=st.integers(0, 2**32 - 1),
    d=st.floats(-6.0, 6.0),
    heading=st.floats(-1.0, 1.0),
    speed=st.just(0.0) | st.floats(0.0, 60.0),
)
@example(world="identical", n=500, seed=0, d=0.0, heading=0.0, speed=20.0)
@example(world="wild", n=500, seed=1, d=0.0, heading=0.0, speed=20.0)
@example(world="ordinary", n=500, seed=2, d=0.0, heading=0.0, speed=0.0)
@example(world="on top of the ego", n=2, seed=3, d=0.0, heading=0.0, speed=0.0)
def test_there_is_always_a_plan_that_can_be_driven(
    planner: CohesivePlanner,
    highway: Road,
    world: str,
    n: int,
    seed: int,
    d: float,
    heading: float,
    speed: float,
) -> None:
    """Variances from nothing (identical cars) to huge (wild ones) are among them."""
    rng = np.random.default_rng(seed)
    cars = WORLDS[world](rng, n)
    history = new_history(COHESION, 0.1)
    planner.reset(highway)
    for k in range(8):  # long enough for transitions over half a second
        ego = RoadState(100.0 + 0.1 * k * speed, d, heading, speed)
        observation = observed(0.1 * k, ego, cars)
        history.push(observation)
        if world == "wild":
            cars = WORLDS[world](rng, n)  # nobody is where they can be
        else:
            cars = cars + 0.1 * np.column_stack((cars[:, 3], np.zeros((n, 3))))
    for _ in range(2):  # without and with a warm start
        assert_can_be_driven(planner.plan(observation, history), ego)


def test_what_is_not_a_number_does_not_get_as_far_as_the_planner() -> None:
    cars = np.array([[120.0, 0.0, 0.0, 20.0]])
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match="not finite"):
            observed(0.0, RoadState(100.0, bad, 0.0, 20.0), cars)
        with pytest.raises(ValueError, match="not finite"):
            observed(0.0, RoadState(100.0, 0.0, 0.0, 20.0), np.full((1, 4), bad))


class Faulty:
    """A solver that does wrong."""

    how = "faulty"

    def __init__(self, solver: mpc.Solver, fault: str) -> None:
        self.name, self._solver, self._fault = solver.name, solver, fault

    def solve(self, instance: Instance, guess: FloatArray) -> Solution:
        if self._fault == "raises":
            raise RuntimeError("out of luck")
        good = self._solver.solve(instance, guess)
        states, controls = good.states.copy(), good.controls.copy()
        solved, status = self._fault != "times out", "solved"
        if self._fault == "times out":
            status = f"{self.name} returned too many iterations"
        elif self._fault == "not a number":
            controls[0, 0] = np.nan
        elif self._fault == "infinite":
            states[3, 1] = np.inf
        elif self._fault == "out of bounds":
            controls[2, 1] = 60.0
        elif self._fault == "inconsistent":
            controls[0] = (0.9 * SETTINGS.max_curvature, 1.0)
        else:
            assert self._fault == "too short"
            states, controls = states[:3], controls[:2]
        return Solution(states, controls, solved, status, 1, 0.0, good.reward)


FAULTS = ("raises", "times out", "not a number", "infinite", "out of bounds", "inconsistent")


@pytest.mark.parametrize("fault", [*FAULTS, "too short"])
def test_a_faulty_solver_is_noticed_and_rescued(highway: Road, fault: str) -> None:
    ego = RoadState(100.0, 0.3, 0.0, 20.0)
    observation = observed(0.0, ego, np.array([[120.0, 0.0, 0.0, 15.0]]))
    history = new_history(COHESION, 0.1)
    history.push(observation)
    planner = CohesivePlanner(SETTINGS, COHESION)
    planner.reset(highway)
    good = planner.plan(observation, history)
    planner.reset(highway)
    assert planner._mpc is not None
    planner._mpc._tools.solver = Faulty(planner._mpc.solver, fault)
    plan = planner.plan(observation, history)
    assert plan.status.startswith(RESCUED)
    assert not plan.fallback
    assert np.array(plan.controls) == pytest.approx(np.array(good.controls), abs=1e-3)


@pytest.mark.parametrize("fault", FAULTS)
def test_if_all_solvers_always_fail_the_ego_brakes_in_its_lane(
    highway: Road, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = mpc.shared_solver
    monkeypatch.setattr(mpc, "shared_solver", lambda *about: Faulty(real(*about), fault))
    ego = RoadState(100.0, 0.3, 0.0, 20.0)
    observation = observed(0.0, ego, np.zeros((0, 4)))
    history = new_history(COHESION, 0.1)
    history.push(observation)
    planner = CohesivePlanner(SETTINGS, COHESION)
    planner.reset(highway)
    plan = planner.plan(observation, history)
    assert plan.fallback
    assert "ilqr" in plan.status
    assert "ipopt" in plan.status
    assert_can_be_driven(plan, ego)
    assert plan.controls[0].acceleration == pytest.approx(SETTINGS.friction * 20.0 - 4.0)


def test_if_all_solvers_fail_now_the_last_plan_goes_on_for_half_its_length(highway: Road) -> None:
    planner = CohesivePlanner(SETTINGS, COHESION)
    planner.reset(highway)
    history = new_history(COHESION, 0.1)
    good = planned(planner, RoadState(100.0, 0.3, 0.0, 20.0), history)
    break_solvers(planner)
    for k in range(1, 5):
        plan = planned(planner, RoadState(*good.states[k]), history)
        assert plan.fallback
        assert plan.controls == good.controls[k:]
        assert np.array(plan.states) == pytest.approx(good.states[k:])
    ego = RoadState(*good.states[5])
    plan = planned(planner, ego, history)
    assert plan.fallback
    assert plan.controls[0].acceleration == pytest.approx(SETTINGS.friction * ego.speed - 4.0)


def test_a_plan_that_was_not_driven_does_not_go_on(highway: Road) -> None:
    """The last resort changed it: what is left of it starts where the ego is not."""
    planner = CohesivePlanner(SETTINGS, COHESION)
    planner.reset(highway)
    history = new_history(COHESION, 0.1)
    ego = RoadState(100.0, 0.0, 0.0, 20.0)
    near = np.array([[122.0, 0.0, 0.0, 10.0]])
    history.push(observed(0.0, ego, near))
    assert planner.plan(observed(0.0, ego, near), history).intervened
    break_solvers(planner)
    plan = planned(planner, RoadState(102.0, 0.0, 0.0, 19.2), history)
    assert plan.fallback
    assert len(plan.controls) == 1


def planned(planner: CohesivePlanner, ego: RoadState, history: History) -> Plan:
    observation = observed(0.0, ego, np.zeros((0, 4)))
    history.push(observation)
    return planner.plan(observation, history)


def break_solvers(planner: CohesivePlanner) -> None:
    planner._mpc._tools.solver = Faulty(planner._mpc.solver, "raises")  # type: ignore[union-attr]
    planner._mpc._rescued = lambda *about: about[-1]  # type: ignore[union-attr,method-assign]


def test_whoever_planned_what_was_driven_it_bounds_the_next_control(highway: Road) -> None:
    tight = SETTINGS.model_copy(update={"max_jerk": 10.0})
    planner = CohesivePlanner(tight, COHESION)
    for driven in (-5.0, 0.0, 3.0):
        planner.reset(highway)
        planner.continue_from(Control(0.0, driven))
        plan = planned(planner, RoadState(100.0, 0.0, 0.0, 15.0), new_history(COHESION, 0.1))
        assert abs(plan.controls[0].acceleration - driven) <= 1.0 + 1e-5


def test_no_car_reverses_whatever_a_planner_wants() -> None:
    state = CartesianState(0.0, 0.0, 0.0, 1.0)
    for _ in range(3):
        plan = Plan((Control(0.0, -99.0),), np.zeros((1, 4)), "mine")
        after = drive(state, plan, SETTINGS)
        assert after is not None
        assert after.x == pytest.approx(state.x, abs=1e-9)
        assert after.speed == pytest.approx(0.0, abs=1e-9)
        state = after


@pytest.mark.parametrize("controls", [((0.001, 1.0),), np.full((10, 2), 0.001), [[0.001, 1.0]]])
def test_a_users_controls_may_be_any_pairs(highway: Road, controls: Any) -> None:
    class Mine:
        def reset(self, road: Road) -> None: ...

        def plan(self, observation: Observation, history: History) -> Plan:
            return Plan(controls, np.zeros((1, 4)), "mine")

    seen = observed(0.0, RoadState(100.0, 0.0, 0.0, 20.0), np.zeros((0, 4)))
    plan = ask(Mine(), seen, new_history(COHESION, 0.1), highway, SETTINGS)
    assert not plan.fallback
    assert isinstance(plan.controls[0], Control)
    assert plan.controls[0].curvature == 0.001
