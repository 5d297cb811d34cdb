"""One planning problem and its solution: what crosses the border between planner and solvers.

Named tuples, which are made faster than frozen dataclasses: every plan makes two.
"""

from __future__ import annotations

from typing import NamedTuple

from sumo_cohesion.road import RoadAhead
from sumo_cohesion.state import Control, FloatArray, RoadState

FAR_AWAY = 1e4
"""Metres at which lanes and cars that do not exist are put: their Gaussians are zero there."""


class Problem(NamedTuple):
    """One instance: what changes from step to step. T stages, k features.

    Attributes
    ----------
    ego : road state.
    ego_size : length, width (m).
    road : the road at the ego, and at the end of each of the T stages if it keeps its speed.
    cars : (n, 7) the nearest others, of which the settings' number count: s, d (m), heading (rad),
        speed (m/s), length, width (m), curvature of the reference line beside it (1/m).
    cohesion_weight, cohesion_target : k each, beta included; zero weights: not cohesive.
    transitions : on how many of the stages, from the first, cohesion acts.
    place_weight, place_target : (T,) per m², beta included, and m: where across the road.
    constraint_weight : per m beyond a constraint.
    theta : weights of the ego's own reward terms, in the order of RewardWeights.in_use.
    driven : the control of the step before, from which this one's may differ by so much; None if
        there is none to differ from.
    """

    ego: RoadState
    ego_size: tuple[float, float]
    road: RoadAhead
    cars: FloatArray
    cohesion_weight: tuple[float, ...]
    cohesion_target: tuple[float, ...]
    transitions: int
    place_weight: FloatArray
    place_target: FloatArray
    constraint_weight: float
    theta: tuple[float, ...]
    driven: Control | None = None


class Instance(NamedTuple):
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


class Solution(NamedTuple):
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
