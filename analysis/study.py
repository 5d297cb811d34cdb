"""One planner under several changed settings, through several scenarios: what the changes cost.

Used by the studies ablation and horizon; each says its changes and writes one table.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from analysis.reproduce import HERE, Case, run_cases
from sumo_cohesion.errors import SimulationError, UserError
from sumo_cohesion.user_input import parse_seeds
from sumo_cohesion.versions import versions

Changes = Mapping[str, Mapping[str, Any]]
_SEPARATOR = ", "


def study(
    name: str,
    changes: Changes,
    scenarios: Sequence[str],
    seeds: str,
    arguments: Sequence[str] | None = None,
) -> None:
    """Run the cohesive planner and write analysis/NAME.csv and analysis/NAME.json."""
    parser = argparse.ArgumentParser(prog=f"python -m analysis.{name}")
    parser.add_argument("--seeds", default=seeds)
    parser.add_argument("--workers", type=int, default=None)
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--work", type=Path, default=HERE.parent / "results" / name)
    given = parser.parse_args(arguments)
    cases: dict[str, Case] = {
        scenario + _SEPARATOR + change: (scenario, changed)
        for scenario in scenarios
        for change, changed in changes.items()
    }
    try:
        parsed = parse_seeds(given.seeds)
        results = run_cases(cases, ("cohesive",), parsed, given.workers, given.work)
    except KeyboardInterrupt:
        sys.exit("interrupted; what is done is kept, run it again to go on")
    except (UserError, SimulationError) as error:
        sys.exit(f"{error}; what is done is kept, run it again to go on")
    table = pd.DataFrame([_row(case, runs) for case, runs in results.items()]).round(3)
    given.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(given.out / f"{name}.csv", index=False)
    about = {
        "command": f"python -m analysis.{name} --seeds {given.seeds}",
        "changes": changes,
        "versions": versions(),
    }
    text = json.dumps(about, indent=2) + "\n"
    (given.out / f"{name}.json").write_text(text, encoding="utf-8")
    print(table.pivot(index="changed", columns="scenario", values="success").to_string())


def _row(case: str, runs: pd.DataFrame) -> dict[str, Any]:
    scenario, change = case.split(_SEPARATOR, 1)
    return {
        "scenario": scenario,
        "changed": change,
        "n": len(runs),
        "success": int(runs["success"].sum()),
        "collision": int(runs["collision"].sum()),
        "collision_visible": int(runs["collision_visible"].sum()),
        "off_road": int(runs["off_road"].sum()),
        "exited": int(runs["exited"].sum()),
        "plan_failures": int(runs["plan_failures"].sum()),
        "interventions": int(runs["interventions"].sum()),
        "median_twin_lateral_deviation": runs["twin_lateral_deviation"].median(),
        "median_twin_speed_deviation": runs["twin_speed_deviation"].median(),
        "median_speed_gap_closed": runs["speed_gap_closed"].median(),
        "median_plan_ms": runs["plan_ms_median"].median(),
        "seeds_failed": " ".join(map(str, runs.loc[~runs["success"], "seed"])),
    }
