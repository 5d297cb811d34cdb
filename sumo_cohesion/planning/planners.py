"""Planners: what drives the ego.

A planner of your own is any class with the two methods of `Planner`; planning.registry makes it.
Whatever it does, `start` and `accepted` make of it a plan that can be driven, or one line that says
what to mend.
"""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from sumo_cohesion.errors import UserError
from sumo_cohesion.perception.history import History
from sumo_cohesion.road import Road
from sumo_cohesion.state import Control, FloatArray, Observation, Plan

SHARPEST, HARDEST = 1.0, 100.0
"""Curvature (1/m) and acceleration (m/s²) beyond which a control is not that of a car."""
BY_SUMO = "sumo"
"""Status of a plan without controls, which leaves a car to SUMO's driver for this step."""


@runtime_checkable
class Planner(Protocol):
    """What a planner must offer."""

    def reset(self, road: Road) -> None:
        """Start a new run on this road."""

    def plan(self, observation: Observation, history: History) -> Plan:
        """Decide the ego's controls from what is seen now and what has been seen."""


class SumoDriver:
    """SUMO's own driver model drives the ego: the baseline that SUMO users expect."""

    def reset(self, road: Road) -> None:
        """Nothing to prepare."""

    def plan(self, observation: Observation, history: History) -> Plan:  # noqa: ARG002
        """Leave the ego to SUMO."""
        return Plan(controls=(), states=np.array([observation.ego]), status=BY_SUMO)


class UnusablePlanError(Exception):
    """A planner returned what cannot be driven; the message says what to return."""


def start(planner: Planner, road: Road) -> None:
    """Start a planner's new run.

    Raises
    ------
    UserError
        If its ``reset`` raises; one line, with the place. The exception is its cause.
    """
    try:
        planner.reset(road)
    except (MemoryError, UserError):
        raise
    except Exception as error:
        name = type(planner).__name__
        raise UserError(f"planner {name}: reset() raised {described(error)}") from error


def accepted(plan: object) -> Plan:
    """Return what a planner returned, if it can be driven; its controls as a tuple of Control.

    Raises
    ------
    UnusablePlanError
        If it cannot.
    """
    if not isinstance(plan, Plan):
        raise UnusablePlanError(
            f"plan() returned {_kind(plan)}; return Plan(controls=(Control(curvature, "
            "acceleration),), states=[], status='...')"
        )
    try:
        controls = tuple(Control(float(c), float(a)) for c, a in plan.controls)
    except (TypeError, ValueError):
        raise UnusablePlanError(
            f"plan() returned {_kind(plan.controls)} as controls; return a tuple of numbers in "
            "pairs, e.g. controls=(Control(0.0, 1.0),)"
        ) from None
    if not isinstance(plan.status, str):
        raise UnusablePlanError(f"plan() returned {_kind(plan.status)} as status; return text")
    if not isinstance(plan.reward, Mapping):
        raise UnusablePlanError(
            f"plan() returned {_kind(plan.reward)} as reward; return a dict of numbers by name"
        )
    if not controls and plan.status != BY_SUMO:
        raise UnusablePlanError(
            "plan() returned no controls; return one at least, or status='sumo' to leave this "
            "step to SUMO's driver"
        )
    if controls and not _is_physical(controls[0]):
        raise UnusablePlanError("control is not finite, or not that of a car")
    return replace(plan, controls=controls)


def planned_states(plan: Plan) -> FloatArray:
    """Road states that a plan leads to, (n, 4); a user's planner need not say, or not so.

    A copy: a planner may write every plan into the same array.
    """
    try:
        states = np.array(plan.states, dtype=float)
    except (TypeError, ValueError):
        states = np.empty(0)
    return states[1:] if states.ndim == 2 and states.shape[1] == 4 else np.empty((0, 4))


def described(error: BaseException) -> str:
    """Say in one line what a planner did wrong, and at which line of its module.

    The exception must have been caught by the function that called the planner.
    """
    if isinstance(error, UnusablePlanError):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)[1:]  # the first is who caught it
    own = [frame for frame in frames if frame.filename == frames[0].filename]
    where = f" ({Path(own[-1].filename).name}:{own[-1].lineno})" if own else ""
    text = f"{type(error).__name__}: {error}{where}"
    return text.encode("utf-8", "replace").decode()  # file names need not be text


def _kind(value: object) -> str:
    if value is None:
        return "nothing"
    return f"the text {value!r}" if isinstance(value, str) else f"a {type(value).__name__}"


def _is_physical(control: Control) -> bool:
    """Tell whether any car could follow a control; no comparison with NaN is true."""
    curvature, acceleration = control
    return abs(curvature) <= SHARPEST and abs(acceleration) <= HARDEST
