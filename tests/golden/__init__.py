"""Golden rows: what one short run per bundled scenario and planner measured when last looked at.

`tests/contract/test_every_scenario.py` drives the same runs and compares. A change that is meant
to change numbers renews them, and shows in its commit which ones and by how much:

    python -m tests.golden

One file per scenario, a row per metric, a column per planner; floats are written to the last bit.
"""

from __future__ import annotations

import json
from functools import cache
from math import isclose, isnan
from pathlib import Path

import pandas as pd

from sumo_cohesion import Rollout, run
from sumo_cohesion.planning.registry import BUILT_IN
from sumo_cohesion.simulation.scenario import scenario_files
from sumo_cohesion.tables.metrics import METRICS
from sumo_cohesion.versions import versions

HERE = Path(__file__).resolve().parent
SCENARIOS = [path.stem for path in scenario_files()]
PLANNERS = list(BUILT_IN)
SECONDS, SEED = 6.0, 1000
TIMES = ("plan_ms_median", "plan_ms_p99")
NUMBERS = {column.name for column in METRICS if column.dtype == "float64"}
TOLERANCE = 1e-9
"""Relative and absolute. On one machine every bit is the same, compiled or not. On another
processor NumPy, OpenBLAS and the C library choose other instructions: with all newer than SSE2
switched off one of these numbers differed, in its last bit. What anybody means to change is far
above it."""


@cache
def drive(scenario: str, planner: str) -> Rollout:
    """Drive a golden run; once per process, whoever asks."""
    return run(scenario, planner, SEED, overrides={"duration": SECONDS})


def measured(scenario: str, planner: str) -> dict[str, str]:
    """Metrics of a run as text, all but wall times."""
    (row,) = drive(scenario, planner).metrics.to_dict(orient="records")
    return {str(name): str(value) for name, value in row.items() if name not in TIMES}


def golden(scenario: str) -> pd.DataFrame:
    """Read the golden rows of a scenario: metrics by planners, as text."""
    return pd.read_csv(HERE / f"{scenario}.csv", index_col="metric", dtype=str, na_filter=False)


def same(metric: str, one: str, other: str) -> bool:
    """Tell whether two texts say the same of a metric.

    >>> same("min_gap", "1.0", "1.0000000000000002"), same("min_gap", "1.0", "1.00000001")
    (True, False)
    >>> same("min_ttc", "nan", "nan"), same("min_ttc", "nan", "0.0"), same("outcome", "1", "1.0")
    (True, False, False)
    """
    if metric not in NUMBERS:
        return one == other
    a, b = float(one), float(other)
    if isnan(a) or isnan(b):
        return isnan(a) and isnan(b)
    return isclose(a, b, rel_tol=TOLERANCE, abs_tol=TOLERANCE)


def differences(scenario: str, planner: str) -> list[str]:
    """Say, in a line each, what a run measures now and what its golden row says."""
    now, then = measured(scenario, planner), golden(scenario)[planner].to_dict()
    return [
        f"{scenario}, {planner}: {name} is {now.get(name)}, was {then.get(name)}"
        for name in {**then, **now}
        if name not in now or name not in then or not same(name, now[name], then[name])
    ]


def made_with() -> dict[str, str]:
    """Return the versions that the golden rows were made with: other ones, other numbers."""
    found: dict[str, str] = json.loads((HERE / "versions.json").read_text())
    return found


def renew() -> None:
    """Write the golden rows anew."""
    for scenario in SCENARIOS:
        rows = {planner: measured(scenario, planner) for planner in PLANNERS}
        pd.DataFrame(rows).to_csv(HERE / f"{scenario}.csv", index_label="metric")
    (HERE / "versions.json").write_text(json.dumps(versions(), indent=2) + "\n")
