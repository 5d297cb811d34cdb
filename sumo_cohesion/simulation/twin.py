"""What cohesion changed: the nominal car beside the ego, in the same traffic.

Two answers, because each alone misleads. *Plan*: from the very state the ego is in, what would the
nominal planner plan? That is what cohesion changes in one horizon. *Twin*: a nominal car that
started where the ego started and has driven on its own ever since, through the traffic of this
run. That adds up over the run, and unlike a run of its own it meets the very same humans: they
react to the ego, not to the twin. It is a ghost: nothing stops it but its own planner, and it sees
only the vehicles that the ego's surroundings hold.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sumo_cohesion.perception.history import History
from sumo_cohesion.perception.observation import Sensor
from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.cohesive import CohesivePlanner
from sumo_cohesion.planning.registry import cohesion_of
from sumo_cohesion.state import STEP, CartesianState, Observation, Plan, Scene

if TYPE_CHECKING:
    from sumo_cohesion.simulation.setup import Setup


class Reference:
    """Follows a run step by step and notes what the nominal planner would have done."""

    def __init__(self, setup: Setup, sensor: Sensor) -> None:
        self._sensor = sensor
        self._friction = setup.settings.friction
        nominal = cohesion_of("nominal", setup.cohesion)
        self._from_here = CohesivePlanner(setup.settings, nominal)
        self._of_twin = CohesivePlanner(setup.settings, nominal)
        self._from_here.reset(setup.road)
        self._of_twin.reset(setup.road)
        self._twin: CartesianState | None = None
        self.rows: list[dict[str, object]] = []
        """One per step; see columns.REFERENCE."""

    def add(self, scene: Scene, observation: Observation, history: History, plan: Plan) -> None:
        """Compare one step's plan with the nominal one, and drive the twin one step."""
        nominal = self._from_here.plan(observation, history)
        self._from_here.continue_from(plan.controls[0] if plan.controls else None)
        if len(plan.states) == len(nominal.states):
            change = plan.states - nominal.states
            lateral, speed = change[np.abs(change).argmax(axis=0), range(4)][[1, 3]]
        else:
            lateral = speed = np.nan  # SUMO drives, a fallback or last resort: nothing to compare
        twin = self._sensor.observe(replace(scene, ego=self._twin or scene.ego))
        self.rows.append(
            {
                "time": scene.time,
                "plan_lateral": lateral,
                "plan_speed": speed,
                "twin_s": twin.ego.s,
                "twin_d": twin.ego.d,
                "twin_speed": twin.ego.speed,
            }
        )
        control = self._of_twin.plan(twin, history).controls[0]
        state = self._twin or scene.ego
        x, y, heading, speed = dynamics.step(state, control, STEP, self._friction)
        self._twin = CartesianState(x, y, heading, max(speed, 0.0))
