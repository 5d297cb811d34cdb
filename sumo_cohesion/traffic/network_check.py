"""Networks are checked for sense before SUMO sees them: some that make none end its process.

Only what every network has that SUMO's own programs write is asked for. One walk through the file.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection
from dataclasses import dataclass
from math import inf, isfinite
from pathlib import Path

from sumo_cohesion.errors import UserError

FARTHEST = 1e8
"""Coordinates (m) up to which a place can be told to a millimetre; once around the Earth is 4e7."""
LONGEST = 1e7
"""Metres of a lane at most."""
WIDEST = 1000.0
"""Metres across a lane at most."""
FASTEST = 1000.0
"""Speed limit (m/s) at most."""
_LIGHTS = frozenset("rRyYgGsuoO")
"""Letters of a traffic light's states."""


class _NonsenseError(Exception):
    """What is wrong, and where: the message is half a line."""


@dataclass(frozen=True)
class _Lane:
    edge: str
    internal: bool


@dataclass(frozen=True)
class _Edges:
    """Edges with their numbers of lanes, junction-internal ones too, and all lanes by id."""

    n_lanes: dict[str, int]
    start: dict[str, str]
    end: dict[str, str]
    lanes: dict[str, _Lane]


def check_network(net: ET.Element, path: Path) -> None:
    """Check a parsed network; ``path`` is its file.

    Raises
    ------
    UserError
        If a number, a shape or a list is not what it should be, an id is there twice or what is
        named is not there, or a lane within a junction is not part of a way through it.
    """
    try:
        edges = _checked_edges(net)
        _check_junctions(net, edges)
        _check_connections(net, edges, _checked_lights(net))
    except _NonsenseError as error:
        raise UserError(f"{path}: {error}; rebuild the network with netconvert") from None


def _checked_edges(net: ET.Element) -> _Edges:
    edges = _Edges({}, {}, {}, {})
    for edge in net.findall("edge"):
        name = _new_id(edge, edges.n_lanes)
        lanes = edge.findall("lane")
        if not lanes:
            raise _NonsenseError(f"edge {name!r} has no lanes")
        for index, lane in enumerate(lanes):
            lane_name = _new_id(lane, edges.lanes)
            if lane_name != f"{name}_{index}":
                raise _NonsenseError(f"lane {index} of edge {name!r} is called {lane_name!r}")
            _check_lane(lane, lane_name)
            edges.lanes[lane_name] = _Lane(name, edge.get("function") == "internal")
        edges.n_lanes[name] = len(lanes)
        if not edge.get("function"):
            _check_indices(name, lanes)
            edges.start[name], edges.end[name] = _need(edge, "from"), _need(edge, "to")
    return edges


def _check_indices(edge: str, lanes: list[ET.Element]) -> None:
    for index, lane in enumerate(lanes):
        if lane.get("index") != str(index):
            raise _NonsenseError(
                f"lane {index} of edge {edge!r} has the index {lane.get('index')!r}"
            )


def _check_lane(lane: ET.Element, name: str) -> None:
    of = f"lane {name!r}"
    _check_number(of, "length", _need(lane, "length"), LONGEST)
    _check_number(of, "speed", _need(lane, "speed"), FASTEST)
    _check_number(of, "width", lane.get("width", "1"), WIDEST)
    if _check_shape(of, _need(lane, "shape")) < 2:
        raise _NonsenseError(f"{of}: its shape has fewer than two points")


def _check_number(of: str, key: str, text: str, most: float) -> None:
    """Check what must be more than nothing, and no more than ``most``."""
    if not 0.0 < _number(of, key, text) <= most:
        raise _NonsenseError(f"{of}: {key} = {text!r} is not between 0 and {most:g}")


