"""Read results: of one run, of a comparison or of a batch, whichever wrote the folder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from sumo_cohesion.batches.store import (
    as_cell,
    is_batch,
    joined,
    read_parquet,
    table_file,
    wanted,
)
from sumo_cohesion.errors import UserError
from sumo_cohesion.tables.metrics import deviation
from sumo_cohesion.tables.rollout import RUN_FILE, Rollout

_OF_NOMINAL = ("nominal_lateral_deviation", "nominal_speed_deviation")


def load_metrics(folder: str | Path) -> pd.DataFrame:
    """Metrics of a run, a comparison or a batch, or of all runs below a folder.

    Of a batch: one row per wanted run that was done or has failed, with its ``status`` and the
    grid's values; its bool and int columns can be missing (pandas "boolean" and "Int64").

    Raises
    ------
    UserError
        If there are none, or they cannot be read.
    """
    root = Path(folder)
    if is_batch(root):
        return joined(root)
    if (root / "metrics.parquet").is_file():
        return read_parquet(root / "metrics.parquet")
    parts = [run / "metrics.parquet" for run in run_folders(root)]
    return pd.concat([read_parquet(part) for part in parts], ignore_index=True)


def load_rollout(folder: str | Path) -> Rollout:
    """Return one run as `run` returned it, from the folder that it wrote.

    Raises
    ------
    UserError
        If it is not the folder of one run, or a table cannot be read.
    """
    root = Path(folder)
    if not (root / RUN_FILE).is_file():
        below = run_folders(root)
        raise UserError(f"{root}: holds {_counted(below)} below; name one, e.g. {below[0]}")
    return Rollout.read(root)


def _counted(folders: Sequence[Path]) -> str:
    return f"{len(folders)} runs" if len(folders) > 1 else "one run"


def load_trajectories(
    folder: str | Path,
    where: Mapping[str, Any] | None = None,
    *,
    table: str = "trajectory",
) -> pd.DataFrame:
    """Trajectories, or another table, of many runs; only files of wanted runs are opened.

    Parameters
    ----------
    folder : of a batch that kept the table, a comparison or a run.
    where : which runs, by ``scenario``, ``planner``, ``seed`` or a grid's name: a value or a
        list of values, e.g. {"planner": "cohesive", "cohesion.beta": [0.03, 0.09]}.
    table : "trajectory", "plan", "horizon", "agreement", "timing", "reference", "sumo_fcd",
        "sumo_tripinfo" or "sumo_ssm"; of a batch also "ego".

    Returns
    -------
    The table, with the columns that tell the runs apart before its own (docs/tables.md).

    Raises
    ------
    UserError
        If no run fits, or the table was not kept.
    """
    root = Path(folder)
    plan = wanted(root) if is_batch(root) else _runs_below(root)
    for name, value in (where or {}).items():
        if name not in plan.columns:
            known = ", ".join(c for c in plan.columns if c not in ("run", "path"))
            raise UserError(f"runs are not told apart by {name!r}; choose from {known}")
        values = value if isinstance(value, list | tuple | set | range) else [value]
        cells = [as_cell(v) if isinstance(v, list) else v for v in values]
        plan = plan[plan[name].isin(cells)]
    frames = []
    for row in plan.to_dict(orient="records"):
        told = {str(name): value for name, value in row.items() if name != "path"}
        path = (
            table_file(root, table, told["run"])
            if "run" in told
            else row["path"] / f"{table}.parquet"
        )
        if path.is_file():
            frame = read_parquet(path).drop(columns="run", errors="ignore")
            frames.append(frame.assign(**told)[[*told, *frame.columns]])
    if not frames:
        raise UserError(
            f"{root}: no run there fits, or the table {table!r} was not kept; "
            "an experiment keeps it with keep = [...] or sumo_outputs = [...]"
        )
    return pd.concat(frames, ignore_index=True)


def with_nominal_deviation(metrics: pd.DataFrame, folder: str | Path) -> pd.DataFrame:
    """Fill ``nominal_lateral_deviation`` and ``nominal_speed_deviation`` of a batch's metrics.

    They compare two runs, so that no single one has them: each run with the nominal planner's
    on the same seed, scenario and grid point. The batch must have run nominal and kept "ego".
    """
    paths = dict(tuple(load_trajectories(folder, table="ego").groupby("run", sort=False)))
    same = [c for c in wanted(Path(folder)).columns if c not in ("run", "planner")]
    nominal = metrics.loc[metrics["planner"] == "nominal", [*same, "run"]]
    pairs = metrics[[*same, "run"]].merge(nominal, on=same, how="left", suffixes=("", "_nominal"))
    filled = metrics.reset_index(drop=True)
    for i, (run, other_run) in enumerate(zip(pairs["run"], pairs["run_nominal"], strict=True)):
        own, other = paths.get(run), None if pd.isna(other_run) else paths.get(other_run)
        if own is not None and other is not None:
            filled.loc[i, list(_OF_NOMINAL)] = deviation(own, other)
    return filled


def run_folders(root: Path) -> list[Path]:
    """Folders of single runs, below a folder or itself; raises UserError if there are none."""
    if not root.is_dir():
        raise UserError(f"{root}: no such folder, so no runs there; give one written by --out")
    found = sorted(path.parent for path in root.rglob(RUN_FILE))
    if not found:
        raise UserError(
            f"{root}: no runs there; give a folder written by run, compare or batch --out"
        )
    return found


def _runs_below(root: Path) -> pd.DataFrame:
    rows = []
    for folder in run_folders(root):
        try:
            info = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise UserError(f"{folder}: not a complete run ({error}); run it again") from None
        names = {"scenario": info["scenario"]["name"], "planner": info["planner"]}
        rows.append({**names, "seed": info["seed"], "path": folder})
    return pd.DataFrame(rows)
