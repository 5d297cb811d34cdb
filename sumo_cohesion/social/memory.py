"""What the ego remembers of other drivers: their social features and their habits."""

from __future__ import annotations

from sumo_cohesion.perception.habit import Features, Habit
from sumo_cohesion.perception.history import Describe, History, State
from sumo_cohesion.social.features import LATERAL, social_features
from sumo_cohesion.social.settings import CohesionSettings

PRIOR: Features = tuple([0.3**2 if lateral else 0.15**2 for lateral in LATERAL])
"""Variance of an unknown driver's normalised features: an addition to the paper, as habits are."""


class SharedFeatures:
    """The social features of transitions, each kept once for all who saw the same in one step.

    A hundred planned cars remember much the same of each other; apart, that is a gigabyte.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[State, State, float], Features] = {}

    def next_step(self) -> None:
        """Forget what was shared in the step before; whoever remembers it keeps it."""
        self._known.clear()

    def __call__(self, before: State, after: State, seconds: float, curvature: float) -> Features:
        """Return social_features of the same arguments."""
        key = before, after, curvature
        features = self._known.get(key)
        if features is None:
            features = self._known[key] = social_features(before, after, seconds, curvature)
        return features


def new_history(
    settings: CohesionSettings, step: float, describe: Describe = social_features
) -> History:
    """Return an empty memory; ``step`` (s) is the time between observations."""
    prior, values = PRIOR, round(settings.habit / settings.interval)
    if values == 0:
        prior = (0.0,) * len(LATERAL)  # nobody has habits
    delay = round(settings.habit_delay / settings.interval)
    return History(
        step,
        settings.interval,
        settings.memory,
        describe=describe,
        habit=lambda: Habit(prior, values, delay),
    )
