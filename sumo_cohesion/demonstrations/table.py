"""Positions of vehicles in a table, with the SUMO network that they drove on.

One row per time and vehicle, with the columns of `COLUMNS`; CSV (also .csv.gz) or Parquet. The
network gives lanes and limits: netconvert makes one of OpenStreetMap, OpenDRIVE and others
(https://sumo.dlr.de/docs/netconvert.html). Which edges a vehicle drove along is found by map
matching.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from sumo_cohesion.demonstrations.checking import checked
from sumo_cohesion.demonstrations.roads import along_network, check_fit, roads_driven, ways
from sumo_cohesion.demonstrations.sizes import CAR
from sumo_cohesion.demonstrations.tabular import read_table
from sumo_cohesion.errors import UserError
from sumo_cohesion.learning.recording import Recording
from sumo_cohesion.traffic.network import Network
from sumo_cohesion.user_input import closest

REQUIRED = ("time", "vehicle", "x", "y")
COLUMNS = {
    "time": "s",
    "vehicle": "id, a number or text",
    "x": "m, its centre, in the network's coordinates",
    "y": "m",
    "heading": "rad, counter-clockwise from east; else that of the way driven",
    "length": "m; else that of SUMO's cars",
    "width": "m; else that of SUMO's cars",
    "speed": "not read: it follows from the positions",
}
"""What the columns hold. Those after y may be left out."""
_MOST_TURNS = 20.0
"""Radians beyond which a heading must be in degrees."""


def read_csv(path: Path, network: Network) -> Recording:
    """Read positions of vehicles on a network.

    Raises
    ------
    UserError
        If the file is damaged, a column is missing or misspelt, or it does not fit the network.
    """
    frame = read_table(path, text=("vehicle",))
    frame.columns = [str(name) for name in frame.columns]
    notes = _check_columns(frame, path)
    table = frame[list(REQUIRED)].copy()
    for column, usual in (("length", CAR.length), ("width", CAR.width)):
        table[column] = frame.get(column, usual)
    in_order, interval = checked(table, str(path))
    matcher = check_fit(in_order[["x", "y"]].to_numpy(float), network, str(path))
    headings = _headings(frame, path)
    edges = {
        vehicle: matcher.passed(points, None if headings is None else headings[vehicle])
        for vehicle, points in ways(in_order).items()
    }
    roads, told = roads_driven(in_order, edges, along_network(network))
    return Recording(str(path), in_order, roads, interval, (*notes, *told))


def _check_columns(frame: pd.DataFrame, path: Path) -> list[str]:
    """Refuse a table in which a column is missing or misspelt; say which are not read."""
    absent = [name for name in COLUMNS if name not in frame]
    strange = [name for name in frame.columns if name not in COLUMNS]
    for name in strange:
        if hint := closest(name, absent):
            raise UserError(f"{path}: unknown column {name!r}{hint}")
    missing = [name for name in REQUIRED if name in absent]
    if missing:
        raise UserError(
            f"{path}: has no column {missing[0]!r}; it needs {', '.join(REQUIRED)}, and its "
            f"columns are {', '.join(frame.columns)}"
        )
    return [f"not read: column {', '.join(strange)}"] if strange else []


def _headings(frame: pd.DataFrame, path: Path) -> dict[str, np.ndarray] | None:
    """Headings (rad) of each vehicle, in the order of time; None if the file has none."""
    if "heading" not in frame:
        return None
    heading = pd.to_numeric(frame["heading"], errors="coerce").to_numpy(float)
    wrong = ~np.isfinite(heading)
    if wrong.any():
        raise UserError(
            f"{path}: row {int(wrong.argmax()) + 1}: heading is not a number; mend it, or leave "
            "the column out"
        )
    if np.abs(heading).max() > _MOST_TURNS:
        raise UserError(
            f"{path}: row {int(np.abs(heading).argmax()) + 1}: heading {np.abs(heading).max():g} "
            "looks like degrees; write radians, counter-clockwise from east"
        )
    ids = frame["vehicle"].astype("string").str.strip().astype(str)
    in_order = pd.DataFrame({"vehicle": ids, "time": frame["time"], "heading": heading})
    in_order = in_order.sort_values(["vehicle", "time"], kind="stable", ignore_index=True)
    found = in_order.groupby("vehicle", sort=False)["heading"]
    return {str(vehicle): values.to_numpy(float) for vehicle, values in found}
