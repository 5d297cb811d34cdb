"""Examples as instances of the planner's problem, with the controls that were chosen in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from sumo_cohesion.learning.example import Example
from sumo_cohesion.learning.motion import controls
from sumo_cohesion.planning.problem import Problem
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.compiled import BUILDING
from sumo_cohesion.planning.solvers.transcription import Transcription
from sumo_cohesion.planning.stage import CONTROL_SCALE, UNLIMITED, StageParameters
from sumo_cohesion.road import RoadAhead
from sumo_cohesion.social.features import FEATURES
from sumo_cohesion.state import STEP, BoolArray, Control, FloatArray

SLOWEST = 2.0
"""Speed (m/s) below which standing still bounds the control, and curvature says little."""
RAILS = 0.005
"""Metres across the road within a segment up to which a human is on rails: SUMO's drivers follow
their lane exactly, and steer only to change it."""
_NOT_DRIVEN = Control(0.0, 0.0)
_HAIR = 1e-6
"""Scaled control within which a bound counts as reached."""


@dataclass(frozen=True)
class Segments:
    """N segments of T steps: arrays with a row each.

    Attributes
    ----------
    run, vehicle : (N,) whose; time (N,) s, when it began.
    start : (N, 6) state and scaled control before, as in stage.Stage.
    stages : (N, T, P) parameters of every stage, see stage.StageParameters.
    states : (N, T, 4) where each step led; controls : (N, T, 2) scaled.
    low, high, change : (N, T, 2) bounds on the controls and on their change, scaled.
    dropped : (N,) why a segment cannot be an optimum of the planner's problem; "" if it can.
    """

    run: NDArray[np.object_]
    vehicle: NDArray[np.object_]
    time: FloatArray
    start: FloatArray
    stages: FloatArray
    states: FloatArray
    controls: FloatArray
    low: FloatArray
    high: FloatArray
    change: FloatArray
    dropped: NDArray[np.object_]

    def __len__(self) -> int:
        return len(self.run)

    def where(self, chosen: BoolArray | slice) -> Segments:
        """Return some of them."""
        return Segments(**{f.name: getattr(self, f.name)[chosen] for f in fields(self)})

    def drop(self, which: BoolArray, reason: str) -> Segments:
        """Give a reason to some of those that have none yet."""
        dropped = np.where(which & (self.dropped == ""), reason, self.dropped)
        return replace(self, dropped=dropped)


def make_segments(examples: Sequence[Example], settings: PlannerSettings) -> Segments:
    """Write every example as an instance of the planner's problem.

    The road, the cars and their prediction are the planner's own (solvers.transcription).
    ``settings.horizon`` is the examples' number of steps; ``settings.reward`` has a weight of one
    for every term in use.
    """
    n_lanes = max((e.road.lane_centre.shape[1] for e in examples), default=1)
    with BUILDING:
        layout, writer = StageParameters(settings, n_lanes), Transcription(settings, n_lanes)
    bends = layout.columns("road_curvature")
    n, steps = len(examples), settings.horizon
    start, stages = np.zeros((n, 6)), np.zeros((n, steps, layout.size))
    low, high, change = (np.zeros((n, steps, 2)) for _ in range(3))
    states = np.zeros((n, steps + 1, 4))
    reason = np.array([e.unusable for e in examples], dtype=object)
    for i, example in enumerate(examples):
        if example.unusable:
            continue
        instance = writer.write(problem_of(example, settings, n_lanes))
        if instance is None or not np.isfinite(example.states).all():
            reason[i] = "not finite"
            continue
        start[i], stages[i] = instance.start, instance.stages
        low[i], high[i], change[i] = instance.low, instance.high, instance.change
        states[i, 0], states[i, 1:] = example.ego, example.states
        if not example.bounded:
            low[i], high[i], change[i] = -UNLIMITED, UNLIMITED, UNLIMITED
            # The control before is what it was, not what the planner's bounds would have left.
            start[i, 4:] = np.array(example.driven or _NOT_DRIVEN) / CONTROL_SCALE
    driven = controls(states, stages[:, :, bends.start], STEP, settings.friction) / CONTROL_SCALE
    lost = (reason == "") & ~np.isfinite(driven).all(axis=(1, 2))
    reason[lost | (states[:, :, 3] < SLOWEST).any(axis=1) & (reason == "")] = "slower than 2 m/s"
    driven[~np.isfinite(driven)] = 0.0
    beyond = (driven < low - _HAIR) | (driven > high + _HAIR)
    before = np.concatenate((start[:, None, 4:], driven[:, :-1]), axis=1)
    outside = (beyond | (np.abs(driven - before) > change + _HAIR)).any(axis=(1, 2))
    # Who does not leave the lane by a hair has chosen nothing across the road.
    rails = ~np.array([e.bounded for e in examples], dtype=bool)
    rails &= np.ptp(states[:, :, 1], axis=1) < RAILS
    low[rails, :, 0] = high[rails, :, 0] = driven[rails, :, 0]
    return Segments(
        run=np.array([e.run for e in examples], dtype=object),
        vehicle=np.array([e.vehicle for e in examples], dtype=object),
        time=np.array([e.time for e in examples], dtype=float),
        start=start,
        stages=stages,
        states=states[:, 1:],
        controls=driven,
        low=low,
        high=high,
        change=change,
        dropped=reason,
    ).drop(outside, "beyond the planner's bounds")


def problem_of(example: Example, settings: PlannerSettings, n_lanes: int) -> Problem:
    """Return the problem that the nominal planner would have had.

    The speed that the driver would like to drive is to it what the limit is to a planner.
    """
    steps, ego = settings.horizon, example.ego
    nothing, nowhere = (0.0,) * len(FEATURES), np.zeros(steps)
    return Problem(
        ego=ego,
        ego_size=example.ego_size,
        road=_known_to(example, n_lanes, steps),
        cars=example.cars[: settings.cars],
        cohesion_weight=nothing,
        cohesion_target=nothing,
        transitions=0,
        place_weight=nowhere,
        place_target=nowhere,
        constraint_weight=1.0,
        theta=settings.reward.theta,
        driven=example.driven,
    )


def _known_to(example: Example, n_lanes: int, steps: int) -> RoadAhead:
    """Return the road ahead as its driver sees it, with the speed that it would like to drive.

    Lanes that the road does not have are infinitely far and 1 m wide.
    """
    ego = example.ego
    ahead = example.road.ahead(ego.s, ego.d, STEP * ego.speed, steps + 1)
    have, n = (ahead.rows.shape[1] - 2) // 2, len(ahead.rows)
    centres, widths, rest = np.split(ahead.rows, [have, 2 * have], axis=1)
    if example.desired_speed is not None:
        rest = np.column_stack((np.full(n, example.desired_speed), rest[:, 1]))
    none = np.full((n, n_lanes - have), np.inf)
    return RoadAhead(np.hstack((centres, none, widths, np.ones_like(none), rest)), ahead.edges)


def free_directions(segments: Segments) -> tuple[FloatArray, BoolArray]:
    """Directions in which the controls could be changed within their bounds.

    An optimum at a bound need not be one without it: gradient and curvature count in the null
    space of the active bounds' normals. A bound on the change ties two stages together.

    Returns
    -------
    basis : (N, 2 T, 2 T), orthonormal columns; free : (N, 2 T), which of them are free.
    """
    n, steps, _ = segments.controls.shape
    size = 2 * steps
    basis, free = np.tile(np.eye(size), (n, 1, 1)), np.ones((n, size), dtype=bool)
    u = segments.controls
    before = np.concatenate((segments.start[:, None, 4:], u[:, :-1]), axis=1)
    at_bound = (np.abs(u - segments.low) < _HAIR) | (np.abs(u - segments.high) < _HAIR)
    at_change = np.abs(np.abs(u - before) - segments.change) < _HAIR
    for i in np.flatnonzero((at_bound | at_change).any(axis=(1, 2))):
        normals = np.eye(size)[at_bound[i].ravel()]
        ties = np.flatnonzero(at_change[i].ravel())
        steps_apart = np.eye(size)[ties] - np.eye(size, k=-2)[ties]
        normals = np.concatenate((normals, steps_apart))
        _, strengths, directions = np.linalg.svd(normals)
        rank = int((strengths > 1e-9).sum())
        basis[i] = np.concatenate((directions[rank:], directions[:rank])).T
        free[i, size - rank :] = False
    return basis, free
