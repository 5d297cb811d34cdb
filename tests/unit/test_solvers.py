"""The planner's solvers: one objective, four ways, the same answer; safe whatever is asked."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sumo_cohesion.planning.dynamics import step
from sumo_cohesion.planning.problem import FAR_AWAY, Problem, Solution
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers import SOLVERS
from sumo_cohesion.planning.solvers import compiled as compilation
from sumo_cohesion.planning.solvers.ilqr import _box_step, _quadratic
from sumo_cohesion.planning.solvers.mpc import Mpc
from sumo_cohesion.planning.solvers.transcription import Transcription
from sumo_cohesion.planning.stage import UNLIMITED, StageParameters, make_stage
from sumo_cohesion.road import RoadAhead
from sumo_cohesion.state import Control, RoadState
from tests.conftest import ROOT
from tests.waiting import is_running, wait_for

SETTINGS = PlannerSettings()
OPTIONAL = ("curvature_change", "acceleration_change", "net_acceleration")
SMOOTH = PlannerSettings(
    reward=RewardWeights(
        acceleration=0.0, curvature_change=2000.0, acceleration_change=1e-3, net_acceleration=0.01
    )
)
"""With all optional terms."""
LANES = np.array([-3.5, 0.0, 3.5])


def straight_road(horizon: int, curvature: float = 0.0, limit: float = 25.0) -> RoadAhead:
    """Three lanes, with one curvature and speed limit all along."""
    row = (*LANES, 3.5, 3.5, 3.5, limit, curvature)
    return RoadAhead(np.tile(row, (horizon + 1, 1)), np.tile((-5.25, 5.25), (horizon + 1, 1)))


def problem(seed: int, horizon: int = 10, cohesion: float = 1.0) -> Problem:
    """Make a random instance: a road, a few cars, something to follow."""
    rng = np.random.default_rng(seed)
    speed = rng.uniform(0.0, 35.0)
    cars = []
    for _ in range(rng.integers(0, SETTINGS.cars + 1)):
        pace = rng.uniform(0.0, 30.0)
        s = 100.0 + rng.uniform(-60.0, 60.0)
        cars.append((s, rng.choice(LANES) + rng.normal(0.0, 0.5), 0.0, pace, 5.0, 1.8, 0.0))
    weight = cohesion * rng.uniform(0.0, 36.0, 5) * rng.integers(0, 2, 5)
    target = rng.normal(0.0, 0.3, 5) + np.array([0.0, speed / 10.0, 0.0, speed / 10.0, 0.0])
    d, heading = rng.uniform(-4.0, 4.0), rng.normal(0.0, 0.05)
    return Problem(
        ego=RoadState(100.0, d, heading, speed),
        ego_size=(5.0, 1.8),
        road=straight_road(horizon, rng.uniform(-0.003, 0.003)),
        cars=np.array(cars).reshape(-1, 7),
        cohesion_weight=tuple(weight.tolist()),
        cohesion_target=tuple(target.tolist()),
        transitions=1,
        place_weight=np.full(horizon, cohesion * rng.uniform(0.0, 5.0)),
        place_target=np.full(horizon, rng.uniform(-4.0, 4.0)),
        constraint_weight=20.0 * (1.0 + float(weight.sum())),
        theta=SETTINGS.reward.theta,
        driven=Control(rng.uniform(-0.01, 0.01), rng.uniform(-8.0, 4.8)) if seed % 2 else None,
    )


def controllers(planner: PlannerSettings) -> dict[str, Mpc]:
    return {name: Mpc(planner.model_copy(update={"solver": name}), 3) for name in SOLVERS}


SEEDS = [pytest.param(s, marks=[pytest.mark.slow] if s > 4 else []) for s in range(25)]


@pytest.fixture(scope="module")
def solvers() -> dict[str, Mpc]:
    return controllers(SETTINGS)


@pytest.fixture(scope="module")
def smooth_solvers() -> dict[str, Mpc]:
    return controllers(SMOOTH)


@pytest.mark.parametrize("seed", SEEDS)
def test_all_solvers_agree_and_keep_their_promises(solvers: dict[str, Mpc], seed: int) -> None:
    value = {}
    for name, mpc in solvers.items():
        mpc.reset()
        solution = mpc.solve(problem(seed))
        assert solution.status == "solved", name  # by itself: IPOPT has not had to help
        for t, control in enumerate(solution.controls):
            curvature = float(problem(seed).road.rows[t, -1])
            again = step(solution.states[t], control, 0.1, SETTINGS.friction, curvature)
            assert np.array(again) == pytest.approx(solution.states[t + 1], abs=1e-5)
        value[name] = sum(solution.reward.values())
    # From the same start; now and then one of them finds another local optimum.
    scale = 1e-4 * (1.0 + abs(value["ipopt"]))
    others = sorted(v for name, v in value.items() if name != "ilqr")
    assert value["ilqr"] >= others[1] - scale  # no worse than the middle one of the others


@pytest.mark.parametrize("seed", SEEDS)
def test_all_solvers_agree_on_the_optional_terms(smooth_solvers: dict[str, Mpc], seed: int) -> None:
    asked = problem(seed)._replace(theta=SMOOTH.reward.theta)
    found, value = {}, {}
    for name, mpc in smooth_solvers.items():
        mpc.reset()
        found[name] = mpc.solve(asked)
        assert found[name].status == "solved", name
        value[name] = sum(found[name].reward.values())
    scale = 1e-4 * (1.0 + abs(value["ipopt"]))
    for name in ("ilqr", "fatrop"):
        assert value[name] == pytest.approx(value["ipopt"], abs=scale)
        assert found[name].states == pytest.approx(found["ipopt"].states, abs=0.01)
    assert value["lbfgs"] >= value["ipopt"] - scale  # it keeps the first control's rates only
    for solution in found.values():
        expected = optional_terms(asked, solution)
        assert [solution.reward[name] for name in OPTIONAL] == pytest.approx(expected, rel=1e-4)


def optional_terms(asked: Problem, solution: Solution) -> list[float]:
    """Work out what the optional terms are worth, from what is driven; SI units."""
    rates = np.diff(solution.controls, axis=0) / 0.1
    if asked.driven is not None:
        bounded = Transcription(SMOOTH, 3).write(asked)
        assert bounded is not None
        before = bounded.start[4:] * (0.01, 5.0)
        rates = np.vstack(((solution.controls[0] - before) / 0.1, rates))
    gained = np.diff(solution.states[:, 3]) / 0.1
    squares = np.array((*np.sum(rates**2, axis=0), np.sum(gained**2)))
    return [-w * s for w, s in zip(SMOOTH.reward.theta[-3:], squares, strict=True)]


def test_what_has_no_weight_is_no_part_of_the_problem() -> None:
    plain, smooth = (StageParameters(one, 3).sizes for one in (SETTINGS, SMOOTH))
    assert plain["theta"] == 6
    assert smooth == {**plain, "theta": 9}
    for name in OPTIONAL:
        weights = RewardWeights(**{name: 1.0})
        assert weights.in_use == (*SETTINGS.reward.in_use, name)
        assert weights.parts == (*weights.in_use, "cohesion", "constraints")
        assert weights.theta == (*SETTINGS.reward.theta, 1.0)
    # One that is not optional may have none, and stays.
    assert RewardWeights(acceleration=0.0).in_use == SETTINGS.reward.in_use
    for one in (SETTINGS, SMOOTH):
        assert tuple(make_stage(one, StageParameters(one, 3)).terms) == one.reward.parts


def test_where_nothing_was_driven_before_no_change_costs() -> None:
    transcription, asked = Transcription(SMOOTH, 3), problem(7)
    theta = SMOOTH.reward.theta
    asked = asked._replace(theta=theta)
    columns = StageParameters(SMOOTH, 3).columns("theta")
    for driven, first in (
        (None, (*theta[:6], 0.0, 0.0, theta[8])),
        (Control(0.0, 0.0), theta),
    ):
        instance = transcription.write(asked._replace(driven=driven))
        assert instance is not None
        rows = instance.stages[:, columns]
        assert rows[0].tolist() == list(first)
        assert (rows[1:] == theta).all()


def test_acceleration_net_of_friction_needs_a_friction_that_leaves_some() -> None:
    weights = RewardWeights(net_acceleration=1.0)
    assert PlannerSettings(friction=9.9, reward=weights).friction == 9.9
    assert PlannerSettings(friction=10.0).friction == 10.0
    with pytest.raises(ValueError, match="net_acceleration needs a friction below 10 1/s, not 10"):
        PlannerSettings(friction=10.0, reward=weights)


@pytest.mark.parametrize("planner", [SETTINGS, SMOOTH], ids=["plain", "smooth"])
def test_the_quadratic_model_is_that_of_the_cost(planner: PlannerSettings) -> None:
    """Put together by the chain rule, it is what derivatives of the whole expression are."""
    stage = make_stage(planner, StageParameters(planner, 3))
    z = ca.vertcat(stage.state, stage.control)
    price, curved = ca.SX.sym("price", 6), ca.SX.sym("curved", 6, 6)
    exact = _quadratic(stage, price, curved, exact=True)
    squares = _quadratic(stage, price, curved, exact=False)
    cost, residuals, weights = stage.landed(stage.cost, stage.residuals, stage.residual_weights)
    move, rows = ca.jacobian(stage.next_state, z), ca.jacobian(residuals, z)
    beyond = move.T @ curved @ move
    hessian, gradient = ca.hessian(cost + ca.dot(price, stage.next_state), z)
    semidefinite = rows.T @ (ca.repmat(weights, 1, 8) * rows)
    expected = [gradient, hessian + beyond, gradient, semidefinite + beyond]
    inputs = [z, stage.parameters, price, curved]
    found, expected = (ca.Function("f", inputs, each) for each in ([*exact, *squares], expected))
    transcription = Transcription(planner, 3)
    for seed in range(30):
        asked = problem(seed)._replace(theta=planner.reward.theta)
        instance = transcription.write(asked)
        assert instance is not None
        rng = np.random.default_rng(seed)
        root = rng.normal(size=(6, 6))
        where = np.concatenate((asked.ego, rng.normal(size=4)))
        numbers = where, instance.stages[1], rng.normal(size=6), root @ root.T
        both = [[np.asarray(value) for value in f(*numbers)] for f in (found, expected)]
        for ours, whole in zip(*both, strict=True):
            assert ours == pytest.approx(whole, abs=1e-9 * (1.0 + np.abs(whole).max()))


@pytest.mark.parametrize("planner", [SETTINGS, SMOOTH], ids=["plain", "smooth"])
def test_squares_have_the_gradient_of_the_cost_and_are_never_negative(
    planner: PlannerSettings,
) -> None:
    parameters = StageParameters(planner, 3)
    stage = make_stage(planner, parameters)
    z = ca.vertcat(stage.state, stage.control)
    cost, residuals = stage.landed(stage.cost, stage.residuals)
    (weights,) = stage.landed(stage.residual_weights)
    jacobian = ca.jacobian(residuals, z)
    function = ca.Function(
        "gradients",
        [z, stage.parameters],
        [ca.gradient(cost, z), jacobian.T @ (weights * residuals), weights],
    )
    transcription = Transcription(planner, 3)
    for seed in range(50):
        asked = problem(seed)._replace(theta=planner.reward.theta)
        instance = transcription.write(asked)
        assert instance is not None
        control = np.random.default_rng(seed).normal(size=4)
        exact, squares, weights = (
            np.asarray(value).ravel()
            for value in function(np.concatenate((asked.ego, control)), instance.stages[0])
        )
        assert squares == pytest.approx(exact, abs=1e-9 * (1.0 + np.abs(exact).max()))
        assert (weights >= 0.0).all()


def part(rows: np.ndarray, name: str) -> np.ndarray:
    """Columns of a stage's parameters, (T, size)."""
    return rows[:, StageParameters(SETTINGS, 3).columns(name)]


