"""A car that a planner drives: the ego, every car of the fleet and the nominal twin are one."""

from __future__ import annotations

import traceback
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from sumo_cohesion.perception.history import History
from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.fallback import fallback
from sumo_cohesion.planning.planners import Planner
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.state import STEP, CartesianState, Control, Observation, Plan

SHARPEST, HARDEST = 1.0, 100.0
"""Curvature (1/m) and acceleration (m/s²) beyond which a control is not that of a car."""
END_OF_ROUTE = 20.0
"""Metres before the end of its route up to which a car is planned; SUMO would remove it there."""


class Spent(NamedTuple):
    """Seconds of wall time that one step took a car: to remember what it sees, and to plan."""

    remembering: float = 0.0
    planning: float = 0.0


class PlannedCar:
    """One car's own memory and planner, along its own road.

    Per step: what it sees (perception.observation.Overview) goes into `step`, which remembers it
    and returns a plan; `drive` says where the plan's first control takes the car.

    Attributes
    ----------
    road : along its route.
    spent : wall time of the last step.
    """

    def __init__(
        self, planner: Planner, road: Road, history: History, settings: PlannerSettings
    ) -> None:
        planner.reset(road)
        self.road = road
        self.spent = Spent()
        self._planner = planner
        self._history = history
        self._settings = settings

    def step(self, observation: Observation) -> Plan:
        """Remember what is seen, and plan; never without a plan, whatever the planner does."""
        t0 = perf_counter()
        self._history.push(observation)
        t1 = perf_counter()
        plan = ask(self._planner, observation, self._history, self.road, self._settings)
        self.spent = Spent(t1 - t0, perf_counter() - t1)
        return plan

    def drive(self, state: CartesianState, plan: Plan) -> CartesianState | None:
        """Where the first planned control takes the car; None if SUMO drives it."""
        return drive(state, plan, self._settings)


def ask(
    planner: Planner,
    observation: Observation,
    history: History,
    road: Road,
    settings: PlannerSettings,
) -> Plan:
    """Ask the planner; whatever goes wrong in it, the car gets a plan and it is counted."""
    try:
        plan = planner.plan(observation, history)
        if not all(isinstance(control, Control) for control in plan.controls):
            controls = tuple(Control(float(c), float(a)) for c, a in plan.controls)
            plan = replace(plan, controls=controls)
        usable = all(_is_physical(control) for control in plan.controls[:1])
        status = "control is not finite, or not that of a car"
    except MemoryError:
        raise  # a car cannot drive on without memory; the run ends
    except Exception as error:
        usable, status = False, f"{type(error).__name__}: {error}{_where(error)}"
    return plan if usable else fallback(observation, road, settings, status)


def _where(error: Exception) -> str:
    """File and line of the planner's module at which `plan` raised; empty if it returned."""
    frames = traceback.extract_tb(error.__traceback__)[1:]  # the first is ask()
    if not frames or frames[0].name != "plan":
        return ""
    own = [frame for frame in frames if frame.filename == frames[0].filename]
    return f" ({Path(own[-1].filename).name}:{own[-1].lineno})"


def _is_physical(control: Control) -> bool:
    """Tell whether any car could follow a control; no comparison with NaN is true."""
    curvature, acceleration = control
    return abs(curvature) <= SHARPEST and abs(acceleration) <= HARDEST


def drive(state: CartesianState, plan: Plan, settings: PlannerSettings) -> CartesianState | None:
    """Where the first planned control takes a car; None if SUMO drives it."""
    if not plan.controls:
        return None
    curvature, acceleration = plan.controls[0]
    # No car reverses, whatever a planner wants.
    stop = settings.friction * state.speed - state.speed / STEP
    control = Control(curvature, max(acceleration, stop))
    x, y, heading, speed = dynamics.step(state, control, STEP, settings.friction)
    return CartesianState(float(x), float(y), float(heading), max(float(speed), 0.0))


def at_end(road: Road, s: float) -> bool:
    """Tell whether a place (m along the route) is where planning ends."""
    return s > road.length - END_OF_ROUTE
