"""Planners compared seed by seed: closed-form answers."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
import pandas as pd
import pytest

from sumo_cohesion import UserError
from sumo_cohesion.report.grid import draw_grid, intervals
from sumo_cohesion.tables.paired import compare_planners


def metrics(
    nominal: list[object], cohesive: list[object], column: str = "success", beta: float = 0.1
) -> pd.DataFrame:
    n = len(nominal)
    table = pd.DataFrame(
        {
            "scenario": "s",
            "planner": ["nominal"] * n + ["cohesive"] * n,
            "cohesion.beta": beta,
            "seed": [*range(n)] * 2,
            column: [*nominal, *cohesive],
        }
    )
    return table.astype({column: "boolean"}) if column == "success" else table


def test_what_is_no_number_cannot_be_compared() -> None:
    outcomes = metrics(["collision"] * 3, ["finished"] * 3, "outcome")
    with pytest.raises(UserError, match="'outcome' is no number"):
        compare_planners(outcomes, ["outcome"])


def test_rates_that_never_agree() -> None:
    (row,) = compare_planners(metrics([False] * 50, [True] * 50), ["success"]).itertuples()
    assert (row.kind, row.n, row.excluded) == ("rate", 50, 0)
    assert (row.baseline_value, row.value, row.difference) == (0.0, 1.0, 1.0)
    assert row.baseline_high == pytest.approx(0.0714, abs=1e-3)
    # Bonett and Price: (51 - 1) / 52, and an interval that does not collapse.
    p, q = 51 / 52, 1 / 52
    half = 1.959964 * sqrt((p + q - (p - q) ** 2) / 52)
    assert row.difference_low == pytest.approx(p - q - half, abs=1e-6)
    assert row.difference_high == 1.0
    assert row.effect == pytest.approx(pi)
    assert row.p == pytest.approx(2.0**-49)


def test_rates_test_only_the_seeds_that_differ() -> None:
    nominal = [True] * 6 + [False] * 4
    cohesive = [True] * 5 + [False] + [True] * 3 + [False]
    (row,) = compare_planners(metrics(nominal, cohesive), ["success"]).itertuples()
    assert row.difference == pytest.approx(0.2)
    assert row.p == pytest.approx(2 * (1 + 4) / 16)  # 1 of 4 discordant pairs, two-sided
    assert row.difference_low < 0.0 < row.difference_high


def test_means_are_of_paired_differences() -> None:
    rng = np.random.default_rng(1)
    seeds = rng.normal(20.0, 5.0, 30)
    gain = rng.normal(1.0, 0.2, 30)
    table = metrics(list(seeds), list(seeds + gain), "speed")
    (row,) = compare_planners(table, ["speed"]).itertuples()
    assert row.kind == "mean"
    assert row.difference == pytest.approx(gain.mean())
    # The seeds' own spread of 5 does not blur the difference.
    assert row.difference_high - row.difference_low < 0.2
    assert row.effect == pytest.approx(gain.mean() / gain.std(ddof=1))
    assert row.p < 1e-6


def test_a_run_without_a_value_is_left_out_with_its_pair_and_counted() -> None:
    (row,) = compare_planners(
        metrics([True, False, pd.NA], [True, pd.NA, False]), ["success"]
    ).itertuples()
    assert (row.n, row.excluded, row.difference) == (1, 2, 0.0)


def test_equal_runs_differ_by_nothing() -> None:
    (row,) = compare_planners(
        metrics([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], "speed"), ["speed"]
    ).itertuples()
    assert (row.difference, row.effect, row.p) == (0.0, 0.0, 1.0)


def test_many_comparisons_are_corrected_together() -> None:
    parts = [
        metrics([False] * 12, [True] * k + [False] * (12 - k), beta=k / 100) for k in (0, 3, 6, 12)
    ]
    table = compare_planners(pd.concat(parts), ["success"])
    assert table["cohesion.beta"].tolist() == [0.0, 0.03, 0.06, 0.12]
    p = table["p"].to_numpy()
    assert p == pytest.approx([1.0, 0.25, 2 / 2**6, 2 / 2**12])
    # Benjamini and Hochberg: p times 4 over its rank, made monotone.
    assert table["p_adjusted"].to_numpy() == pytest.approx([1.0, 1 / 3, p[2] * 2, p[3] * 4])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop(columns="success"), "no column 'success'"),
        (lambda t: t[t["planner"] != "nominal"], "no runs of the baseline 'nominal'"),
        (lambda t: t[t["planner"] == "nominal"], "the only planner"),
        (lambda t: pd.concat([t, t]), "several runs of one seed"),
    ],
)
def test_wrong_tables_say_what_is_wrong(change: object, message: str) -> None:
    table = change(metrics([True, False], [True, True]))  # type: ignore[operator]
    with pytest.raises(UserError, match=message):
        compare_planners(table, ["success"])


def test_a_metric_over_a_grid_has_intervals_and_a_picture(tmp_path: object) -> None:
    table = pd.concat(
        [metrics([False] * 10, [True] * k + [False] * (10 - k), beta=k / 10) for k in (2, 8)]
    ).assign(humans="[2, 5]")
    found = intervals(table, "success", ["planner", "cohesion.beta"])
    cohesive = found[found["planner"] == "cohesive"]
    assert cohesive["value"].tolist() == [0.2, 0.8]
    assert cohesive["low"].tolist() == pytest.approx([0.0567, 0.4902], abs=1e-3)
    # A run that several rows share is one measurement.
    shared = pd.concat([table.assign(run=[*range(40)])] * 3)
    assert intervals(shared, "success", ["planner", "humans"])["n"].tolist() == [20, 20]
    with pytest.raises(UserError, match="neither the planner nor one name twice"):
        draw_grid(table, "success", "humans", "humans", f"{tmp_path}/grid.png")
    for x, panels in (("cohesion.beta", "humans"), ("humans", None)):
        picture = draw_grid(table, "success", x, panels, f"{tmp_path}/grid.png")
        assert picture.stat().st_size > 5000
    with pytest.raises(UserError, match="no column 'nothing'"):
        draw_grid(table, "nothing", "humans", None, f"{tmp_path}/grid.png")
    with pytest.raises(UserError, match="is text"):
        draw_grid(table, "scenario", "humans", None, f"{tmp_path}/grid.png")
