"""Several planned cars at once: the ego's planner drives a share of the others, too.

Every member of the fleet is an ego of its own: its own planner and warm start, its own sensing and
memory, the road along its own route. It is planned while it is within the main ego's sensing
range, beyond which nothing is recorded that it could change, and SUMO drives it elsewhere.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from math import hypot
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sumo_cohesion.perception.observation import Overview
from sumo_cohesion.planning.route import check_road
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.car import PlannedCar, at_end
from sumo_cohesion.social.memory import SharedFeatures, new_history
from sumo_cohesion.state import EGO, STEP, CartesianState, FloatArray, Scene
from sumo_cohesion.traffic.contact import contacts

if TYPE_CHECKING:
    from sumo_cohesion.simulation.setup import Setup

HYSTERESIS = 20.0
"""Metres beyond the ego's sensing range at which a planned car is handed back."""


class Register(Protocol):
    """What a fleet asks a simulation about a vehicle."""

    def route(self, vehicle: str) -> tuple[str, ...]:
        """Edges of its route."""

    def has_stop(self, vehicle: str) -> bool:
        """Tell whether it stands at a stop of its route, or has one before it."""


def is_equipped(vehicle: str, seed: int, penetration: float) -> bool:
    """Tell whether a car has the planner: drawn from the seed and its name alone.

    The sets are nested: who is equipped at one penetration is so at every higher one.

    >>> is_equipped("a", 0, 1.0), is_equipped("a", 0, 0.0)
    (True, False)
    """
    # Not a CRC: it is linear, so that two cars' draws would differ by the same bits at all seeds.
    digest = hashlib.blake2b(f"{seed} {vehicle}".encode(), digest_size=6).digest()
    return int.from_bytes(digest) / 2**48 < penetration


class Fleet:
    """The cars besides the ego that planners drive; empty at a penetration of zero.

    A car is taken in when it is equipped and comes into the ego's sensing range. It is handed
    back, by no longer being driven, when it is `HYSTERESIS` beyond that range, at the end of its
    route, or when it has touched another car; the last two are never taken in again. Never taken
    in are cars that no road can be built for, or driven along (check_road), and none as long as it
    has a stop to make: planners know nothing of stops.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._sensing = setup.scenario.sensing
        self._members: dict[str, PlannedCar] = {}
        self._features = SharedFeatures()
        self._human: set[str] = set(setup.not_human)  # never taken in (again)
        self._were_planned = {EGO}
        self._touched: dict[str, list[str]] = {}
        self._without_road: dict[str, str] = {}
        self._failures = 0
        self._interventions = 0

    @property
    def not_followed(self) -> Collection[str]:
        """Cars that egos do not follow: those that planners drive or drove before.

        What a car did while it was planned stays remembered, so it is no human's vote later on.
        If egos follow egos, only wrecks are left.
        """
        return self._touched if self._setup.cohesion.follow_egos else self._were_planned

    def meet(self, scene: Scene, register: Register) -> None:
        """Hand back who is no longer to be planned, and take in who is now; once per scene."""
        if not self._setup.penetration:
            return
        self._find_contacts(scene)
        reach, ego = self._sensing.range, scene.ego
        present = dict(zip(scene.ids, scene.states.tolist(), strict=True))
        for name in list(self._members):
            state = present.get(name)
            if state is None or hypot(state[0] - ego.x, state[1] - ego.y) > reach + HYSTERESIS:
                del self._members[name]
            elif _at_end(self._members[name].road, state):
                self._stays_human(name)
        for name, state in present.items():
            if name in self._human or name in self._members:
                continue
            if hypot(state[0] - ego.x, state[1] - ego.y) <= reach:
                self._take_in(name, state, register)

    def drive(self, scene: Scene, overview: Overview) -> dict[str, CartesianState]:
        """Plan every member from what it sees; returns where it is driven in this step.

        ``overview`` is of the ego's road. Who is missing in the result is left to SUMO.
        """
        if not self._members:
            return {}
        self._features.next_step()
        not_followed = self.not_followed
        overviews = {id(overview.road): overview}
        states = dict(zip(scene.ids, scene.states.tolist(), strict=True))
        driven = {}
        for name, car in self._members.items():
            view = overviews.get(id(car.road))
            if view is None:
                view = self._setup.sensor.survey(scene, car.road, not_followed)
                overviews[id(car.road)] = view
            plan = car.step(view.seen_by(name))
            self._failures += plan.fallback
            self._interventions += plan.intervened
            state = car.drive(CartesianState(*states[name]), plan)
            if state is not None:
                driven[name] = state
                self._were_planned.add(name)
        return driven

    def summary(self) -> dict[str, Any]:
        """Say what became of the fleet, ready for JSON."""
        return {
            "touched": self._touched,
            "failures": self._failures,
            "interventions": self._interventions,
            "without_road": self._without_road,
        }

    def _find_contacts(self, scene: Scene) -> None:
        if not self._members:
            return
        ids = (*scene.ids, EGO)
        states = np.concatenate((scene.states, [scene.ego]))
        sizes = np.concatenate((scene.sizes, [scene.ego_size]))
        rows = [i for i, name in enumerate(scene.ids) if name in self._members]
        for i in _near_another(rows, states, sizes):
            length, width = sizes[i].tolist()
            found = contacts(CartesianState(*states[i].tolist()), (length, width), states, sizes)
            others = [ids[j] for j in found if j != i]
            if others:
                self._touched[ids[i]] = others
                self._stays_human(ids[i])

    def _take_in(self, name: str, state: list[float], register: Register) -> None:
        setup = self._setup
        if not is_equipped(name, setup.seed, setup.penetration):
            self._human.add(name)
            return
        if register.has_stop(name):
            return
        planner, history = setup.make_planner(), new_history(setup.cohesion, STEP, self._features)
        try:
            road = setup.road_along(register.route(name))
            s, *_ = road.project(state[0], state[1])
            check_road(setup.planner_name, setup.settings, road, s, setup.scenario.duration)
            car = PlannedCar(planner, road, history, setup.settings)
        except MemoryError:
            raise
        except Exception as error:  # whatever a network has that this planner cannot drive along
            self._without_road[name] = str(error)
            self._human.add(name)
            return
        if _at_end(road, state):
            self._human.add(name)
            return
        self._members[name] = car
        self._were_planned.add(name)

    def _stays_human(self, name: str) -> None:
        del self._members[name]
        self._human.add(name)


def _at_end(road: Road, state: list[float]) -> bool:
    s, *_ = road.project(state[0], state[1])
    return at_end(road, s)


def _near_another(rows: list[int], states: FloatArray, sizes: FloatArray) -> list[int]:
    """Which of the rows have any other car so near that the circles around them overlap."""
    x, y = states[:, 0], states[:, 1]
    radius = np.hypot(sizes[:, 0], sizes[:, 1]) / 2
    apart = (x[rows, None] - x) ** 2 + (y[rows, None] - y) ** 2
    near = (apart < (radius[rows, None] + radius) ** 2).sum(axis=1) > 1  # itself is one
    return [i for i, is_near in zip(rows, near.tolist(), strict=True) if is_near]
