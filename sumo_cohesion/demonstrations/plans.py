"""Plans of a run as examples: each is the optimum of its own problem."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from sumo_cohesion.learning.example import Example
from sumo_cohesion.learning.tracks import nearest_first
from sumo_cohesion.road import Road
from sumo_cohesion.state import EGO, Control, FloatArray, RoadState

_NO_STATES, _NO_CARS = np.empty((0, 4)), np.empty((0, 7))
_STATE = ["s", "d", "road_heading", "speed"]


def plans(
    name: str,
    road: Road,
    trajectory: pd.DataFrame,
    plan: pd.DataFrame,
    horizon: pd.DataFrame,
    steps: int,
) -> list[Example]:
    """Return every plan of so many steps that is half its own length after the one before."""
    egos = trajectory[trajectory["vehicle"] == EGO]
    size = float(egos["length"].iloc[0]), float(egos["width"].iloc[0])
    states, ahead = _by_time(egos, _STATE), _by_time(horizon, _STATE)
    others = _by_time(_others(trajectory, road), [*_STATE, "length", "width", "bend"])
    found, driven = [], None
    for i, row in enumerate(plan.to_dict(orient="records")):
        time = row["time"]
        if i % max(steps // 2, 1) == 0:
            ego, planned = RoadState(*states[time][0].tolist()), ahead.get(time, _NO_STATES)
            found.append(
                Example(
                    run=name,
                    vehicle=EGO,
                    time=time,
                    road=road,
                    ego=ego,
                    ego_size=size,
                    cars=nearest_first(others.get(time, _NO_CARS), ego),
                    driven=driven,
                    states=planned,
                    bounded=True,
                    unusable=_unusable(row, len(planned), steps),
                )
            )
        control = Control(row["curvature"], row["acceleration"])
        driven = control if np.isfinite(control).all() else None
    return found


def _unusable(row: Mapping[Hashable, Any], planned: int, steps: int) -> str:
    """Say why a plan demonstrates nothing; planners of others need not tell their cohesion."""
    if not planned:
        return "no plan"
    if row["fallback"] or row["intervened"]:
        return "not the planner's own optimum"
    if planned != steps:
        return "a plan of another length"
    if abs(row.get("reward_cohesion", 0.0)) > 0.0:
        return "cohesion had a part in it"
    return ""


def _others(trajectory: pd.DataFrame, road: Road) -> pd.DataFrame:
    """Return what the ego saw, with the curvature of the reference line beside each car."""
    seen = trajectory[trajectory["visible"] & (trajectory["vehicle"] != EGO)]
    _, bends = road.to_frenet(seen[["x", "y", "heading", "speed"]].to_numpy(float))
    return seen.assign(bend=bends)


def _by_time(table: pd.DataFrame, columns: list[str]) -> dict[float, FloatArray]:
    """Rows of a table, by the time they are of; in the order of the table."""
    times, values = table["time"].to_numpy(float), table[columns].to_numpy(float)
    order = np.argsort(times, kind="stable")
    found, starts = np.unique(times[order], return_index=True)
    return dict(zip(found.tolist(), np.split(values[order], starts[1:]), strict=True))
