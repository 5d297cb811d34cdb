"""SUMO network files: read them safely and build the Road along a route.

Network file format: https://sumo.dlr.de/docs/Networks/SUMO_Road_Networks.html
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from sumo_cohesion.errors import UserError
from sumo_cohesion.road import SPACING, Road
from sumo_cohesion.state import FloatArray, IntArray
from sumo_cohesion.traffic.network_check import check_network
from sumo_cohesion.traffic.xml_files import check_xml

EXTENSION = 100.0
"""Straight metres added to both ends of the reference line, so that cars near them project."""
_APART = round(100.0 / SPACING)
"""Vertices between two exits in one column: farther than from one car to another in its lane."""
LONGEST_ROUTE = 300_000.0
"""Metres of the ego's route at most: its road takes half a gigabyte then."""
SMOOTHING = 4.0
"""Standard deviation (m) of the filter that rounds the kinks of a polyline. It moves a curve of
radius R inwards by SMOOTHING²/2R (2 cm at 400 m); the lanes, measured in the same frame, are
where they were."""


class Network:
    """A SUMO network, read once per file.

    Raises
    ------
    UserError
        If the file is not a usable network.
    """

    def __init__(self, path: Path) -> None:
        import sumolib

        check_network(check_xml(path, "net"), path)
        self.path = path
        try:
            self._net: Any = sumolib.net.readNet(str(path), withInternal=True)
        except Exception as error:
            # sumolib raises whatever the broken attribute happens to cause.
            raise UserError(
                f"{path}: SUMO's reader rejects the network "
                f"({type(error).__name__}: {error}); rebuild it with netconvert"
            ) from None
        if not self.edges():
            raise UserError(f"{path}: the network has no edges; rebuild it with netconvert")

    def edges(self) -> list[str]:
        """Ids of the ordinary (not junction-internal) edges."""
        return [str(e.getID()) for e in self._net.getEdges(withInternal=False)]

    def n_lanes(self, edge: str) -> int:
        """Return the number of lanes of an edge."""
        return int(self._edge(edge).getLaneNumber())

    def lanes_for_cars(self, edge: str) -> list[int]:
        """Return the lanes of an edge that cars may use, from right to left."""
        return [int(lane.getIndex()) for lane in _car_lanes(self._edge(edge))]

    def edge_length(self, edge: str) -> float:
        """Length (m) of an edge."""
        return float(self._edge(edge).getLength())

    def speed_limit(self, edge: str) -> float:
        """Highest speed limit (m/s) of an edge's lanes."""
        return max(float(lane.getSpeed()) for lane in self._edge(edge).getLanes())

    def route(self, origin: str, destination: str) -> list[str]:
        """Edges of the shortest route for cars between two edges, both included."""
        first, last = self._edge(origin), self._edge(destination)
        with self._readable(f"from edge {origin!r} to edge {destination!r}"):
            path, _ = self._net.getShortestPath(first, last, vClass="passenger")
        if path is None:
            raise UserError(
                f"{self.path}: no way for a car from edge {origin!r} to edge {destination!r}"
            )
        return [str(e.getID()) for e in path]

    def traffic_lights(self, route: Sequence[str]) -> list[str]:
        """Ids of the traffic lights that a route passes, in order."""
        edges = [self._edge(e) for e in route]
        found: dict[str, None] = {}
        for edge, following in pairwise(edges):
            for connection in edge.getConnections(following):
                if connection.getTLSID():
                    found[str(connection.getTLSID())] = None
        return list(found)

    def road(self, route: Sequence[str]) -> Road:
        """Build the Road along a route; its s = 0 is the start of the first edge."""
        edges = [self._edge(e) for e in route]
        with self._readable(f"along the route from edge {route[0]!r} to edge {route[-1]!r}"):
            chain = self._lane_chain(edges)
            line = _reference_line(self._chain_shape(chain))
            return self._with_lanes(_bare_road(line), edges)

    @contextmanager
    def _readable(self, where: str) -> Iterator[None]:
        """Turn whatever a network that makes no sense causes into one line."""
        try:
            yield
        except UserError:
            raise
        except Exception as error:
            raise UserError(
                f"{self.path}: no road can be made of it {where} ({type(error).__name__}: "
                f"{error}); rebuild the network with netconvert"
            ) from None

    def _edge(self, edge: str) -> Any:
        if not self._net.hasEdge(edge) or self._net.getEdge(edge).getFunction() == "internal":
            names = sorted(self.edges())
            shown = ", ".join(names[:8]) + (f", … ({len(names)} in all)" if names[8:] else "")
            raise UserError(f"{self.path}: has no edge {edge!r}; its edges are {shown}")
        return self._net.getEdge(edge)

    def _lane_chain(self, edges: list[Any]) -> list[tuple[Any, Any]]:
        """Pick the lanes to enter and to leave each edge by, with the fewest lane changes.

        The reference line follows them. Among equals the rightmost lane is taken.
        """
        # best[i][lane id]: lane changes needed from entering edge i on that lane to the end of
        # the route, the lane to leave edge i by, the lane to enter edge i + 1 by.
        best: list[dict[str, tuple[int, Any, Any]]] = [{} for _ in edges]
        for i in reversed(range(len(edges))):
            leaving: list[tuple[int, Any, Any]] = []
            for lane in _car_lanes(edges[i]):
                if i + 1 == len(edges):
                    leaving.append((0, lane, None))
                    continue
                onward = [c.getToLane() for c in lane.getOutgoing()]
                onward = [to for to in onward if to.getID() in best[i + 1]]
                if onward:
                    to = min(onward, key=lambda o: (best[i + 1][o.getID()][0], o.getIndex()))
                    leaving.append((best[i + 1][to.getID()][0], lane, to))
            for lane in _car_lanes(edges[i]):
                options = [
                    (cost + abs(out.getIndex() - lane.getIndex()), out.getIndex(), out, to)
                    for cost, out, to in leaving
                ]
                if options:
                    cost, _, out, to = min(options, key=lambda o: o[:2])
                    best[i][lane.getID()] = (cost, out, to)
            if not best[i]:
                raise UserError(
                    f"{self.path}: on the ego's route, no lane for cars leads on from edge "
                    f"{edges[i].getID()!r}; choose another destination or mend its connections"
                )
        first = _car_lanes(edges[0])
        lane = min(first, key=lambda o: (best[0][o.getID()][0], o.getIndex()))
        chain = []
        for choices in best:
            _, out, onward_lane = choices[lane.getID()]
            chain.append((lane, out))
            lane = onward_lane
        return chain

    def _chain_shape(self, chain: list[tuple[Any, Any]]) -> FloatArray:
        """Polyline (n, 2) of a chain of lanes and the junction-internal lanes between them."""
        pieces = []
        for i, (enter, leave) in enumerate(chain):
            pieces.append(_blend(_shape(enter), _shape(leave)) if enter != leave else _shape(enter))
            if i + 1 < len(chain):
                pieces.extend(_shape(via) for via in self._internal(leave, chain[i + 1][0]))
        return np.concatenate(pieces)

    def _internal(self, lane: Any, to: Any) -> list[Any]:
        """Junction-internal lanes of the connection between two lanes, in driving order."""
        connection = next(c for c in lane.getOutgoing() if c.getToLane() == to)
        lanes = []
        # A connection with an internal junction is split into several internal lanes.
        while connection is not None and connection.getViaLaneID():
            via = self._net.getLane(connection.getViaLaneID())
            lanes.append(via)
            connection = next(iter(via.getOutgoing()), None)
        return lanes

    def _with_lanes(self, road: Road, edges: list[Any]) -> Road:
        """Measure every lane on, and every exit off, the route in the road's own frame."""
        n_route = max(e.getLaneNumber() for e in edges)
        strips: list[tuple[int, list[Any]]] = []
        exits: list[list[Any]] = []
        for edge, following in zip(edges, [*edges[1:], None], strict=True):
            for lane in _car_lanes(edge):
                strips.append((lane.getIndex(), [lane]))
                for connection in lane.getOutgoing():
                    to = connection.getToLane()
                    if not to.allows("passenger"):
                        continue
                    via = self._internal(lane, to)
                    if to.getEdge() == following:
                        strips.append((to.getIndex(), via))
                    elif connection.getDirection() != connection.LINKDIR_TURN:
                        exits.append([*via, to])
        columns = n_route
        for k, lanes in zip(_pack([_extent(road, lanes) for lanes in exits]), exits, strict=True):
            strips.append((n_route + k, lanes))
            columns = max(columns, n_route + k + 1)
        centre = np.full((road.x.size, columns), np.nan)
        width = np.full_like(centre, np.nan)
        limit = np.full(road.x.size, np.nan)
        ends = []
        for column, lanes in strips:
            for lane in lanes:
                at, d = _strip(road, _shape(lane))
                free = np.isnan(centre[at, column])
                centre[at[free], column] = d[free]
                width[at[free], column] = lane.getWidth()
                if column < n_route and lane.getEdge().getFunction() != "internal":
                    limit[at] = np.fmax(limit[at], lane.getSpeed())
                    if lane.getEdge() == edges[-1]:
                        ends.append(at[-1])
        if not ends:
            raise UserError(
                f"{self.path}: along the ego's route its own lanes cannot be found; it turns back "
                "on itself; choose another destination"
            )
        last = max(ends)
        first = round(-road.s0 / SPACING)
        for values in (centre[:, :n_route], width[:, :n_route], limit[:, None]):
            values[:first] = values[first]
            values[last:] = values[last]
        return replace(
            road,
            length=road.s0 + last * SPACING,
            lane_centre=centre,
            lane_width=width,
            speed_limit=_filled(limit),
            n_route_lanes=n_route,
        )


