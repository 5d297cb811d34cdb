"""Examples from recorded tracks: into the road's frame, smoothed, cut into a few steps each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline

from sumo_cohesion.learning.example import Example
from sumo_cohesion.learning.motion import Motion, controls, motion, smoothed
from sumo_cohesion.learning.recording import Recording
from sumo_cohesion.road import Road
from sumo_cohesion.state import STEP, Control, FloatArray, IntArray, RoadState

DESIRED_QUANTILE = 0.9
"""Of a driver's own speeds, what is taken for the speed that it would like to drive."""
_ASTRAY = 1.0
"""Heading (rad) relative to the road beyond which a car does not drive along it."""
_MOVING = 0.5
"""Speed (m/s) below which positions say nothing of a heading."""


@dataclass(frozen=True)
class Cutting:
    """How tracks become examples.

    Attributes
    ----------
    steps : of 0.1 s in each example.
    smooth : seconds along and across the road: faster oscillations of a place are noise.
    own_speed : take each driver's own speed for what it would like to drive, not the limit.
    friction : 1/s, of the planner's dynamics.
    sensing_range : m within which others are there for the driver.
    by_vehicle : each vehicle is a run of its own, to be drawn and held out by itself.
    bounded : the tracks are those of a planner that keeps to its bounds.
    """

    steps: int
    smooth: tuple[float, float] = (0.0, 0.0)
    own_speed: bool = False
    friction: float = 0.1
    sensing_range: float = 150.0
    by_vehicle: bool = False
    bounded: bool = False


def cut(recording: Recording, how: Cutting) -> list[Example]:
    """Return the examples of all vehicles of a recording that have a road, one after another."""
    around = _Around(recording)
    found: list[Example] = []
    for vehicle, track in recording.table.groupby("vehicle", sort=False):
        road = recording.roads.get(str(vehicle))
        if road is not None:
            run = f"{recording.name}/{vehicle}" if how.by_vehicle else recording.name
            found += _of_vehicle(run, str(vehicle), track, road, around, recording.interval, how)
    return found


def _of_vehicle(
    run: str,
    vehicle: str,
    track: pd.DataFrame,
    road: Road,
    around: _Around,
    interval: float,
    how: Cutting,
) -> list[Example]:
    size = float(track["length"].iloc[0]), float(track["width"].iloc[0])
    pieces = [
        (start, moved)
        for rows in _without_gaps(track["time"].to_numpy(), interval)
        for start, moved in _pieces(track.iloc[rows], road, interval, how)
    ]
    if not pieces:
        return []
    desired = None
    if how.own_speed:
        speeds = np.concatenate([moved.states[1:, 3] for _, moved in pieces])
        desired = float(np.quantile(speeds, DESIRED_QUANTILE))
    found = []
    for start, moved in pieces:
        driven = controls(moved.states, moved.bends[:-1], STEP, how.friction)
        # The first state has no speed of its own, the first control of the second is known.
        for first in range(2, len(moved.states) - how.steps, how.steps):
            time, ego = start + STEP * first, RoadState(*moved.states[first].tolist())
            found.append(
                Example(
                    run=run,
                    vehicle=vehicle,
                    time=time,
                    road=road,
                    ego=ego,
                    ego_size=size,
                    cars=around.cars(vehicle, time, ego, road, how.sensing_range),
                    driven=Control(*driven[first - 1].tolist()),
                    states=moved.states[first + 1 : first + 1 + how.steps],
                    desired_speed=desired,
                    bounded=how.bounded,
                )
            )
    return found


def _without_gaps(times: FloatArray, interval: float) -> list[IntArray]:
    """Rows of a track between two gaps."""
    ends = np.flatnonzero(np.diff(times) > 1.5 * interval) + 1
    return np.split(np.arange(len(times)), ends)


