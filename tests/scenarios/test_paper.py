"""The paper's other scenarios on real SUMO traffic, one seed each; rates are in analysis/."""

from __future__ import annotations

import pytest

from sumo_cohesion import run


def test_speeding_nominal_keeps_the_limit_and_cohesive_goes_with_the_flow() -> None:
    nominal = run("speeding", "nominal", 1000).metrics.iloc[0]
    cohesive = run("speeding", "cohesive", 1000).metrics.iloc[0]
    assert nominal["max_speed_shift"] < 0.5
    assert nominal["speed_gap_closed"] == pytest.approx(0.0, abs=0.1)
    assert 0.5 < cohesive["speed_gap_closed"] < 1.0


def test_exit_nominal_stays_and_cohesive_is_tricked() -> None:
    nominal = run("exit", "nominal", 1000)
    cohesive = run("exit", "cohesive", 1000)
    assert not nominal.metrics["exited"].iloc[0]
    assert cohesive.metrics["exited"].iloc[0]
    assert not cohesive.metrics["off_road"].iloc[0]
    # By geometry: far from every lane of the route at the end.
    ego = cohesive.trajectory[cohesive.trajectory["vehicle"] == "ego"]
    assert ego["d"].iloc[-1] < -5.0


def test_ambulance_nominal_holds_it_up_and_cohesive_makes_way() -> None:
    nominal = run("ambulance", "nominal", 1000)
    cohesive = run("ambulance", "cohesive", 1000)
    assert nominal.metrics["emergency_delay"].iloc[0] > 2.5
    assert cohesive.metrics["emergency_delay"].iloc[0] < 0.5
    assert cohesive.metrics["yield_time"].iloc[0] < 8.0
    assert set(nominal.info["events"]) == {"0", "1"}
    for rollout in (nominal, cohesive):
        assert not rollout.metrics["collision"].iloc[0]
        # SUMO drives the ambulance: it was told to keep its lane, nothing else.
        ambulance = rollout.trajectory[rollout.trajectory["vehicle"] == "ambulance"]
        assert (ambulance["d"] - 7.0).abs().max() < 0.5


def test_same_speed_only_the_speed_is_followed() -> None:
    row = run("same_speed", "cohesive", 1000).metrics.iloc[0]
    assert row["success"]
