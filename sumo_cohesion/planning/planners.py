"""Planners: what drives the ego.

A planner of your own is any class with the two methods of `Planner`; planning.registry makes it.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from sumo_cohesion.perception.history import History
from sumo_cohesion.road import Road
from sumo_cohesion.state import Observation, Plan


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
        return Plan(controls=(), states=np.array([observation.ego]), status="sumo")