def _pieces(
    track: pd.DataFrame, road: Road, interval: float, how: Cutting
) -> Iterator[tuple[float, Motion]]:
    """Parts of a track without gaps that are driven along the road: begin (s) and motion."""
    points = np.column_stack((track[["x", "y"]].to_numpy(float), np.zeros((len(track), 2))))
    times = track["time"].to_numpy(float)
    frenet, bends = road.to_frenet(points)
    on_road = (frenet[:, 0] >= 0.0) & (frenet[:, 0] <= road.length)
    for rows in np.split(np.arange(len(track)), np.flatnonzero(np.diff(on_road)) + 1):
        if not on_road[rows[0]] or len(rows) < 4:
            continue
        places = np.column_stack(
            [smoothed(frenet[rows, i : i + 1], interval, how.smooth[i])[:, 0] for i in range(2)]
        )
        begin, bent = times[rows[0]], bends[rows]
        if abs(interval - STEP) > 1e-6:
            told = interval * np.arange(len(rows))
            grid = np.arange(0.0, told[-1] + 1e-9, STEP)
            places, bent = CubicSpline(told, places)(grid), np.interp(grid, told, bent)
        if len(places) < 4:
            continue
        moved = motion(places, bent, STEP)
        astray = np.abs(moved.states[:, 2]) > _ASTRAY
        if not astray[moved.states[:, 3] > _MOVING].any():
            yield begin, moved


class _Around:
    """Who is where at any time of a recording."""

    def __init__(self, recording: Recording) -> None:
        table, self._interval = recording.table, recording.interval
        self._names = table["vehicle"].to_numpy(str)
        self._times = table["time"].to_numpy(float)
        self._places = table[["x", "y"]].to_numpy(float)
        self._sizes = table[["length", "width"]].to_numpy(float)
        self._velocities = self._differences()
        self._order = np.argsort(self._times, kind="stable")
        self._in_order = self._times[self._order]

    def _rows_at(self, time: float) -> IntArray:
        """Row of every vehicle nearest to a time, of those that are there.

        Times of vehicles need not be those of each other.
        """
        reach = 0.51 * self._interval
        first, end = np.searchsorted(self._in_order, (time - reach, time + reach))
        rows = self._order[first:end]
        nearest = rows[np.abs(self._times[rows] - time).argsort(kind="stable")]
        _, of_each = np.unique(self._names[nearest], return_index=True)
        return np.sort(nearest[of_each])

    def _differences(self) -> FloatArray:
        """Velocity (m/s) of every row: half-way to both neighbours of the same vehicle."""
        n = len(self._times)
        before, after = np.arange(n) - 1, np.arange(n) + 1
        for other in (before, after):
            other[:] = np.clip(other, 0, n - 1)
            apart = np.abs(self._times[other] - self._times) > 1.5 * self._interval
            alone = apart | (self._names[other] != self._names)
            other[alone] = np.flatnonzero(alone)
        time = self._times[after] - self._times[before]
        way = self._places[after] - self._places[before]
        return np.asarray(way / np.where(time > 0.0, time, 1.0)[:, None])

    def cars(
        self, vehicle: str, time: float, ego: RoadState, road: Road, sensing_range: float
    ) -> FloatArray:
        """Return the others at a time in a road's frame, nearest first, as planners see them."""
        rows = self._rows_at(time)
        rows = rows[self._names[rows] != vehicle]
        velocity = self._velocities[rows]
        late = (time - self._times[rows])[:, None]
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        heading = np.arctan2(velocity[:, 1], velocity[:, 0])
        places = self._places[rows] + late * velocity
        here = road.to_cartesian(np.array([ego]))[0, :2]
        near = np.hypot(*(places - here).T) <= sensing_range
        states, bends = road.to_frenet(np.column_stack((places, heading, speed))[near])
        states[states[:, 3] < _MOVING, 2] = 0.0
        return nearest_first(np.column_stack((states, self._sizes[rows][near], bends)), ego)


def nearest_first(cars: FloatArray, ego: RoadState) -> FloatArray:
    """Sort cars (n, 7) by their distance from the ego, as planners do."""
    distance = (cars[:, 0] - ego.s) ** 2 + (cars[:, 1] - ego.d) ** 2
    return cars[distance.argsort(kind="stable")]
