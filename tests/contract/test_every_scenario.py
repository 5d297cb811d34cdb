"""Every planner in every bundled scenario: it runs, its tables are whole, its numbers are known."""

from __future__ import annotations

import numpy as np
import pytest

from sumo_cohesion.versions import versions
from tests.golden import PLANNERS, SCENARIOS, SECONDS, differences, drive, golden, made_with

RUNS = [
    pytest.param(scenario, planner, marks=[] if scenario == SCENARIOS[-1] else pytest.mark.slow)
    for scenario in SCENARIOS
    for planner in PLANNERS
]


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "planner"), RUNS)
def test_runs(scenario: str, planner: str) -> None:
    rollout = drive(scenario, planner)
    row = rollout.metrics.iloc[0]
    assert row["outcome"] == "finished"
    assert row["plan_failures"] == 0
    assert not row["off_road"]
    assert np.isfinite(rollout.trajectory.select_dtypes("number")).all().all()
    assert len(rollout.plan) == round(10 * SECONDS)
    assert (len(rollout.agreement) > 0) == (planner in ("cohesive", "paper"))


@pytest.mark.parametrize(("scenario", "planner"), RUNS)
def test_a_change_of_numbers_is_seen(scenario: str, planner: str) -> None:
    """If they are meant to change: ``python -m tests.golden``, and say in the commit why."""
    changed = differences(scenario, planner)
    others = {name: version for name, version in versions().items() if made_with()[name] != version}
    assert not changed, "\n".join(
        [*changed, f"made with other versions, here are {others}" if others else ""]
    )


def test_every_golden_row_is_of_a_run() -> None:
    for scenario in SCENARIOS:
        assert list(golden(scenario).columns) == PLANNERS
