"""What the ego remembers of other drivers: their social features and their habits."""

from __future__ import annotations

from sumo_cohesion.perception.habit import Features, Habit
from sumo_cohesion.perception.history import History
from sumo_cohesion.social.features import LATERAL, social_features
from sumo_cohesion.social.settings import CohesionSettings

PRIOR: Features = tuple([0.3**2 if lateral else 0.15**2 for lateral in LATERAL])
"""Variance of an unknown driver's normalised features: an addition to the paper, as habits are."""


def new_history(settings: CohesionSettings, step: float) -> History:
    """Return an empty memory; ``step`` (s) is the time between observations."""
    prior, values = PRIOR, round(settings.habit / settings.interval)
    if values == 0:
        prior = (0.0,) * len(LATERAL)  # nobody has habits
    delay = round(settings.habit_delay / settings.interval)
    return History(
        step,
        settings.interval,
        settings.memory,
        describe=social_features,
        habit=lambda: Habit(prior, values, delay),
    )
