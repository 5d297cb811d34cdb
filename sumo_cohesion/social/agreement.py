"""When: how much a group agrees, and the cohesion term that follows (paper, eq. 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_cohesion.social.features import LATERAL
from sumo_cohesion.social.groups import Votes
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import FloatArray

_LATERAL = np.array(LATERAL)


@dataclass(frozen=True, slots=True)
class Agreement:
    """What one group agrees on: n cars, and (k,) mean, variance and weight per feature.

    A group of too few cars has weight zero everywhere, and mean and variance zero.
    """

    group: str
    n: int
    mean: FloatArray
    variance: FloatArray
    weight: FloatArray


@dataclass(frozen=True, slots=True)
class CohesionTerm:
    """The sum over groups of weight · (mean − psi)², per feature.

    A sum of squares about several means is one square about their weighted mean, plus a
    constant that no plan can change; so (k,) ``weight`` and ``target`` say it all.
    """

    weight: FloatArray
    target: FloatArray


def agreement(votes: Votes, settings: CohesionSettings) -> Agreement:
    """Mean and unbiased variance of a group's votes; weight = 1 / (variance + floor)."""
    n, k = votes.values.shape
    if n < settings.min_cars:
        zero = np.zeros(k)
        return Agreement(votes.group, n, zero, zero, zero)
    mean = votes.values.sum(axis=0) / n
    deviation = votes.values - mean
    variance = (deviation * deviation).sum(axis=0) / (n - 1)
    return Agreement(votes.group, n, mean, variance, 1.0 / (variance + settings.variance_floor))


def elect_lateral(groups: Sequence[Agreement]) -> tuple[Agreement, ...]:
    """Let only the most surprising group vote on lateral features.

    Once humans have finished a swerve they all drive straight, and their unanimous "straight"
    elsewhere would outvote the "turn" of those who pass the ego's own place. The ego keeps its
    lane by itself; so of all agreements the one that contradicts lane keeping most, with the
    largest sum of weight · mean², is the one that has something to say ("for only the subset
    of cars that exhibits the low variance", paper, section I).
    """
    surprise = [float((g.weight * g.mean * g.mean)[_LATERAL].sum()) for g in groups]
    chosen = int(np.argmax(surprise))
    if surprise[chosen] <= 1.0:
        return tuple(groups)
    return tuple(
        g
        if i == chosen
        else Agreement(g.group, g.n, g.mean, g.variance, np.where(_LATERAL, 0.0, g.weight))
        for i, g in enumerate(groups)
    )


def combine(groups: Sequence[Agreement]) -> CohesionTerm:
    """Sum the groups' terms into one weight and one target per feature."""
    weights = np.array([g.weight for g in groups])
    total = weights.sum(axis=0)
    pulled = (weights * np.array([g.mean for g in groups])).sum(axis=0)
    return CohesionTerm(total, pulled / np.maximum(total, 1e-12))
