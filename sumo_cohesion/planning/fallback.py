"""The plan when there is no plan: brake in lane."""

from __future__ import annotations

from math import isfinite

import numpy as np

from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.state import STEP, Control, Observation, Plan

BRAKING = 4.0
"""m/s², braking of the fallback plan."""


def fallback(observation: Observation, road: Road, settings: PlannerSettings, status: str) -> Plan:
    """Plan without a solver: brake in the lane the ego is in."""
    ego = observation.ego
    curvature = keep_lane(observation, road, settings)
    braking = min(BRAKING, ego.speed / STEP)
    control = Control(curvature, settings.friction * ego.speed - braking)
    return Plan(controls=(control,), states=np.array([ego]), status=status, fallback=True)


def keep_lane(observation: Observation, road: Road, settings: PlannerSettings) -> float:
    """Curvature (1/m) that takes the ego to its lane's centre and along it in about a second."""
    ego = observation.ego
    centre = road.nearest_lane(ego.s, ego.d)
    reach = max(0.7 * ego.speed, 5.0)
    off = ego.d - centre if isfinite(centre) else 0.0  # there is no lane here
    bend = -2.0 * ego.heading / reach - off / reach**2
    curvature = road.bend_at(ego.s) + bend
    sharpest = settings.sharpest(ego.speed)
    return min(max(curvature, -sharpest), sharpest)
