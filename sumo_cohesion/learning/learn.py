"""From sources of driving to weights: cut, weigh, fit, doubt, and try on what was held out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from sumo_cohesion.errors import UserError
from sumo_cohesion.learning.example import Example
from sumo_cohesion.learning.fit import UNKNOWN, Fit, bootstrap, fit
from sumo_cohesion.learning.learned import DIGITS, Learned
from sumo_cohesion.learning.likelihood import Quadratics, quadratics
from sumo_cohesion.learning.prediction import (
    DEFAULT,
    FITTED,
    HORIZONS,
    LEARNED,
    best_scale,
    displacements,
    likelihoods,
    spread_out,
)
from sumo_cohesion.learning.segments import Segments, make_segments
from sumo_cohesion.learning.source import Source
from sumo_cohesion.learning.told import (
    FEW_RUNS,
    fit_table,
    segment_table,
    warnings,
    weight_table,
)
from sumo_cohesion.learning.tracks import Cutting
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.state import STEP, BoolArray, FloatArray
from sumo_cohesion.tables.columns import as_table
from sumo_cohesion.versions import versions

Progress = Callable[[str, int, int], None]
"""Called with (what is being done, how much of it is done, how much there is)."""

DOWN_TO_ZERO = 0.1
"""Share of a weight below which the lower end of its interval is as good as zero."""
DOUBTED = "its interval reaches down to zero"
INTERVAL = (0.05, 0.95)


@dataclass(frozen=True)
class Options:
    """How to learn.

    Attributes
    ----------
    keep : share of the segments that the fit is made of, the rest is trimmed.
    fixed : weights that are not learned, by name.
    hold_out : share of the runs that the fit is tried on, by another fit without them.
    draws : of the bootstrap over runs; 0: no intervals.
    exact : the segments are optima as they are, without noise: plans.
    """

    keep: float = 0.85
    fixed: Mapping[str, float] = field(default_factory=dict)
    hold_out: float = 0.25
    draws: int = 100
    exact: bool = False


@dataclass(frozen=True)
class Material:
    """Segments that can be learned from, and what the fit needs of them."""

    segments: Segments
    data: Quadratics
    names: tuple[str, ...]
    defaults: FloatArray

    def where(self, chosen: BoolArray) -> Material:
        """Return some of them."""
        return replace(self, segments=self.segments.where(chosen), data=self.data.where(chosen))

    def fit(self, options: Options) -> Fit:
        """Fit the weights."""
        try:
            return fit(self.data, self.names, self.defaults, options.fixed, options.keep)
        except np.linalg.LinAlgError:
            raise UserError(
                "--fix: with these weights some controls cost nothing; keep fewer at zero"
            ) from None


def learn_from(
    sources: Sequence[Source],
    how: Cutting,
    settings: PlannerSettings,
    options: Options,
    about: Mapping[str, object],
    progress: Progress | None = None,
) -> Learned:
    """Learn the weights of the terms that ``settings.reward`` has in use.

    Raises
    ------
    UserError
        If nothing can be learned from the sources; the message says why.
    """
    say = progress or _silent
    for name in options.fixed:
        if name not in settings.reward.in_use:
            known = ", ".join(settings.reward.in_use)
            raise UserError(f"--fix: there is no term {name!r} in use; terms are {known}")
    settings = settings.model_copy(update={"horizon": how.steps, "reward": settings.reward.shape})
    segments, material = _material(_examples(sources, how, say), settings, say)
    found, interval = _doubted(material, options, say)
    table, predictions = _tried(sources, how, settings, material, found, options, say)
    rows = segment_table(segments, found, material.data.free)
    runs = len(set(material.segments.run))
    return Learned(
        reward=_reward(found.names, found.weights),
        anchor=found.anchor,
        temperature=1.0 / found.scale,
        weights=weight_table(found, interval),
        segments=rows,
        fit=table,
        predictions=predictions,
        warnings=warnings(rows, found, table, runs, exact=options.exact),
        about={
            **about,
            "steps": how.steps,
            "segments": len(segments),
            "kept": int(found.kept.sum()),
            "runs": runs,
            "keep": options.keep,
            "dropped": _counted(segments),
            "digest": _digest(segments),
            "versions": versions(),
        },
    )


def _silent(_what: str, _done: int, _total: int) -> None:
    pass


def _examples(sources: Sequence[Source], how: Cutting, say: Progress) -> list[Example]:
    found: list[Example] = []
    for i, source in enumerate(sources):
        found += source.examples(how)
        say("cutting", i + 1, len(sources))
    if not found:
        names = ", ".join([source.name for source in sources][:3])
        raise UserError(
            f"no segment of {how.steps} steps of {STEP:g} s in {names}; give longer driving, or "
            "fewer --steps"
        )
    return found


def _material(
    examples: Sequence[Example], settings: PlannerSettings, say: Progress
) -> tuple[Segments, Material]:
    """Return all segments, each with why it is dropped, and what is made of the others."""
    say("weighing", 0, 1)
    segments = make_segments(examples, settings)
    _require_some(segments)
    usable = segments.dropped == ""
    data = quadratics(segments.where(usable), settings)
    penalty = np.zeros(len(segments))
    penalty[usable] = data.penalty
    # An active penalty has a kink: no gradient is zero there.
    segments = segments.drop(penalty > 0.0, "too near to a car, or off the road")
    say("weighing", 1, 1)
    _require_some(segments)
    names = settings.reward.in_use
    defaults = np.array([getattr(RewardWeights(), name) for name in names])
    chosen = segments.where(segments.dropped == "")
    return segments, Material(chosen, data.where(data.penalty <= 0.0), names, defaults)


def _require_some(segments: Segments) -> None:
    if not (segments.dropped == "").any():
        reasons = "; ".join(f"{reason}: {count}" for reason, count in _counted(segments).items())
        raise UserError(f"nothing can be learned from {len(segments)} segments ({reasons})")


def _doubted(
    material: Material, options: Options, say: Progress
) -> tuple[Fit, tuple[FloatArray, FloatArray] | None]:
    """Fit, and draw runs again; a weight that may as well be zero is not learned."""
    found = material.fit(options)
    if options.draws == 0 or len(set(material.segments.run)) < 2:
        return found, None
    samples = bootstrap(
        material.data,
        material.segments.run,
        found,
        options.draws,
        lambda done, total: say("drawing runs", done, total),
    )
    low, high = np.quantile(samples, INTERVAL, axis=0)
    unsure = low < DOWN_TO_ZERO * found.weights
    names = [n for n, so in zip(found.names, unsure, strict=True) if so]
    return found.without({n: DOUBTED for n in names if n not in found.kept_default}), (low, high)


def _tried(
    sources: Sequence[Source],
    how: Cutting,
    settings: PlannerSettings,
    material: Material,
    found: Fit,
    options: Options,
    say: Progress,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Compare with simpler models on runs held out: likelihood, and where predictions lead."""
    out = _held_out(sorted(set(material.segments.run)), options.hold_out)
    train = ~np.isin(material.segments.run, list(out))
    if not out or not train.any() or train.all():
        return as_table("fit", []), as_table("predictions", [])
    seen = material.where(train)
    trained = seen.fit(options)
    # What all runs do not tell, some of them do not tell either.
    trained = trained.without({n: UNKNOWN for n in found.kept_default if n not in options.fixed})
    default = material.defaults * best_scale(seen.data, material.defaults, options.keep)
    told = likelihoods(
        material.data,
        material.segments,
        train,
        {
            LEARNED: trained.scale * trained.weights,
            FITTED: trained.theta,
            DEFAULT: default,
        },
        options.keep,
    )
    # Plans end with their horizon; tracks can be followed for longer.
    longest = how if options.exact else replace(how, steps=round(HORIZONS[-1] / STEP))
    windows = [e for s in sources for e in s.examples(longest) if e.run in out]
    say("predicting", 0, 1)
    predictions = displacements(
        spread_out(windows),
        settings.model_copy(update={"horizon": longest.steps}),
        {
            LEARNED: _reward(trained.names, trained.weights),
            FITTED: _reward(trained.names, trained.theta / trained.scale),
            DEFAULT: RewardWeights(),
        },
    )
    say("predicting", 1, 1)
    return fit_table(told, predictions), predictions


def _held_out(runs: Sequence[str], share: float) -> set[str]:
    """Choose runs by their names, so that the same are held out wherever the folder lies."""
    count = round(share * len(runs))
    if len(runs) < FEW_RUNS + 1 or not 0 < count < len(runs):
        return set()
    return set(sorted(runs, key=lambda r: hashlib.sha256(r.encode()).digest())[:count])


def _reward(names: Sequence[str], weights: FloatArray) -> RewardWeights:
    pairs = zip(names, weights, strict=True)
    return RewardWeights(**{name: float(f"{weight:.{DIGITS}g}") for name, weight in pairs})


def _counted(segments: Segments) -> dict[str, int]:
    reasons = pd.Series(segments.dropped[segments.dropped != ""], dtype=object).value_counts()
    return {str(reason): int(count) for reason, count in reasons.items()}


def _digest(segments: Segments) -> str:
    """Digest of the driving: where it began, what was around it, and what was chosen."""
    found = hashlib.sha256()
    for part in (segments.start, segments.stages, segments.controls):
        found.update(np.ascontiguousarray(part).tobytes())
    return found.hexdigest()[:32]
