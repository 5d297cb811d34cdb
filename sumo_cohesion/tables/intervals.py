"""Rates and means with 95 % confidence intervals; scipy does the work."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy import stats

RATES = ("success", "collision", "off_road", "exited", "sumo_collision")
MEANS = (
    "mean_speed",
    "min_gap",
    "min_ttc",
    "max_drac",
    "human_mean_speed",
    "human_hard_brakes",
    "plan_failures",
    "plan_ms_median",
)
_LEVEL = 0.95
_MANY = 1000


def wilson(successes: int, n: int) -> tuple[float, float, float]:
    """Rate and its Wilson score interval (Wilson 1927, JASA 22, p. 209).

    >>> [round(v, 3) for v in wilson(50, 50)]
    [1.0, 0.929, 1.0]
    """
    interval = stats.binomtest(successes, n).proportion_ci(_LEVEL, method="wilson")
    return successes / n, float(interval.low), float(interval.high)


def mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean and its BCa bootstrap interval (Efron 1987); fixed random numbers.

    One value, or several equal ones, give an interval of width zero. Of more than a thousand
    values the mean is as good as normally distributed, and its interval is the normal one.
    """
    data = np.asarray(values, dtype=float)
    mean = float(data.mean())
    if data.size < 2 or np.ptp(data) == 0.0:
        return mean, mean, mean
    if data.size > _MANY:
        half = float(stats.norm.ppf(0.5 + _LEVEL / 2) * data.std(ddof=1) / np.sqrt(data.size))
        return mean, mean - half, mean + half
    # BCa has no interval where all but one value coincide; the percentile method always has.
    method = "BCa" if len(np.unique(data)) > 2 else "percentile"
    result = stats.bootstrap(
        (data,), np.mean, confidence_level=_LEVEL, method=method, n_resamples=2000, rng=0
    )
    interval = result.confidence_interval
    return mean, float(interval.low), float(interval.high)


def median_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Median and its percentile bootstrap interval; fixed random numbers.

    One value, or several equal ones, give an interval of width zero.

    >>> median_interval([2.0, 2.0])
    (2.0, 2.0, 2.0)
    """
    data = np.asarray(values, dtype=float)
    median = float(np.median(data))
    if data.size < 2 or np.ptp(data) == 0.0:
        return median, median, median
    interval = stats.bootstrap(
        (data,),
        np.median,
        confidence_level=_LEVEL,
        method="percentile",  # BCa rests on leaving one out, which says little of a median
        n_resamples=2000,
        rng=0,
    ).confidence_interval
    return median, float(interval.low), float(interval.high)


def summarize(metrics: pd.DataFrame) -> pd.DataFrame:
    """Summarize metrics rows by planner: value, low, high and n for each rate and mean.

    n counts the runs in which the metric is defined (a run may have no car in its path).
    """
    rows = []
    for planner, runs in metrics.groupby("planner", sort=False):
        for metric in RATES:
            count, n = int(runs[metric].sum()), len(runs)
            rows.append((planner, metric, *wilson(count, n), n))
        for metric in MEANS:
            values = runs[metric].dropna()
            interval = mean_interval(values.to_list()) if len(values) else (np.nan,) * 3
            rows.append((planner, metric, *interval, len(values)))
    return pd.DataFrame(rows, columns=["planner", "metric", "value", "low", "high", "n"])
