"""Settings of cohesion: one set for every scenario."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from sumo_cohesion.perception.habit import Habit
from sumo_cohesion.social.features import LATERAL

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class CohesionSettings(BaseModel):
    """Who, what, when and how much to follow.

    Attributes
    ----------
    beta : trade-off between the ego's own reward and cohesion (paper, eq. 2); only its ratio
        to the reward weights matters. Zero is the nominal planner.
    variance_floor : added to the sample variance of a normalised feature, so that perfect
        agreement has a finite weight.
    min_cars : fewest cars that can agree; one car always agrees with itself.
    lateral_votes : "all": every group votes on lateral features, as in the paper's eq. 2;
        "most_surprising": only the group whose agreement contradicts lane keeping most.
    surprise : lateral agreement counts only if it contradicts lane keeping by more than this
        (largest sum of weight · mean²); what lane keeping does anyway is no news.
    surprise_hold : seconds for which lateral agreement counts once it has surprised.
    habit : seconds of a driver's own past whose variance adds to the group's; zero: none.
    speed_weight : weight of the features that set the speed, relative to those that steer.
    place_weight : weight of the lateral position at a place (social.place), relative to the
        other features; zero switches it off.
    interval : seconds that a human's transition spans.
    memory : seconds that past transitions are remembered for the position group.
    position_length, position_width : half sizes (m) of the position group's box.
    lane_ahead, lane_behind : reach (m) of the lane group.
    road_reach : reach (m) of the road group, ahead and behind.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    beta: NonNegative = 0.09
    variance_floor: Positive = 2.5e-3
    min_cars: Annotated[int, Field(ge=2)] = 2
    lateral_votes: Literal["all", "most_surprising"] = "most_surprising"
    surprise: NonNegative = 5.0
    surprise_hold: NonNegative = 2.0
    habit: NonNegative = 10.0
    habit_delay: NonNegative = 2.0
    habit_prior: NonNegative = 0.3
    habit_prior_speed: NonNegative = 0.15
    speed_weight: NonNegative = 0.25
    place_weight: NonNegative = 4.0
    look_back: NonNegative = 200.0
    preview: NonNegative = 2.5
    clip: bool = True
    interval: Positive = 0.5
    memory: Positive = 20.0
    position_length: Positive = 8.0
    position_width: Positive = 2.5
    lane_ahead: Positive = 60.0
    lane_behind: NonNegative = 20.0
    road_reach: Positive = 60.0


def as_printed(cohesion: CohesionSettings) -> CohesionSettings:
    """Return the paper's formula as printed (eq. 2), with the given beta, floor and reaches.

    Every group votes on every feature, transitions span one step, nothing is added.
    """
    printed = {
        "lateral_votes": "all",
        "place_weight": 0.0,
        "habit": 0.0,
        "speed_weight": 1.0,
        "interval": 0.1,
        "position_length": 3.0,
        "position_width": 1.85,
    }
    return cohesion.model_copy(update=printed)


def new_habit(cohesion: CohesionSettings) -> Habit:
    """Return what is known of a driver that has never been seen."""
    prior = tuple(
        [
            cohesion.habit_prior**2 if lateral else cohesion.habit_prior_speed**2
            for lateral in LATERAL
        ]
    )
    window = max(round(cohesion.habit / cohesion.interval), 1)
    return Habit(prior, window, delay=round(10 * cohesion.habit_delay), every=5)