def test_what_solvers_read_is_what_is_known() -> None:
    transcription, asked = Transcription(SETTINGS, 3), problem(7)
    car = (130.0, 3.0, 0.1, 20.0, 12.0, 2.4, 0.004)
    road = straight_road(10)
    road.rows[:, 0], road.rows[3:, -2], road.rows[:, -1] = np.inf, 30.0, 0.001 * np.arange(11)
    asked = asked._replace(cars=np.array([car]), road=road, transitions=4)
    instance = transcription.write(asked)
    assert instance is not None
    rows, time = instance.stages, 0.1 * np.arange(1, 11)
    cars = part(rows, "cars").reshape(10, SETTINGS.cars, 6)
    along = 20.0 * np.cos(0.1) / (1.0 - 0.004 * 3.0)
    assert cars[:, 0, 0] == pytest.approx(130.0 + along * time)
    assert cars[:, 0, 1] == pytest.approx(3.0 + 20.0 * np.sin(0.1) * time)
    assert cars[0, 0, 2:] == pytest.approx([np.cos(0.1), np.sin(0.1), 8.5, 2.1])
    assert (cars[:, 1:, 0] == FAR_AWAY).all()
    lanes = part(rows, "lanes")
    assert (lanes[:, 0] == FAR_AWAY).all()
    assert (lanes[:, 1:] == LANES[1:]).all()
    # A stage is judged where it ends, and begins in the bend that is there.
    assert part(rows, "speed_limit").ravel().tolist() == [25.0] * 2 + [30.0] * 8
    assert part(rows, "road_curvature").ravel() == pytest.approx(0.001 * np.arange(10))
    weights = part(rows, "cohesion_weight")
    assert (weights[:4] == asked.cohesion_weight).all()
    assert (weights[4:] == 0.0).all()
    assert instance.start[:4].tolist() == list(asked.ego)


