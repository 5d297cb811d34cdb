"""The example of docs/batches.md: how much to follow, and among how many humans.

    python -m analysis.beta [--workers 2]

Runs docs/examples/beta.toml and writes analysis/beta.csv (planners compared with nominal on the
same seeds, per beta and number of humans), analysis/beta.json and docs/figures/beta_*.png.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import sumo_cohesion as sc
from sumo_cohesion.report.grid import draw_grid
from sumo_cohesion.versions import versions

ROOT = Path(__file__).resolve().parent.parent
EXPERIMENT = ROOT / "docs" / "examples" / "beta.toml"
METRICS = ("success", "human_hard_brakes", "mean_speed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, default=None)
    given = parser.parse_args()
    rows = sc.batch(EXPERIMENT, ROOT / "results" / "beta", workers=given.workers)
    done = rows[rows["status"] == "done"]
    table = sc.compare_planners(done, METRICS)
    table.round(4).to_csv(ROOT / "analysis" / "beta.csv", index=False)
    about = {
        "command": "python -m analysis.beta",
        "runs": int(done["run"].nunique()),
        "failed": int((rows["status"] != "done").sum()),
        "versions": versions(),
    }
    path = ROOT / "analysis" / "beta.json"
    path.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    for metric in METRICS:
        out = ROOT / "docs" / "figures" / f"beta_{metric}.png"
        draw_grid(done, metric, "cohesion.beta", "randomize.humans", out)
    print(table.round(3).to_string(index=False))


if __name__ == "__main__":
    main()
