"""SUMO's floating car data as demonstrations: every car of it, in any network.

https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html: XML, gzipped or not, and the same as
CSV or Parquet (``--fcd-output f.csv``, ``f.parquet``; column names as SUMO 1.28 writes them).
Positions are those of front bumpers, angles compass degrees. Sizes are not written; no option
adds them. They follow from the types where the route files are given, else all are taken for cars
of SUMO's default size; then the centre of a longer vehicle is too far ahead, all the time by as
much. Written with two digits, positions are good for accelerations to about 1 m/s²: record with
``--precision 6`` and ``--step-length 0.1``.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from sys import intern

import numpy as np
import pandas as pd

from sumo_cohesion.demonstrations.checking import checked
from sumo_cohesion.demonstrations.roads import along_network, check_fit, roads_driven
from sumo_cohesion.demonstrations.sizes import kinds_of
from sumo_cohesion.demonstrations.tabular import read_table
from sumo_cohesion.errors import UserError
from sumo_cohesion.learning.recording import Recording
from sumo_cohesion.state import FloatArray
from sumo_cohesion.traffic.network import Network
from sumo_cohesion.traffic.xml_files import each_element

_NUMBERS = ("x", "y", "angle")
_NEEDED = ("time", "id", *_NUMBERS, "lane")
_SAMPLES = 2000
"""Rows that are looked for in the network, to tell whether it is the right one."""


def read_fcd(path: Path, network: Network, demand: Sequence[Path] = ()) -> Recording:
    """Read SUMO's floating car data.

    Parameters
    ----------
    path : .xml, .csv (both also .gz) or .parquet.
    network : that was driven on.
    demand : route and additional files in which the vehicles' types are written.

    Raises
    ------
    UserError
        If the file is damaged, of another kind, or does not fit the network.
    """
    if path.name.removesuffix(".gz").endswith(".xml"):
        frame = _from_xml(path)
    else:
        frame = read_table(path, text=("vehicle_id", "vehicle_type", "vehicle_lane"))
        frame.columns = [_plain(str(name)) for name in frame.columns]
    return read_sumo_table(frame, network, str(path), demand)


def read_sumo_table(
    frame: pd.DataFrame, network: Network, name: str, demand: Sequence[Path] = ()
) -> Recording:
    """Take floating car data from a table, such as a run's ``sumo_fcd``.

    Parameters
    ----------
    frame : with the columns time, id, x, y, angle, lane, as SUMO calls them, and type.
    network, demand : as in `read_fcd`.
    name : of what it is from, for messages.
    """
    for column in _NEEDED:
        if column not in frame:
            raise UserError(
                f"{name}: has no {column!r}; write it with SUMO's "
                f"--fcd-output.attributes {','.join(_NUMBERS)},type,lane"
            )
    frame = frame.reset_index(drop=True)
    frame = frame.assign(id=frame["id"].astype("string").fillna("").str.strip().astype(str))
    frame = frame[frame["id"] != ""]  # rows of persons have none
    types = frame["type"].fillna("") if "type" in frame else pd.Series("", index=frame.index)
    kinds, notes = kinds_of(sorted(pd.unique(types)), demand)
    table = pd.DataFrame(
        {
            "time": frame["time"],
            "vehicle": frame["id"],
            "length": np.array([kinds[t].length for t in types]),
            "width": np.array([kinds[t].width for t in types]),
        }
    )
    x, y, angle = (pd.to_numeric(frame[n], errors="coerce").to_numpy(float) for n in _NUMBERS)
    heading = np.radians(90.0 - angle)
    table["x"] = x - 0.5 * table["length"] * np.cos(heading)
    table["y"] = y - 0.5 * table["length"] * np.sin(heading)
    in_order, interval = checked(table, name)
    if _rounded(x, y):
        notes.append(
            "positions are rounded to centimetres, which blurs accelerations; record with SUMO's "
            "--precision 6"
        )
    by_time = frame.assign(type=types).sort_values("time", kind="stable")
    edges, others = _driven(by_time, network, name)
    for vehicle, kind in by_time.groupby("id", sort=False)["type"].first().items():
        if not kinds[kind].car:
            others[str(vehicle)] = "does not drive as cars do"
    every = max(len(in_order) // _SAMPLES, 1)
    check_fit(in_order[["x", "y"]].to_numpy(float)[::every], network, name)
    roads, told = roads_driven(in_order, edges, along_network(network), others)
    return Recording(name, in_order, roads, interval, (*notes, *told))


def _from_xml(path: Path) -> pd.DataFrame:
    """Read the vehicles of an XML file, without ever holding it all as a tree."""
    times, numbers = array("d"), {name: array("d") for name in _NUMBERS}
    texts: dict[str, list[str]] = {name: [] for name in ("id", "type", "lane")}
    for step in each_element(path, "fcd-export", "timestep"):
        time = _number(step.get("time"), "time", "a timestep", path)
        for vehicle in step.iter("vehicle"):
            times.append(time)
            name = vehicle.get("id", "")
            for attribute, values in numbers.items():
                text = vehicle.get(attribute)
                values.append(_number(text, attribute, f"vehicle {name!r} at {time:g} s", path))
            for attribute, found in texts.items():
                found.append(intern(vehicle.get(attribute, "")))
    columns = {name: np.frombuffer(values) for name, values in numbers.items() if len(values)}
    return pd.DataFrame({"time": np.array(times), **(columns or numbers), **texts})


def _number(text: str | None, attribute: str, whose: str, path: Path) -> float:
    try:
        return float(text if text is not None else "")
    except ValueError:
        wrong = "is missing" if text is None else f"{text!r} is not a number"
        raise UserError(
            f"{path}: {attribute} of {whose} {wrong}; write it again with SUMO's "
            f"--fcd-output.attributes {','.join(_NUMBERS)},type,lane"
        ) from None


def _plain(column: str) -> str:
    """Name of an attribute without that of its element, which column formats put before it."""
    return column.removeprefix("timestep_").removeprefix("vehicle_")


def _rounded(x: FloatArray, y: FloatArray) -> bool:
    cents = 100.0 * np.concatenate((x, y))
    return bool(np.abs(cents - np.rint(cents)).max(initial=0.0) < 1e-4)


def _driven(
    frame: pd.DataFrame, network: Network, name: str
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Edges of each vehicle, in order; and who was on lanes that are not for cars."""
    names = [str(lane) for lane in frame["lane"].dropna().unique() if lane]
    edge_of = {lane: _edge(lane) for lane in names}
    closed = {lane for lane in names if edge_of[lane] and not _for_cars(lane, network, name)}
    edges: dict[str, list[str]] = {}
    others: dict[str, str] = {}
    for vehicle, lanes in frame.groupby("id", sort=False)["lane"]:
        passed = [lane for lane, _ in groupby(lanes.tolist()) if lane in edge_of]
        if not closed.isdisjoint(passed):
            others[str(vehicle)] = "was on a lane that is not for cars"
        edges[str(vehicle)] = [e for e, _ in groupby(filter(None, map(edge_of.get, passed)))]
    return edges, others


def _edge(lane: str) -> str:
    """Edge of a lane; empty if it is within a junction."""
    return "" if lane.startswith(":") else lane.rpartition("_")[0]


def _for_cars(lane: str, network: Network, name: str) -> bool:
    edge, _, index = lane.rpartition("_")
    try:
        return int(index) in network.lanes_for_cars(edge)
    except (UserError, ValueError):
        raise UserError(
            f"{name}: a vehicle is on lane {lane!r}, and {network.path} has no such edge; give "
            "the network that was driven on"
        ) from None
