"""Dynamics, reward and the controller: closed-form answers and promises."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin

import numpy as np
import pytest

from sumo_cohesion.errors import UserError
from sumo_cohesion.perception.history import History
from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.cohesive import CohesivePlanner, nearest_cars
from sumo_cohesion.planning.fallback import fallback
from sumo_cohesion.planning.planners import Planner, SumoDriver
from sumo_cohesion.planning.registry import make_planner
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.mpc import shifted
from sumo_cohesion.road import Road
from sumo_cohesion.social.memory import new_history
from sumo_cohesion.social.place import NOWHERE, Place
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import Observation, RoadState

SETTINGS = PlannerSettings()
CAR = (5.0, 1.8)


def observation(
    ego: tuple[float, float, float, float], cars: list[tuple[float, float, float, float]]
) -> Observation:
    return Observation(
        time=0.0,
        ego=RoadState(*ego),
        ego_size=CAR,
        ids=tuple(f"car_{i}" for i in range(len(cars))),
        states=np.array(cars, dtype=float).reshape(-1, 4),
        sizes=np.tile(CAR, (len(cars), 1)),
        curvature=np.zeros(len(cars)),
        voter=(True,) * len(cars),
    )


def empty_history() -> History:
    return new_history(CohesionSettings(), 0.1)


def nominal(road: Road, **settings: object) -> Planner:
    planner = make_planner("nominal", SETTINGS.model_copy(update=settings), CohesionSettings())
    planner.reset(road)
    return planner


def test_constant_speed_on_a_straight_line() -> None:
    state = (0.0, 0.0, 0.0, 20.0)
    for _ in range(20):
        state = dynamics.step(state, (0.0, 2.0), 0.1, 0.1)  # 2 m/s² against friction 0.1 · 20
    assert state == pytest.approx((40.0, 0.0, 0.0, 20.0))


def test_constant_curvature_drives_a_circle() -> None:
    state = (0.0, 0.0, 0.0, 20.0)
    for _ in range(100):
        state = dynamics.step(state, (0.01, 2.0), 0.1, 0.1)
    # 200 m on a radius of 100 m: 2 rad; the polygon of 2 m steps is within half a step.
    assert state[2] == pytest.approx(2.0)
    assert state[:2] == pytest.approx((100 * sin(2), 100 * (1 - cos(2))), abs=1.5)


def test_following_a_curved_road_keeps_d() -> None:
    state = (0.0, -3.5, 0.0, 20.0)
    k = 0.002
    own = k / (1 - k * -3.5)
    for _ in range(100):
        state = dynamics.step(state, (own, 2.0), 0.1, 0.1, k)
    assert state[1:3] == pytest.approx((-3.5, 0.0), abs=1e-9)
    assert state[0] == pytest.approx(200 / (1 + 0.002 * 3.5))


def test_the_first_transition_depends_on_the_first_control() -> None:
    rest = dynamics.step((0.0, 0.0, 0.0, 20.0), (0.0, 2.0), 0.1, 0.1)
    pushed = dynamics.step((0.0, 0.0, 0.0, 20.0), (0.01, 4.0), 0.1, 0.1)
    assert pushed[0] > rest[0]
    assert pushed[1] > rest[1]


def test_nominal_alone_keeps_lane_and_limit(highway: Road) -> None:
    planner = nominal(highway)
    ego = (100.0, 0.6, 0.0, 22.0)
    for _ in range(150):
        plan = planner.plan(observation(ego, []), empty_history())
        assert plan.status == "solved"
        ego = dynamics.step(ego, plan.controls[0], 0.1, SETTINGS.friction)
    assert ego[1] == pytest.approx(0.0, abs=0.05)
    assert ego[3] == pytest.approx(25.0, abs=0.1)


def test_plan_keeps_its_own_promises(highway: Road) -> None:
    plan = nominal(highway).plan(
        observation((100.0, 0.4, 0.05, 24.0), [(125.0, 0.0, 0.0, 20.0)]), empty_history()
    )
    assert plan.states.shape == (SETTINGS.horizon + 1, 4)
    assert len(plan.controls) == SETTINGS.horizon
    for t, control in enumerate(plan.controls):
        predicted = dynamics.step(tuple(plan.states[t]), control, 0.1, SETTINGS.friction)
        assert predicted == pytest.approx(tuple(plan.states[t + 1]), abs=1e-6)
        assert abs(control.curvature) <= SETTINGS.max_curvature + 1e-6
    assert plan.iterations > 0
    assert plan.wall_time > 0
    assert set(plan.reward) == {
        "lane", "edge", "speed", "car", "curvature", "acceleration", "cohesion", "constraints",
    }  # fmt: skip
    assert plan.reward["cohesion"] == 0.0


def test_both_solvers_find_the_same_plan(highway: Road) -> None:
    scene = observation((100.0, 0.3, 0.02, 24.0), [(118.0, 0.1, 0.0, 21.0)])
    plans = [
        nominal(highway, solver=solver).plan(scene, empty_history())
        for solver in ("fatrop", "ipopt")
    ]
    assert plans[0].states == pytest.approx(plans[1].states, abs=1e-3)


def test_a_car_ahead_makes_it_brake(highway: Road) -> None:
    planner = nominal(highway)
    free = planner.plan(observation((100.0, 0.0, 0.0, 25.0), []), empty_history())
    planner.reset(highway)
    behind = planner.plan(
        observation((100.0, 0.0, 0.0, 25.0), [(115.0, 0.0, 0.0, 15.0)]), empty_history()
    )
    assert behind.controls[0].acceleration < free.controls[0].acceleration - 1.0


def agreeing_history(across: float) -> tuple[Observation, History]:
    """Three cars drove through the ego's place at s = 300, all moving sideways alike."""
    history = empty_history()
    for k in range(60):
        t = 0.1 * k
        cars = [
            (start + 25.0 * t, across * (start + 25.0 * t - 300.0) / 25.0, 0.0, 25.0)
            for start in (270.0, 260.0, 250.0)
        ]
        scene = observation((300.0, 0.0, 0.0, 25.0), cars)
        history.push(scene)
    return scene, history


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_cohesive_follows_a_swerve_that_nominal_ignores(highway: Road, side: float) -> None:
    scene, history = agreeing_history(side)
    cohesion = CohesionSettings()
    cohesive = CohesivePlanner(SETTINGS, cohesion)
    cohesive.reset(highway)
    followed = cohesive.plan(scene, history)
    ignored = nominal(highway).plan(scene, history)
    assert side * followed.states[1, 2] > 0.003
    assert abs(ignored.states[1, 2]) < 0.001
    rows = {(r.group, r.feature): r for r in followed.agreement}
    assert rows["position", "lateral"].n == 3
    assert rows["position", "lateral"].mean * 1.5 == pytest.approx(side, rel=0.01)
    strongest = max(followed.agreement, key=lambda r: r.pull)
    assert strongest.group == "position"


