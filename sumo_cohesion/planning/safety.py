"""The last resort: no plan is driven that leaves no way out if a visible car brakes hard.

Responsibility-sensitive safety (S. Shalev-Shwartz, S. Shammah and A. Shashua, 2017, "On a Formal
Model of Safe and Scalable Self-driving Cars"), one step ahead, for the first control, the only one
that is driven. What cohesion wants does not enter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import cos, sin

import numpy as np

from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.state import STEP, Control, Observation, Plan

HARDEST_BRAKING = 8.0
"""m/s² that a car ahead may brake with."""
ONCOMING_BRAKING = 4.0
"""m/s² with which a car that comes the other way is trusted to brake, one step from now."""
SIDE_MARGIN = 0.3
"""Metres between the sides of two cars below which the ego does not move closer."""


def checked(plan: Plan, observation: Observation, road: Road, settings: PlannerSettings) -> Plan:
    """Return the plan, or one that brakes or stays aside where it would leave no way out.

    - *Too close behind a car ahead*: if it braked with HARDEST_BRAKING, the ego, braking with its
      own most after one step, would hit it. The ego brakes with its most now.
    - *Too close before a car that comes the other way*, likewise: it is trusted to brake with
      ONCOMING_BRAKING.
    - *Too close beside a car*: the plan moves towards a car whose side is nearer than SIDE_MARGIN.
      The ego goes straight on instead, or on away from the car if that is what it planned.

    Returns the same plan, or one of a single control that says which cars were too close.
    """
    if not plan.controls:
        return plan
    control, ego = plan.controls[0], observation.ego
    bend = road.bend_at(ego.s)
    after = dynamics.step(ego, control, STEP, settings.friction, bend)
    # The curvature with which the ego goes parallel to the road after one step.
    level = bend * cos(ego.heading) / dynamics.stretch(bend, ego.d)
    level -= ego.heading / (STEP * max(after[3], 1.0))
    sharpest = settings.sharpest(max(ego.speed, after[3]))
    level = min(max(level, -sharpest), sharpest)
    hardest = settings.friction * ego.speed - min(settings.max_braking, ego.speed / STEP)
    curvature, acceleration, reasons = control.curvature, control.acceleration, []
    own = _extent(ego.heading, observation.ego_size)
    reach = safe_distance(after[3], 0.0, settings) + sum(observation.ego_size) / 2
    pace, clear = 2.0 * STEP * after[3], own[1] + SIDE_MARGIN
    sizes = observation.sizes.tolist()
    for i, (s, d, heading, speed) in enumerate(observation.states.tolist()):
        size = sizes[i]
        # As |sin h| <= |h| and cos h <= 1, the car is at least so far aside: most need no more.
        turned = abs(heading) * (size[0] / 2 + STEP * abs(speed))
        if abs(d - after[1]) - turned - size[1] / 2 > clear:
            continue
        along = speed * cos(heading)
        # Far away however it is turned, and wherever it is a step from now.
        own_way = 2.0 * STEP * speed + (_oncoming_way(-along) if along < 0.0 else 0.0)
        if abs(s - ego.s) > reach + pace + own_way + (size[0] + size[1]) / 2:
            continue
        other = _extent(heading, size)
        aside = abs(d + STEP * speed * sin(heading) - after[1]) - own[1] - other[1]
        if aside >= SIDE_MARGIN:
            continue
        stretch = dynamics.stretch(float(observation.curvature[i]), d)
        ahead = s + STEP * along / stretch - after[0] - own[0] - other[0]
        if s > ego.s and aside < 0.0 and ahead < safe_distance(after[3], along, settings):
            if acceleration > hardest + 1e-9:
                acceleration = hardest
                side = "behind" if along >= 0.0 else "before"
                reasons.append(f"too close {side} {observation.ids[i]}")
            continue
        if abs(s - ego.s) < own[0] + other[0]:
            straight = min(curvature, level) if d > ego.d else max(curvature, level)
            if straight != curvature:
                curvature = straight
                reasons.append(f"too close beside {observation.ids[i]}")
    if not reasons:
        return plan
    safe = Control(curvature, acceleration)
    after = dynamics.step(ego, safe, STEP, settings.friction, bend)
    return replace(
        plan,
        controls=(safe,),
        states=np.array((ego, after)),
        intervened=True,
        status=f"{plan.status}; last resort: {', '.join(reasons)}",
    )


def _extent(heading: float, size: Sequence[float]) -> tuple[float, float]:
    """Half of what a turned box of (length, width) covers along and across the road (m)."""
    length, width, c, s = size[0] / 2, size[1] / 2, abs(cos(heading)), abs(sin(heading))
    return length * c + width * s, length * s + width * c


def safe_distance(speed: float, speed_ahead: float, settings: PlannerSettings) -> float:
    """Metres that the ego needs to a car ahead, bumper to bumper.

    The speeds (m/s) are along the road; the other's is negative if it comes the other way. The ego
    may accelerate for one more step before it brakes. That it brakes no harder than the car ahead
    can is assumed: then the gap is smallest when both stand.
    """
    faster = speed + STEP * settings.max_acceleration
    braking = min(settings.max_braking, HARDEST_BRAKING)
    way = STEP * (speed + faster) / 2 + faster**2 / (2 * braking)
    if speed_ahead < 0.0:
        return way + _oncoming_way(-speed_ahead)
    return max(way - speed_ahead**2 / (2 * HARDEST_BRAKING), 0.0)


def _oncoming_way(speed: float) -> float:
    """Metres that a car goes until it stands, if it keeps its speed (m/s) for one more step."""
    return STEP * speed + speed**2 / (2 * ONCOMING_BRAKING)
