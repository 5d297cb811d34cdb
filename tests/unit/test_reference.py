"""What cohesion changed, against nominal in the same traffic."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from sumo_cohesion import compare, run
from sumo_cohesion.tables import metrics

SHORT = {"reference": True, "duration": 8.0}


@pytest.mark.slow
def test_nominal_changes_nothing_and_is_its_own_twin() -> None:
    row = run("same_speed", "nominal", 1000, overrides=SHORT).metrics.iloc[0]
    assert row["plan_lateral_change"] == 0.0
    assert row["plan_speed_change"] == 0.0
    assert row["twin_lateral_deviation"] < 1e-6
    assert row["twin_speed_deviation"] < 1e-6


@pytest.mark.slow
def test_cohesive_speeds_up_and_its_twin_does_not() -> None:
    rollout = run("same_speed", "cohesive", 1000, overrides=SHORT)
    row = rollout.metrics.iloc[0]
    assert (rollout.reference["twin_speed"] - 25.0).abs().max() < 0.5
    assert row["twin_speed_deviation"] > 1.0
    assert 0.2 < row["plan_speed_change"] < row["twin_speed_deviation"]
    assert len(rollout.reference) == len(rollout.plan)


def test_a_car_that_sumo_drives_has_no_plan_to_compare() -> None:
    row = run("same_speed", "sumo", 1000, overrides={**SHORT, "duration": 2.0}).metrics.iloc[0]
    assert np.isnan(row["plan_lateral_change"])
    assert np.isfinite(row["twin_speed_deviation"])


def test_without_a_reference_nothing_is_claimed() -> None:
    rollout = run("speeding", "cohesive", 1000, overrides={"duration": 2.0})
    assert rollout.reference.empty
    assert np.isnan(rollout.metrics["twin_lateral_deviation"].iloc[0])


@pytest.mark.slow
def test_compare_sets_each_run_beside_nominals_own() -> None:
    runs = compare("speeding", seeds=[1000], overrides={"duration": 6.0}, workers=2).runs.set_index(
        "planner"
    )
    assert runs.loc["nominal", "nominal_speed_deviation"] == 0.0
    assert runs.loc["cohesive", "nominal_speed_deviation"] > 0.5


def test_deviation_counts_common_times_only() -> None:
    one = pd.DataFrame({"time": [0.0, 0.1, 0.2], "d": [0.0, 1.0, 9.0], "speed": [5.0, 5.0, 5.0]})
    other = pd.DataFrame({"time": [0.0, 0.1], "d": [0.5, 0.0], "speed": [5.0, 7.0]})
    assert metrics.deviation(one, other) == pytest.approx((1.0, 2.0))
    assert metrics.deviation(one, one) == (0.0, 0.0)
    assert metrics.deviation(one, other[:1] - 0.5) == pytest.approx((np.nan, np.nan), nan_ok=True)


def test_speed_is_most_agreed_where_both_its_features_lead() -> None:
    rows = [
        (time, "road", feature, precision)
        for time, values in ((0.0, (9, 1, 1, 8, 1)), (0.1, (9, 1, 1, 2, 3)), (0.2, (np.nan,) * 5))
        for feature, precision in zip(
            ("distance", "lateral", "heading", "longitudinal", "direction"), values, strict=True
        )
    ]
    table = pd.DataFrame(rows, columns=["time", "group", "feature", "precision"])
    assert metrics.speed_most_agreed(table) == 0.5
    assert np.isnan(metrics.speed_most_agreed(table.iloc[:0]))
    # Other groups have no say in it, and as much is not more.
    lane = table.assign(group="lane", precision=100.0, time=table["time"] + 9.0)
    assert metrics.speed_most_agreed(pd.concat([table, lane])) == 0.5
    equal = table.assign(precision=5.0)[:5]
    assert metrics.speed_most_agreed(equal) == 0.0


def test_max_excess_speed_is_over_the_mean_of_those_near() -> None:
    ego = pd.DataFrame({"time": [0.0, 0.1], "s": [0.0, 3.0], "speed": [30.0, 28.0]})
    humans = pd.DataFrame(
        {
            "time": [0.0, 0.0, 0.0, 0.1],
            "s": [10.0, 20.0, 500.0, 20.0],
            "speed": [29.0, 33.0, 1.0, 27.5],
        }
    )
    assert metrics.max_excess_speed(ego, humans) == pytest.approx(0.5)
    for away, excess in ((80.0, 1.0), (-80.0, 1.0), (80.5, 2.0), (-80.5, 2.0)):
        two = pd.DataFrame({"time": 0.0, "s": [away, 0.0], "speed": [30.0, 28.0]})
        assert metrics.max_excess_speed(ego, two) == pytest.approx(excess), away
    assert np.isnan(metrics.max_excess_speed(ego, humans.iloc[:0]))
