"""The last resort: no plan is driven that leaves no way out if a visible car brakes hard.

Responsibility-sensitive safety (S. Shalev-Shwartz, S. Shammah and A. Shashua, 2017, "On a Formal
Model of Safe and Scalable Self-driving Cars"), one step ahead, for the first control, the only one
that is driven. What cohesion wants does not enter.
"""

from __future__ import annotations

from dataclasses import replace
from math import cos, sin

import numpy as np

from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.dynamics import DT
from sumo_cohesion.planning.fallback import keep_lane
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.state import Control, Observation, Plan

HARDEST_BRAKING = 8.0
"""m/s² that a car ahead may brake with."""
SIDE_MARGIN = 0.3
"""Metres between the sides of two cars below which the ego does not move closer."""


def checked(plan: Plan, observation: Observation, road: Road, settings: PlannerSettings) -> Plan:
    """Return the plan, or one that brakes or stays aside where it would leave no way out.

    - *Too close behind a car ahead*: if it braked with HARDEST_BRAKING, the ego, braking with its
      own most after one step, would hit it. The ego brakes with its most now.
    - *Too close beside a car*: the plan moves towards a car whose side is nearer than SIDE_MARGIN.
      The ego steers to keep its lane instead.

    Returns the same plan, or one of a single control that says which cars were too close.
    """
    if not plan.controls:
        return plan
    control, ego = plan.controls[0], observation.ego
    after = dynamics.step(ego, control, DT, settings.friction, float(road.curvature_at(ego.s)))
    half_length, half_width = (size / 2 for size in observation.ego_size)
    reasons, brake, straighten = [], False, False
    states, sizes = observation.states.tolist(), observation.sizes.tolist()
    for name, state, (length, width) in zip(observation.ids, states, sizes, strict=True):
        s, d, heading, speed = state
        along, across = speed * cos(heading), speed * sin(heading)
        ahead = s + DT * along - after[0] - half_length - length / 2
        aside = abs(d + DT * across - after[1]) - half_width - width / 2
        if s > ego.s and aside < 0.0 and ahead < safe_distance(after[3], along, settings):
            brake = True
            reasons.append(f"too close behind {name}")
        beside = abs(s - ego.s) < half_length + length / 2
        closing = (after[1] - ego.d - DT * across) * (d - ego.d) > 0.0
        if beside and closing and aside < SIDE_MARGIN:
            straighten = True
            reasons.append(f"too close beside {name}")
    hardest = settings.friction * ego.speed - min(settings.max_braking, ego.speed / DT)
    safe = Control(
        keep_lane(observation, road, settings) if straighten else control.curvature,
        min(control.acceleration, hardest) if brake else control.acceleration,
    )
    if safe == control:
        return plan
    after = dynamics.step(ego, safe, DT, settings.friction, float(road.curvature_at(ego.s)))
    return replace(
        plan,
        controls=(safe,),
        states=np.array((ego, after)),
        intervened=True,
        status=f"{plan.status}; last resort: {', '.join(reasons)}",
    )


def safe_distance(speed: float, speed_ahead: float, settings: PlannerSettings) -> float:
    """Metres that the ego needs behind a car, bumper to bumper.

    It may accelerate for one more step before it brakes.
    """
    faster = speed + DT * settings.max_acceleration
    way = DT * (speed + faster) / 2 + faster**2 / (2 * settings.max_braking)
    return max(way - max(speed_ahead, 0.0) ** 2 / (2 * HARDEST_BRAKING), 0.0)