def test_more_cars_than_the_settings_count_are_left_out() -> None:
    transcription = Transcription(SETTINGS, 3)
    cars = np.array([(110.0 + 10.0 * i, 0.0, 0.0, 20.0, 5.0, 1.8, 0.0) for i in range(12)])
    instance = transcription.write(problem(7)._replace(cars=cars))
    assert instance is not None
    written = part(instance.stages, "cars").reshape(10, SETTINGS.cars, 6)
    assert written[0, :, 0] == pytest.approx(cars[:8, 0] + 2.0)


def test_the_change_of_the_first_control_is_bounded_if_one_was_driven() -> None:
    transcription, asked = Transcription(SETTINGS, 3), problem(7)
    ego = RoadState(100.0, 0.0, 0.0, 20.0)
    free = transcription.write(asked._replace(ego=ego, driven=None))
    assert free is not None
    assert (free.change[0] == UNLIMITED).all()
    assert (free.start[4:] == 0.0).all()
    most = 0.1 * SETTINGS.max_curvature_rate / 0.01, 0.1 * SETTINGS.max_jerk / 5.0
    assert free.change[1] == pytest.approx(most)
    bound = transcription.write(asked._replace(ego=ego, driven=Control(0.002, -50.0)))
    assert bound is not None
    assert bound.change[0] == pytest.approx(most)
    # Braking harder than is allowed now would leave nothing to choose.
    hardest = SETTINGS.friction * 20.0 - SETTINGS.max_braking
    assert bound.start[4:] == pytest.approx([0.2, hardest / 5.0])


