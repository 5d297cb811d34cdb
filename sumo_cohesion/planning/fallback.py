"""The plan when there is no plan: brake in lane."""

from __future__ import annotations

import numpy as np

from sumo_cohesion.planning.dynamics import DT
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.state import AgreementRow, Control, Observation, Plan

BRAKING = 4.0
"""m/s², braking of the fallback plan."""


def fallback(
    observation: Observation,
    road: Road,
    settings: PlannerSettings,
    status: str,
    iterations: int = 0,
    wall_time: float = 0.0,
    agreement_rows: tuple[AgreementRow, ...] = (),
) -> Plan:
    """Plan without a solver: brake in the lane the ego is in."""
    ego = observation.ego
    centre = float(road.lanes_at(ego.s)[road.lane_index(ego.s, ego.d)])
    # Steer so that heading and offset from the lane's centre decay within about a second.
    reach = max(0.7 * ego.speed, 5.0)
    bend = -2.0 * ego.heading / reach - (ego.d - centre) / reach**2
    curvature = float(road.curvature_at(ego.s)) + bend
    curvature = float(np.clip(curvature, -settings.max_curvature, settings.max_curvature))
    braking = min(BRAKING, ego.speed / DT)
    control = Control(curvature, settings.friction * ego.speed - braking)
    return Plan(
        controls=(control,),
        states=np.array([ego]),
        status=status,
        fallback=True,
        iterations=iterations,
        wall_time=wall_time,
        agreement=agreement_rows,
    )
