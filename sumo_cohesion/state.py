"""What crosses the borders between the rooms: frozen values, SI units, radians.

Two frames are used. *Cartesian*: SUMO's network coordinates, x east and y north, headings
counter-clockwise from east. *Road*: Frenet coordinates along the ego's route, ``s`` along the
reference line, ``d`` to its left, headings relative to it. Positions are those of a car's
centre in both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

STEP = 0.1
"""Seconds per step, of SUMO and of every planner."""
EGO = "ego"
"""Id of the ego vehicle, in SUMO and in all tables."""
LANE_WIDTH = 3.5
"""Metres of a lane where none is at hand: what is measured in lanes is measured in these."""
STOPPED = "stopped"
"""Outcome of a run that SUMO stopped."""

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


class CartesianState(NamedTuple):
    """Centre (m), heading (rad, counter-clockwise from east) and speed (m/s) of one car."""

    x: float
    y: float
    heading: float
    speed: float


class RoadState(NamedTuple):
    """Centre (m), heading (rad, relative to the reference line) and speed (m/s) of one car."""

    s: float
    d: float
    heading: float
    speed: float


class Control(NamedTuple):
    """One step's control: path curvature (1/m, left positive) and acceleration (m/s²).

    The paper's steering Θ is a curvature: the heading turns by speed · Θ (paper, eq. 3).
    The acceleration is the commanded one, before friction.
    """

    curvature: float
    acceleration: float


def _require_finite(name: str, values: FloatArray, shape: tuple[int, int]) -> None:
    """Check an array that several rooms share, and make it read-only."""
    values.flags.writeable = False
    if values.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {values.shape}")
    # A sum is finite only if every summand is, and is much cheaper than isfinite().all().
    if not np.isfinite(values.sum()):
        raise ValueError(f"{name} holds a number that is not finite")


@dataclass(frozen=True, slots=True)
class Scene:
    """The truth around the ego at one instant, in the Cartesian frame.

    Attributes
    ----------
    time : seconds of SUMO time.
    ego : the ego's state.
    ids : SUMO's ids of the n other vehicles.
    states : (n, 4), columns x, y (m), heading (rad), speed (m/s).
    sizes : (n, 2), columns length, width (m).
    ego_size : length, width (m) of the ego.
    """

    time: float
    ego: CartesianState
    ego_size: tuple[float, float]
    ids: tuple[str, ...]
    states: FloatArray
    sizes: FloatArray

    def __post_init__(self) -> None:
        _require_finite("Scene.states", self.states, (len(self.ids), 4))
        _require_finite("Scene.sizes", self.sizes, (len(self.ids), 2))


@dataclass(frozen=True, slots=True)
class Observation:
    """What the ego may see at one instant, in the road frame.

    Attributes
    ----------
    time : seconds of SUMO time.
    ego : the ego's state.
    ego_size : length, width (m) of the ego.
    ids : the n visible vehicles.
    states : (n, 4), columns s, d (m), heading (rad, relative to the road), speed (m/s).
    sizes : (n, 2), columns length, width (m).
    curvature : (n,), curvature (1/m) of the reference line beside each vehicle.
    voter : n flags, False for vehicles that the scenario marks as special (an ambulance):
        they are obstacles, but nobody to follow.
    """

    time: float
    ego: RoadState
    ego_size: tuple[float, float]
    ids: tuple[str, ...]
    states: FloatArray
    sizes: FloatArray
    curvature: FloatArray
    voter: tuple[bool, ...]

    def __post_init__(self) -> None:
        _require_finite("Observation.states", self.states, (len(self.ids), 4))
        self.sizes.flags.writeable = self.curvature.flags.writeable = False
        if len(self.voter) != len(self.ids):
            raise ValueError(f"Observation.voter must have {len(self.ids)} flags")
        if not isfinite(sum(self.ego)):
            raise ValueError("Observation.ego holds a number that is not finite")


class AgreementRow(NamedTuple):
    """One social feature of one group: what its cars agree on, and how strongly it pulled.

    ``mean`` and ``variance`` are of the normalised feature; ``weight`` is 1/variance with the
    floor and the settings' relative weights applied, zero where the group has no vote; ``own`` is
    the ego's value if it keeps its course; ``pull`` is what ignoring the group would cost in
    one step: beta · weight · (mean − own)².
    """

    group: str
    feature: str
    n: int
    mean: float
    variance: float
    weight: float
    own: float
    pull: float


RESCUED = "rescued by ipopt"
"""Start of a plan's status if the chosen solver failed and IPOPT, asked next, did not."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What a planner decided, and why.

    Attributes
    ----------
    controls : the T planned controls; the first is driven. Empty, with the status "sumo":
        SUMO drives the ego.
    states : (T + 1, 4) predicted road states, the present one first.
    status : "solved", RESCUED, "sumo", or why the plan is a fallback.
    solver : which one, and whether it is compiled; empty for planners without.
    fallback : True if there was no usable plan: the rest of the last one, or braking in lane.
    intervened : True if the last resort (planning.safety) changed the first control.
    iterations : solver iterations.
    wall_time, social_time : seconds spent in the solver, and on who, what and when (the runner
        times the whole call itself).
    reward : the reward terms summed over the horizon, by name, weights included.
    agreement : one row per group and feature; empty for planners that follow nobody.
    """

    controls: tuple[Control, ...]
    states: FloatArray
    status: str
    solver: str = ""
    fallback: bool = False
    intervened: bool = False
    iterations: int = 0
    wall_time: float = 0.0
    social_time: float = 0.0
    reward: dict[str, float] = field(default_factory=dict)
    agreement: Sequence[AgreementRow] = ()
