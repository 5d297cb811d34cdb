"""SUMO network files: read them safely and build the Road along a route.

Network file format: https://sumo.dlr.de/docs/Networks/SUMO_Road_Networks.html
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sumo_cohesion.errors import UserError
from sumo_cohesion.road import Road
from sumo_cohesion.road_shape import Lane, NoRoadError, blend, road_along
from sumo_cohesion.state import FloatArray
from sumo_cohesion.traffic.network_check import check_network
from sumo_cohesion.traffic.xml_files import check_xml


class Edge(NamedTuple):
    """An edge as cars see it.

    ``lanes`` are the centre lines (n, 2) of its lanes for cars, ``onward`` the names of all edges
    that they lead to, ``internal`` tells whether it is within a junction.
    """

    name: str
    lanes: tuple[FloatArray, ...]
    onward: frozenset[str]
    internal: bool = False


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

    def for_cars(self) -> list[Edge]:
        """Every edge that cars may use, those within junctions too."""
        return [
            Edge(
                str(edge.getID()),
                tuple(_shape(lane) for lane in lanes),
                frozenset(name for lane in lanes for name in self._onward(lane)),
                edge.getFunction() == "internal",
            )
            for edge in self._net.getEdges(withInternal=True)
            if (lanes := _car_lanes(edge))
        ]

    def _onward(self, lane: Any) -> Iterator[str]:
        for connection in lane.getOutgoing():
            yield str(connection.getToLane().getEdge().getID())
            if via := connection.getViaLaneID():
                yield str(self._net.getLane(via).getEdge().getID())

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
            lanes, exits = self._lanes_beside(edges)
            n_route = max(e.getLaneNumber() for e in edges)
            return road_along(self._chain_shape(chain), lanes, n_route, exits)

    @contextmanager
    def _readable(self, where: str) -> Iterator[None]:
        """Turn whatever a network that makes no sense causes into one line."""
        try:
            yield
        except UserError:
            raise
        except NoRoadError as error:
            raise UserError(f"the ego's route {error}; choose another destination") from error
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
                edge = edges[i].getID()
                raise UserError(
                    f"{self.path}: on the ego's route, no lane for cars leads on from edge "
                    f"{edge!r}; choose another destination or mend its connections"
                ) from NoRoadError(f"has no lane for cars that leads on from edge {edge!r}")
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
            pieces.append(blend(_shape(enter), _shape(leave)) if enter != leave else _shape(enter))
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

    def _lanes_beside(self, edges: list[Any]) -> tuple[list[tuple[int, Lane]], list[list[Lane]]]:
        """Return every lane on a route, with its column, and the lanes of every exit off it."""
        route: list[tuple[int, Lane]] = []
        exits: list[list[Lane]] = []
        for edge, following in zip(edges, [*edges[1:], None], strict=True):
            for lane in _car_lanes(edge):
                limit, last = float(lane.getSpeed()), edge == edges[-1]
                route.append((lane.getIndex(), Lane(_shape(lane), lane.getWidth(), limit, last)))
                for connection in lane.getOutgoing():
                    to = connection.getToLane()
                    if not to.allows("passenger"):
                        continue
                    via = [Lane(_shape(v), v.getWidth()) for v in self._internal(lane, to)]
                    if to.getEdge() == following:
                        route += [(to.getIndex(), piece) for piece in via]
                    elif connection.getDirection() != connection.LINKDIR_TURN:
                        exits.append([*via, Lane(_shape(to), to.getWidth())])
        return route, exits


def _car_lanes(edge: Any) -> list[Any]:
    return [lane for lane in edge.getLanes() if lane.allows("passenger")]


def _shape(lane: Any) -> FloatArray:
    return np.asarray([p[:2] for p in lane.getShape()], dtype=float)
