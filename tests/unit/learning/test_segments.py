"""Examples as instances of the planner's problem: what is dropped, and what bounds leave free."""

from __future__ import annotations

import numpy as np
import pytest

from sumo_cohesion.learning.likelihood import quadratics
from sumo_cohesion.learning.segments import (
    Segments,
    free_directions,
    make_segments,
    problem_of,
)
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.mpc import Mpc
from sumo_cohesion.planning.stage import CONTROL_SCALE, StageParameters
from sumo_cohesion.state import Control, FloatArray, RoadState
from tests.unit.learning.making import LIMIT, example, straight

STEPS = 5
SETTINGS = PlannerSettings(horizon=STEPS, cars=2)
SHAPE = SETTINGS.model_copy(update={"reward": RewardWeights().shape})
STILL = np.tile([0.0, 1.9], (STEPS, 1))


def segments_of(*controls: FloatArray, bounded: bool = True) -> Segments:
    return make_segments([example(c, bounded=bounded) for c in controls], SHAPE)


def test_without_bounds_all_directions_are_free() -> None:
    basis, free = free_directions(segments_of(STILL))
    assert free.all()
    assert np.array_equal(basis[0], np.eye(2 * STEPS))


def with_bounds(segments: Segments, **bounds: FloatArray) -> Segments:
    arrays = {name: getattr(segments, name).copy() for name in ("low", "high", "change")}
    for name, (stage, control, value) in bounds.items():  # type: ignore[misc]
        arrays[name][0, stage, control] = value
    fields = {name: getattr(segments, name) for name in segments.__dataclass_fields__}
    return Segments(**(fields | arrays))


def test_a_control_at_its_own_bound_is_not_free() -> None:
    segments = segments_of(STILL)
    u = segments.controls[0]
    for name in ("low", "high"):
        held = with_bounds(segments, **{name: (2, 1, u[2, 1])})  # type: ignore[arg-type]
        basis, free = free_directions(held)
        assert basis[0].T @ basis[0] == pytest.approx(np.eye(2 * STEPS), abs=1e-12)
        assert free[0].sum() == 2 * STEPS - 1
        assert basis[0][5, free[0]] == pytest.approx(np.zeros(9), abs=1e-12)


def test_controls_at_the_bound_of_their_change_are_free_together() -> None:
    segments = segments_of(STILL)
    u = segments.controls[0]
    held = with_bounds(segments, change=(3, 0, abs(u[3, 0] - u[2, 0])))  # type: ignore[arg-type]
    basis, free = free_directions(held)
    assert free[0].sum() == 2 * STEPS - 1
    # What is free changes both curvatures by the same.
    assert basis[0][6, free[0]] == pytest.approx(basis[0][4, free[0]], abs=1e-12)
    assert np.abs(basis[0][6, free[0]]).max() > 0.1


def test_the_first_control_is_bounded_by_the_one_driven_before() -> None:
    segments = segments_of(STILL)
    step = abs(segments.controls[0, 0, 1] - segments.start[0, 5])
    basis, free = free_directions(with_bounds(segments, change=(0, 1, step)))  # type: ignore[arg-type]
    assert free[0].sum() == 2 * STEPS - 1
    assert basis[0][1, free[0]] == pytest.approx(np.zeros(9), abs=1e-12)


def test_bounds_that_say_the_same_are_one() -> None:
    segments = segments_of(STILL)
    u = segments.controls[0]
    held = with_bounds(segments, low=(2, 1, u[2, 1]), high=(2, 1, u[2, 1]))  # type: ignore[arg-type]
    assert free_directions(held)[1][0].sum() == 2 * STEPS - 1


