"""What cohesion changed: the nominal car beside the ego, in the same traffic.

Two answers, because each alone misleads. *Plan*: from the very state the ego is in, what would the
nominal planner plan? That is what cohesion changes in one horizon. *Twin*: a nominal car that
started where the ego started and has driven on its own ever since, through the traffic of this
run. That adds up over the run, and unlike a run of its own it meets the very same humans: they
react to the ego, not to the twin. It is a ghost: nothing stops it but its own planner, and it sees
only the vehicles that the ego's surroundings hold.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sumo_cohesion.planning.cohesive import CohesivePlanner
from sumo_cohesion.planning.planners import planned_states
from sumo_cohesion.planning.registry import cohesion_of
from sumo_cohesion.simulation.car import PlannedCar
from sumo_cohesion.social.memory import new_history
from sumo_cohesion.state import STEP, CartesianState

if TYPE_CHECKING:
    from sumo_cohesion.simulation.episode import Ending, Moment
    from sumo_cohesion.simulation.setup import Setup


class Twin:
    """Listens to a run and notes what the nominal planner would have done.

    Attributes
    ----------
    rows : one per step; see columns.REFERENCE.
    """

    def __init__(self, setup: Setup) -> None:
        nominal = cohesion_of("nominal", setup.cohesion)
        self._from_here = CohesivePlanner(setup.settings, nominal)
        self._from_here.reset(setup.road)
        self._history = new_history(nominal, STEP)  # which no nominal planner asks
        self._car = PlannedCar(
            CohesivePlanner(setup.settings, nominal), setup.road, self._history, setup.settings
        )
        self._state: CartesianState | None = None
        self._ended = False
        self.rows: list[dict[str, object]] = []

    def on_step(self, moment: Moment) -> None:
        """Compare one step's plan with the nominal one, and drive the twin one step."""
        if self._ended:  # another run begins
            self._ended, self._state = False, None
            self.rows.clear()
        plan, observation = moment.plan, moment.observation
        nominal = self._from_here.plan(observation, self._history)
        self._from_here.continue_from(plan.controls[0] if plan.controls else None)
        planned, expected = planned_states(plan), planned_states(nominal)
        if len(planned) == len(expected) > 0:
            change = planned - expected
            lateral, speed = change[np.abs(change).argmax(axis=0), range(4)][[1, 3]]
        else:
            lateral = speed = np.nan  # SUMO drives, a fallback or last resort: nothing to compare
        state = self._state or moment.scene.ego
        seen = moment.overview.seen_from(state)
        self.rows.append(
            {
                "time": moment.scene.time,
                "plan_lateral": lateral,
                "plan_speed": speed,
                "twin_s": seen.ego.s,
                "twin_d": seen.ego.d,
                "twin_speed": seen.ego.speed,
            }
        )
        self._state = self._car.drive(state, self._car.step(seen))

    def on_end(self, ending: Ending) -> None:  # noqa: ARG002
        """Whatever comes next is another run."""
        self._ended = True
