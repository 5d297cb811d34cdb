"""What was learned, as tables and figures in a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sumo_cohesion.tables.folders import require_replaceable, whole_folder

if TYPE_CHECKING:
    from sumo_cohesion.learning.learned import Learned


def write_report(learned: Learned, folder: Path) -> Path:
    """Write the tables weights, segments, fit and predictions (CSV) to a folder."""
    require_replaceable(folder)
    with whole_folder(folder) as new:
        for name in ("weights", "segments", "fit", "predictions"):
            getattr(learned, name).to_csv(new / f"{name}.csv", index=False)
    return folder
