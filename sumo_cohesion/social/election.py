"""Who steers: an addition to the paper's sum over all groups.

Once humans have finished a swerve they all drive straight, and their unanimous "straight"
elsewhere would outvote the "turn" of those who pass the ego's own place. The ego keeps its lane by
itself; so of all agreements the one that contradicts lane keeping most is the one that has
something to say ("for only the subset of cars that exhibits the low variance", paper, section I),
and if none does there is nothing to follow sideways.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import mul

from sumo_cohesion.social.agreement import Agreement
from sumo_cohesion.social.features import LATERAL
from sumo_cohesion.social.place import Place
from sumo_cohesion.social.settings import CohesionSettings

_STEERING = [i for i, lateral in enumerate(LATERAL) if lateral]
_NOT_STEERING = [float(not lateral) for lateral in LATERAL]
_STILL_NEWS = 1.0
"""Surprise that is enough as long as a greater one is remembered."""


class Election:
    """Elects the group that steers, step after step, and remembers when it was surprised.

    Agreement comes and goes within a second while humans move one after another; what has
    once surprised the ego keeps its attention for ``surprise_hold`` seconds.
    """

    def __init__(self, settings: CohesionSettings) -> None:
        self._settings = settings
        self._attentive_until = -1.0

    def reset(self) -> None:
        """Forget the last run."""
        self._attentive_until = -1.0

    def elect(
        self, groups: Sequence[Agreement], place: Place, time: float
    ) -> tuple[tuple[Agreement, ...], Place]:
        """Leave the lateral weights to one group, or to none; ``time`` in s."""
        attentive = time < self._attentive_until
        threshold = min(self._settings.surprise, _STILL_NEWS if attentive else float("inf"))
        surprise = [surprise_of(group, place) for group in groups]
        most = max(surprise)
        if most > self._settings.surprise:
            self._attentive_until = time + self._settings.surprise_hold
        chosen = surprise.index(most) if most > threshold else -1
        elected = tuple([g if i == chosen else _silent(g) for i, g in enumerate(groups)])
        if chosen < 0 or groups[chosen].group != "position":
            place = place._replace(weight=(0.0,) * len(place.weight))
        return elected, place


def surprise_of(group: Agreement, place: Place) -> float:
    """How much a group contradicts lane keeping: sum over lateral features of weight · mean².

    The position group's place counts with it.
    """
    weight, mean = group.weight, group.mean
    features = sum([weight[i] * mean[i] * mean[i] for i in _STEERING])
    return features + (place.surprise if group.group == "position" else 0.0)


def _silent(group: Agreement) -> Agreement:
    weight = tuple(map(mul, group.weight, _NOT_STEERING))
    return Agreement(group.group, group.n, group.mean, group.variance, weight)