def _car_lanes(edge: Any) -> list[Any]:
    return [lane for lane in edge.getLanes() if lane.allows("passenger")]


def _shape(lane: Any) -> FloatArray:
    return np.asarray([p[:2] for p in lane.getShape()], dtype=float)


def _arc_length(points: FloatArray) -> FloatArray:
    steps = np.diff(points, axis=0)
    return np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))


def _resample(points: FloatArray, n: int) -> FloatArray:
    """Return n points at equal arc length along a polyline, both ends kept."""
    s = _arc_length(points)
    at = np.linspace(0.0, s[-1], n)
    return np.column_stack((np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])))


def _blend(a: FloatArray, b: FloatArray) -> FloatArray:
    """Polyline that leaves one lane at its start and reaches another at its end."""
    n = max(int(_arc_length(a)[-1]), 2)
    u = np.linspace(0.0, 1.0, n)[:, None]
    share = u * u * (3.0 - 2.0 * u)
    return (1.0 - share) * _resample(a, n) + share * _resample(b, n)


def _reference_line(points: FloatArray) -> FloatArray:
    """Smooth line (G, 2) with a vertex every SPACING m, extended straight at both ends."""
    length = _arc_length(points)[-1]
    if length < 3 * SPACING:
        raise UserError("the ego's route is shorter than 3 m; choose another destination")
    if length > LONGEST_ROUTE:
        raise UserError(
            f"the ego's route is {length / 1e3:.0f} km long, more than {LONGEST_ROUTE / 1e3:g} km; "
            "choose another destination"
        )
    line = _resample(points, round(length / SPACING) + 1)
    head, tail = line[0] - line[1], line[-1] - line[-2]
    steps = np.arange(1.0, EXTENSION / SPACING + 1)[:, None]
    head, tail = (steps * v * SPACING / np.hypot(*v) for v in (head, tail))
    line = np.concatenate((line[0] + head[::-1], line, line[-1] + tail))
    smooth = np.asarray(gaussian_filter1d(line, SMOOTHING / SPACING, axis=0, mode="nearest"))
    # The filter needs neighbours on both sides; the straight ends do not need the filter.
    margin = int(EXTENSION / SPACING) // 2
    smooth[:margin], smooth[-margin:] = line[:margin], line[-margin:]
    return _resample(smooth, round(_arc_length(smooth)[-1] / SPACING) + 1)


