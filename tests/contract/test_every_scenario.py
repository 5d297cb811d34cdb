"""Every planner in every bundled scenario: it runs, its tables are whole, its plans usable."""

from __future__ import annotations

import numpy as np
import pytest

from sumo_cohesion import run
from sumo_cohesion.planning.registry import BUILT_IN
from sumo_cohesion.simulation.scenario import scenario_files


@pytest.mark.parametrize("planner", BUILT_IN)
@pytest.mark.parametrize("scenario", [path.stem for path in scenario_files()])
def test_runs(scenario: str, planner: str) -> None:
    rollout = run(scenario, planner, seed=1000, overrides={"duration": 2.0})
    row = rollout.metrics.iloc[0]
    assert row["outcome"] == "finished"
    assert row["plan_failures"] == 0
    assert not row["off_road"]
    assert np.isfinite(rollout.trajectory.select_dtypes("number")).all().all()
    assert len(rollout.plan) == 20
    assert (len(rollout.agreement) > 0) == (planner in ("cohesive", "paper"))