def _number(of: str, key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = inf
    if not isfinite(value):
        raise _NonsenseError(f"{of}: {key} = {text[:40]!r} is not a finite number")
    return value


def _check_shape(of: str, text: str) -> int:
    """Check the points of a shape, each x,y or x,y,z, and return how many there are."""
    points = text.split()
    for point in points:
        if point.count(",") not in (1, 2):
            raise _NonsenseError(f"{of}: {point[:40]!r} in its shape is not a point x,y")
    try:
        # All numbers at once: networks have millions.
        values = [float(part) for part in ",".join(points).split(",")] if points else []
    except ValueError:
        raise _NonsenseError(f"{of}: its shape is not a list of points x,y") from None
    if not (isfinite(sum(values)) and max(map(abs, values), default=0.0) < FARTHEST):
        raise _NonsenseError(f"{of}: its shape goes farther than {FARTHEST:g} m")
    return len(points)


def _check_junctions(net: ET.Element, edges: _Edges) -> None:
    names: set[str] = set()
    for junction in net.findall("junction"):
        name = _new_id(junction, names)
        names.add(name)
        of = f"junction {name!r}"
        for key in ("x", "y"):
            if abs(_number(of, key, _need(junction, key))) >= FARTHEST:
                raise _NonsenseError(f"{of}: {key} is farther than {FARTHEST:g} m")
        _check_shape(of, junction.get("shape", ""))
    for ends in (edges.start, edges.end):
        for edge, junction_name in ends.items():
            if junction_name not in names:
                raise _NonsenseError(
                    f"edge {edge!r} names junction {junction_name!r}, which is not there"
                )
    for junction in net.findall("junction"):
        _check_lists(junction, edges)


def _check_lists(junction: ET.Element, edges: _Edges) -> None:
    """Check what a junction says of the lanes that lead to it and of those within it."""
    name = junction.get("id", "")
    of = f"junction {name!r}"
    for key in ("incLanes", "intLanes"):
        for lane in junction.get(key, "").split():
            if lane not in edges.lanes:
                raise _NonsenseError(f"{of}: {key} names lane {lane!r}, which is not there")
            if _node(lane) != _node(name) and edges.end.get(_edge_of(lane)) != _node(name):
                raise _NonsenseError(f"{of}: {key} names lane {lane!r} of another junction")
    _check_requests(of, junction.findall("request"))


def _edge_of(lane: str) -> str:
    return lane.rpartition("_")[0]


def _node(name: str) -> str:
    """Junction that a lane within one, or a junction within one, is part of; else the name."""
    return name[1:].rsplit("_", 2)[0] if name.startswith(":") else name


def _check_requests(of: str, requests: list[ET.Element]) -> None:
    """Check a junction's right of way: of each of its links, which others it waits for."""
    for index, request in enumerate(requests):
        if request.get("index") != str(index):
            raise _NonsenseError(f"{of}: request {index} has the index {request.get('index')!r}")
        for key in ("response", "foes"):
            text = _need(request, key)
            if len(text) != len(requests) or not set(text) <= {"0", "1"}:
                raise _NonsenseError(
                    f"{of}: {key} = {text[:40]!r} of request {index} is not a 0 or 1 for each of "
                    f"its {len(requests)} links"
                )


def _checked_lights(net: ET.Element) -> dict[str, int]:
    """Check programs of traffic lights; return how many links each light has."""
    links: dict[str, int] = {}
    programs: set[tuple[str, str]] = set()
    for logic in net.findall("tlLogic"):
        name = _need(logic, "id")
        of = f"traffic light {name!r}"
        program = (name, _need(logic, "programID"))
        if program in programs:
            raise _NonsenseError(f"{of} has the program {program[1]!r} twice")
        programs.add(program)
        _number(of, "offset", logic.get("offset", "0"))
        phases = logic.findall("phase")
        if not phases:
            raise _NonsenseError(f"{of}: its program has no phases")
        for phase in phases:
            state = _need(phase, "state")
            if len(state) != links.setdefault(name, len(state)) or not set(state) <= _LIGHTS:
                raise _NonsenseError(
                    f"{of}: the state {state[:40]!r} of a phase is not a letter for each of its "
                    f"{links[name]} links"
                )
            _check_number(of, "duration", _need(phase, "duration"), inf)
    return links


def _check_connections(net: ET.Element, edges: _Edges, lights: dict[str, int]) -> None:
    entered: set[str] = set()  # lanes within junctions that a connection leads by
    onward: dict[str, ET.Element] = {}
    ordinary = []
    for connection in net.findall("connection"):
        first, _ = _check_ends(connection, edges)
        start = edges.lanes[first]
        via = connection.get("via")
        if via:
            if via not in edges.lanes or not via.startswith(":"):
                raise _NonsenseError(
                    f"{_called(connection)} leads by lane {via!r}, which is not one within a "
                    "junction"
                )
            if via in entered and edges.lanes[via].internal:
                raise _NonsenseError(f"two connections lead by lane {via!r}")
            entered.add(via)
        if start.internal:
            if first in onward:
                raise _NonsenseError(f"two connections lead on from lane {first!r}")
            onward[first] = connection
        elif via:
            ordinary.append(connection)
        light = connection.get("tl")
        if light in lights:  # those of railways have no program
            _check_link(connection, lights[light])
    for name, lane in edges.lanes.items():
        if lane.internal and (name not in entered or name not in onward):
            how = "into" if name not in entered else "on from"
            raise _NonsenseError(f"no connection leads {how} lane {name!r} within a junction")
    for connection in ordinary:
        _check_way(connection, onward)


def _check_ends(connection: ET.Element, edges: _Edges) -> list[str]:
    """Check where a connection leads from and to; return the two lanes."""
    ends = []
    for key, lane_key in (("from", "fromLane"), ("to", "toLane")):
        edge, index = _need(connection, key), _need(connection, lane_key)
        n = edges.n_lanes.get(edge)
        if n is None:
            raise _NonsenseError(f"{_called(connection)} names edge {edge!r}, which is not there")
        if f"{edge}_{index}" not in edges.lanes or edges.lanes[f"{edge}_{index}"].edge != edge:
            raise _NonsenseError(
                f"{_called(connection)}: {lane_key} = {index!r}, but edge {edge!r} has lanes 0 to "
                f"{n - 1}"
            )
        ends.append(f"{edge}_{index}")
    junctions = {
        edges.end.get(connection.get("from", "")),
        edges.start.get(connection.get("to", "")),
    }
    if len(junctions - {None}) > 1:
        raise _NonsenseError(f"{_called(connection)}: the one does not end where the other begins")
    return ends


def _check_link(connection: ET.Element, n: int) -> None:
    index = _need(connection, "linkIndex")
    if not (index.isdecimal() and int(index) < n):
        raise _NonsenseError(
            f"{_called(connection)}: linkIndex = {index[:40]!r}, but its traffic light has {n} "
            "links"
        )


def _check_way(connection: ET.Element, onward: dict[str, ET.Element]) -> None:
    """Check that the lanes within a junction that a connection leads by end where it ends."""
    last, passed = connection, 0
    while via := last.get("via"):
        if via not in onward or passed > 10:
            raise _NonsenseError(f"{_called(connection)} leads into a junction and not out of it")
        last, passed = onward[via], passed + 1
    if any(last.get(key) != connection.get(key) for key in ("to", "toLane")):
        raise _NonsenseError(
            f"{_called(connection)} leads by {connection.get('via')!r}, which ends on another lane"
        )


def _called(connection: ET.Element) -> str:
    return f"the connection from {connection.get('from')!r} to {connection.get('to')!r}"


def _need(element: ET.Element, key: str) -> str:
    """Return an attribute that must be there, and not empty."""
    text = element.get(key)
    if not text:
        name = element.get("id")
        of = f"<{element.tag}>" if name is None else f"{element.tag} {name!r}"
        raise _NonsenseError(f"{of} has no {key}")
    return text


def _new_id(element: ET.Element, known: Collection[str]) -> str:
    name = _need(element, "id")
    if name in known:
        raise _NonsenseError(f"{element.tag} {name!r} is there twice")
    return name
