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


class Place(NamedTuple):
    """What the position group agrees on, at each of several places ahead of the ego.

    ``mean`` (m) is where across the road its n cars drove, ``variance`` and ``weight`` are of
    the position normalised by SCALE; a place with too few cars has weight zero. ``surprise`` is
    how much the group contradicts lane keeping: the largest weight · (distance / SCALE)², the
    distance from the mean to the ego or to the nearest lane centre, whichever is larger.
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
    places: Sequence[float],
    settings: CohesionSettings,
) -> Place:
    """Agreement of the cars that passed beside the ego's place on where they drove from there.

    ``places`` are arc lengths s (m).
    """
    members = [
        track
        for track in history.all()
        if track.voter
        and (here := track.across(ego.s)) is not None
        and abs(here - ego.d) <= settings.position_width
    ]
    means, variances, weights, surprise = [], [], [], 0.0
    for s in places:
        across = [d for track in members if (d := track.across(s)) is not None]
        n = len(across)
        if n < settings.min_cars:
            means.append(ego.d)
            variances.append(0.0)
            weights.append(0.0)
            continue
        mean = sum(across) / n
        variance = sum([(d - mean) * (d - mean) for d in across]) / (n - 1) / SCALE**2
        weight = settings.place_weight / (variance + settings.variance_floor)
        distance = max(abs(mean - ego.d), abs(mean - road.nearest_lane(s, mean)))
        surprise = max(surprise, weight * (distance / SCALE) ** 2)
        means.append(mean)
        variances.append(variance)
        weights.append(weight)
    return Place(len(members), tuple(means), tuple(variances), tuple(weights), surprise)
