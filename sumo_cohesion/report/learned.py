"""What was learned, as tables and figures in a folder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy import stats

from sumo_cohesion.report.drawing import EGO_COLOURS, new_figure, save
from sumo_cohesion.state import FloatArray
from sumo_cohesion.tables.columns import LEARNED
from sumo_cohesion.tables.folders import require_replaceable, whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sumo_cohesion.learning.learned import Learned

WIDTH = 8.0
"""Inches."""
LEVEL = 0.95
"""Of the intervals of prediction errors, as everywhere but of the weights' own."""
DRAWS = 2000
BINS = 60
SHOWN, WIDEST = (0.005, 0.995), 1e25
"""Quantiles of the misfits that the bars reach from and to; ratio of the two at most."""
STYLES: dict[str, dict[str, Any]] = {
    "learned": {"color": EGO_COLOURS["cohesive"], "marker": "o"},
    "default": {"color": EGO_COLOURS["nominal"], "marker": "s"},
    "constant velocity": {"color": "0.35", "marker": "^"},
    "constant controls": {"color": "0.65", "marker": "v"},
}
"""Of the models whose predictions are compared, in this order."""
KEPT, TRIMMED, UNKNOWN = EGO_COLOURS["cohesive"], "tab:purple", "0.55"
"""Colours of what the fit is made of, of what it leaves out, and of what is not learned."""
WEIGHTS: dict[str, dict[str, Any]] = {
    "learned": {"color": KEPT, "marker": "o"},
    "not learned": {"mec": UNKNOWN, "mfc": "white", "marker": "o"},
    "what the others are relative to": {"color": "black", "marker": "s"},
}
FEW_TICKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Multiples that are marked where all weights lie between the first and the last."""


def write_report(learned: Learned, folder: str | Path) -> Path:
    """Write tables (parquet), weights (theta.toml) and figures (PNG) to a folder.

    Only the files of an earlier result are replaced; there is no figure where there is nothing to
    show. Returns the folder.

    Raises
    ------
    UserError
        If the folder holds something else, or cannot be written to.
    """
    folder = Path(folder)
    require_replaceable(folder, "--report")
    with whole_folder(folder, "--report") as new:
        for name in LEARNED:
            getattr(learned, name).to_parquet(new / f"{name}.parquet", index=False)
        (new / "theta.toml").write_text(learned.to_toml(), encoding="utf-8")
        save(draw_weights(learned.weights, learned.anchor), new / "weights.png")
        save(draw_misfit(learned.segments), new / "misfit.png")
        if len(learned.predictions):
            save(draw_predictions(learned.predictions), new / "predictions.png")
    return folder


# Weights


def draw_weights(weights: pd.DataFrame, anchor: str) -> Figure:
    """Draw weights and their 90 % intervals as multiples of their defaults, one term a line.

    ``anchor`` is the term that all are relative to.
    """
    figure = new_figure(WIDTH, 0.42 * len(weights) + 1.3)
    axis = figure.subplots()
    axis.axvline(1.0, color="0.8", lw=1.0, zorder=0.5)
    told = [_draw_weight(axis, y, row, anchor) for y, (_, row) in enumerate(weights.iterrows())]
    axis.set_xscale("log")
    _mark_multiples(axis)
    axis.set_yticks(range(len(weights)), list(weights["term"]))
    axis.set_ylim(len(weights) - 0.4, -0.6)
    sure = ", 90 % of a bootstrap over runs" if weights["low"].notna().any() else ""
    axis.set_xlabel(f"weight / default{sure}")
    axis.grid(axis="x", color="0.93", lw=0.8)
    axis.set_axisbelow(True)
    values = axis.secondary_yaxis("right")
    values.set_yticks(range(len(weights)), told, fontsize="small")
    values.tick_params(length=0)
    _legend(axis, WEIGHTS)
    return figure


def _draw_weight(axis: Axes, y: int, row: pd.Series, anchor: str) -> str:
    """Draw one weight, and return what there is to say about it."""
    value = f"{row['learned']:.3g}"
    if row["default"] == 0.0:  # no multiple of nothing
        value += ", off by default"
    else:
        learned, relative = "learned", "what the others are relative to"
        kind = relative if row["term"] == anchor else learned
        kind = "not learned" if row["kept_default"] else kind
        ends = np.array([row["low"], row["high"]]) / row["default"]
        axis.plot(ends, [y, y], color=KEPT, lw=2.0, marker="|", ms=9, mew=2.0, zorder=2.5)
        at = row["learned"] / row["default"]
        axis.plot([at], [y], ls="none", zorder=3.0, label=kind, **WEIGHTS[kind])
    if row["kept_default"]:
        return f"{value}: {row['kept_default']}"
    if np.isfinite(row["low"]):
        return f"{value}  [{row['low']:.3g}, {row['high']:.3g}]"
    return value


def _mark_multiples(axis: Axes) -> None:
    """Show half to twice the default at least, so that next to nothing does not look like much."""
    low, high = axis.get_xlim()
    low, high = min(low, 0.45), max(high, 2.2)
    if FEW_TICKS[0] <= low and high <= FEW_TICKS[-1]:
        axis.set_xticks(FEW_TICKS, [f"{tick:g}" for tick in FEW_TICKS])
        axis.set_xticks([], minor=True)
    axis.set_xlim(low, high)


# Misfit


def draw_misfit(segments: pd.DataFrame) -> Figure:
    """Draw the segments' misfits q / f, beside what normal noise of the fit's size would give.

    The misfit q of a segment with f free controls is then distributed as chi-square with f degrees
    of freedom. The first and the last bar hold what lies beyond them, too: of exact optima some
    are twenty powers of ten apart.
    """
    used = segments[np.isfinite(segments["misfit"])]
    values = used["misfit"].to_numpy(float)
    least, most = np.quantile(values, SHOWN)
    most = max(most, 10.0)
    least = max(min(least, 0.1), most / WIDEST)
    edges = np.geomspace(least, most, BINS + 1)
    values = np.clip(values, edges[0], edges[-1])
    kept = used["kept"].to_numpy(bool)
    figure = new_figure(WIDTH, 3.4)
    axis = figure.subplots()
    axis.hist(
        [values[kept], values[~kept]],
        edges.tolist(),
        stacked=True,
        color=[KEPT, TRIMMED],
        label=[f"kept ({kept.sum()})", f"trimmed ({(~kept).sum()})"],
    )
    expected = expected_counts(used["free"].to_numpy(float), edges)
    axis.stairs(expected, edges, color="black", lw=1.2, label="χ² of f degrees / f")
    axis.set_xscale("log")
    axis.set_xlabel("misfit q / f of a segment")
    axis.set_ylabel("segments")
    median, dropped = float(used["misfit"].median()), len(segments) - len(used)
    axis.set_title(
        f"median {median:.2g}; {dropped} of {len(segments)} segments dropped before",
        loc="left",
        fontsize="medium",
    )
    axis.legend(fontsize="small", frameon=False)
    return figure


def expected_counts(free: FloatArray, edges: FloatArray) -> FloatArray:
    """How many of the segments would lie between edges of q / f, each chi-square of its own f."""
    degrees, counts = np.unique(free[free > 0.0], return_counts=True)
    below = stats.chi2.cdf(edges * degrees[:, None], degrees[:, None])
    return np.asarray(counts @ np.diff(below, axis=1))


# Predictions


def prediction_errors(predictions: pd.DataFrame) -> pd.DataFrame:
    """Mean error per model and horizon, with its bootstrap interval over runs.

    Runs are drawn, not windows: what is in one run is alike. All models see the same draws. One
    run alone has no interval.

    Returns
    -------
    One row per model and horizon: off, low, high (m), runs.
    """
    names = np.unique(predictions["run"].astype(str))
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(len(names), np.full(len(names), 1.0 / len(names)), size=DRAWS)
    rows = []
    for (model, horizon), part in predictions.groupby(["model", "horizon"], sort=False):
        each = part.groupby(part["run"].astype(str))["off"].agg(["sum", "count"])
        each = each.reindex(names, fill_value=0)
        low = high = np.nan
        if (each["count"] > 0).sum() > 1:
            count = drawn @ each["count"].to_numpy()
            means = (drawn @ each["sum"].to_numpy())[count > 0] / count[count > 0]
            low, high = np.quantile(means, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
        off, runs = each["sum"].sum() / each["count"].sum(), int((each["count"] > 0).sum())
        rows.append((model, horizon, off, low, high, runs))
    return pd.DataFrame(rows, columns=["model", "horizon", "off", "low", "high", "runs"])


def draw_predictions(predictions: pd.DataFrame) -> Figure:
    """Draw how far predictions are off on what was held out, by horizon, a line per model."""
    table = prediction_errors(predictions)
    horizons = sorted(table["horizon"].unique())
    models = [m for m in dict.fromkeys([*STYLES, *table["model"]]) if m in set(table["model"])]
    figure = new_figure(WIDTH, 3.4)
    axis = figure.subplots()
    for i, model in enumerate(models):
        own = table[table["model"] == model].sort_values("horizon")
        at = own["horizon"] + 0.05 * (i - (len(models) - 1) / 2)
        reach = np.abs(own[["low", "high"]].to_numpy(float).T - own["off"].to_numpy(float))
        axis.errorbar(
            at,
            own["off"],
            yerr=np.nan_to_num(reach),
            ms=5,
            capsize=3,
            lw=1.2,
            clip_on=False,
            label=model,
            **STYLES.get(model, {"color": "tab:purple", "marker": "d"}),
        )
    axis.set_ylim(bottom=0.0)
    axis.set_xlim(horizons[0] - 0.4, horizons[-1] + 0.4)
    axis.set_xticks(horizons, [f"{horizon:g} s" for horizon in horizons])
    axis.set_xlabel("how far ahead")
    sure = f", {100 * LEVEL:.0f} % over runs" if table["low"].notna().any() else ""
    axis.set_ylabel(f"mean error [m]{sure}")
    windows, runs = predictions["example"].nunique(), predictions["run"].nunique()
    axis.set_title(f"{windows} windows of {runs} runs held out", loc="left", fontsize="medium")
    axis.grid(axis="y", color="0.93", lw=0.8)
    _legend(axis, models)
    return figure


def _legend(axis: Axes, order: Iterable[str]) -> None:
    """Name what is drawn, each once, above the axis."""
    lines, labels = axis.get_legend_handles_labels()
    drawn = dict(zip(labels, lines, strict=True))
    names = [name for name in order if name in drawn]
    figure = axis.get_figure(root=True)
    assert figure is not None
    figure.legend(
        [drawn[name] for name in names],
        names,
        loc="outside upper center",
        ncols=len(names),
        fontsize="small",
        frameon=False,
    )
