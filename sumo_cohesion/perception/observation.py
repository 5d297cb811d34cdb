"""Scene to Observation: what the ego may see, in the road's frame."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from math import hypot

import numpy as np

from sumo_cohesion.road import Road, wrap_angle
from sumo_cohesion.state import Observation, RoadState, Scene


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

    def observe(self, scene: Scene) -> Observation:
        """Return what the ego may see of a scene."""
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
            voter=tuple([name not in self.special for name in ids]),
        )
