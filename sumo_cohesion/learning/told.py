"""What was found as tables, and what to mind before using it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd

from sumo_cohesion.learning.fit import Fit
from sumo_cohesion.learning.prediction import DEFAULT, HORIZONS, LEARNED, VELOCITY
from sumo_cohesion.learning.segments import Segments
from sumo_cohesion.state import FloatArray
from sumo_cohesion.tables.columns import as_table

FEW_SEGMENTS, FEW_RUNS = 30, 3
MUCH_DROPPED = 0.3
LEAST_MISFIT, MOST_MISFIT = 0.5, 2.0
"""Between these is the median of q / f where the reward describes the driving."""


def fit_table(told: Mapping[str, float], predictions: pd.DataFrame) -> pd.DataFrame:
    """One row per model: median log-likelihood per second, mean displacements (m)."""
    off = predictions.pivot_table(index="model", columns="horizon", values="off", aggfunc="mean")
    windows = predictions.groupby("model")["example"].nunique()
    rows = []
    for model in dict.fromkeys([*told, *off.index]):
        row: dict[str, object] = {"model": model, "log_likelihood": told.get(model, np.nan)}
        for horizon in HORIZONS:
            known = model in off.index and horizon in off.columns
            row[f"off_{horizon:g}s"] = off.loc[model, horizon] if known else np.nan
        rows.append({**row, "windows": int(windows.get(model, 0))})
    return as_table("fit", rows)


def weight_table(found: Fit, interval: tuple[FloatArray, FloatArray] | None) -> pd.DataFrame:
    """One row per term: what was learned, and how sure it is."""
    nothing = np.full(len(found.names), np.nan)
    low, high = interval or (nothing, nothing)
    known = [name not in found.kept_default for name in found.names]
    free = [name not in found.kept_default and name != found.anchor for name in found.names]
    return as_table(
        "weights",
        {
            "term": found.names,
            "default": found.defaults,
            "learned": found.weights,
            "low": np.where(free, rounded(low, np.floor), np.nan),
            "high": np.where(free, rounded(high, np.ceil), np.nan),
            "error": found.error,
            "identified": known,
            "kept_default": [found.kept_default.get(name, "") for name in found.names],
            "share": found.share,
        },
    )


def rounded(values: FloatArray, towards: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Round outwards to three digits: what a solver's tolerance leaves open is unknown, too."""
    digit = 10.0 ** (np.floor(np.log10(np.maximum(np.abs(values), 1e-300))) - 2.0)
    # Written and read again: 120 times 1e-6 is a hair less than 0.00012.
    return np.array([float(f"{value:.3g}") for value in towards(values / digit) * digit])


def segment_table(segments: Segments, found: Fit, free: FloatArray) -> pd.DataFrame:
    """One row per segment; ``free`` are the dimensions of those that can be learned from."""
    usable = segments.dropped == ""
    each, misfit, free_of = (np.full(len(segments), np.nan) for _ in range(3))
    kept = np.zeros(len(segments), dtype=bool)
    each[usable], misfit[usable], kept[usable] = found.each, found.misfit, found.kept
    free_of[usable] = free
    reason = np.where(usable & ~kept, "trimmed", segments.dropped)
    return as_table(
        "segments",
        {
            "run": segments.run,
            "vehicle": segments.vehicle,
            "time": segments.time,
            "log_likelihood": each,
            "free": free_of,
            "misfit": misfit,
            "kept": kept,
            "reason": reason,
        },
    )


def warnings(
    rows: pd.DataFrame, found: Fit, table: pd.DataFrame, runs: int, *, exact: bool
) -> tuple[str, ...]:
    """Say what to mind; ``exact``: no noise is to be expected."""
    said = []
    usable, n = rows["misfit"].notna(), len(rows)
    if usable.sum() < FEW_SEGMENTS or runs < FEW_RUNS:
        said.append(
            f"{usable.sum()} segments from {runs} runs are few: give {FEW_SEGMENTS} or more from "
            f"{FEW_RUNS} or more"
        )
    dropped = rows.loc[~usable, "reason"].value_counts()
    if dropped.sum() > MUCH_DROPPED * n:
        why = ", ".join(f"{reason}: {count}" for reason, count in dropped.items())
        said.append(f"{dropped.sum()} of {n} segments are no optimum of this problem ({why})")
    middle = float(np.median(found.misfit))
    if not exact and not LEAST_MISFIT < middle < MOST_MISFIT:
        said.append(
            f"the median misfit is {middle:.2g}, not about 1: the reward does not describe this "
            "driving"
        )
    said += _beaten(table)
    for name, why in found.kept_default.items():
        if name not in found.fixed:
            said.append(f"{name} keeps its default: {why}")
    return tuple(said)


def _beaten(table: pd.DataFrame) -> list[str]:
    """Say where simpler models do better on what was held out."""
    if not len(table):
        return []
    said = []
    told = dict(zip(table["model"], table["log_likelihood"], strict=True))
    if told[LEARNED] < told[DEFAULT]:
        said.append("held-out driving is less likely than with the default weights")
    for horizon in reversed(HORIZONS):
        off = dict(zip(table["model"], table[f"off_{horizon:g}s"], strict=True))
        if not np.isnan(off[LEARNED]):
            if off[LEARNED] > off[VELOCITY]:
                said.append(f"{horizon:g} s ahead, constant velocity predicts it better")
            break
    return said