def _bare_road(line: FloatArray) -> Road:
    """Road with a reference line (G, 2) but no lanes yet."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.hypot(tangent[:, 0], tangent[:, 1])[:, None]
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return Road(
        x=line[:, 0].copy(),
        y=line[:, 1].copy(),
        tangent_x=tangent[:, 0].copy(),
        tangent_y=tangent[:, 1].copy(),
        curvature=np.gradient(heading, SPACING),
        s0=-EXTENSION,
        length=(len(line) - 1) * SPACING - 2 * EXTENSION,
        lane_centre=np.full((len(line), 1), np.nan),
        lane_width=np.full((len(line), 1), np.nan),
        speed_limit=np.full(len(line), np.nan),
        n_route_lanes=1,
    )


def _extent(road: Road, lanes: list[Any]) -> tuple[int, int]:
    """First and last vertex of the reference line beside some lanes."""
    beside = np.concatenate([_strip(road, _shape(lane))[0] for lane in lanes])
    return (int(beside.min()), int(beside.max())) if beside.size else (0, 0)


def _pack(extents: list[tuple[int, int]]) -> list[int]:
    """Give each of some extents (first, last) a column, the first in which none is near it.

    >>> _pack([(0, 9), (5, 20), (150, 190), (160, 170)])
    [0, 1, 0, 1]
    """
    columns: list[list[tuple[int, int]]] = []
    chosen = []
    for first, last in extents:
        free = (
            k
            for k, taken in enumerate(columns)
            if all(last + _APART < a or b + _APART < first for a, b in taken)
        )
        k = next(free, len(columns))
        if k == len(columns):
            columns.append([])
        columns[k].append((first, last))
        chosen.append(k)
    return chosen


def _strip(road: Road, shape: FloatArray) -> tuple[IntArray, FloatArray]:
    """Vertices of the reference line beside a lane, and the lane centre's d (m) at each."""
    n = max(int(_arc_length(shape)[-1] / SPACING) + 1, 2)
    points = _resample(shape, n)
    frenet, _ = road.to_frenet(np.column_stack((points, np.zeros((n, 2)))))
    order = np.argsort(frenet[:, 0], kind="stable")
    s, d = frenet[order, 0], frenet[order, 1]
    # Half a vertex beyond each end, so that lanes that abut leave no gap between them.
    first = int(np.ceil((s[0] - road.s0) / SPACING - 0.5))
    last = int(np.floor((s[-1] - road.s0) / SPACING + 0.5))
    at = np.arange(max(first, 0), min(last, road.x.size - 1) + 1)
    return at, np.interp(road.s0 + at * SPACING, s, d)


def _filled(values: FloatArray) -> FloatArray:
    """Carry known values forward into gaps (a junction keeps the limit of the edge before)."""
    known = np.flatnonzero(~np.isnan(values))
    previous = np.searchsorted(known, np.arange(values.size), side="right") - 1
    return values[known[np.maximum(previous, 0)]]
