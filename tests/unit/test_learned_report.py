"""Tables and figures of what was learned show what they should."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import same_color
from matplotlib.patches import Polygon, StepPatch
from scipy import stats

from sumo_cohesion.learning.learned import Learned
from sumo_cohesion.learning.prediction import HORIZONS
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.report import learned as report
from sumo_cohesion.tables.columns import LEARNED, as_table

NAN = float("nan")
FREE = 20.0


def weights(*rows: tuple[str, float, float, float, float, float, str]) -> pd.DataFrame:
    names = ("term", "default", "learned", "low", "high", "error", "kept_default")
    each = [dict(zip(names, row, strict=True)) for row in rows]
    return as_table(
        "weights", [{**r, "identified": not r["kept_default"], "share": 0.1} for r in each]
    )


def segments(misfit: np.ndarray, kept: np.ndarray) -> pd.DataFrame:
    n = len(misfit)
    columns = {"misfit": misfit, "kept": kept, "free": np.where(np.isnan(misfit), NAN, FREE)}
    whose = {"run": ["r"] * n, "vehicle": ["ego"] * n, "reason": [""] * n}
    return as_table(
        "segments", {"time": np.arange(n), "log_likelihood": misfit, **whose, **columns}
    )


def predictions(off: dict[str, list[float]], model: str = "learned") -> pd.DataFrame:
    """Errors at 1 s by run."""
    rows = [
        {"example": i, "run": run, "model": model, "horizon": 1.0, "off": value}
        for i, (run, value) in enumerate((run, v) for run, values in off.items() for v in values)
    ]
    return as_table("predictions", rows)


WEIGHTS = weights(
    ("lane", 1.0, 1.0, NAN, NAN, 0.0, ""),
    ("edge", 500.0, 500.0, NAN, NAN, np.inf, "the demonstrations do not tell it"),
    ("speed", 0.04, 0.08, 0.02, 0.4, 0.1, ""),
    ("car", 100.0, 50.0, 30.0, 60.0, 0.1, ""),
    ("curvature_change", 0.0, 2e4, 1e4, 3e4, 0.1, ""),
)
LEARNED_HERE = Learned(
    reward=RewardWeights(),
    temperature=0.1,
    weights=WEIGHTS,
    segments=segments(np.linspace(0.5, 2.0, 30), np.arange(30) < 25),
    fit=as_table("fit", []),
    predictions=predictions({"a": [1.0, 2.0], "b": [3.0]}),
)


@pytest.mark.slow
def test_the_report_holds_tables_weights_and_figures(tmp_path: Path) -> None:
    folder = report.write_report(LEARNED_HERE, tmp_path / "found")
    for name in LEARNED:
        table = pd.read_parquet(folder / f"{name}.parquet")
        pd.testing.assert_frame_equal(table, getattr(LEARNED_HERE, name))
        assert list(table.columns) == [column.name for column in LEARNED[name]]
    assert (folder / "theta.toml").read_text(encoding="utf-8") == LEARNED_HERE.to_toml()
    for name in ("weights", "misfit", "predictions"):
        assert (folder / f"{name}.png").stat().st_size > 5_000


@pytest.mark.slow
def test_there_is_no_figure_of_what_was_not_predicted(tmp_path: Path) -> None:
    nothing = replace(LEARNED_HERE, predictions=as_table("predictions", []))
    folder = report.write_report(nothing, tmp_path)
    assert {path.name for path in folder.glob("*.png")} == {"weights.png", "misfit.png"}
    assert pd.read_parquet(folder / "predictions.parquet").empty


def test_the_horizons_have_their_columns() -> None:
    names = [column.name for column in LEARNED["fit"] if column.name.startswith("off_")]
    assert names == [f"off_{horizon:g}s" for horizon in HORIZONS]


# Weights


def points(axis: Axes) -> dict[str, list[tuple[float, float]]]:
    """Where the weights of each kind are drawn."""
    found: dict[str, list[tuple[float, float]]] = {}
    for line in axis.lines:
        if str(line.get_label()) in report.WEIGHTS:
            x, y = np.column_stack(line.get_data())[0]
            found.setdefault(str(line.get_label()), []).append((x, y))
    return found


def test_weights_are_multiples_of_their_default() -> None:
    (axis,) = report.draw_weights(WEIGHTS, "lane").axes
    assert axis.get_xscale() == "log"
    assert points(axis) == {
        "what the others are relative to": [(1.0, 0.0)],
        "not learned": [(1.0, 1.0)],
        "learned": [(2.0, 2.0), (0.5, 3.0)],  # nothing of what is off by default
    }
    intervals = {
        line.get_ydata()[0]: line.get_xdata().tolist()
        for line in axis.lines
        if line.get_marker() == "|" and np.isfinite(line.get_xdata()).all()
    }
    assert intervals == {2: pytest.approx([0.5, 10.0]), 3: pytest.approx([0.3, 0.6])}
    low, high = axis.get_xlim()
    assert low < 0.3
    assert high > 10.0
    (values,) = axis.child_axes
    told = [label.get_text() for label in values.get_yticklabels()]
    assert told[1] == "500: the demonstrations do not tell it"
    assert told[2] == "0.08  [0.02, 0.4]"
    assert told[4] == "2e+04, off by default  [1e+04, 3e+04]"


def test_without_a_bootstrap_no_interval_is_promised() -> None:
    (axis,) = report.draw_weights(WEIGHTS.assign(low=NAN, high=NAN), "lane").axes
    assert points(axis)["learned"] == [(2.0, 2.0), (0.5, 3.0)]
    assert axis.get_xlabel() == "weight / default"


# Misfit


def test_chi_square_is_each_segments_own() -> None:
    edges = np.geomspace(1e-6, 1e3, 200)
    free = np.array([2.0, 20.0, 20.0, 5.0])
    counts = report.expected_counts(free, edges)
    assert counts.sum() == pytest.approx(4.0, abs=1e-5)
    drawn = np.random.default_rng(0).chisquare(20.0, 4000) / 20.0
    seen, _ = np.histogram(drawn, edges)
    expected = report.expected_counts(np.full(4000, 20.0), edges)
    assert (
        stats.chisquare(seen[expected > 10], expected[expected > 10], sum_check=False).pvalue > 0.01
    )


@pytest.mark.parametrize(
    "misfit",
    [
        np.linspace(0.5, 2.0, 40),
        np.geomspace(1e-30, 1e20, 40),
        np.concatenate((np.zeros(20), np.full(20, 1e-12))),
        np.zeros(40),
        np.array([1.0]),
    ],
)
def test_every_segment_is_in_the_histogram(misfit: np.ndarray) -> None:
    kept = np.arange(len(misfit)) < 0.85 * len(misfit)
    table = segments(np.append(misfit, NAN), np.append(kept, False))
    (axis,) = report.draw_misfit(table).axes
    heights = {
        report.KEPT: 0.0,
        report.TRIMMED: 0.0,
    }
    for bar in axis.patches:
        for colour in heights:
            if not isinstance(bar, StepPatch | Polygon) and same_color(bar.get_facecolor(), colour):
                heights[colour] += bar.get_height()
    assert heights == {report.KEPT: kept.sum(), report.TRIMMED: (~kept).sum()}
    assert np.isfinite(axis.get_xlim()).all()
    assert axis.get_xlim()[0] > 0.0
    (curve,) = (patch for patch in axis.patches if isinstance(patch, StepPatch))
    # Where chi-square has its mass is always in view.
    assert curve.get_data().values.sum() == pytest.approx(len(misfit), rel=0.01)
    assert "1 of" in axis.get_title(loc="left")


# Predictions


def test_errors_are_means_of_windows_with_intervals_over_runs() -> None:
    (row,) = report.prediction_errors(predictions({"a": [0.0], "b": [4.0, 4.0, 4.0]})).itertuples()
    # Of two runs every fourth draw is one of them twice.
    assert (row.off, row.low, row.high, row.runs) == (3.0, 0.0, 4.0, 2)
    (row,) = report.prediction_errors(predictions({"a": [2.0], "b": [1.0, 3.0]})).itertuples()
    assert (row.off, row.low, row.high) == (2.0, 2.0, 2.0)  # runs are alike, windows are not
    (row,) = report.prediction_errors(predictions({"a": [1.0, 3.0]})).itertuples()
    assert row.off == 2.0
    assert np.isnan([row.low, row.high]).all()  # one run says nothing of others


@pytest.mark.slow
def test_an_interval_covers_the_mean_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    means = rng.normal(5.0, 1.0, (200, 30))  # of 200 times 30 runs with two windows each
    covered = 0
    for runs in means:
        off = {str(i): [m - 0.5, m + 0.5] for i, m in enumerate(runs)}
        (row,) = report.prediction_errors(predictions(off)).itertuples()
        covered += row.low <= 5.0 <= row.high
    assert 0.88 <= covered / len(means) <= 0.99


def test_all_models_meet_the_same_draws() -> None:
    one = predictions({"a": [1.0], "b": [2.0, 5.0], "c": [9.0]})
    other = one.assign(model="constant velocity", off=one["off"] + 7.0).astype({"model": "string"})
    rows = report.prediction_errors(pd.concat([one, other])).set_index("model")
    shift = rows.loc["constant velocity"] - rows.loc["learned"]
    assert shift[["off", "low", "high"]].to_list() == pytest.approx([7.0] * 3)


def test_predictions_are_drawn_by_model_and_horizon() -> None:
    table = predictions({"a": [1.0], "b": [3.0]})
    later = table.assign(horizon=2.0, off=2.0 * table["off"])
    guess = table.assign(model="constant velocity").astype({"model": "string"})
    (axis,) = report.draw_predictions(pd.concat([guess, table, later])).axes
    drawn = {bars.get_label(): bars.lines[0].get_ydata().tolist() for bars in axis.containers}
    assert drawn == {"learned": [2.0, 4.0], "constant velocity": [2.0]}
    assert [tick.get_text() for tick in axis.get_xticklabels()] == ["1 s", "2 s"]
    assert axis.get_ylim()[0] == 0.0
    assert "95 %" in axis.get_ylabel()
    (alone,) = report.draw_predictions(table[table["run"] == "a"]).axes
    assert "95 %" not in alone.get_ylabel()
