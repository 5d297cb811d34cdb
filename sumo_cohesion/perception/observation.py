"""Scene to Observation: what a planned car may see, in its road's frame."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from sumo_cohesion.road import Road, wrap_angle
from sumo_cohesion.state import EGO, CartesianState, FloatArray, Observation, RoadState, Scene


@dataclass(frozen=True)
class Sensor:
    """What perception lets through, of the ego as of every other planned car.

    Attributes
    ----------
    range : metres between centres within which vehicles are seen.
    hidden : ids of vehicles that are there but never seen (the paper's stalled car).
    special : ids of vehicles that are obstacles but nobody to follow (an ambulance).
    """

    range: float
    hidden: Collection[str] = ()
    special: Collection[str] = ()

    def survey(self, scene: Scene, road: Road, not_followed: Collection[str] = ()) -> Overview:
        """Put everybody who can be seen, the ego among them, into the frame of a road.

        ``not_followed`` are ids of more vehicles that are nobody to follow, at this instant.
        """
        ids, states, sizes = scene.ids, scene.states, scene.sizes
        if not set(ids).isdisjoint(self.hidden):
            shown = [i for i, name in enumerate(ids) if name not in self.hidden]
            ids = tuple([ids[i] for i in shown])
            states, sizes = states[shown], sizes[shown]
        ids = (*ids, EGO)
        states = np.concatenate((states, [scene.ego]))
        frenet, curvature = road.to_frenet(states)
        return Overview(
            time=scene.time,
            road=road,
            range=self.range,
            ids=ids,
            places=states[:, :2],
            states=frenet,
            curvature=curvature,
            sizes=np.concatenate((sizes, [scene.ego_size])),
            voter=tuple([n not in self.special and n not in not_followed for n in ids]),
        )


@dataclass(frozen=True)
class Overview:
    """Everybody who can be seen, in one road's frame: worked out once for all who drive along it.

    What one of them sees of it is a slice.

    Attributes
    ----------
    time : seconds of SUMO time.
    road : the road whose frame it is.
    range : metres between centres within which one sees another.
    ids : SUMO's ids of n vehicles; the ego's is the last.
    places : (n, 2) centres x, y (m), Cartesian.
    states, curvature : (n, 4) and (n,), as in Observation.
    sizes : (n, 2) length, width (m).
    voter : n flags, as in Observation.
    """

    time: float
    road: Road
    range: float
    ids: tuple[str, ...]
    places: FloatArray
    states: FloatArray
    curvature: FloatArray
    sizes: FloatArray
    voter: tuple[bool, ...]

    def seen_by(self, name: str) -> Observation:
        """Return what a vehicle of this overview sees of the others."""
        i = self.ids.index(name)
        length, width = self.sizes[i].tolist()
        ego = RoadState(*self.states[i].tolist())
        return self._around(self.places[i], i, ego, (length, width))

    def seen_from(self, state: CartesianState, instead_of: str = EGO) -> Observation:
        """Return what a vehicle would see that were in this state instead of its own."""
        i = self.ids.index(instead_of)
        length, width = self.sizes[i].tolist()
        x, y, heading, speed = state
        s, d, road_heading, _ = self.road.project(x, y)
        ego = RoadState(s, d, wrap_angle(heading - road_heading), speed)
        return self._around(np.array((x, y)), i, ego, (length, width))

    def _around(
        self, place: FloatArray, itself: int, ego: RoadState, size: tuple[float, float]
    ) -> Observation:
        offset = self.places - place
        near = np.hypot(offset[:, 0], offset[:, 1]) <= self.range
        near[itself] = False
        seen = np.flatnonzero(near)
        picked = seen.tolist()
        return Observation(
            time=self.time,
            ego=ego,
            ego_size=size,
            ids=tuple([self.ids[j] for j in picked]),
            states=self.states[seen],
            sizes=self.sizes[seen],
            curvature=self.curvature[seen],
            voter=tuple([self.voter[j] for j in picked]),
        )
