"""Where across the road: an addition to the paper's features.

The paper's features are differences, so a car that lags behind a swerve is told to straighten
when the others straighten, and ends up beside their path. Here the ego also sees where across the
road those drove who had come along where it came along, at its own place and at those ahead, and
follows that as it follows the other features: by mean and variance, habits included.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from sumo_cohesion.perception.history import History, Track
from sumo_cohesion.road import Road
from sumo_cohesion.social.agreement import estimate
from sumo_cohesion.social.features import FEATURES
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import LANE_WIDTH, RoadState

SCALE = LANE_WIDTH
"""Metres by which positions across the road are normalised: a lane's width."""
_LATERAL = FEATURES.index("lateral")


class Place(NamedTuple):
    """Where those who came along here drove, at several times ahead of the ego.

    ``mean`` (m), ``variance`` (of the position normalised by SCALE) and ``weight`` are per time;
    a weight of zero asks for nothing. ``n`` cars came along. ``surprise`` is how much they
    contradict lane keeping: the largest weight · (distance / SCALE)², the distance from the
    mean to the ego or to the nearest lane's centre, whichever is larger.
    """

    n: int
    mean: tuple[float, ...]
    variance: tuple[float, ...]
    weight: tuple[float, ...]
    surprise: float


NOWHERE = Place(0, (), (), (), 0.0)
"""No agreement on a place."""


def agree_on_place(
    ego: RoadState,
    history: History,
    road: Road,
    times: Sequence[float],
    settings: CohesionSettings,
) -> Place:
    """Agreement of the cars that came along where the ego did on where to be from here.

    ``times`` (s) are those of the planned stages that are asked.
    """
    companions = _companions(ego, history, settings)
    if len(companions) < settings.min_cars:
        return NOWHERE
    places = [ego.s + time * ego.speed for time in times]
    rows, surprise = [], 0.0
    for s in places:
        found = [(track.d_at(s), habit) for track, habit in companions]
        known = [(d / SCALE, habit) for d, habit in found if d is not None]
        if len(known) < settings.min_cars:
            rows.append((ego.d, 0.0, 0.0))
            continue
        across, habits = zip(*known, strict=True)
        mean, variance = estimate(across, habits, settings.variance_floor)
        mean *= SCALE
        weight = settings.place_weight / (variance + settings.variance_floor)
        off = max(abs(mean - ego.d), abs(mean - road.nearest_lane(s, mean)))
        surprise = max(surprise, weight * (off / SCALE) ** 2)
        rows.append((mean, variance, weight))
    means, variances, weights = zip(*rows, strict=True)
    return Place(len(companions), means, variances, weights, surprise)


def _companions(
    ego: RoadState, history: History, settings: CohesionSettings
) -> list[tuple[Track, float]]:
    """Cars that were beside the ego's own path, and have passed the ego's place since.

    Some way back, or where they came into sight if that is nearer; who came into sight ahead of
    the ego may have come from anywhere.

    With the variance of their lateral feature up to there: what they have done since is what they
    are asked about. It stands for how little their place can be relied on, though it is one of
    lateral speeds.
    """
    tracks = history.passed(ego.s)
    if not tracks:
        return []
    path, width = history.ego_path, settings.position_width
    farthest = max(ego.s - settings.place_look_back, path.first)
    companions = []
    for track in tracks:
        s = max(farthest, track.middle_s[0])
        d = track.d_at(s)
        if d is not None and abs(d - path.at(s)) <= width:
            companions.append((track, track.habit_at(s)[_LATERAL]))
    return companions
