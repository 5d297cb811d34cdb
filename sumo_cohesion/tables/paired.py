"""Planners compared on the same seeds: differences, intervals, tests, effect sizes."""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, nan, sqrt
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from sumo_cohesion.errors import UserError
from sumo_cohesion.tables.intervals import mean_interval, wilson

_Z = float(stats.norm.ppf(0.975))


class _Difference(NamedTuple):
    """A planner's metric beside the baseline's, on n common seeds; see compare_planners."""

    kind: str
    n: int
    baseline_value: float
    baseline_low: float
    baseline_high: float
    value: float
    low: float
    high: float
    difference: float
    difference_low: float
    difference_high: float
    effect: float
    p: float


def compare_planners(
    metrics: pd.DataFrame,
    of: Sequence[str] = ("success", "collision", "mean_speed", "human_hard_brakes"),
    *,
    baseline: str = "nominal",
    by: Sequence[str] | None = None,
    correction: str = "bh",
) -> pd.DataFrame:
    """Compare every planner with a baseline, seed by seed.

    Parameters
    ----------
    metrics : rows as load_metrics() gives them, of one or many scenarios and grid points.
    of : metrics to compare; those that are true or false become rates.
    baseline : planner to compare with.
    by : columns whose combinations are compared one by one. Default: the scenario and the
        columns of the grid (all before ``seed``, as a batch writes them).
    correction : for testing many times: "bh" (Benjamini & Hochberg 1995) or "by" (Benjamini &
        Yekutieli 2001) control the rate of false discoveries among all rows of the result.

    Returns
    -------
    One row per combination, planner and metric:

    - ``n`` common seeds on which both runs have a value; ``excluded``: seeds where one has none;
    - ``value``, ``low``, ``high`` (and ``baseline_...``): rate with its Wilson interval, or mean
      with its BCa bootstrap interval, 95 %;
    - ``difference``, ``difference_low``, ``difference_high``: paired, planner minus baseline; of
      rates with the adjusted Wald interval of Bonett & Price (2012, JEBS 37, 479-488), which
      stays honest at 0 and 100 %; of means with the BCa bootstrap;
    - ``effect``: Cohen's h of two rates, or Cohen's d of the paired differences (d_z);
    - ``p``: exact McNemar test of rates, Wilcoxon signed-rank test of means; ``p_adjusted``.

    Raises
    ------
    UserError
        If a column or the baseline is not there.
    """
    keys = list(by) if by is not None else _grid_columns(metrics)
    missing = [c for c in (*of, *keys, "planner", "seed") if c not in metrics.columns]
    if missing:
        raise UserError(f"the metrics have no column {missing[0]!r}")
    if baseline not in set(metrics["planner"]):
        raise UserError(f"no runs of the baseline {baseline!r}; name another with baseline=")
    rows: list[dict[str, Any]] = []
    for names, runs in metrics.groupby(keys, sort=False, dropna=False) if keys else [((), metrics)]:
        values = names if isinstance(names, tuple) else (names,)
        where = dict(zip(keys, values, strict=True))
        seeds = {
            str(planner): own.set_index("seed")
            for planner, own in runs.groupby("planner", sort=False)
        }
        if baseline not in seeds:
            continue
        for planner, own in seeds.items():
            if planner != baseline:
                rows += [
                    {
                        **where,
                        "planner": planner,
                        "metric": metric,
                        **_paired(own, seeds[baseline], metric),
                    }
                    for metric in of
                ]
    if not rows:
        raise UserError(f"nothing to compare with {baseline!r}: it is the only planner")
    table = pd.DataFrame(rows)
    tested = table["p"].notna()
    table["p_adjusted"] = nan
    if tested.any():
        table.loc[tested, "p_adjusted"] = stats.false_discovery_control(
            table.loc[tested, "p"], method=correction
        )
    return table


def _grid_columns(metrics: pd.DataFrame) -> list[str]:
    """Scenario, and what a batch puts between planner and seed: the grid."""
    names = [str(c) for c in metrics.columns]
    if not {"scenario", "planner", "seed"} <= set(names):
        raise UserError("not a table of metrics: it needs scenario, planner and seed")
    between = names[names.index("planner") + 1 : names.index("seed")]
    return ["scenario", *between]


def _paired(own: pd.DataFrame, other: pd.DataFrame, metric: str) -> dict[str, Any]:
    if not (own.index.is_unique and other.index.is_unique):
        raise UserError("a planner has several runs of one seed; tell them apart with by=")
    if not pd.api.types.is_numeric_dtype(own[metric].dtype):
        raise UserError(f"{metric!r} is no number and cannot be compared")
    pairs = pd.DataFrame({"a": own[metric], "b": other[metric]})
    whole = pairs.dropna()
    rate = pd.api.types.is_bool_dtype(own[metric].dtype)
    a, b = whole["a"].to_numpy(float), whole["b"].to_numpy(float)
    found = (_of_rates if rate else _of_means)(a, b) if len(whole) else _nothing(rate=rate)
    return {**found._asdict(), "excluded": len(pairs) - len(whole)}


def _nothing(*, rate: bool) -> _Difference:
    return _Difference("rate" if rate else "mean", 0, *[nan] * 11)


def _of_rates(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> _Difference:
    n, gained, lost = len(a), int(((a == 1) & (b == 0)).sum()), int(((a == 0) & (b == 1)).sum())
    own, other = wilson(int(a.sum()), n), wilson(int(b.sum()), n)
    # Bonett & Price: one run more in each of the cells that differ.
    p, q = (gained + 1) / (n + 2), (lost + 1) / (n + 2)
    half = _Z * sqrt((p + q - (p - q) ** 2) / (n + 2))
    low, high = max(p - q - half, -1.0), min(p - q + half, 1.0)
    effect = 2.0 * (asin(sqrt(own[0])) - asin(sqrt(other[0])))
    test = stats.binomtest(gained, gained + lost).pvalue if gained + lost else 1.0
    return _Difference("rate", n, *other, *own, own[0] - other[0], low, high, effect, float(test))


def _of_means(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> _Difference:
    change = a - b
    spread = float(change.std(ddof=1)) if len(change) > 1 else nan
    same = 0.0 if not change.any() else nan  # the same difference on every seed
    effect = float(change.mean()) / spread if spread > 0.0 else same
    test = float(stats.wilcoxon(change).pvalue) if change.any() else 1.0
    return _Difference(
        "mean",
        len(a),
        *mean_interval(b.tolist()),
        *mean_interval(a.tolist()),
        *mean_interval(change.tolist()),
        effect,
        test,
    )
