"""Where across the road: an addition to the paper's features.

The paper's features are differences, so a car that lags behind a swerve is told to straighten
when the others straighten, and ends up beside their path. Here the ego also sees where across the
road the cars of its position group drove, at its own place and at those just ahead, and follows
that as it follows the other features: by mean and sample variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from sumo_cohesion.perception.history import History
from sumo_cohesion.road import Road
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import RoadState

SCALE = 3.5
"""Metres by which positions across the road are normalised: a lane's width."""


LATERAL_SPEED = 1.0
"""m/s, at which SUMO's drivers change lane (maxSpeedLat's default): what the ego has time for."""


class Place(NamedTuple):
    """Where the position group wants the ego to be, at each of several times ahead.

    ``target`` (m) and ``weight`` are per time; a weight of zero asks for nothing. ``n`` cars
    passed beside the ego's place; ``mean``, ``variance`` (of the position across the road,
    normalised by SCALE) are those of the place that asks most, and ``surprise`` is how much it
    contradicts lane keeping: weight · (distance / SCALE)², the distance from the mean to
    the ego or to the nearest lane centre, whichever is larger.
    """

    n: int
    target: tuple[float, ...]
    weight: tuple[float, ...]
    mean: float
    variance: float
    surprise: float


NOWHERE = Place(0, (), (), 0.0, 0.0, 0.0)
"""No agreement on a place."""


def agree_on_place(
    ego: RoadState,
    history: History,
    road: Road,
    times: Sequence[float],
    settings: CohesionSettings,
) -> Place:
    """Agreement of the cars that passed beside the ego's place on where they drove from there.

    ``times`` (s) are those of the planned stages that are asked.
    """
    back = ego.s - settings.look_back
    own = history.ego_path
    start = max(back, own.first)
    lane = road.nearest_lane(start, own.at(start))
    members, habits = [], []
    for track in history.all():
        if not track.voter or not track.middle_s or track.middle_s[-1] <= ego.s:
            continue
        s = max(start, track.middle_s[0])
        there = track.across(s)
        if there is not None and abs(there - own.at(s)) <= settings.position_width:
            members.append(track)
            habits.append(track.habit_at(s)[0] if settings.habit > 0 else 0.0)
    if len(members) < settings.min_cars:
        return NOWHERE
    horizon = times[-1]
    preview = [horizon + 0.5 * k for k in range(1, 1 + round(2 * settings.preview))]
    agreed = []
    most = (0.0, 0.0, 0.0)
    for time in (*times, *preview):
        s = ego.s + time * ego.speed
        found = [
            (d, habit)
            for track, habit in zip(members, habits, strict=True)
            if (d := track.across(s)) is not None
        ]
        if len(found) < settings.min_cars:
            continue
        across, habit = zip(*found, strict=True)
        mean, variance = _mean_and_variance(across)
        if settings.clip:
            clipped = [min(max(d, lane - SCALE), lane + SCALE) for d in across]
            mean_clipped, variance_clipped = _mean_and_variance(clipped)
            floor = settings.variance_floor * SCALE**2
            if variance_clipped + floor < 0.5 * (variance + floor):
                mean, variance = mean_clipped, variance_clipped
        variance = variance / SCALE**2 + sum(habit) / len(habit)
        weight = settings.place_weight / (variance + settings.variance_floor)
        late = LATERAL_SPEED * max(time - horizon, 0.0)
        distance = max(abs(mean - ego.d), abs(mean - road.nearest_lane(s, mean))) - late
        if distance > 0.0:
            surprise = weight * (distance / SCALE) ** 2
            most = max(most, (surprise, mean, variance))
        agreed.append((time, mean, weight))
    targets, weights = zip(*[_must_move(ego.d, time, agreed) for time in times], strict=True)
    surprise, mean, variance = most
    return Place(len(members), targets, weights, mean, variance, surprise)


def _mean_and_variance(values: Sequence[float]) -> tuple[float, float]:
    n = len(values)
    mean = sum(values) / n
    return mean, sum([(value - mean) * (value - mean) for value in values]) / (n - 1)


def _must_move(
    d: float, time: float, agreed: Sequence[tuple[float, float, float]]
) -> tuple[float, float]:
    """Target (m) and weight at one time: the place ahead that the ego is latest for.

    From a place that it reaches in t seconds it may still be LATERAL_SPEED · t away.
    """
    most, chosen = 0.0, (d, 0.0)
    for at, mean, weight in agreed:
        if at < time - 1e-6:
            continue
        away = mean - d
        late = abs(away) - LATERAL_SPEED * (at - time)
        if late > 0.0 and weight * late * late > most:
            most = weight * late * late
            chosen = (d + (late if away > 0.0 else -late), weight)
    return chosen
