"""Which streets a vehicle drove along, from its positions alone: map matching.

The most probable sequence of edges is looked for, by dynamic programming over the edges near each
position (Newson, Krumm: Hidden Markov map matching through noise and sparseness, 2009, in spirit):
an edge far aside, against the direction, or not led to by the one before, costs.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from math import hypot, inf

import numpy as np
from scipy.spatial import cKDTree

from sumo_cohesion.road_shape import arc_length, resample
from sumo_cohesion.state import FloatArray
from sumo_cohesion.traffic.network import Edge

SPREAD = 2.0
"""Metres between two positions that are looked at, and between two points of a lane."""
_NEAR = 10.0
"""Metres from a lane up to which a vehicle can be on it."""
_MOST = 32
"""Points of lanes looked at around a position."""
_TURNED = np.radians(60.0)
"""Angle to a lane's direction up to which a vehicle can be on it."""
_ASIDE, _ASKEW = 1.5, np.radians(20.0)
"""Usual distance (m) from a lane's centre and usual angle to it."""
_LEAP = 40.0
"""Cost of going on to an edge that the one before does not lead to; one is that of being _ASIDE."""
_CHANGE = 0.5
"""Cost of going on to the next edge."""


class Matcher:
    """A network's edges, to find those that were driven along."""

    def __init__(self, edges: Sequence[Edge]) -> None:
        self._edges = edges
        number = {edge.name: k for k, edge in enumerate(edges)}
        self._onward = [{number[n] for n in e.onward if n in number} for e in edges]
        points, headings, owners = [], [], []
        for k, edge in enumerate(edges):
            for lane in edge.lanes:
                line = resample(lane, max(int(arc_length(lane)[-1] / SPREAD) + 1, 2))
                along = np.gradient(line, axis=0)
                points.append(line)
                headings.append(np.arctan2(along[:, 1], along[:, 0]))
                owners.append(np.full(len(line), k))
        self._tree = cKDTree(np.concatenate(points))
        self._heading = np.concatenate(headings)
        self._owner = np.concatenate(owners)

    def away(self, points: FloatArray) -> FloatArray:
        """Metres (n,) from points (n, 2) to the nearest lane, to half of SPREAD."""
        return np.asarray(self._tree.query(points)[0])

    def passed(self, points: FloatArray, heading: FloatArray | None = None) -> list[str]:
        """Names of the edges that were driven along, in order; those within junctions left out.

        Parameters
        ----------
        points : (n, 2) m, a vehicle's centre, in the order of time.
        heading : (n,) rad; None if it is that of the way driven.
        """
        looked_at = thinned(points, SPREAD)
        places = points[looked_at]
        headings = _of_way(places) if heading is None else heading[looked_at]
        found = self._most_probable(self._candidates(places, headings))
        names = [self._edges[k].name for k in found if not self._edges[k].internal]
        return [name for name, _ in groupby(names)]

    def _candidates(self, places: FloatArray, headings: FloatArray) -> list[dict[int, float]]:
        """Edges that each place can be on, with what that costs; places on none are left out."""
        most = min(_MOST, self._tree.n)
        distance, near = (np.reshape(a, (-1, most)) for a in self._tree.query(places, k=most))
        turned = np.abs((self._heading[near] - headings[:, None] + np.pi) % (2 * np.pi) - np.pi)
        turned = np.nan_to_num(turned)  # who stands has no direction
        cost = (distance / _ASIDE) ** 2 + (turned / _ASKEW) ** 2
        possible = (distance <= _NEAR) & (turned <= _TURNED)
        found = []
        for costs, edges, can in zip(cost, self._owner[near], possible, strict=True):
            best: dict[int, float] = {}
            for edge, value in zip(edges[can].tolist(), costs[can].tolist(), strict=True):
                best[edge] = min(value, best.get(edge, np.inf))
            if best:
                found.append(best)
        return found

    def _most_probable(self, candidates: Sequence[dict[int, float]]) -> list[int]:
        """Edges on the cheapest way through the candidates, one for each."""
        if not candidates:
            return []
        total, came_from = dict(candidates[0]), []
        for here in candidates[1:]:
            cheapest = min(total, key=total.__getitem__)
            leap = (total[cheapest] + _LEAP, cheapest)
            before: dict[int, int] = {}
            costs: dict[int, float] = {}
            for edge, cost in here.items():
                ways = [leap]
                if edge in total:
                    ways.append((total[edge], edge))
                ways += [(c + _CHANGE, e) for e, c in total.items() if edge in self._onward[e]]
                least, before[edge] = min(ways)
                costs[edge] = least + cost
            total = costs
            came_from.append(before)
        found = [min(total, key=total.__getitem__)]
        for before in reversed(came_from):
            found.append(before[found[-1]])
        return found[::-1]


def thinned(points: FloatArray, metres: float) -> list[int]:
    """Choose points (n, 2) of a way so far from each other that noise is no way; return indices.

    >>> thinned(np.array([(0.0, 0.0), (0.3, 0.1), (2.2, 0.0), (2.1, 0.1), (5.0, 0.0)]), 2.0)
    [0, 2, 4]
    """
    kept: list[int] = []
    x0 = y0 = inf
    for k, (x, y) in enumerate(points.tolist()):
        if hypot(x - x0, y - y0) >= metres:
            kept.append(k)
            x0, y0 = x, y
    return kept


def _of_way(places: FloatArray) -> FloatArray:
    """Heading (rad) of the way at each of its places; NaN for one that has not moved."""
    if len(places) < 2:
        return np.full(len(places), np.nan)
    along = np.gradient(places, axis=0)
    return np.arctan2(along[:, 1], along[:, 0])