def test_what_cannot_be_a_solution_is_found_out() -> None:
    transcription, asked = Transcription(SETTINGS, 3), problem(7)
    mpc = Mpc(SETTINGS, 3)
    good = mpc.solve(asked)
    assert transcription.write(asked) is not None
    assert transcription.is_solution(good)
    states, controls = good.states, good.controls
    wrong = np.zeros_like(states)
    for row in (0, 1):
        for column in range(4):
            wrong[:] = 0.0
            wrong[row, column] = 0.002
            assert not transcription.is_solution(good._replace(states=states + wrong))
    for value in (np.nan, np.inf, 0.02):
        for row in (0, 9):
            broken = controls.copy()
            broken[row, 0] = value
            assert not transcription.is_solution(good._replace(controls=broken))
    for value in (np.nan, np.inf, -np.inf):
        broken = states.copy()
        broken[7, 1] = value
        assert not transcription.is_solution(good._replace(states=broken))
    assert not transcription.is_solution(good._replace(states=states[:-1]))
    assert not transcription.is_solution(good._replace(controls=controls[:-1]))


def test_the_box_problem_is_solved_exactly() -> None:
    h, g = ca.SX.sym("h", 2, 2), ca.SX.sym("g", 2)
    low, high = ca.SX.sym("low", 2), ca.SX.sym("high", 2)
    function = ca.Function("box", [h, g, low, high], [_box_step(h, g, low, high)[0]])
    rng = np.random.default_rng(2)
    for _ in range(200):
        root = rng.normal(size=(2, 2))
        hessian, gradient = root @ root.T + 0.01 * np.eye(2), rng.normal(size=2) * 3.0
        lower, upper = -rng.uniform(0.0, 2.0, 2), rng.uniform(0.0, 2.0, 2)
        step = np.asarray(function(hessian, gradient, lower, upper)).ravel()
        assert (step >= lower - 1e-12).all()
        assert (step <= upper + 1e-12).all()

        def value(u: np.ndarray) -> np.ndarray:
            """Values of the points of the last axis."""
            return 0.5 * np.sum(u * (u @ hessian), axis=-1) + u @ gradient  # noqa: B023

        sides = [np.linspace(a, b, 41) for a, b in zip(lower, upper, strict=True)]
        grid = np.stack(np.meshgrid(*sides), axis=-1)
        assert value(step) <= value(grid).min() + 1e-12


