"""The evidence on the stalled car: every row of docs/evidence.md's table, from real runs.

    python analysis/stalled.py [--seeds 0:50] [--workers 2]

Writes analysis/stalled.csv, one row per case and planner, and analysis/stalled.json with the
seeds and versions that made it. About 15 minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import pandas as pd

from sumo_cohesion import compare
from sumo_cohesion.cli import parse_seeds
from sumo_cohesion.experiments.rollout import versions
from sumo_cohesion.experiments.statistics import wilson

HERE = Path(__file__).resolve().parent
PLANNERS = ("nominal", "cohesive", "paper", "sumo")
CASES = {
    "stalled": ("stalled", {}),
    "stalled_swerve": ("stalled_swerve", {}),
    "stalled, leads 40 m apart": ("stalled", {"randomize.lead_spacing": [40.0, 40.0]}),
    "stalled_dense": ("stalled_dense", {}),
    "stalled_dense, 7 to 11 humans": ("stalled_dense", {"randomize.humans": [7, 11]}),
}


def summarize_case(case: str, runs: pd.DataFrame) -> list[dict[str, object]]:
    """Count outcomes per planner, with Wilson intervals."""
    rows: list[dict[str, object]] = []
    for planner, group in runs.groupby("planner", sort=False):
        n, collisions = len(group), int(group["collision"].sum())
        _, low, high = wilson(collisions, n)
        hidden = int((group["collision"] & ~group["collision_visible"]).sum())
        rows.append(
            {
                "case": case,
                "planner": planner,
                "n": n,
                "collisions": collisions,
                "rate_low": round(low, 3),
                "rate_high": round(high, 3),
                "with_the_stalled_car": hidden,
                "with_a_visible_car": collisions - hidden,
                "seen_by_sumo": int((group["collision"] & group["sumo_collision"]).sum()),
                "off_road": int(group["off_road"].sum()),
                "success": int(group["success"].sum()),
                "fallback_steps": int(group["plan_failures"].sum()),
                "plan_ms_median": round(float(group["plan_ms_median"].median()), 2),
                "collided_seeds": " ".join(map(str, group.loc[group["collision"], "seed"])),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="0:50")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    seeds = parse_seeds(arguments.seeds)
    rows: list[dict[str, object]] = []
    for case, (scenario, overrides) in CASES.items():
        result = compare(scenario, PLANNERS, seeds, overrides=overrides, workers=arguments.workers)
        rows += summarize_case(case, result.runs)
        print(pd.DataFrame(rows[-len(PLANNERS) :]).to_string(index=False), file=sys.stderr)
        pd.DataFrame(rows).to_csv(HERE / "stalled.csv", index=False)
    about = {
        "command": f"python analysis/stalled.py --seeds {arguments.seeds}",
        "seeds": arguments.seeds,
        "fitted_on": "seeds >= 1000",
        "versions": versions(),
    }
    (HERE / "stalled.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