@pytest.mark.parametrize(
    ("ego", "before"),
    [
        (RoadState(50.0, 1.75, 0.0, 12.0), Control(0.0, 1.2)),  # far below the limit: accelerates
        (RoadState(50.0, 3.2, 0.0, 19.0), Control(0.0, 1.9)),  # beside its lane: steers
        (RoadState(50.0, 1.75, 0.0, 29.0), None),  # far above the limit: brakes
    ],
)
def test_a_plan_at_its_bounds_has_no_gradient_in_what_is_free(
    ego: RoadState, before: Control | None
) -> None:
    settings = SETTINGS.model_copy(
        update={
            "max_acceleration": 1.0,
            "max_curvature_rate": 0.005,
            "max_jerk": 20.0,
            "max_braking": 2.0,
        }
    )
    shape = settings.model_copy(update={"reward": RewardWeights().shape})
    blank = example(STILL, ego, before=before, bounded=True)
    solution = Mpc(settings, 2).solve(problem_of(blank, settings, 2))
    assert solution.solved
    segments = make_segments([blank._replace(states=solution.states[1:])], shape)
    assert segments.dropped.tolist() == [""]
    assert segments.controls[0] * CONTROL_SCALE == pytest.approx(solution.controls, abs=1e-9)
    data, theta = quadratics(segments, shape), np.array(RewardWeights().theta)
    assert data.fixed.any()
    free = ~free_directions(segments)[1]
    assert np.array_equal(data.fixed, free)
    reduced = np.abs(theta @ data.gradient[0])
    full = quadratics(
        with_unbounded(segments),
        shape,
    )
    assert np.abs(theta @ full.gradient[0]).max() > 1e-3  # the bound does hold it
    assert reduced.max() < 1e-4 * np.abs(theta @ full.gradient[0]).max()
    assert (data.gradient[0][:, data.fixed[0]] == 0.0).all()
    assert (data.curvature[0][:, data.fixed[0]] == 0.0).all()
    # What is left is the curvature in the free directions, no more and no less.
    basis, _ = free_directions(segments)
    z = basis[0][:, ~data.fixed[0]]
    expected = z.T @ np.einsum("k,kij->ij", theta, full.curvature[0]) @ z
    found = np.einsum("k,kij->ij", theta, data.curvature[0])[~data.fixed[0]][:, ~data.fixed[0]]
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


def with_unbounded(segments: Segments) -> Segments:
    far = np.full_like(segments.low, 1e6)
    fields = {name: getattr(segments, name) for name in segments.__dataclass_fields__}
    return Segments(**(fields | {"low": -far, "high": far, "change": far}))


def test_why_a_segment_is_dropped() -> None:
    slow = RoadState(50.0, 1.75, 0.0, 1.9)
    examples = [
        example(STILL, bounded=True),
        example(STILL, unusable="cohesion had a part in it"),
        example(STILL)._replace(states=np.full((STEPS, 4), np.nan)),
        example(0.1 * STILL, slow),
        example(STILL * [1.0, 10.0], bounded=True),
        example(STILL * [1.0, 10.0], bounded=False),
        example(STILL)._replace(ego=RoadState(50.0, 2.0, 0.0, 0.0), states=np.zeros((STEPS, 4))),
        example(STILL, cars=np.full((1, 7), np.nan)),
    ]
    assert make_segments(examples, SHAPE).dropped.tolist() == [
        "",
        "cohesion had a part in it",
        "not finite",
        "slower than 2 m/s",
        "beyond the planner's bounds",
        "",
        "slower than 2 m/s",
        "not finite",
    ]


def test_a_drivers_own_speed_stands_for_the_limit() -> None:
    """In what is learned, and in what is predicted."""
    layout = StageParameters(SHAPE, 2)
    one, own = example(STILL), example(STILL)._replace(desired_speed=15.0)
    found = make_segments([one, own], SHAPE).stages[:, :, layout.columns("speed_limit")]
    assert (found[0] == LIMIT).all()
    assert (found[1] == 15.0).all()
    assert (problem_of(own, SHAPE, 2).road.rows[:, -2] == 15.0).all()
    assert (problem_of(one, SHAPE, 2).road.rows[:, -2] == LIMIT).all()
    solution = Mpc(SETTINGS, 2).solve(problem_of(own, SETTINGS, 2))
    assert solution.states[-1, 3] < own.ego.speed - 0.05


def test_roads_with_fewer_lanes_have_none_where_others_have_some() -> None:
    both = [example(STILL, road=straight(1)), example(STILL, road=straight(3))]
    layout = StageParameters(SHAPE, 3)
    found = make_segments(both, SHAPE).stages[:, 0, layout.columns("lanes")]
    assert found[0].tolist() == [1.75, 1e4, 1e4]
    assert found[1].tolist() == [1.75, 5.25, 8.75]