@pytest.mark.slow
def test_bounds_hold_whatever_is_asked(solvers: dict[str, Mpc]) -> None:
    solved: list[bool] = []

    @settings(max_examples=settings().max_examples * 4)
    @given(
        seed=st.integers(0, 10**6),
        cohesion=st.sampled_from([0.0, 1.0, 1e3, 1e6]),
        d=st.floats(-20.0, 20.0),
        heading=st.floats(-1.5, 1.5),
        speed=st.floats(0.0, 60.0),
        driven=st.none() | st.tuples(st.floats(-0.01, 0.01), st.floats(-8.0, 10.0)),
    )
    def ask(
        seed: int,
        cohesion: float,
        d: float,
        heading: float,
        speed: float,
        driven: tuple[float, float] | None,
    ) -> None:
        instance = problem(seed, cohesion=cohesion)
        last = None if driven is None else Control(*driven)
        instance = instance._replace(ego=RoadState(100.0, d, heading, speed), driven=last)
        mpc = solvers["ilqr"]
        mpc.reset()
        solution = mpc.solve(instance)
        solved.append(solution.solved)
        if not solution.solved:
            assert "returned" in solution.status  # the planner then brakes in lane
            return
        assert np.isfinite(solution.states).all()
        hold_limits(solution, instance)

    ask()
    assert np.mean(solved) > 0.9  # or nothing has been shown


def hold_limits(solution: Solution, instance: Problem) -> None:
    """Assert that every control of a solution keeps to every limit, the interior point's hair."""
    speed = instance.ego.speed
    curvature, acceleration = solution.controls.T
    assert np.abs(curvature).max() <= SETTINGS.max_curvature + 1e-9
    aside = np.abs(curvature) * solution.states[1:, 3] ** 2
    assert aside.max() <= SETTINGS.max_lateral_acceleration * (1.0 + 1e-6) + 1e-6
    drag = SETTINGS.friction * speed
    stops = acceleration * 0.1 <= -solution.states[:-1, 3] * (1.0 - SETTINGS.friction * 0.1) + 1e-6
    assert (acceleration >= drag - SETTINGS.max_braking - 1e-6)[~stops].all()
    assert acceleration.max() <= drag + SETTINGS.max_acceleration + 1e-6
    assert solution.states[:, 3].min() >= -1e-6  # what IPOPT, which rescues, calls zero
    before = curvature[:1], acceleration[:1]
    if instance.driven is not None:
        sharpest = SETTINGS.sharpest(speed + 0.1 * SETTINGS.max_acceleration)
        low = -sharpest, drag - SETTINGS.max_braking
        last = np.clip(instance.driven, low, (sharpest, drag + SETTINGS.max_acceleration))
        before = last[:1], last[1:]
    turned = np.abs(np.diff(np.concatenate((before[0], curvature))))
    assert turned.max() <= 0.1 * SETTINGS.max_curvature_rate + 1e-7
    change = np.diff(np.concatenate((before[1], acceleration)))
    assert change.min() >= -0.1 * SETTINGS.max_jerk - 1e-5
    assert (change <= 0.1 * SETTINGS.max_jerk + 1e-5)[~stops].all()


