"""When: how much each group agrees, and the cohesion term that follows (paper, eq. 2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from sumo_cohesion.perception.habit import Features
from sumo_cohesion.social.features import FEATURES, LATERAL
from sumo_cohesion.social.groups import Vote, Votes
from sumo_cohesion.social.place import Place
from sumo_cohesion.social.settings import CohesionSettings

_ZEROS: Features = (0.0,) * len(FEATURES)


class Agreement(NamedTuple):
    """What one group agrees on, per normalised social feature.

    ``weight`` is 1 / (variance + floor). A group of too few cars has zeros everywhere: it has
    no say.
    """

    group: str
    n: int
    mean: Features
    variance: Features
    weight: Features


class CohesionTerm(NamedTuple):
    """The sum over groups of weight · (mean − psi)², per feature.

    A sum of squares about several means is one square about their weighted mean, plus a
    constant that no plan can change; so one ``weight`` and one ``target`` per feature say it all.
    """

    weight: Features
    target: Features


def agree(votes: Votes, settings: CohesionSettings) -> tuple[Agreement, ...]:
    """Sample mean, unbiased sample variance and weight of every group's votes."""
    return tuple([_agree(group, cast, settings) for group, cast in votes.items()])


def _agree(group: str, votes: Sequence[Vote], settings: CohesionSettings) -> Agreement:
    n = len(votes)
    if n < settings.min_cars:
        return Agreement(group, n, _ZEROS, _ZEROS, _ZEROS)
    features, habits = zip(*votes, strict=True)
    values = list(zip(*features, strict=True))
    if settings.habit > 0.0:
        columns = [
            _with_habit(column, habit, settings.variance_floor)
            for column, habit in zip(values, zip(*habits, strict=True), strict=True)
        ]
    else:
        columns = [_plain(column, settings.variance_floor) for column in values]
    mean, variance, weight = zip(*columns, strict=True)
    weight = tuple(
        [
            w if lateral else w * settings.speed_weight
            for w, lateral in zip(weight, LATERAL, strict=True)
        ]
    )
    return Agreement(group, n, mean, variance, weight)


def _plain(values: Sequence[float], floor: float) -> tuple[float, float, float]:
    n = len(values)
    mean = sum(values) / n
    variance = sum([(value - mean) * (value - mean) for value in values]) / (n - 1)
    return mean, variance, 1.0 / (variance + floor)


def _with_habit(
    values: Sequence[float], habits: Sequence[float], floor: float
) -> tuple[float, float, float]:
    """Mean, variance and weight of one feature, each driver counting by its own reliability."""
    n = len(values)
    precision = [1.0 / (floor + habit) for habit in habits]
    total = sum(precision)
    mean = sum([q * value for q, value in zip(precision, values, strict=True)]) / total
    spread = sum(
        [q * (value - mean) * (value - mean) for q, value in zip(precision, values, strict=True)]
    )
    variance = spread / total * n / (n - 1) + n / total - floor
    return mean, variance, 1.0 / (variance + floor)


def elect_lateral(
    groups: Sequence[Agreement], place: Place, threshold: float
) -> tuple[tuple[Agreement, ...], Place, float]:
    """Let only the most surprising group vote on lateral features, and none if nothing surprises.

    Once humans have finished a swerve they all drive straight, and their unanimous "straight"
    elsewhere would outvote the "turn" of those who pass the ego's own place. The ego keeps its
    lane by itself; so of all agreements the one that contradicts lane keeping most, with the
    largest sum of weight · mean², is the one that has something to say ("for only the subset
    of cars that exhibits the low variance", paper, section I). The position group's place
    counts with it.
    """
    surprise = [
        sum(w * m * m for w, m, lateral in zip(g.weight, g.mean, LATERAL, strict=True) if lateral)
        + (place.surprise if g.group == "position" else 0.0)
        for g in groups
    ]
    most = max(surprise)
    chosen = surprise.index(most) if most > threshold else -1
    elected = tuple(
        [
            g
            if i == chosen
            else g._replace(
                weight=tuple([0.0 if lat else w for w, lat in zip(g.weight, LATERAL, strict=True)])
            )
            for i, g in enumerate(groups)
        ]
    )
    if chosen < 0 or groups[chosen].group != "position":
        place = place._replace(weight=(0.0,) * len(place.weight))
    return elected, place, most


def combine(groups: Sequence[Agreement]) -> CohesionTerm:
    """Sum the groups' terms into one weight and one target per feature."""
    weights = list(zip(*[g.weight for g in groups], strict=True))
    means = list(zip(*[g.mean for g in groups], strict=True))
    total = [sum(w) for w in weights]
    target = [
        sum([wi * mi for wi, mi in zip(w, m, strict=True)]) / t if t > 0.0 else 0.0
        for w, m, t in zip(weights, means, total, strict=True)
    ]
    return CohesionTerm(tuple(total), tuple(target))
