"""Settings of cohesion: one set for every scenario."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class CohesionSettings(BaseModel):
    """Who, what, when and how much to follow.

    Attributes
    ----------
    beta : trade-off between the ego's own reward and cohesion (paper, eq. 2); only its ratio
        to the reward weights matters. Zero is the nominal planner.
    transitions : on which of the plan's transitions cohesion acts: on the "first", as in the paper,
        or on "all" of the horizon.
    variance_floor : added to the sample variance of a normalised feature, so that perfect
        agreement has a finite weight.
    min_cars : fewest cars that can agree; one car always agrees with itself.
    lateral_votes : "all": every group votes on lateral features, as in the paper's eq. 2;
        "most_surprising": only the group whose agreement contradicts lane keeping most.
    surprise : lateral agreement counts only if it contradicts lane keeping by more than this
        (largest sum of weight · mean²); what lane keeping does anyway is no news.
    surprise_hold : seconds for which a contradiction above 1 counts, once there was such a
        surprise.
    speed_weight : weight of the features that set the speed, relative to those that steer.
    habit : seconds of a driver's own past whose variance adds to the group's, in whole
        intervals; zero: none.
    habit_delay : the newest seconds, which do not count as its past yet.
    place_weight : weight of the lateral position at a place (social.place), relative to the
        features that steer; zero switches it off.
    place_look_back : metres back to where the ego and the cars it asks must have come along.
    interval : seconds that a human's transition spans.
    memory : seconds that past transitions are remembered for the position group.
    position_length, position_width : half sizes (m) of the position group's box.
    lane_ahead, lane_behind : reach (m) of the lane group.
    road_reach : reach (m) of the road group, ahead and behind.
    follow_egos : whether other cars that a planner drives ([fleet] of a scenario) vote like
        humans; False: only humans are followed, which is the paper's idea.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    beta: NonNegative = 0.09
    transitions: Literal["first", "all"] = "first"
    variance_floor: Positive = 2.5e-3
    min_cars: Annotated[int, Field(ge=2)] = 2
    lateral_votes: Literal["all", "most_surprising"] = "most_surprising"
    surprise: NonNegative = 5.0
    surprise_hold: NonNegative = 2.0
    speed_weight: NonNegative = 0.2
    habit: NonNegative = 10.0
    habit_delay: NonNegative = 2.0
    place_weight: NonNegative = 4.0
    place_look_back: NonNegative = 200.0
    interval: Positive = 0.5
    memory: Positive = 20.0
    position_length: Positive = 8.0
    position_width: Positive = 2.5
    lane_ahead: Positive = 60.0
    lane_behind: NonNegative = 20.0
    road_reach: Positive = 60.0
    follow_egos: bool = False


def as_printed(cohesion: CohesionSettings) -> CohesionSettings:
    """Return the paper's formula as printed (eq. 2), with the given beta, floor and reaches.

    Every group votes on every feature, transitions span one step, nothing is added.
    """
    printed = {
        "transitions": "first",
        "lateral_votes": "all",
        "place_weight": 0.0,
        "habit": 0.0,
        "speed_weight": 1.0,
        "interval": 0.1,
        "position_length": 3.0,
        "position_width": 1.85,
    }
    return cohesion.model_copy(update=printed)
