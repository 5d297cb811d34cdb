"""What each addition to the printed formula is worth: the default with one piece taken out.

    python -m analysis.ablation [--seeds 2000:2010] [--workers 2]

Writes analysis/ablation.csv and analysis/ablation.json. The seeds are neither those the pieces
were chosen on (1000 to 1999) nor those the claims are reported on.
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
from sumo_cohesion.experiments.rollout import versions
from sumo_cohesion.experiments.scenario import parse_seeds

PIECES: dict[str, Mapping[str, Any]] = {
    "default": {},
    "drivers have no habits": {"cohesion.habit": 0.0},
    "speed weighs as much as steering": {"cohesion.speed_weight": 1.0},
    "no place across the road": {"cohesion.place_weight": 0.0},
    "a surprise is forgotten at once": {"cohesion.surprise_hold": 0.0},
    "no need of a surprise": {"cohesion.surprise": 0.0},
    "all groups steer": {"cohesion.lateral_votes": "all"},
}
SCENARIOS = ("stalled_swerve", "ambulance", "nothing_to_follow")
SEPARATOR = ", "


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="2000:2010")
    parser.add_argument("--workers", type=int, default=None)
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--work", type=Path, default=HERE.parent / "results" / "ablation")
    given = parser.parse_args(arguments)
    cases: dict[str, Case] = {
        scenario + SEPARATOR + piece: (scenario, changed)
        for scenario in SCENARIOS
        for piece, changed in PIECES.items()
    }
    try:
        seeds = parse_seeds(given.seeds)
        results = run_cases(cases, ("cohesive",), seeds, given.workers, given.work)
    except KeyboardInterrupt:
        sys.exit("interrupted; what is done is kept, run it again to go on")
    except (UserError, SimulationError) as error:
        sys.exit(f"{error}; what is done is kept, run it again to go on")
    rows = []
    for case, runs in results.items():
        scenario, piece = case.split(SEPARATOR, 1)
        rows.append(
            {
                "scenario": scenario,
                "changed": piece,
                "n": len(runs),
                "success": int(runs["success"].sum()),
                "collision": int(runs["collision"].sum()),
                "collision_visible": int(runs["collision_visible"].sum()),
                "median_twin_lateral_deviation": runs["twin_lateral_deviation"].median(),
                "median_twin_speed_deviation": runs["twin_speed_deviation"].median(),
                "median_speed_gap_closed": runs["speed_gap_closed"].median(),
                "seeds_failed": " ".join(map(str, runs.loc[~runs["success"], "seed"])),
            }
        )
    table = pd.DataFrame(rows).round(3)
    given.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(given.out / "ablation.csv", index=False)
    about = {
        "command": f"python -m analysis.ablation --seeds {given.seeds}",
        "pieces": PIECES,
        "versions": versions(),
    }
    (given.out / "ablation.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    print(table.pivot(index="changed", columns="scenario", values="success").to_string())


if __name__ == "__main__":
    main()
