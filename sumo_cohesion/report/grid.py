"""A metric over one or two axes of a batch's grid, with 95 % intervals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from sumo_cohesion.errors import UserError
from sumo_cohesion.report.drawing import EGO_COLOURS, new_figure, save
from sumo_cohesion.tables.intervals import mean_interval, wilson


def intervals(metrics: pd.DataFrame, metric: str, over: list[str]) -> pd.DataFrame:
    """Value, low, high and n of a metric per combination of columns.

    Rates with Wilson intervals where the metric is true or false, means with BCa bootstrap
    intervals elsewhere.
    """
    missing = [name for name in (metric, *over) if name not in metrics.columns]
    if missing:
        raise UserError(f"the metrics have no column {missing[0]!r}")
    rate = pd.api.types.is_bool_dtype(metrics[metric].dtype)
    if not rate and not pd.api.types.is_numeric_dtype(metrics[metric].dtype):
        raise UserError(f"{metric} is text; name a metric that is a number or true or false")
    rows = []
    for names, part in metrics.groupby(over, sort=False):
        # Rows that share a run are one measurement.
        runs = part.drop_duplicates("run") if "run" in part.columns else part
        values = runs[metric].dropna()
        if rate and len(values):
            found = wilson(int(values.sum()), len(values))
        else:
            found = mean_interval(values.astype(float).to_list()) if len(values) else (np.nan,) * 3
        rows.append((*names, *found, len(values)))
    return pd.DataFrame(rows, columns=[*over, "value", "low", "high", "n"])


def draw_grid(
    metrics: pd.DataFrame,
    metric: str,
    x: str,
    panels: str | None = None,
    out: str | Path = "grid.png",
) -> Path:
    """Draw a metric over the column ``x``, a line per planner, a panel per value of ``panels``.

    Returns the picture's path.
    """
    over = ["planner", x, *([panels] if panels else [])]
    if len(set(over)) < len(over):
        raise UserError("the axes are the grid's: neither the planner nor one name twice")
    table = intervals(metrics, metric, over)
    if table.empty:
        raise UserError("no runs to draw")
    split = list(table.groupby(panels, sort=False)) if panels else [("", table)]
    places = {value: i for i, value in enumerate(table[x].unique())}
    numeric = pd.api.types.is_numeric_dtype(table[x].dtype)
    figure = new_figure(3.4 * len(split) + 1.2, 3.2)
    axes = figure.subplots(1, len(split), sharey=True, squeeze=False)[0]
    planners = list(table["planner"].unique())
    for axis, (value, part) in zip(axes, split, strict=True):
        for i, planner in enumerate(planners):
            own = part[part["planner"] == planner]
            own = own.sort_values(x) if numeric else own
            at = own[x].to_numpy(float) if numeric else np.array([places[v] for v in own[x]], float)
            if not numeric:
                at += 0.08 * (i - (len(planners) - 1) / 2)
            error = np.abs(own[["low", "high"]].to_numpy(float).T - own["value"].to_numpy(float))
            axis.errorbar(
                at,
                own["value"],
                yerr=error,
                marker="o",
                markersize=4,
                capsize=3,
                linewidth=1.2,
                color=EGO_COLOURS.get(str(planner)),
                label=str(planner),
            )
        values = table[x].to_numpy(float) if numeric else np.zeros(1)
        if values.min() > 0.0 and values.max() > 20.0 * values.min():
            axis.set_xscale("log")
        if not numeric:
            axis.set_xticks(range(len(places)), [str(v) for v in places])
        axis.set_xlabel(x)
        axis.set_title(f"{panels} = {value!s}" if panels else "", fontsize=9)
        if pd.api.types.is_bool_dtype(metrics[metric].dtype):
            axis.set_ylim(-0.04, 1.04)
    axes[0].set_ylabel(f"{metric}, 95 % interval")
    axes[-1].legend(fontsize=8)
    return save(figure, Path(out))