def test_a_lagging_ego_is_drawn_to_the_others_path(highway: Road) -> None:
    # All drove straight, 1.6 m left of the lane's centre: every difference is zero, so only
    # where they drove can tell the ego to move over.
    history = empty_history()
    for k in range(60):
        cars = [(start + 2.5 * k, 1.6, 0.0, 25.0) for start in (270.0, 260.0, 250.0)]
        scene = observation((300.0, 0.4, 0.0, 25.0), cars)
        history.push(scene)
    moved = {}
    for weight in (0.0, 8.0):
        planner = CohesivePlanner(SETTINGS, CohesionSettings(place_weight=weight, surprise=1.0))
        planner.reset(highway)
        plan = planner.plan(scene, history)
        moved[weight] = plan.states[-1, 1] - 0.4
    assert moved[0.0] < 0.0  # back to the lane's centre
    assert moved[8.0] > 0.1
    (row,) = [r for r in plan.agreement if r.feature == "place"]
    assert (row.n, row.mean * 3.5) == pytest.approx((3, 1.6))


def test_only_a_known_place_pulls(highway: Road) -> None:
    planner = CohesivePlanner(SETTINGS, CohesionSettings())
    planner.reset(highway)
    n = len(planner._place_steps)
    unknown = (0.0,) * (n - 1)
    place = Place(2, (1.6, *[0.4] * (n - 1)), (0.0, *unknown), (400.0, *unknown), 9.0)
    problem = planner._problem(observation((300.0, 0.4, 0.0, 25.0), []), (), place, None)
    assert problem.place_target == pytest.approx(np.full(SETTINGS.horizon, 1.6))
    assert problem.place_weight[0] == problem.place_weight.max() > 0.0
    assert (problem.place_weight[planner._place_steps[1] - 1 :] == 0.0).all()


def test_beta_zero_is_the_nominal_planner(highway: Road) -> None:
    scene, history = agreeing_history(1.0)
    planner = CohesivePlanner(SETTINGS, CohesionSettings(beta=0.0))
    planner.reset(highway)
    a, b = planner.plan(scene, history), nominal(highway).plan(scene, history)
    assert np.array_equal(a.states, b.states)
    assert list(a.agreement) == []


def test_a_planner_asked_before_it_has_seen_anything_plans(highway: Road) -> None:
    planner = CohesivePlanner(SETTINGS, CohesionSettings())
    planner.reset(highway)
    plan = planner.plan(observation((300.0, 0.0, 0.0, 25.0), []), empty_history())
    assert plan.status == "solved"
    assert all(row.n == 0 for row in plan.agreement)


