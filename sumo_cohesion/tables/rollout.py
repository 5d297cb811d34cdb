"""What one run leaves behind: tables, metrics and a description, in memory or in a folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from sumo_cohesion.errors import UserError
from sumo_cohesion.tables.columns import TABLES
from sumo_cohesion.tables.folders import require_replaceable, whole_folder

RUN_FILE = "run.json"


@dataclass(frozen=True)
class Rollout:
    """The complete record of one run.

    Attributes
    ----------
    info : scenario, planner, settings, seed, versions and outcome, ready for JSON.
    trajectory, plan, horizon, agreement, timing, reference, metrics : tables; see docs/tables.md
        for their columns.
    sumo : SUMO's own outputs that were asked for, by kind (traffic.outputs).
    """

    info: dict[str, Any]
    trajectory: pd.DataFrame
    plan: pd.DataFrame
    horizon: pd.DataFrame
    agreement: pd.DataFrame
    timing: pd.DataFrame
    reference: pd.DataFrame
    metrics: pd.DataFrame
    sumo: Mapping[str, pd.DataFrame] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Write run.json and one parquet file per table, all of them or none."""
        require_replaceable(folder)
        with whole_folder(folder) as new:
            for name in TABLES:
                getattr(self, name).to_parquet(new / f"{name}.parquet", index=False)
            for name, table in self.sumo.items():
                table.to_parquet(new / f"sumo_{name}.parquet", index=False)
            text = json.dumps(self.info, indent=2, ensure_ascii=False)
            (new / RUN_FILE).write_text(text + "\n", encoding="utf-8")
        return folder

    @staticmethod
    def read(folder: Path) -> Rollout:
        """Read a folder that `write` wrote."""
        try:
            info = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
            tables = {name: pd.read_parquet(folder / f"{name}.parquet") for name in TABLES}
            found = sorted(folder.glob("sumo_*.parquet"))
            sumo = {path.stem.removeprefix("sumo_"): pd.read_parquet(path) for path in found}
        except (OSError, ValueError) as error:
            raise UserError(f"{folder}: not a complete run ({error}); run it again") from None
        return Rollout(info=info, sumo=sumo, **tables)
