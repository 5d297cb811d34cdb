"""The paper's algorithm: who, what, when and how, once per step."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from sumo_cohesion.perception.history import History
from sumo_cohesion.planning.explanation import Explanation
from sumo_cohesion.planning.fallback import fallback
from sumo_cohesion.planning.problem import Problem, Solution
from sumo_cohesion.planning.safety import checked
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.social.agreement import Agreement, agree, combine
from sumo_cohesion.social.election import Election
from sumo_cohesion.social.features import FEATURES
from sumo_cohesion.social.groups import group_votes
from sumo_cohesion.social.place import NOWHERE, Place, agree_on_place
from sumo_cohesion.social.place import SCALE as PLACE_SCALE
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import STEP, AgreementRow, Control, FloatArray, Observation, Plan

if TYPE_CHECKING:
    from sumo_cohesion.planning.solvers.mpc import Mpc


_NOTHING = (0.0,) * len(FEATURES)


class CohesivePlanner:
    """The paper's cohesive car: MPC on its own reward plus cohesion (paper, eq. 2).

    With ``cohesion.beta = 0`` it is the nominal car: the same problem, the same solver.
    """

    def __init__(self, settings: PlannerSettings, cohesion: CohesionSettings) -> None:
        self.settings = settings
        self.cohesion = cohesion
        self._election = Election(cohesion)
        self._mpc: Mpc | None = None
        self._driven: Control | None = None
        self._theta = settings.reward.theta
        self._no_place = np.zeros(settings.horizon)
        # Where the horizon is asked for the others' place: every third step is dense enough.
        self._place_steps = list(range(1, settings.horizon + 1, 3))

    def reset(self, road: Road) -> None:
        """Build the controller, once per number of lanes, and forget the last run."""
        from sumo_cohesion.planning.solvers.mpc import Mpc

        self._road = road
        n_lanes = road.lane_centre.shape[1]
        if self._mpc is None or self._mpc.n_lanes != n_lanes:
            self._mpc = Mpc(self.settings, n_lanes)
        self._mpc.reset()
        self._election.reset()
        self._driven = None

    def plan(self, observation: Observation, history: History) -> Plan:
        """Plan one step, in the paper's order."""
        # 1. Who and what: the groups' social features (section III-D and III-B).
        # 2. When: their agreement, by sample variance (section III-C).
        assert self._mpc is not None, "call reset(road) before plan()"
        driven, self._driven = self._driven, None
        if driven is None:
            self._mpc.drop_rest()  # the step before was not this plan's
        start = perf_counter()
        groups, place = self._agreement(observation, history)
        social_time = perf_counter() - start
        # 3. How: trade the ego's reward against cohesion (eq. 2) by MPC (section II-A).
        solution = self._mpc.solve(self._problem(observation, groups, place, driven))
        # 4. Never without a plan: after a failed solve the last plan goes on, or the ego brakes.
        plan = self._to_plan(observation, solution, groups, place, social_time)
        # 5. Never a plan without a way out: visible cars come before whatever was agreed.
        if self.settings.last_resort:
            plan = checked(plan, observation, self._road, self.settings)
        if plan.intervened:
            self._mpc.drop_rest()
        self._driven = plan.controls[0]
        return plan

    def continue_from(self, control: Control | None) -> None:
        """Take a control as the one driven last, whoever planned it; None if nobody did."""
        self._driven = control

    def _agreement(
        self, observation: Observation, history: History
    ) -> tuple[tuple[Agreement, ...], Place]:
        cohesion, road, ego = self.cohesion, self._road, observation.ego
        if cohesion.beta == 0.0:
            return (), NOWHERE
        groups = agree(group_votes(ego, history, road, cohesion), cohesion)
        place = NOWHERE
        if cohesion.place_weight > 0.0:
            times = [STEP * t for t in self._place_steps]
            place = agree_on_place(ego, history, road, times, cohesion)
        if cohesion.lateral_votes == "most_surprising":
            groups, place = self._election.elect(groups, place, observation.time)
        return groups, place

    def _problem(
        self,
        observation: Observation,
        groups: tuple[Agreement, ...],
        place: Place,
        driven: Control | None,
    ) -> Problem:
        horizon, ego = self.settings.horizon, observation.ego
        weight, target, transitions, pressure = _NOTHING, _NOTHING, 0, 0.0
        if groups:
            # The paper's cohesion is on the first transition.
            transitions = 1 if self.cohesion.transitions == "first" else horizon
            term = combine(groups)
            weight = tuple([self.cohesion.beta * w for w in term.weight])
            target = term.target
            pressure = transitions * self.cohesion.beta * sum(term.weight)
        place_weight, place_target = self._no_place, self._no_place
        if any(place.weight):
            place_weight, place_target = self._place(place)
            pressure += float(place_weight.sum()) * PLACE_SCALE**2
        return Problem(
            ego=ego,
            ego_size=observation.ego_size,
            # Where the ego will be if it keeps its speed.
            road=self._road.ahead(ego.s, ego.d, STEP * ego.speed, horizon + 1),
            cars=nearest_cars(observation, self.settings.cars),
            cohesion_weight=weight,
            cohesion_target=target,
            transitions=transitions,
            place_weight=place_weight,
            place_target=place_target,
            # The more, the more cohesion could win by coming too close.
            constraint_weight=self.settings.constraint * (1.0 + pressure),
            theta=self._theta,
            driven=driven,
        )

    def _place(self, place: Place) -> tuple[FloatArray, FloatArray]:
        """Weights and targets of the place across the road, for every stage."""
        stages = np.arange(1, self.settings.horizon + 1)
        steps, asked = np.array(self._place_steps), np.array(place.weight)
        known = asked > 0.0
        weight = np.interp(stages, steps, asked) * (self.cohesion.beta / PLACE_SCALE**2)
        # Between a known place and an unknown one the known one counts, ever less.
        return weight, np.interp(stages, steps[known], np.array(place.mean)[known])

    def _to_plan(
        self,
        observation: Observation,
        solution: Solution,
        groups: tuple[Agreement, ...],
        place: Place,
        social_time: float,
    ) -> Plan:
        assert self._mpc is not None
        ego = observation.ego
        why: Sequence[AgreementRow] = ()
        if groups:
            why = Explanation(ego, self._road.bend_at(ego.s), groups, place, self.cohesion.beta)
        if solution.solved:
            controls, states = _controls(solution.controls), solution.states
        elif (rest := self._mpc.rest) is not None:
            states, controls = rest[0], _controls(rest[1])
        else:
            braking = fallback(observation, self._road, self.settings, solution.status)
            controls, states = braking.controls, braking.states
        return Plan(
            controls=controls,
            states=states,
            status=solution.status,
            fallback=not solution.solved,
            solver=self._mpc.how,
            iterations=solution.iterations,
            wall_time=solution.wall_time,
            social_time=social_time,
            reward=solution.reward,
            agreement=why,
        )


def nearest_cars(observation: Observation, n: int) -> FloatArray:
    """Return the up to n cars nearest to the ego, nearest first: rows as in Problem.cars."""
    ego, states = observation.ego, observation.states
    distance = (states[:, 0] - ego.s) ** 2 + (states[:, 1] - ego.d) ** 2
    nearest = distance.argsort(kind="stable")[:n]
    cars = np.empty((len(nearest), 7))
    cars[:, :4] = states.take(nearest, axis=0)
    cars[:, 4:6] = observation.sizes.take(nearest, axis=0)
    cars[:, 6] = observation.curvature.take(nearest)
    return cars


def _controls(rows: FloatArray) -> tuple[Control, ...]:
    return tuple([Control(c, a) for c, a in rows.tolist()])
