"""Why a plan is as it is: what the groups agreed on, and what ignoring them would have cost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from math import cos, sin
from typing import Any, overload

from sumo_cohesion.planning.dynamics import stretch
from sumo_cohesion.social.agreement import Agreement
from sumo_cohesion.social.features import FEATURES, social_features
from sumo_cohesion.social.place import SCALE, Place
from sumo_cohesion.state import STEP, AgreementRow, RoadState


@dataclass(frozen=True, slots=True)
class Explanation(Sequence[AgreementRow]):
    """One row per group and feature; worked out when it is asked for, not while planning.

    Attributes
    ----------
    ego, bend : the ego's road state, and the road's curvature (1/m) there.
    groups, place : what was agreed, as it steered; at least one group.
    beta : the cohesion's trade-off.
    """

    ego: RoadState
    bend: float
    groups: tuple[Agreement, ...]
    place: Place
    beta: float

    def columns(self) -> tuple[list[Any], ...]:
        """Say what was agreed and what ignoring it would cost: by field of AgreementRow."""
        s, d, heading, speed = self.ego
        on = (
            s + STEP * speed * cos(heading) / stretch(self.bend, d),
            d + STEP * speed * sin(heading),
            heading,
            speed,
        )
        groups, k = self.groups, len(FEATURES)
        group = [g.group for g in groups for _ in range(k)]
        n = [g.n for g in groups for _ in range(k)]
        mean, variance, weight = (
            list(chain.from_iterable(values))
            for values in zip(*[(g.mean, g.variance, g.weight) for g in groups], strict=True)
        )
        own = [*social_features(self.ego, on, STEP, self.bend)] * len(groups)
        names = [*FEATURES] * len(groups)
        place = self.place
        if any(place.weight):
            # The nearest place that is known.
            i = next(i for i, w in enumerate(place.weight) if w > 0.0)
            group.append("position")
            names.append("place")
            n.append(place.n)
            mean.append(place.mean[i] / SCALE)
            variance.append(place.variance[i])
            weight.append(place.weight[i])
            own.append(d / SCALE)
        missed = zip(weight, mean, own, strict=True)
        pull = [self.beta * w * (m - o) ** 2 for w, m, o in missed]
        return group, names, n, mean, variance, weight, own, pull

    def rows(self) -> list[AgreementRow]:
        """Return one row per group and feature, and one for the place if there is one."""
        return [AgreementRow(*row) for row in zip(*self.columns(), strict=True)]

    def __len__(self) -> int:
        return len(FEATURES) * len(self.groups) + any(self.place.weight)

    def __iter__(self) -> Iterator[AgreementRow]:
        return iter(self.rows())

    @overload
    def __getitem__(self, index: int) -> AgreementRow: ...
    @overload
    def __getitem__(self, index: slice) -> list[AgreementRow]: ...
    def __getitem__(self, index: int | slice) -> AgreementRow | list[AgreementRow]:
        return self.rows()[index]
