"""A car that a planner drives: the ego, every car of the fleet and the nominal twin are one."""

from __future__ import annotations

from time import perf_counter
from typing import NamedTuple

from sumo_cohesion.perception.history import History
from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.fallback import fallback
from sumo_cohesion.planning.planners import Planner, accepted, described, start
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.state import STEP, CartesianState, Control, Observation, Plan

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
        start(planner, road)
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
        return accepted(planner.plan(observation, history))
    except MemoryError:
        raise  # a car cannot drive on without memory; the run ends
    except Exception as error:
        return fallback(observation, road, settings, described(error))


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
