"""The road along the ego's route: a Frenet frame, lanes, drivable edges and limits.

Pure geometry: it knows neither SUMO nor files. ``traffic.network`` builds it from a network.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from itertools import pairwise
from math import floor, isfinite, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from sumo_cohesion.state import FloatArray, IntArray

SPACING = 1.0
"""Metres between vertices of the reference line."""


TOO_NEAR = 6.0
"""Metres between two stretches of a road below which they cannot be told apart (returns)."""
MISS = 1.0
"""Metres beside the reference line up to which a path still keeps to the road (too_sharp)."""


class RoadAhead(NamedTuple):
    """The road at n places, one row each.

    rows : (n, 2 L + 2), columns: the L lanes' centres (m) and widths (m), speed limit (m/s) and
        curvature (1/m). Where a lane does not exist it is infinitely far and 1 m wide. Nor does a
        lane off the route, as long as it has not parted from one of the route's.
    edges : (n, 2) m, right and left border of the paved strip.
    """

    rows: FloatArray
    edges: FloatArray


@dataclass(frozen=True)
class Road:
    """A curved road in Frenet coordinates.

    The reference line is sampled every metre; between vertices its points and its tangents are
    interpolated linearly, so that the frame is continuous on both sides of a curve (a plain
    projection on segments sticks or jumps there), and to_cartesian(to_frenet(p)) returns p.

    Attributes
    ----------
    x, y : (G,) vertices of the reference line (m, Cartesian).
    tangent_x, tangent_y : (G,) unit tangents at the vertices.
    curvature : (G,) curvature of the reference line (1/m, left positive).
    s0 : arc length (m) of the first vertex; the route itself starts at s = 0.
    length : arc length (m) at which the route ends.
    lane_centre, lane_width : (G, L) lateral position and width (m) of each lane, NaN where the
        lane does not exist. Lanes off the route that can be reached from it (exits) come last; a
        column may hold several that are far apart.
    speed_limit : (G,) limit (m/s).
    n_route_lanes : how many of the L lanes belong to the route.
    """

    x: FloatArray
    y: FloatArray
    tangent_x: FloatArray
    tangent_y: FloatArray
    curvature: FloatArray
    s0: float
    length: float
    lane_centre: FloatArray
    lane_width: FloatArray
    speed_limit: FloatArray
    n_route_lanes: int
    _first: int = field(init=False, repr=False, compare=False)
    _tree: cKDTree = field(init=False, repr=False, compare=False)
    _segments: list[tuple[float, ...]] = field(init=False, repr=False, compare=False)
    _near: dict[tuple[int, int], int] = field(init=False, repr=False, compare=False)
    _centre_or_far: FloatArray = field(init=False, repr=False, compare=False)
    _ahead: FloatArray = field(init=False, repr=False, compare=False)
    _same_until: list[int] = field(init=False, repr=False, compare=False)
    _looked_up: dict[tuple[int, int, int], RoadAhead] = field(init=False, repr=False, compare=False)
    _bends: list[float] = field(init=False, repr=False, compare=False)
    _lane_rows: list[list[float]] = field(init=False, repr=False, compare=False)
    _borders: list[tuple[list[float], list[int]]] = field(init=False, repr=False, compare=False)
    _strips: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # All runs of a process share a road: what one planner did to it would reach the others.
        for array in (
            self.x,
            self.y,
            self.tangent_x,
            self.tangent_y,
            self.curvature,
            self.lane_centre,
            self.lane_width,
            self.speed_limit,
        ):
            array.flags.writeable = False
        vertices = np.column_stack((self.x, self.y))
        tangents = np.column_stack((self.tangent_x, self.tangent_y))
        heading = np.unwrap(np.arctan2(self.tangent_y, self.tangent_x))
        rows = np.column_stack((vertices, tangents, heading))
        # One row per segment: values at its start, then their change along it, then curvature.
        segments = np.column_stack((rows[:-1], np.diff(rows, axis=0), self.curvature[:-1]))
        # Of the route alone: an extension beyond its end may well cross it.
        first, end = self.index(0.0), self.index(self.length)
        object.__setattr__(self, "_first", int(first))
        object.__setattr__(self, "_tree", cKDTree(vertices[first : end + 1]))
        object.__setattr__(self, "_segments", [tuple(row) for row in segments.tolist()])
        object.__setattr__(self, "_near", {})
        # No lane is infinitely far: NaN would win every argmin.
        centre = np.where(np.isnan(self.lane_centre), np.inf, self.lane_centre)
        object.__setattr__(self, "_centre_or_far", centre)
        width = np.where(np.isnan(self.lane_width), 1.0, self.lane_width)
        forked = _forked(centre, self.lane_width, self.n_route_lanes)
        # Side by side, so that one look finds everything.
        ahead = np.column_stack((forked, width, self.speed_limit, self.curvature))
        object.__setattr__(self, "_ahead", ahead)
        object.__setattr__(self, "_bends", self.curvature.tolist())
        object.__setattr__(self, "_lane_rows", centre.tolist())
        object.__setattr__(self, "_borders", _borders(centre.tolist()))
        strips = _strips(self.lane_centre, self.lane_width).reshape(-1, 2)
        object.__setattr__(self, "_strips", strips)  # a row per vertex and lane
        everything = np.column_stack((ahead, strips.reshape(len(ahead), -1)))
        object.__setattr__(self, "_same_until", _same_until(everything))
        object.__setattr__(self, "_looked_up", {})
        for array in (centre, ahead, strips):
            array.flags.writeable = False

    def index(self, s: ArrayLike) -> IntArray:
        """Vertex nearest to each arc length s (m)."""
        i = np.rint((np.asarray(s, float) - self.s0) / SPACING).astype(np.intp)
        return np.minimum(np.maximum(i, 0), self.x.size - 1)

    def curvature_at(self, s: ArrayLike) -> FloatArray:
        """Curvature (1/m) of the reference line at arc lengths s (m)."""
        return self.curvature[self.index(s)]

    def bend_at(self, s: float) -> float:
        """Return curvature_at of one place: scalar arithmetic, faster than arrays."""
        return self._bends[min(max(round((s - self.s0) / SPACING), 0), self.x.size - 1)]

    def speed_limit_at(self, s: ArrayLike) -> FloatArray:
        """Speed limit (m/s) at arc lengths s (m)."""
        return self.speed_limit[self.index(s)]

    def lanes_at(self, s: ArrayLike) -> FloatArray:
        """Lateral positions (m) of the lane centres at s: shape (..., L), NaN where none is."""
        return self.lane_centre[self.index(s)]

    def lane_index(self, s: ArrayLike, d: ArrayLike) -> IntArray:
        """Column of the lane whose centre is nearest to (s, d)."""
        distance = np.abs(self._centre_or_far[self.index(s)] - np.asarray(d, float)[..., None])
        return np.asarray(distance.argmin(axis=-1))

    def lane_of(self, s: float, d: float) -> int:
        """Return lane_index of one point, faster; half-way between two lanes, the right one."""
        vertex = min(max(round((s - self.s0) / SPACING), 0), self.x.size - 1)
        borders, lanes = self._borders[vertex]
        return lanes[bisect_left(borders, d)]

    def nearest_lane(self, s: float, d: float) -> float:
        """Lateral position (m) of the lane centre nearest to one point."""
        i = min(max(round((s - self.s0) / SPACING), 0), self.x.size - 1)
        return self._lane_rows[i][self.lane_of(s, d)]

    def drivable_at(self, s: ArrayLike, d: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Right and left border (m) of the paved strip that holds, or is nearest to, (s, d).

        Lanes less than half a metre apart make one strip; an exit that has parted from the
        route is a strip of its own.
        """
        lane = self.lane_index(s, d)
        right, left = self._strips[self.index(s) * self.lane_centre.shape[1] + lane].T
        return right, left

    def ahead(self, s: float, d: float, pace: float, n: int) -> RoadAhead:
        """Look the road up at n places, from s (m) on, ``pace`` (m) apart.

        The strip is that of the lane that holds d (m) at the first place and goes on from there:
        where an exit parts from the route, each has its own.
        """
        last, s0, n_lanes = self.x.size - 1, self.s0, self.lane_centre.shape[1]
        first, end = (
            min(max(round((place - s0) / SPACING), 0), last) for place in (s, s + pace * (n - 1))
        )
        until = self._same_until[first]
        if first <= end <= until:
            # One look is enough where nothing changes.
            off = [abs(centre - d) for centre in self._ahead[first, :n_lanes].tolist()]
            lane = off.index(min(off))
            known = self._looked_up.get((until, lane, n))
            if known is None:
                known = self._look_up([first] * n, [lane] * n)
                self._looked_up[until, lane, n] = known
            return known
        i = [min(max(round((s + pace * t - s0) / SPACING), 0), last) for t in range(n)]
        followed = []
        for row in self._ahead[i, :n_lanes].tolist():
            off = [abs(centre - d) for centre in row]
            lane = off.index(min(off))
            d = row[lane] if isfinite(row[lane]) else d
            followed.append(lane)
        return self._look_up(i, followed)

    def _look_up(self, i: list[int], lanes: list[int]) -> RoadAhead:
        """Return the rows of some vertices, and the edges of a lane at each; read-only."""
        n_lanes = self.lane_centre.shape[1]
        strips = [vertex * n_lanes + lane for vertex, lane in zip(i, lanes, strict=True)]
        ahead = RoadAhead(self._ahead.take(i, axis=0), self._strips.take(strips, axis=0))
        for array in ahead:
            array.setflags(write=False)
        return ahead

    def too_sharp(self, curvature: float, first: float, last: float) -> float | None:
        """Where (s, m), between two places, no path of at most this curvature (1/m) keeps to it.

        That is where one that turns in time would be more than MISS beside the reference line: a
        quarter of how far one would be that turns with the line, and goes on until it has turned
        as far. None if it can be followed everywhere.
        """
        i, j = (min(max(round((s - self.s0) / SPACING), 0), self.x.size - 1) for s in (first, last))
        bends = self._bends[i : j + 1]
        for side in (1.0, -1.0):
            behind = aside = 0.0  # heading (rad) and metres that such a path lacks
            begun = 0
            for k, bend in enumerate(bends):
                behind += (side * bend - curvature) * SPACING
                if behind <= 0.0:
                    behind, aside, begun = 0.0, 0.0, k + 1
                aside += behind * SPACING
                if aside > 4.0 * MISS:
                    sharpest = max(range(begun, k + 1), key=lambda m: side * bends[m])
                    return self.s0 + (i + sharpest) * SPACING
        return None

    def returns(self, first: float, last: float) -> float | None:
        """Where (s, m) the road comes back to, or crosses, where it is between two places.

        Nearer than TOO_NEAR, so that a car beside it could be in either place. None if nowhere.
        """
        pairs = self._first + self._tree.query_pairs(TOO_NEAR, output_type="ndarray")
        pairs = self.s0 + SPACING * pairs
        before, after = pairs.min(axis=1), pairs.max(axis=1)
        met = after - before > 6.0 * TOO_NEAR
        met &= ((first <= before) & (before <= last)) | ((first <= after) & (after <= last))
        return float(after[met].min()) if met.any() else None

    def away(self, x: float, y: float) -> float:
        """Metres from a point to the nearest vertex of the route."""
        return float(self._tree.query((x, y))[0])

    def project(self, x: float, y: float) -> tuple[float, float, float, float]:
        """Road coordinates of one Cartesian point.

        Scalar arithmetic: for the handful of cars around an ego it costs less than arrays.
        Points beyond the ends are measured from the line's extension.

        Returns
        -------
        s, d (m), heading (rad) and curvature (1/m) of the reference line there.
        """
        # Start from the vertex nearest to the point's 10 m cell, then walk along the line.
        cell = (int(x // 10.0), int(y // 10.0))
        i = self._near.get(cell, -1)
        if i < 0:
            if len(self._near) > 100_000:
                self._near.clear()
            i = self._near[cell] = self._start_of(cell)
        last = len(self._segments) - 1
        if i == last + 1:  # of several stretches nearby the nearest to the point itself
            i = min(self._first + int(self._tree.query((x, y))[1]), last)
        came_from = -1
        for _ in range(20):
            x0, y0, tx0, ty0, h0, ex, ey, tx1, ty1, h1, curvature = self._segments[i]
            rx, ry = x - x0, y - y0
            # Foot of the point: (r - u e) . (t0 + u t1) = 0, a quadratic in u whose leading
            # coefficient is tiny; two Newton steps from the segment's own projection solve it.
            c0 = rx * tx0 + ry * ty0
            c1 = rx * tx1 + ry * ty1 - ex * tx0 - ey * ty0
            c2 = -(ex * tx1 + ey * ty1)
            u = -c0 / c1
            if c2:  # zero on a straight segment
                u -= (c0 + u * (c1 + u * c2)) / (c1 + 2.0 * u * c2)
                u -= (c0 + u * (c1 + u * c2)) / (c1 + 2.0 * u * c2)
            step = floor(u)
            # At a vertex of a sharp bend both segments may say that it is on the other one.
            if step == 0 or not 0 <= i + step <= last or i + step == came_from:
                break
            came_from, i = i, i + step
        d = (tx0 + u * tx1) * (ry - u * ey) - (ty0 + u * ty1) * (rx - u * ex)
        return self.s0 + (i + u) * SPACING, d, h0 + u * h1, curvature

    def _start_of(self, cell: tuple[int, int]) -> int:
        """Segment from which to look for the foot of a 10 m cell's points.

        The nearest to its centre; one more than there are if several stretches of the route could
        be the nearest of one of its points.
        """
        last, centre = len(self._segments) - 1, (10.0 * cell[0] + 5.0, 10.0 * cell[1] + 5.0)
        distance, nearest = self._tree.query(centre)
        around = np.sort(self._tree.query_ball_point(centre, distance + 15.0))
        if (np.diff(around) > 40.0 / SPACING).any():
            return last + 1
        return min(self._first + int(nearest), last)

    def to_frenet(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Cartesian to road frame.

        Parameters
        ----------
        states : (n, 4) of x, y, heading, speed.

        Returns
        -------
        (n, 4) of s, d, heading relative to the road in [-pi, pi), speed; and (n,) the
        curvature (1/m) of the reference line beside each.
        """
        rows = []
        for x, y, heading, speed in states.tolist():
            s, d, road_heading, curvature = self.project(x, y)
            rows.append((s, d, wrap_angle(heading - road_heading), speed, curvature))
        out = np.array(rows, dtype=float).reshape(-1, 5)
        return out[:, :4], out[:, 4]

    def to_cartesian(self, states: FloatArray) -> FloatArray:
        """Road frame to Cartesian: (n, 4) of s, d, heading, speed to x, y, heading, speed."""
        rows = []
        for s, d, heading, speed in states.tolist():
            g = (s - self.s0) / SPACING
            i = min(max(floor(g), 0), len(self._segments) - 1)
            u = g - i
            x0, y0, tx0, ty0, h0, ex, ey, tx1, ty1, h1, _ = self._segments[i]
            tx, ty = tx0 + u * tx1, ty0 + u * ty1
            # project() measures d with the interpolated tangent, a hair shorter than one.
            d /= tx * tx + ty * ty
            rows.append((x0 + u * ex - d * ty, y0 + u * ey + d * tx, heading + h0 + u * h1, speed))
        return np.array(rows, dtype=float).reshape(-1, 4)


def _forked(centre: FloatArray, width: FloatArray, n_route_lanes: int) -> FloatArray:
    """Centres without those of lanes off the route that still overlap one of the route's: (G, L).

    Where a lane splits in two, both begin at the same place, and the way between them is neither.
    """
    route = np.where(np.isinf(centre[:, :n_route_lanes]), 1e9, centre[:, :n_route_lanes])
    forked = centre.copy()
    for lane in range(n_route_lanes, centre.shape[1]):
        nearest = np.abs(route - centre[:, lane : lane + 1]).min(axis=1)
        forked[nearest < width[:, lane] / 2, lane] = np.inf
    return forked


def _borders(rows: list[list[float]]) -> list[tuple[list[float], list[int]]]:
    """Per row of lane centres: the places half-way between two, and the lanes beside them.

    From right to left. Of lanes in the same place the first counts; without any lane it is lane 0.
    """
    known: dict[tuple[float, ...], tuple[list[float], list[int]]] = {}
    for row in rows:
        if tuple(row) in known:
            continue
        centres = sorted({c for c in row if isfinite(c)})
        middle = [0.5 * (a + b) for a, b in pairwise(centres)]
        known[tuple(row)] = middle, [row.index(c) for c in centres] or [0]
    return [known[tuple(row)] for row in rows]


def _same_until(rows: FloatArray) -> list[int]:
    """Return the last row up to which all are the same, for every row."""
    same = (rows[1:] == rows[:-1]) | (np.isnan(rows[1:]) & np.isnan(rows[:-1]))
    ends = np.append(np.flatnonzero(~same.all(axis=1)), len(rows) - 1)
    return list(ends[np.searchsorted(ends, np.arange(len(rows)))].tolist())


def _strips(centre: FloatArray, width: FloatArray) -> FloatArray:
    """Right and left border of the strip that each lane is part of: (G, L, 2)."""
    right, left = centre - width / 2, centre + width / 2
    lower, upper = right.copy(), left.copy()
    for _ in range(centre.shape[1] - 1):
        # (G, L, L): does the strip grown so far touch the other lane?
        touches = (left[:, None] > lower[:, :, None] - 0.5) & (
            right[:, None] < upper[:, :, None] + 0.5
        )
        lower = np.where(touches, right[:, None], np.inf).min(axis=2)
        upper = np.where(touches, left[:, None], -np.inf).max(axis=2)
    return np.stack((lower, upper), axis=2)


def wrap_angle(angle: float) -> float:
    """Return the same angle (rad) in [-pi, pi).

    >>> round(wrap_angle(1.5 * pi), 6) == round(-0.5 * pi, 6)
    True
    """
    return (angle + pi) % (2.0 * pi) - pi
