"""What one run leaves behind: tables, metrics and a description, in memory or in a folder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd

from sumo_cohesion.errors import UserError
from sumo_cohesion.state import STEP
from sumo_cohesion.tables.columns import TABLES
from sumo_cohesion.tables.folders import require_replaceable, whole_folder

RUN_FILE = "run.json"


@dataclass(frozen=True, repr=False)
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

    def __repr__(self) -> str:
        row = self.metrics.iloc[0]
        planner = row["planner"] if len(row["planner"]) < 60 else f"{row['planner'][:60]}..."
        ended = f"{row['outcome']}, {'success' if row['success'] else 'no success'}"
        seconds = f"{len(self.plan) * STEP:.1f} s"
        return f"<Rollout {row['scenario']}, {planner}, seed {row['seed']}: {ended}, {seconds}>"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>{self.metrics.T.to_html(header=False)}"

    def write(self, folder: str | Path, outputs: Path | None = None) -> Path:
        """Write run.json and one parquet file per table, all of them or none.

        And the files below ``outputs``, if there are any, into the folder's "outputs".
        """
        folder = Path(folder)
        require_replaceable(folder)
        with whole_folder(folder) as new:
            if outputs is not None and any(outputs.iterdir()):
                shutil.copytree(outputs, new / "outputs")
            for name in TABLES:
                getattr(self, name).to_parquet(new / f"{name}.parquet", index=False)
            for name, table in self.sumo.items():
                table.to_parquet(new / f"sumo_{name}.parquet", index=False)
            text = json.dumps(self.info, indent=2, ensure_ascii=False)
            (new / RUN_FILE).write_text(text + "\n", encoding="utf-8")
        return folder

    @staticmethod
    def read(folder: str | Path) -> Rollout:
        """Read a folder that `write` wrote."""
        folder = Path(folder)
        try:
            info = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
            tables = {name: pd.read_parquet(folder / f"{name}.parquet") for name in TABLES}
            found = sorted(folder.glob("sumo_*.parquet"))
            sumo = {path.stem.removeprefix("sumo_"): pd.read_parquet(path) for path in found}
        except (OSError, ValueError) as error:
            raise UserError(f"{folder}: not a complete run ({error}); run it again") from None
        return Rollout(info=info, sumo=sumo, **tables)
