"""Which routes a planner can drive along."""

from __future__ import annotations

from sumo_cohesion.errors import UserError
from sumo_cohesion.planning.registry import BUILT_IN
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road

_STREETS = 0.2
"""Curvature (1/m) of a car's tightest turn."""


def check_road(
    name: str, settings: PlannerSettings, road: Road, first: float, seconds: float
) -> None:
    """Raise UserError if a car cannot be told, or driven by this planner, along a road.

    ``first`` is where (s, m) it starts, ``seconds`` how long it may drive at the speed limit.
    """
    last = min(first + seconds * float(road.speed_limit.max()), road.length)
    s = road.returns(first, last)
    if s is not None:
        raise UserError(
            f"{s:.0f} m from its start the route comes back to where it was before (a U-turn, or a "
            "bridge over itself); a car there could be in either place; choose another route"
        )
    s = road.too_sharp(settings.max_curvature, first, last)
    if s is None or name == "sumo" or name not in BUILT_IN:
        return
    radius, allowed = 1.0 / abs(road.bend_at(s)), 1.0 / settings.max_curvature
    turns = f"{s:.0f} m from its start the route turns with a radius of {radius:.0f} m"
    if settings.max_curvature >= _STREETS:
        raise UserError(f"{turns}, which no car can; choose another route")
    raise UserError(
        f"{turns}, and planner.max_curvature = {settings.max_curvature:g} allows {allowed:.0f} m; "
        f"for streets set planner.max_curvature = {_STREETS:g} and planner.max_curvature_rate = 1, "
        "or choose another route"
    )
