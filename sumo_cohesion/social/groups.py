"""Who: the groups whose agreement counts (paper, sections III-D and IV-A).

Each group gives every car one vote: the mean of the transitions it contributes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sumo_cohesion.perception.history import History, Transitions
from sumo_cohesion.road import Road
from sumo_cohesion.social.features import FEATURES, social_features
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import FloatArray, RoadState

GROUPS = ("position", "lane", "road")


@dataclass(frozen=True, slots=True)
class Votes:
    """The votes of one group: (n, k) normalised social features, one row per car."""

    group: str
    values: FloatArray


def group_votes(
    ego: RoadState, history: History, road: Road, settings: CohesionSettings
) -> tuple[Votes, ...]:
    """Collect the votes of the position, lane and road groups, in this order.

    - position: transitions that any car made, at any remembered time, where the ego is now;
    - lane: cars that are in the ego's lane now;
    - road: cars that are near the ego on the road now.
    """
    past = history.near(ego.s, ego.d, settings.position_length, settings.position_width)
    now = history.newest()
    values = _features(now)
    ahead = now.after[:, 0] - ego.s
    along = np.abs(now.after[:, 2]) < np.pi / 2  # oncoming traffic is nobody to follow
    reach = np.abs(ahead)
    on_road = along & (reach <= settings.road_reach)
    in_lane = (
        along
        & (ahead <= settings.lane_ahead)
        & (ahead >= -settings.lane_behind)
        & (road.lane_index(now.after[:, 0], now.after[:, 1]) == road.lane_index(ego.s, ego.d))
    )
    return (
        Votes("position", _mean_per_car(past.car, _features(past))),
        Votes("lane", values[in_lane]),
        Votes("road", values[on_road]),
    )


def _features(transitions: Transitions) -> FloatArray:
    """Return (m, k) social features of m transitions."""
    columns = social_features(
        transitions.before.T, transitions.after.T, transitions.interval, transitions.curvature
    )
    return np.array(columns).T


def _mean_per_car(car: FloatArray, values: FloatArray) -> FloatArray:
    """Average (m, k) rows that belong to the same car: (n, k)."""
    cars, member = np.unique(car, return_inverse=True)
    share = (member[:, None] == np.arange(cars.size)).astype(float)
    share /= share.sum(axis=0)
    return share.T @ values