@pytest.mark.parametrize("name", ["ilqr", "fatrop", "ipopt"])
def test_tight_rates_bind_and_hold(name: str) -> None:
    tight = SETTINGS.model_copy(
        update={"solver": name, "max_jerk": 10.0, "max_curvature_rate": 0.005}
    )
    mpc, bound = Mpc(tight, 3), 0
    for seed in range(1, 21, 2):
        mpc.reset()
        instance = problem(seed)._replace(driven=Control(0.0, 0.0))
        solution = mpc.solve(instance)
        assert solution.status == "solved"
        both = np.vstack((np.zeros(2), solution.controls))
        turned = np.abs(np.diff(both[:, 0])).max()
        assert turned <= 0.0005 + 1e-8
        stands = solution.states[:-1, 3] < 1.0
        assert (np.abs(np.diff(both[:, 1]))[~stands] <= 1.0 + 1e-5).all()
        bound += turned > 0.000499
    assert bound >= 5


@pytest.mark.parametrize("cohesion", [1.0, 1e3, 1e6])
def test_no_cohesion_buys_leaving_the_road(cohesion: float) -> None:
    mpc = Mpc(SETTINGS, 3)
    instance = problem(3, cohesion=cohesion)
    pull = 36.0 * cohesion
    instance = instance._replace(
        ego=RoadState(100.0, 4.0, 0.0, 25.0),
        cars=np.zeros((0, 7)),
        cohesion_weight=(pull, 0.0, pull, 0.0, pull),  # turn left, hard
        cohesion_target=(1.0,) * 5,
        place_weight=np.full(10, cohesion),
        place_target=np.full(10, 8.0),
        constraint_weight=20.0 * (1.0 + 3.0 * pull + 10.0 * cohesion * 3.5**2),
        road=straight_road(10),
        driven=None,
    )
    solution = mpc.solve(instance)
    assert solution.solved
    assert (solution.states[:, 1] + 0.9).max() <= 5.25 + 0.05


def test_a_car_that_has_to_stop_stops(solvers: dict[str, Mpc]) -> None:
    instance = problem(0, cohesion=0.0)._replace(
        ego=RoadState(100.0, 0.0, 0.0, 2.0),
        road=straight_road(10, limit=0.0),
        cars=np.array([[106.5, 0.0, 0.0, 0.0, 5.0, 1.8, 0.0]]),
        place_weight=np.zeros(10),
    )
    speeds = {}
    for name in ("ilqr", "ipopt"):
        solvers[name].reset()
        solution = solvers[name].solve(instance)
        assert solution.solved
        speeds[name] = solution.states[:, 3]
        assert speeds[name][-1] == pytest.approx(0.0, abs=1e-3)
        assert speeds[name].min() >= -1e-6
    assert speeds["ilqr"] == pytest.approx(speeds["ipopt"], abs=1e-2)


CODE = """
import sys, numpy as np
from tests.unit.test_solvers import problem, SETTINGS
from sumo_cohesion.planning.solvers.mpc import Mpc
mpc = Mpc(SETTINGS, 3)
print(mpc.solver.how)
for seed in range(20):
    s = mpc.solve(problem(seed))
    sys.stdout.write(s.states.tobytes().hex() + s.controls.tobytes().hex() + "\\n")
"""


