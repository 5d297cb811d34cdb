"""One planning problem and its solution: what crosses the border between planner and solvers."""

from __future__ import annotations

from dataclasses import dataclass

from sumo_cohesion.state import Control, FloatArray

FAR_AWAY = 1e4
"""Metres at which lanes and cars that do not exist are put: their Gaussians are zero there."""


@dataclass(frozen=True)
class Problem:
    """One instance: what changes from step to step. T stages, L lanes, N cars, k features.

    Attributes
    ----------
    ego : (4,) road state.
    ego_width : (1,) m.
    road_curvature : (T,) of the reference line (1/m) at the start of each stage.
    lanes, lane_widths : (L, T) m, at the end of each stage.
    right, left : (T,) m, edges of the drivable strip.
    speed_limit : (T,) m/s.
    cars : (6, N, T), see reward.StageInputs.
    theta : (6,) weights of the reward terms.
    cohesion_weight, cohesion_target : (k, T), beta included; zero weights: not cohesive.
    place_weight, place_target : (T,) per m², beta included, and m: where across the road.
    constraint_weight : (1,) per m beyond a constraint.
    driven : the control of the step before, from which this one's may differ by so much; None if
        there is none to differ from.
    """

    ego: FloatArray
    ego_width: FloatArray
    road_curvature: FloatArray
    lanes: FloatArray
    lane_widths: FloatArray
    right: FloatArray
    left: FloatArray
    speed_limit: FloatArray
    cars: FloatArray
    theta: FloatArray
    cohesion_weight: FloatArray
    cohesion_target: FloatArray
    place_weight: FloatArray
    place_target: FloatArray
    constraint_weight: FloatArray
    driven: Control | None = None


@dataclass(frozen=True)
class Instance:
    """A problem in the solvers' own numbers.

    Attributes
    ----------
    start : (6,) road state and the scaled control of the step before.
    stages : (T, n) parameters of every stage, see stage.StageParameters.
    low, high : (T, 2) bounds on the scaled controls.
    change : (T, 2) bounds on their change from the control before.
    """

    start: FloatArray
    stages: FloatArray
    low: FloatArray
    high: FloatArray
    change: FloatArray


@dataclass(frozen=True)
class Guess:
    """Where a solver starts: states (T + 1, 4), controls (T, 2)."""

    states: FloatArray
    controls: FloatArray


@dataclass(frozen=True)
class Solution:
    """What the solver gave: states (T + 1, 4), controls (T, 2), and how it went.

    ``reward`` holds the weighted terms over the horizon, cohesion included; their sum is what was
    maximised.
    """

    states: FloatArray
    controls: FloatArray
    solved: bool
    status: str
    iterations: int
    wall_time: float
    reward: dict[str, float]
