"""Lanelets as streets: what lies side by side makes one, and roads go along their sequence.

Lanelets: Bender, Ziegler, Stiller: Lanelets: efficient map representation for autonomous driving,
2014.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import isnan, nan

import numpy as np

from sumo_cohesion.road import Road
from sumo_cohesion.road_shape import Lane, NoRoadError, arc_length, blend, resample, road_along
from sumo_cohesion.state import FloatArray
from sumo_cohesion.traffic.network import Edge

_PIECE = 10.0
"""Metres of a lanelet that count as equally wide."""
_FARTHEST = 4
"""Sections from one that was passed to the next at most."""


@dataclass(frozen=True)
class Lanelet:
    """One lanelet.

    Attributes
    ----------
    id : as the file has it.
    centre : (n, 2) m, in the direction of driving.
    width : (n,) m.
    onward : ids of its successors.
    right, left : id of the lanelet beside it that is driven in the same direction; empty if none.
    limit : m/s; NaN if nothing says so.
    for_cars : cars may drive on it.
    """

    id: str
    centre: FloatArray
    width: FloatArray
    onward: tuple[str, ...] = ()
    right: str = ""
    left: str = ""
    limit: float = nan
    for_cars: bool = True


class Streets:
    """Sections of lanelets that lie side by side, from right to left: what edges are in SUMO."""

    def __init__(self, lanelets: Mapping[str, Lanelet]) -> None:
        self._lanelets = {name: one for name, one in lanelets.items() if one.for_cars}
        self._sections: dict[str, tuple[str, ...]] = {}
        self._section_of: dict[str, str] = {}
        for name in self._lanelets:
            if name not in self._section_of:
                section = self._beside(name)
                self._sections[name] = section
                self._section_of |= dict.fromkeys(section, name)

    def edges(self) -> list[Edge]:
        """Every section, by the name of one of its lanelets."""
        return [
            Edge(
                name,
                tuple(self._lanelets[one].centre for one in section),
                frozenset(self._section_of[to] for to, _ in self._ways(section)),
            )
            for name, section in self._sections.items()
        ]

    def road(self, passed: Sequence[str], usual_limit: float) -> Road:
        """Build the road along some sections; its s = 0 is where the first begins.

        ``usual_limit`` (m/s) is that of a road along which nothing says any.

        Raises
        ------
        NoRoadError
            If there is no way from one to the next, or no road along them.
        """
        route = [*passed[:1]]
        for pair in pairwise(passed):
            route += self._bridge(*pair)
        line = np.concatenate([*self._line(route)])
        lanes: list[tuple[int, Lane]] = []
        exits: list[list[Lane]] = []
        for section, following in zip(route, [*route[1:], ""], strict=True):
            last = section == route[-1]
            for column, name in enumerate(self._sections[section]):
                lanes += [(column, piece) for piece in _pieces(self._lanelets[name], last)]
            for to, _ in self._ways(self._sections[section]):
                if following and self._section_of[to] != following:
                    exits.append(_pieces(self._lanelets[to], last=False))
        if all(isnan(lane.limit) for _, lane in lanes):
            lanes = [(column, lane._replace(limit=usual_limit)) for column, lane in lanes]
        n_route = max(len(self._sections[section]) for section in route)
        return road_along(line, lanes, n_route, exits)

    def _beside(self, name: str) -> tuple[str, ...]:
        """Lanelets in the same direction beside one, from right to left."""
        section = [name]
        while (right := self._lanelets[section[0]].right) in self._lanelets:
            if right in section or right in self._section_of:
                break
            section.insert(0, right)
        while (left := self._lanelets[section[-1]].left) in self._lanelets:
            if left in section or left in self._section_of:
                break
            section.append(left)
        return tuple(section)

    def _ways(self, section: Sequence[str]) -> list[tuple[str, str]]:
        """Lanelets that those of a section lead to, each with the one that does."""
        return [
            (to, name)
            for name in section
            for to in self._lanelets[name].onward
            if to in self._lanelets
        ]

    def _bridge(self, first: str, last: str) -> list[str]:
        """Sections from one to another by the fewest in between; the first is left out."""
        reached: list[list[str]] = [[first]]
        for _ in range(_FARTHEST):
            further: list[list[str]] = []
            for way in reached:
                for to, _ in self._ways(self._sections[way[-1]]):
                    if self._section_of[to] == last:
                        return [*way[1:], last]
                    if self._section_of[to] not in way:
                        further.append([*way, self._section_of[to]])
            reached = further
        raise NoRoadError(
            f"drove from lanelet {first} to lanelet {last}, which it does not lead to"
        )

    def _line(self, route: Sequence[str]) -> list[FloatArray]:
        """Polylines along the lanelets of a route, with as few changes as one sees from each."""
        pieces = []
        enter = ""
        for section, following in zip(route, [*route[1:], ""], strict=True):
            names = self._sections[section]
            ways = [(to, by) for to, by in self._ways(names) if self._section_of[to] == following]
            if not enter:
                enter = ways[0][1] if ways else names[0]
            at = names.index(enter)
            onward, leave = min(
                ways, key=lambda way: abs(names.index(way[1]) - at), default=("", enter)
            )
            a, b = self._lanelets[enter].centre, self._lanelets[leave].centre
            pieces.append(a if enter == leave else blend(a, b))
            enter = onward
        return pieces


def between(left: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centre line (n, 2) and width (n,) between two bounds (m)."""
    if len(left) != len(right):
        n = max(len(left), len(right))
        left, right = resample(left, n), resample(right, n)
    apart = left - right
    return 0.5 * (left + right), np.hypot(apart[:, 0], apart[:, 1])


def _pieces(lanelet: Lanelet, last: bool) -> list[Lane]:
    """Cut a lanelet into pieces that are each about equally wide."""
    s = arc_length(lanelet.centre)
    n = max(round(s[-1] / _PIECE), 1)
    cuts = np.linspace(0.0, s[-1], n + 1)
    found = []
    for begin, end in pairwise(cuts):
        at = np.concatenate(([begin], s[(s > begin) & (s < end)], [end]))
        shape = np.column_stack([np.interp(at, s, lanelet.centre[:, k]) for k in range(2)])
        width = float(np.interp(0.5 * (begin + end), s, lanelet.width))
        found.append(Lane(shape, width, lanelet.limit, last))
    return found
