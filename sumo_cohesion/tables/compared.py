"""How the folder of a comparison is laid out.

DIR/comparison.json      scenario, planners, seeds, overrides
DIR/metrics.parquet      one row per run
DIR/summary.parquet      rates and means with their intervals
DIR/PLANNER/seed_0003/   one run (tables.rollout)
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from urllib.parse import quote

COMPARISON_FILE = "comparison.json"
_LONGEST = 150
"""Characters of a folder's name."""


def run_folder(folder: Path, planner: str, seed: int) -> Path:
    """Folder of one run within a comparison's folder."""
    name = quote(planner.replace(":", ".", 1), safe="()=', ")
    if len(name) > _LONGEST:
        name = f"{name[:_LONGEST]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return folder / name / f"seed_{seed:04d}"
