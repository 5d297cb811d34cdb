"""What a reward says of driving that it was not learned from, beside simpler guesses."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from sumo_cohesion.learning.example import Example
from sumo_cohesion.learning.likelihood import Quadratics, score
from sumo_cohesion.learning.segments import Segments, problem_of
from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.mpc import Mpc
from sumo_cohesion.state import STEP, BoolArray, Control, FloatArray, RoadState
from sumo_cohesion.tables.columns import as_table

HORIZONS = (1.0, 2.0, 3.0)
"""Seconds after which a prediction is compared with what was driven."""
VELOCITY = "constant velocity"
LEARNED, FITTED, DEFAULT = "learned", "as fitted", "default"
"""Models: what is learned, with defaults in place of what the demonstrations do not tell; the same
without them; and the default weights."""
WINDOWS = 100
"""Held-out windows that are predicted, at most."""


def best_scale(data: Quadratics, weights: FloatArray, keep: float) -> float:
    """Scale of the greatest likelihood of given weights, of the share that they fit best."""
    found = score(data, weights, np.ones(len(data.free)))
    order = np.argsort(found.misfit / np.maximum(data.free, 1.0))
    kept = order[: max(round(keep * len(order)), 1)]
    return float(data.free[kept].sum() / max(found.misfit[kept].sum(), 1e-300))


def likelihoods(
    data: Quadratics,
    segments: Segments,
    train: BoolArray,
    thetas: Mapping[str, FloatArray],
    keep: float,
) -> dict[str, float]:
    """Median log-likelihood per second (nats, of scaled controls) of segments not in ``train``.

    Of rewards by name, and of two guesses that know no reward: the control before plus white noise,
    and a random walk of the controls. ``keep`` is the share of the segments with the least noise
    that the guesses are fitted to, as rewards are.
    """
    seconds = STEP * segments.controls.shape[1]
    held_out = data.where(~train)
    found = {
        name: float(np.median(score(held_out, theta, np.ones(len(held_out.free))).each))
        for name, theta in thetas.items()
    }
    first = segments.start[:, None, 4:]
    steps = np.diff(np.concatenate((first, segments.controls), axis=1), axis=1)
    for name, noise in (
        ("control before, white noise", segments.controls - first),
        ("random walk of controls", steps),
    ):
        chosen = np.where(segments.high > segments.low, noise, np.nan)
        found[name] = _noise_likelihood(chosen[train], chosen[~train], keep)
    return {name: value / seconds for name, value in found.items()}


def _noise_likelihood(seen: FloatArray, unseen: FloatArray, keep: float) -> float:
    """Median log-likelihood of (N, T, 2) normal noise, of the deviations fitted to other noise.

    Not a number where there was no choice (who is on rails): it does not count.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a control that nobody chose: no mean
        usual = np.nanmedian(np.abs(seen), axis=(0, 1))
        order = np.argsort(np.nansum((seen / np.maximum(usual, 1e-12)) ** 2, axis=(1, 2)))
        kept = seen[order[: max(round(keep * len(order)), 1)]]
        deviation = np.maximum(np.sqrt(np.nanmean(kept**2, axis=(0, 1))), 1e-12)
    each = -0.5 * (unseen / deviation) ** 2 - np.log(deviation) - 0.5 * np.log(2.0 * np.pi)
    return float(np.median(np.nansum(each, axis=(1, 2))))


def spread_out(examples: Sequence[Example], most: int = WINDOWS) -> list[Example]:
    """Return at most so many examples, evenly spread over all."""
    usable = [e for e in examples if not e.unusable and np.isfinite(e.states).all()]
    chosen = np.unique(np.linspace(0, len(usable) - 1, min(most, len(usable))).round().astype(int))
    return [usable[i] for i in chosen]


def displacements(
    examples: Sequence[Example],
    settings: PlannerSettings,
    rewards: Mapping[str, RewardWeights],
) -> pd.DataFrame:
    """How far (m) predictions are from what was driven: a row per example, model and horizon.

    Rewards predict by the planner's own plan. Others are taken to keep their velocity. The guesses:
    constant velocity, and constant controls (the control before goes on).
    """
    steps = settings.horizon
    horizons = [h for h in HORIZONS if h <= STEP * steps + 1e-9]
    n_lanes = max((e.road.lane_centre.shape[1] for e in examples), default=1)
    planners = {
        name: Mpc(settings.model_copy(update={"reward": reward}), n_lanes)
        for name, reward in rewards.items()
    }
    rows = []
    for i, example in enumerate(examples):
        predicted = {
            VELOCITY: _driven_on(example, None, settings),
            "constant controls": _driven_on(example, example.driven, settings),
        }
        for name, planner in planners.items():
            planner.reset()
            solution = planner.solve(problem_of(example, planner.settings, n_lanes))
            if solution.solved:
                predicted[name] = solution.states[1:, :2]
        for name, places in predicted.items():
            for horizon in horizons:
                at = round(horizon / STEP) - 1
                off = float(np.hypot(*(places[at] - example.states[at, :2])))
                whose = {"example": i, "run": example.run, "model": name}
                rows.append({**whose, "horizon": horizon, "off": off})
    return as_table("predictions", rows)


def _driven_on(example: Example, control: Control | None, settings: PlannerSettings) -> FloatArray:
    """Places (T, 2) that a car comes to with a constant control, or along the road as it goes."""
    state, places = example.ego, np.empty((len(example.states), 2))
    held = Control(0.0, settings.friction * example.ego.speed) if control is None else control
    for t in range(len(places)):
        bend = example.road.bend_at(state[0])
        if control is None:
            # Its heading to the road stays: as cars are predicted.
            held = held._replace(
                curvature=bend * np.cos(state[2]) / dynamics.stretch(bend, state[1])
            )
        state = RoadState(*dynamics.step(state, held, STEP, settings.friction, bend))
        places[t] = state[:2]
    return places
