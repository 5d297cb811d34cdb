"""When: how much each group agrees, and the cohesion term that follows (paper, eq. 2)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import repeat
from operator import mul
from typing import NamedTuple

from sumo_cohesion.perception.habit import Features
from sumo_cohesion.social.features import FEATURES, LATERAL
from sumo_cohesion.social.groups import Vote, Votes
from sumo_cohesion.social.settings import CohesionSettings

_ZEROS: Features = (0.0,) * len(FEATURES)


class Agreement(NamedTuple):
    """What one group agrees on, per normalised social feature.

    ``weight`` is 1 / (variance + floor), for features that set the speed times
    ``speed_weight``. A group of too few cars has zeros everywhere: it has no say.
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
    """Mean, variance and weight of every group's votes."""
    return tuple([_agree(group, cast, settings) for group, cast in votes.items()])


def _agree(group: str, votes: Sequence[Vote], settings: CohesionSettings) -> Agreement:
    n = len(votes)
    if n < settings.min_cars:
        return Agreement(group, n, _ZEROS, _ZEROS, _ZEROS)
    features, habits = zip(*votes, strict=True)
    floor = settings.variance_floor
    columns = map(estimate, zip(*features, strict=True), zip(*habits, strict=True), repeat(floor))
    mean, variance = zip(*columns, strict=True)
    weight = tuple(
        [
            (1.0 if lateral else settings.speed_weight) / (v + floor)
            for v, lateral in zip(variance, LATERAL, strict=True)
        ]
    )
    return Agreement(group, n, mean, variance, weight)


def estimate(values: Sequence[float], habits: Sequence[float], floor: float) -> tuple[float, float]:
    """Mean and variance of what n >= 2 drivers do, each counting by its own reliability.

    With weights q = 1 / (floor + habit): mean = sum q x / sum q, and variance = unbiased weighted
    sample variance (reliability weights: divided by 1 - sum q² / (sum q)²) + n / sum q - floor.
    The last part is what these drivers vary by anyway. Without habits (all zero) this is the
    paper's plain sample mean and variance.

    >>> estimate([0.0, 2.0], [0.0, 0.0], floor=0.01)
    (1.0, 2.0)
    """
    total = total_squared = weighted = squares = 0.0
    for x, habit in zip(values, habits, strict=True):
        q = 1.0 / (floor + habit)
        qx = q * x
        total += q
        total_squared += q * q
        weighted += qx
        squares += qx * x
    n, mean = len(values), weighted / total
    spread = max(squares / total - mean * mean, 0.0)
    unbiased = spread / (1.0 - total_squared / (total * total))
    return mean, unbiased + max(n / total - floor, 0.0)


def combine(groups: Sequence[Agreement]) -> CohesionTerm:
    """Sum the groups' terms into one weight and one target per feature."""
    weights = zip(*[g.weight for g in groups], strict=True)
    means = zip(*[g.mean for g in groups], strict=True)
    total, target = [], []
    for weight, mean in zip(weights, means, strict=True):
        total.append(t := sum(weight))
        target.append(sum(map(mul, weight, mean)) / t if t > 0.0 else 0.0)
    return CohesionTerm(tuple(total), tuple(target))
