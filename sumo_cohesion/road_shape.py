"""Lay out a Road: a smooth line along polylines, and lanes measured in its frame.

Pure geometry: it knows neither SUMO nor files. ``traffic.network`` builds roads of a SUMO network
with it, ``demonstrations.lanelets`` those of a CommonRoad scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import nan
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from sumo_cohesion.road import SPACING, Road
from sumo_cohesion.state import FloatArray, IntArray

EXTENSION = 100.0
"""Straight metres added to both ends of the reference line, so that cars near them project."""
_APART = round(100.0 / SPACING)
"""Vertices between two exits in one column: farther than from one car to another in its lane."""
LONGEST_ROUTE = 300_000.0
"""Metres of a route at most: its road takes half a gigabyte then."""
SMOOTHING = 4.0
"""Standard deviation (m) of the filter that rounds the kinks of a polyline. It moves a curve of
radius R inwards by SMOOTHING²/2R (2 cm at 400 m); the lanes, measured in the same frame, are
where they were."""


class NoRoadError(Exception):
    """Along a route no road can be made; the message goes on after "the route"."""


class Lane(NamedTuple):
    """A lane beside a reference line, or a piece of one.

    ``shape`` are points (n, 2) of its centre line, ``width`` in m. ``limit`` (m/s) is NaN where
    the lane says nothing of it. ``last`` tells whether the route ends with it.
    """

    shape: FloatArray
    width: float
    limit: float = nan
    last: bool = False


def road_along(
    points: FloatArray,
    route: Sequence[tuple[int, Lane]],
    n_route: int,
    exits: Sequence[Sequence[Lane]] = (),
) -> Road:
    """Build the Road along a polyline; its s = 0 is the first point.

    Parameters
    ----------
    points : (n, 2) m, near which the reference line runs.
    route : the route's lanes, each with its column. Where two of a column overlap, the first
        counts.
    n_route : how many columns are the route's.
    exits : lanes off the route, in driving order, of each way that leads off it.

    Raises
    ------
    NoRoadError
        If the polyline is too short, too long or turns back on itself.
    """
    road = _bare_road(_reference_line(points))
    strips = [(column, lane, _strip(road, lane.shape)) for column, lane in route]
    off = [[(lane, _strip(road, lane.shape)) for lane in lanes] for lanes in exits]
    columns = n_route
    for k, lanes in zip(_pack([_extent([at for _, (at, _) in w]) for w in off]), off, strict=True):
        strips += [(n_route + k, lane, beside) for lane, beside in lanes]
        columns = max(columns, n_route + k + 1)
    centre = np.full((road.x.size, columns), np.nan)
    width = np.full_like(centre, np.nan)
    limit = np.full(road.x.size, np.nan)
    ends = []
    for column, lane, (at, d) in strips:
        free = np.isnan(centre[at, column])
        centre[at[free], column] = d[free]
        width[at[free], column] = lane.width
        if column < n_route:
            limit[at] = np.fmax(limit[at], lane.limit)
            if lane.last and at.size:
                ends.append(at[-1])
    if not ends:
        raise NoRoadError("turns back on itself: its own lanes cannot be found along it")
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


def arc_length(points: FloatArray) -> FloatArray:
    """Metres (n,) along a polyline (n, 2) up to each of its points."""
    steps = np.diff(points, axis=0)
    return np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))


def resample(points: FloatArray, n: int) -> FloatArray:
    """Return n points at equal arc length along a polyline, both ends kept."""
    s = arc_length(points)
    at = np.linspace(0.0, s[-1], n)
    return np.column_stack((np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])))


def blend(a: FloatArray, b: FloatArray) -> FloatArray:
    """Polyline that leaves one lane at its start and reaches another at its end."""
    n = max(int(arc_length(a)[-1]), 2)
    u = np.linspace(0.0, 1.0, n)[:, None]
    share = u * u * (3.0 - 2.0 * u)
    return (1.0 - share) * resample(a, n) + share * resample(b, n)


def _reference_line(points: FloatArray) -> FloatArray:
    """Smooth line (G, 2) with a vertex every SPACING m, extended straight at both ends."""
    length = arc_length(points)[-1]
    if length < 3 * SPACING:
        raise NoRoadError("is shorter than 3 m")
    if length > LONGEST_ROUTE:
        raise NoRoadError(f"is {length / 1e3:.0f} km long, more than {LONGEST_ROUTE / 1e3:g} km")
    line = resample(points, round(length / SPACING) + 1)
    head, tail = line[0] - line[1], line[-1] - line[-2]
    steps = np.arange(1.0, EXTENSION / SPACING + 1)[:, None]
    head, tail = (steps * v * SPACING / np.hypot(*v) for v in (head, tail))
    line = np.concatenate((line[0] + head[::-1], line, line[-1] + tail))
    smooth = np.asarray(gaussian_filter1d(line, SMOOTHING / SPACING, axis=0, mode="nearest"))
    # The filter needs neighbours on both sides; the straight ends do not need the filter.
    margin = int(EXTENSION / SPACING) // 2
    smooth[:margin], smooth[-margin:] = line[:margin], line[-margin:]
    return resample(smooth, round(arc_length(smooth)[-1] / SPACING) + 1)


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


def _extent(beside: Sequence[IntArray]) -> tuple[int, int]:
    """First and last of the vertices of the reference line beside some lanes."""
    found = np.concatenate(beside)
    return (int(found.min()), int(found.max())) if found.size else (0, 0)


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
    n = max(int(arc_length(shape)[-1] / SPACING) + 1, 2)
    points = resample(shape, n)
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
