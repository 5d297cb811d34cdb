"""One example of driving: a few steps of one car, and what was around it when they began."""

from __future__ import annotations

from typing import NamedTuple

from sumo_cohesion.road import Road
from sumo_cohesion.state import Control, FloatArray, RoadState


class Example(NamedTuple):
    """What a car did in T steps, in the road's frame.

    Attributes
    ----------
    run : what it belongs to; whole runs are drawn by the bootstrap and held out, for what is in
        one run is alike.
    vehicle, time : whose, and when (s) the steps began.
    road : along which the car drove.
    ego, ego_size : where it began; length, width (m).
    cars : (n, 7) the others then, as in planning.problem.Problem, nearest first.
    driven : the control before; None if there was none to differ from.
    states : (T, 4) s, d (m), heading (rad), speed (m/s) that it came to.
    desired_speed : m/s that the car would like to drive; None is the limit.
    bounded : it kept to the planner's bounds, and may have been held by them.
    unusable : why nothing can be learned from it; "" if something can.
    """

    run: str
    vehicle: str
    time: float
    road: Road
    ego: RoadState
    ego_size: tuple[float, float]
    cars: FloatArray
    driven: Control | None
    states: FloatArray
    desired_speed: float | None = None
    bounded: bool = False
    unusable: str = ""
