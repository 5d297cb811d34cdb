"""Who: the groups whose agreement counts (paper, sections III-D and IV-A).

Every car has one vote in a group: the mean of the transitions it contributes.
"""

from __future__ import annotations

from math import pi

from sumo_cohesion.perception.history import Features, History, Track
from sumo_cohesion.road import Road
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import RoadState

GROUPS = ("position", "lane", "road")

Votes = dict[str, list[Features]]
"""By group: the normalised social features that each of its cars votes for."""


def group_votes(ego: RoadState, history: History, road: Road, settings: CohesionSettings) -> Votes:
    """Collect the votes of the three groups.

    - position: transitions that any car made, at any remembered time, where the ego is now;
    - lane: cars that are in the ego's lane now;
    - road: cars that are near the ego on the road now.
    """
    votes: Votes = {group: [] for group in GROUPS}
    for track in history.all():
        if track.voter and (vote := _vote_at_place(track, ego, settings)):
            votes["position"].append(vote)
    own_lane = road.lane_of(ego.s, ego.d)
    for track in history.in_sight():
        vote = track.newest() if track.voter else None
        s, d, heading, _ = track.state
        if vote is None or abs(heading) > pi / 2:
            continue  # oncoming traffic is nobody to follow
        ahead = s - ego.s
        if abs(ahead) <= settings.road_reach:
            votes["road"].append(vote)
        within = -settings.lane_behind <= ahead <= settings.lane_ahead
        if within and road.lane_of(s, d) == own_lane:
            votes["lane"].append(vote)
    return votes


def _vote_at_place(track: Track, ego: RoadState, settings: CohesionSettings) -> Features | None:
    """Mean features of one car's transitions around the ego's place; None if it kept aside."""
    passed = track.passed(ego.s, settings.position_length)
    samples = [
        features
        for features, d in zip(track.features[passed], track.middle_d[passed], strict=True)
        if abs(d - ego.d) <= settings.position_width
    ]
    if not samples:
        return None
    n = len(samples)
    return tuple([sum(column) / n for column in zip(*samples, strict=True)])