def test_an_explanation_is_a_sequence_of_rows(highway: Road) -> None:
    scene, history = agreeing_history(1.0)
    planner = CohesivePlanner(SETTINGS, CohesionSettings())
    planner.reset(highway)
    why = planner.plan(scene, history).agreement
    rows = list(why)
    assert len(why) == len(rows) >= 15
    assert (why[0], why[-1], why[1:3]) == (rows[0], rows[-1], rows[1:3])
    assert [list(column) for column in zip(*rows, strict=True)] == list(why.columns())


def test_only_the_nearest_cars_count_and_their_order_does_not(highway: Road) -> None:
    cars = [(300.0 + 7.0 * i, 3.5 * (i % 3), 0.0, 20.0) for i in range(1, 30)]
    scene = observation((300.0, 0.0, 0.0, 25.0), cars)
    near = nearest_cars(scene, 8)
    assert near[:, :4].tolist() == [list(car) for car in sorted(cars, key=distance_to(scene))[:8]]
    assert near[:, 4:].tolist() == [[*CAR, 0.0]] * 8
    assert len(nearest_cars(observation((0.0, 0.0, 0.0, 1.0), cars[:3]), 8)) == 3


def distance_to(scene: Observation) -> Callable[[tuple[float, float, float, float]], float]:
    return lambda car: (car[0] - scene.ego.s) ** 2 + (car[1] - scene.ego.d) ** 2


def test_warm_start_shifts_time_not_controls() -> None:
    controls = np.column_stack((np.arange(10.0), 10.0 + np.arange(10.0)))
    u = shifted(controls)
    assert u[:, 0].tolist() == [*range(1, 10), 9]
    assert u[:, 1].tolist() == [*range(11, 20), 19]


def test_a_problem_that_is_not_a_number_is_refused(highway: Road) -> None:
    planner = CohesivePlanner(SETTINGS, CohesionSettings())
    planner.reset(highway)
    scene = observation((100.0, 0.0, 0.0, 25.0), [])
    problem = planner._problem(scene, (), NOWHERE, None)
    assert planner._mpc is not None
    broken = problem._replace(ego=RoadState(np.nan, 0.0, 0.0, 25.0))
    solution = planner._mpc.solve(broken)
    assert not solution.solved
    assert solution.status == "input is not finite"


def test_a_failed_solve_brakes_in_lane_and_says_so(highway: Road) -> None:
    planner = nominal(highway, max_iterations=1)
    plan = planner.plan(observation((100.0, 0.5, 0.1, 25.0), []), empty_history())
    assert plan.fallback
    assert "returned" in plan.status
    ego = (100.0, 0.5, 0.1, 25.0)
    for _ in range(100):
        scene = observation(ego, [])
        control = fallback(scene, highway, SETTINGS, "test").controls[0]
        ego = dynamics.step(ego, control, 0.1, SETTINGS.friction)
    assert ego[3] == pytest.approx(0.0, abs=1e-6)
    assert abs(ego[1]) < 0.5
    assert abs(ego[2]) < 0.05


def test_planners_by_name() -> None:
    for name in ("nominal", "cohesive", "paper"):
        assert isinstance(make_planner(name, SETTINGS, CohesionSettings()), CohesivePlanner)
    assert isinstance(make_planner("sumo", SETTINGS, CohesionSettings()), SumoDriver)
    paper = make_planner("paper", SETTINGS, CohesionSettings())
    assert isinstance(paper, CohesivePlanner)
    assert paper.cohesion.lateral_votes == "all"
    assert paper.cohesion.interval == 0.1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nominl", "unknown planner 'nominl'"),
        ("no_such_module:Planner", "cannot import 'no_such_module'"),
        ("no_such_module:Planner(2)", "arguments by name"),
        ("no_such_module:Planner(a=b)", "arguments by name"),
        ("no_such_module:Planner(", "unknown planner"),
        ("no_such_module:Planner(a=1)(b=2)", "arguments by name"),
        ("no_such_module:Planner(a={[1]: 2})", "arguments by name"),
        ("no_such_module:Planner(**{'a': 1})", "arguments by name"),
        ("json:Planner", "'json' has no 'Planner'"),
        ("json:JSONDecoder", "needs the methods"),
        ("datetime:datetime", "needs the methods"),
        (
            "sumo_cohesion.planning.planners:SumoDriver(a=1)",
            "cannot be called with these arguments",
        ),
    ],
)
def test_planner_names_that_are_wrong(name: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_planner(name, SETTINGS, CohesionSettings())
