"""CommonRoad scenes as demonstrations: XML files of the versions 2018b and 2020a.

Format: https://commonroad.in.tum.de (documentation of the XML format; its schema is part of
commonroad-io). Metres, radians counter-clockwise, m/s; times are whole numbers of time steps;
positions are those of centres. Limits come from the lanelets' traffic signs (2020a) or from their
speedLimit (2018b).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from math import cos, isfinite, nan, sin
from pathlib import Path

import numpy as np
import pandas as pd

from sumo_cohesion.demonstrations.checking import checked
from sumo_cohesion.demonstrations.lanelets import Lanelet, Streets, between
from sumo_cohesion.demonstrations.matching import Matcher
from sumo_cohesion.demonstrations.roads import roads_driven, ways
from sumo_cohesion.errors import UserError
from sumo_cohesion.learning.recording import Recording
from sumo_cohesion.road_shape import LONGEST_ROUTE, arc_length
from sumo_cohesion.state import FloatArray
from sumo_cohesion.traffic.network_check import FARTHEST
from sumo_cohesion.traffic.xml_files import check_xml

VERSIONS = ("2018b", "2020a")
_CARS = {"car", "taxi"}
_NOT_FOR_CARS = {"sidewalk", "crosswalk", "bicycleLane", "busLane", "busStop"}
"""Types of lanelets that cars do not drive on."""
_LIMIT_SIGNS = {"274", "274.1", "R2-1"}
"""Traffic signs with a limit: those of Germany, which all of Europe has here, and of the USA."""
_DESIRED = 0.9
"""Quantile of the speeds driven that stands in for a limit."""


def read_commonroad(path: Path) -> Recording:
    """Read the moving obstacles of a CommonRoad scene, and along which lanelets they drove.

    Raises
    ------
    UserError
        If the file is damaged, of another kind or version, or makes no sense.
    """
    root = check_xml(path, "commonRoad")
    version = root.get("commonRoadVersion", "")
    if version not in VERSIONS:
        raise UserError(
            f"{path}: is CommonRoad of the version {version!r}; {' and '.join(VERSIONS)} can be "
            "read: convert it with commonroad-io"
        )
    try:
        streets = Streets(_lanelets(root))
        step = _float(root, "timeStepSize")
        if step <= 0.0:
            raise _SenselessError(f"timeStepSize is {step:g}, which is not positive")
        table, others, notes = _obstacles(root, step)
    except _SenselessError as error:
        raise UserError(f"{path}: {error}; write it again") from None
    if not streets.edges():
        raise UserError(f"{path}: holds no lanelets for cars, so that there are no roads")
    in_order, interval = checked(table, str(path))
    limit = _usual_speed(in_order, interval, others)
    matcher = Matcher(streets.edges())
    edges = {v: matcher.passed(points) for v, points in ways(in_order).items() if v not in others}
    roads, told = roads_driven(in_order, edges, lambda passed: streets.road(passed, limit), others)
    if any((road.speed_limit == limit).all() for road in roads.values()):
        notes.append(
            f"it does not say the speed limit of every road; taken for one is {limit:.1f} m/s, the "
            f"{_DESIRED:g} quantile of the speeds driven"
        )
    return Recording(str(path), in_order, roads, interval, (*notes, *told))


class _SenselessError(Exception):
    """What in the file makes no sense: half a line."""


def _float(element: ET.Element, name: str) -> float:
    """Return the number in an attribute or in a child."""
    text = element.get(name) or element.findtext(name)
    try:
        number = float(text or "")
    except ValueError:
        number = nan
    if not isfinite(number):
        raise _SenselessError(f"in <{element.tag}>, {name} is {text!r}, which is no number")
    return number


def _points(element: ET.Element | None, whose: str) -> FloatArray:
    found = [] if element is None else element.findall("point")
    if len(found) < 2:
        raise _SenselessError(f"{whose} has no bound of two points or more")
    points = np.array([(_float(p, "x"), _float(p, "y")) for p in found])
    if arc_length(points)[-1] > LONGEST_ROUTE:
        raise _SenselessError(f"{whose} has a bound longer than {LONGEST_ROUTE / 1e3:g} km")
    if np.abs(points).max() > FARTHEST:
        raise _SenselessError(f"{whose} is nowhere on Earth")
    return points


def _lanelets(root: ET.Element) -> dict[str, Lanelet]:
    signs = {sign.get("id", ""): _limit_of(sign) for sign in root.iter("trafficSign")}
    found = {}
    for element in root.findall("lanelet"):
        name = element.get("id", "")
        centre, width = between(
            _points(element.find("leftBound"), f"lanelet {name}"),
            _points(element.find("rightBound"), f"lanelet {name}"),
        )
        kinds = {(kind.text or "").strip() for kind in element.findall("laneletType")}
        limits = [signs.get(ref.get("ref", ""), nan) for ref in element.findall("trafficSignRef")]
        if element.find("speedLimit") is not None:
            limits.append(_float(element, "speedLimit"))
        known = [limit for limit in limits if limit > 0.0]
        found[name] = Lanelet(
            name,
            centre,
            width,
            onward=tuple(to.get("ref", "") for to in element.findall("successor")),
            right=_neighbour(element, "adjacentRight"),
            left=_neighbour(element, "adjacentLeft"),
            limit=min(known, default=nan),
            for_cars=not kinds & _NOT_FOR_CARS,
        )
    return found


def _neighbour(element: ET.Element, side: str) -> str:
    """Id of the lanelet beside one that is driven in the same direction; empty if none."""
    beside = element.find(side)
    if beside is None or beside.get("drivingDir") != "same":
        return ""
    return beside.get("ref", "")


def _limit_of(sign: ET.Element) -> float:
    """Limit (m/s) of a traffic sign; NaN if it is another one."""
    for part in sign.findall("trafficSignElement"):
        if (part.findtext("trafficSignID") or "").strip() in _LIMIT_SIGNS:
            return _float(part, "additionalValue")
    return nan


def _obstacles(root: ET.Element, step: float) -> tuple[pd.DataFrame, dict[str, str], list[str]]:
    """Rows of all obstacles that move; who of them is no car; and what there is to say."""
    rows: list[tuple[float, str, float, float, float, float]] = []
    others: dict[str, str] = {}
    left_out = 0
    for element in root:
        role = (element.findtext("role") or "").strip()  # of 2018b
        if element.tag != "dynamicObstacle" and (element.tag, role) != ("obstacle", "dynamic"):
            continue
        name = element.get("id", "")
        shape = element.find("shape")
        states = [(s, _place(s)) for s in _states(element)]
        if shape is None or len(states) < 2 or any(place is None for _, place in states):
            left_out += 1
            continue
        size, centre = _size(shape, name)
        for state, place in states:
            assert place is not None
            heading = _exact(state, "orientation") if any(centre) else 0.0
            x = place[0] + centre[0] * cos(heading) - centre[1] * sin(heading)
            y = place[1] + centre[0] * sin(heading) + centre[1] * cos(heading)
            rows.append((_exact(state, "time") * step, name, x, y, *size))
        if (element.findtext("type") or "").strip() not in _CARS:
            others[name] = "does not drive as cars do"
    columns = ["time", "vehicle", "x", "y", "length", "width"]
    notes = (
        [f"left out, for they have no exact positions: {left_out} obstacles"] if left_out else []
    )
    return pd.DataFrame(rows, columns=columns), others, notes


def _states(obstacle: ET.Element) -> list[ET.Element]:
    """States of an obstacle in order; in some files the trajectory repeats the initial one."""
    later = obstacle.findall("trajectory/state")
    known = {_exact(state, "time") for state in later[:1]}
    first = [s for s in obstacle.findall("initialState") if _exact(s, "time") not in known]
    return [*first, *later]


def _place(state: ET.Element) -> tuple[float, float] | None:
    """Where an obstacle is (m); None if the file does not say so exactly."""
    point = state.find("position/point")
    return None if point is None else (_float(point, "x"), _float(point, "y"))


def _exact(state: ET.Element, name: str) -> float:
    """Value of a state, or the middle of its interval."""
    value = state.find(name)
    if value is None:
        raise _SenselessError(f"a state has no {name}")
    if value.find("exact") is not None:
        return _float(value, "exact")
    return 0.5 * (_float(value, "intervalStart") + _float(value, "intervalEnd"))


def _size(shape: ET.Element, name: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Length, width (m) of a shape, and where its centre is (m) as seen from its place."""
    part = next(iter(shape), None)
    centre = (0.0, 0.0)
    if part is not None and (offset := part.find("center")) is not None:
        centre = (_float(offset, "x"), _float(offset, "y"))
    if part is not None and part.tag == "rectangle":
        return (_float(part, "length"), _float(part, "width")), centre
    if part is not None and part.tag == "circle":
        across = 2.0 * _float(part, "radius")
        return (across, across), centre
    if part is not None and part.tag == "polygon":
        points = _points(part, f"obstacle {name}")
        low, high = points.min(axis=0), points.max(axis=0)
        middle = 0.5 * (low + high)
        size = high - low
        return (float(size[0]), float(size[1])), (float(middle[0]), float(middle[1]))
    raise _SenselessError(f"obstacle {name} has no rectangle, circle or polygon for a shape")


def _usual_speed(table: pd.DataFrame, interval: float, others: dict[str, str]) -> float:
    """Quantile of the speeds (m/s) that cars drove, of a checked table."""
    cars = table[~table["vehicle"].isin(list(others))]
    steps = cars.groupby("vehicle", sort=False)[["time", "x", "y"]].diff().dropna()
    steps = steps[steps["time"] < 1.5 * interval]
    speeds = np.hypot(steps["x"], steps["y"]) / steps["time"]
    return max(float(speeds.quantile(_DESIRED)), 1.0) if len(speeds) else 1.0
