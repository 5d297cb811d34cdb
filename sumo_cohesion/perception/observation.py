"""Scene to Observation: what the ego may see, in the road's frame."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from math import hypot

import numpy as np

from sumo_cohesion.road import Road, wrap_angle
from sumo_cohesion.state import FloatArray, Observation, RoadState, Scene


@dataclass(frozen=True)
class Sensor:
    """What the ego's perception lets through.

    Attributes
    ----------
    road : the road along the ego's route.
    range : metres between centres within which vehicles are seen.
    hidden : ids of vehicles that are there but never seen (the paper's stalled car).
    special : ids of vehicles that are obstacles but nobody to follow (an ambulance).
    """

    road: Road
    range: float
    hidden: Collection[str] = ()
    special: Collection[str] = ()

    def observe(self, scene: Scene, not_followed: Collection[str] = ()) -> Observation:
        """Return what the ego may see of a scene.

        ``not_followed`` are ids of more vehicles that are nobody to follow, at this instant.
        """
        project = self.road.project
        x, y, heading, speed = scene.ego
        s, d, road_heading, _ = project(x, y)
        ego = RoadState(s, d, wrap_angle(heading - road_heading), speed)
        seen, ids, rows = [], [], []
        for i, (name, state) in enumerate(zip(scene.ids, scene.states.tolist(), strict=True)):
            if name in self.hidden or hypot(state[0] - x, state[1] - y) > self.range:
                continue
            s, d, road_heading, curvature = project(state[0], state[1])
            rows.append((s, d, wrap_angle(state[2] - road_heading), state[3], curvature))
            ids.append(name)
            seen.append(i)
        table = np.array(rows, dtype=float).reshape(-1, 5)
        return Observation(
            time=scene.time,
            ego=ego,
            ego_size=scene.ego_size,
            ids=tuple(ids),
            states=table[:, :4],
            sizes=scene.sizes[seen],
            curvature=table[:, 4],
            voter=tuple([n not in self.special and n not in not_followed for n in ids]),
        )


@dataclass(frozen=True)
class Overview:
    """Everybody who can be seen, in one road's frame: worked out once for all who drive along it.

    What one of them sees of it is a slice, the same as `Sensor.observe` makes of a scene whose
    ego is that car.

    Attributes
    ----------
    time : seconds of SUMO time.
    ids : SUMO's ids of n vehicles.
    places : (n, 2) centres x, y (m), Cartesian.
    states, curvature : (n, 4) and (n,), as in Observation.
    sizes : (n, 2) length, width (m).
    voter : n flags, as in Observation.
    """

    time: float
    ids: tuple[str, ...]
    places: FloatArray
    states: FloatArray
    curvature: FloatArray
    sizes: FloatArray
    voter: tuple[bool, ...]

    @staticmethod
    def along(
        road: Road,
        time: float,
        ids: tuple[str, ...],
        states: FloatArray,
        sizes: FloatArray,
        voter: tuple[bool, ...],
    ) -> Overview:
        """Put n cars, (n, 4) Cartesian states, into the frame of a road."""
        frenet, curvature = road.to_frenet(states)
        return Overview(time, ids, states[:, :2], frenet, curvature, sizes, voter)

    def seen_by(self, i: int, reach: float) -> Observation:
        """Return what car i sees of the others, up to ``reach`` (m) between centres."""
        offset = self.places - self.places[i]
        near = np.hypot(offset[:, 0], offset[:, 1]) <= reach
        near[i] = False
        seen = np.flatnonzero(near)
        picked = seen.tolist()
        length, width = self.sizes[i].tolist()
        return Observation(
            time=self.time,
            ego=RoadState(*self.states[i].tolist()),
            ego_size=(length, width),
            ids=tuple([self.ids[j] for j in picked]),
            states=self.states[seen],
            sizes=self.sizes[seen],
            curvature=self.curvature[seen],
            voter=tuple([self.voter[j] for j in picked]),
        )
