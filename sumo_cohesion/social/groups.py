"""Who: the groups whose agreement counts (paper, sections III-D and IV-A).

Every car has one vote in a group: the mean of the transitions it contributes.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

from sumo_cohesion.perception.habit import Features
from sumo_cohesion.perception.history import History, Track
from sumo_cohesion.road import Road
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import RoadState

GROUPS = ("position", "lane", "road")


class Vote(NamedTuple):
    """One car's normalised social features, and their variance in its own past."""

    features: Features
    habit: Features


Votes = dict[str, list[Vote]]
"""By group: what each of its cars votes for."""


def group_votes(ego: RoadState, history: History, road: Road, settings: CohesionSettings) -> Votes:
    """Collect the votes of the three groups.

    - position: transitions that any car made, at any remembered time, where the ego is now;
    - lane: cars that are in the ego's lane now;
    - road: cars that are near the ego on the road now.
    """
    votes: Votes = {group: [] for group in GROUPS}
    for track, passed in history.near(ego.s, settings.position_length):
        oncoming = abs(track.state[2]) > pi / 2  # nobody to follow
        if not oncoming and (vote := _vote_at_place(track, passed, ego.d, settings)):
            votes["position"].append(vote)
    own_lane = road.lane_of(ego.s, ego.d)
    farthest = max(settings.road_reach, settings.lane_ahead, settings.lane_behind)
    for track in history.in_sight():
        s, d, heading, _ = track.state
        ahead = s - ego.s
        if abs(ahead) > farthest or abs(heading) > pi / 2:
            continue
        newest = track.newest()
        if newest is None:
            continue
        vote = Vote(newest, track.habits[-1])
        if abs(ahead) <= settings.road_reach:
            votes["road"].append(vote)
        within = -settings.lane_behind <= ahead <= settings.lane_ahead
        if within and road.lane_of(s, d) == own_lane:
            votes["lane"].append(vote)
    return votes


def _vote_at_place(
    track: Track, passed: range, d: float, settings: CohesionSettings
) -> Vote | None:
    """Mean features of those transitions that are near d (m), too; None if none is."""
    across, width = track.middle_d, settings.position_width
    here = [i for i in passed if abs(across[i] - d) <= width]
    if not here:
        return None
    n = len(here)
    columns = zip(*[track.features[i] for i in here], strict=True)
    return Vote(tuple([sum(column) / n for column in columns]), track.habits[here[0]])