def plans(**environment: str) -> tuple[str, str]:
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    how, _, rest = done.stdout.partition("\n")
    return how, rest


@pytest.mark.slow
def test_compiled_or_not_the_plans_are_the_same_bit_for_bit(tmp_path: Path) -> None:
    if compilation.find_compiler() is None:
        pytest.skip("no C compiler here")
    how, fast = plans(XDG_CACHE_HOME=str(tmp_path))
    assert how == "compiled"
    assert (
        len(list((tmp_path / "sumo-cohesion").glob("*.so"))) == 2
    )  # the solver, the transcription
    how, slow = plans(SUMO_COHESION_COMPILE="0")
    assert how == "not compiled: SUMO_COHESION_COMPILE is 0"
    assert fast == slow


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"PATH": "/nonexistent", "CC": ""}, "no C compiler"),
        ({"PATH": "/nonexistent", "CC": "/bin/false"}, "/bin/false failed"),
        ({"XDG_CACHE_HOME": "/proc/no/such/folder"}, "No such file"),
    ],
)
def test_without_a_working_compiler_it_plans_all_the_same(
    environment: dict[str, str], said: str, tmp_path: Path
) -> None:
    if "XDG_CACHE_HOME" in environment and compilation.find_compiler() is None:
        pytest.skip("no C compiler here")
    how, rest = plans(**{"XDG_CACHE_HOME": str(tmp_path), **environment})
    assert how.startswith("not compiled: ")
    assert said in how
    assert len(rest.splitlines()) == 20


BLOCKED_COMPILER = """#!/bin/sh
sleep 1000000 &
echo $! > "$0.new"
mv "$0.new" "$0.child"
wait
"""
"""Compiles with a program of its own, for ever."""


@pytest.fixture
def blocked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Make that the C compiler; the file in which the number of its child will be."""
    compiler = tmp_path / "cc"
    compiler.write_text(BLOCKED_COMPILER)
    compiler.chmod(0o755)
    for name, value in (("CC", compiler), ("XDG_CACHE_HOME", tmp_path)):
        monkeypatch.setenv(name, str(value))
    monkeypatch.delenv(compilation.SWITCH, raising=False)
    child = tmp_path / "cc.child"
    yield child
    if child.exists() and is_running(int(child.read_text())):
        os.kill(int(child.read_text()), signal.SIGKILL)


def a_function() -> ca.Function:
    x = ca.SX.sym("x")
    return ca.Function("twice", [x], [2.0 * x])


@pytest.mark.slow
def test_a_compiler_that_is_given_up_ends_with_all_that_it_started(
    blocked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    patience = 0.1
    while not blocked.exists():  # it has been given up before it had a child
        patience *= 2.0
        monkeypatch.setattr(compilation, "_PATIENCE", patience)
        functions, how = compilation.compiled([a_function()])
        compiler = blocked.with_suffix("")
        assert how == f"not compiled: {compiler} was given up after {patience:g} s"
        assert float(functions[0](3.0)) == 6.0
    wait_for(lambda: not is_running(int(blocked.read_text())), what="the end of its child")


@pytest.mark.slow
def test_a_compiler_that_is_interrupted_ends_with_all_that_it_started(
    blocked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        wait_for(blocked.exists, what="its child")
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess.Popen, "communicate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        compilation.compiled([a_function()])
    wait_for(lambda: not is_running(int(blocked.read_text())), what="the end of its child")


@pytest.mark.slow
def test_many_processes_compile_once(tmp_path: Path) -> None:
    if compilation.find_compiler() is None:
        pytest.skip("no C compiler here")
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    code = CODE.replace("range(20)", "range(1)")
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(4)
    ]
    said = [process.communicate()[0] for process in processes]
    assert all(text.startswith("compiled") for text in said)
    assert len(set(said)) == 1
    assert (
        len(list((tmp_path / "sumo-cohesion").glob("*.so"))) == 2
    )  # the solver, the transcription
