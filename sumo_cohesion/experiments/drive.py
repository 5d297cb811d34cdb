"""One planned car's step: ask its planner, and go where the first control takes it."""

from __future__ import annotations

import math

from sumo_cohesion.perception.history import History
from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.fallback import fallback
from sumo_cohesion.planning.planners import Planner
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.state import CartesianState, Observation, Plan
from sumo_cohesion.traffic.simulator import STEP_LENGTH

END_OF_ROUTE = 20.0
"""Metres before the end of its route up to which a car is planned; SUMO would remove it there."""


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
        usable = all(math.isfinite(v) for control in plan.controls[:1] for v in control)
        status = "control is not finite"
    except MemoryError:
        raise  # a car cannot drive on without memory; the run ends
    except Exception as error:
        usable, status = False, f"{type(error).__name__}: {error}"
    return plan if usable else fallback(observation, road, settings, status)


def drive(state: CartesianState, plan: Plan, settings: PlannerSettings) -> CartesianState | None:
    """Where the first planned control takes a car; None if SUMO drives it."""
    if not plan.controls:
        return None
    x, y, heading, speed = dynamics.step(state, plan.controls[0], STEP_LENGTH, settings.friction)
    return CartesianState(float(x), float(y), float(heading), max(float(speed), 0.0))
