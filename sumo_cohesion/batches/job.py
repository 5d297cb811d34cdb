"""One run of a batch, as a worker process does it."""

from __future__ import annotations

import uuid
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import pandas as pd

from sumo_cohesion.batches.identity import point_digest, run_key
from sumo_cohesion.batches.store import table_file
from sumo_cohesion.errors import InputsChangedError, StorageError
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.run import simulate
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.state import EGO
from sumo_cohesion.tables.rollout import Rollout
from sumo_cohesion.traffic.outputs import Output

TASK = f"{__name__}:drive"
"""What workers are asked to do."""
SUMO = "sumo_"
"""Before the name of a table that SUMO wrote."""


class Job(NamedTuple):
    """One run: its key, what to run, and what to keep where."""

    run: str
    request: RunRequest
    tables: tuple[str, ...]
    folder: str


def drive(job: Job) -> dict[str, Any]:
    """Do one run; keep its tables; return its metrics and what it took.

    Raises
    ------
    UserError, SimulationError
        As run() does.
    InputsChangedError
        If anything that decides the result has changed since the batch was started, or is
        different on this machine.
    """
    start = perf_counter()
    setup = prepare(job.request)
    if run_key(point_digest(setup), job.request.seed) != job.run:
        raise InputsChangedError(
            "scenario, network, planner, code or versions are not those the batch was started "
            "with; run it again, with the same versions on every machine"
        )
    outputs: list[Output] = [
        kind for kind in ("fcd", "tripinfo", "ssm") if SUMO + kind in job.tables
    ]
    rollout = simulate(setup, sumo_outputs=outputs)
    for name in job.tables:
        _keep(rollout, name, table_file(Path(job.folder), name, job.run))
    (row,) = rollout.metrics.to_dict(orient="records")
    failed = rollout.plan[rollout.plan["fallback"]]
    reason = ""
    if len(failed):
        first = failed["status"].iloc[0]
        reason = f"no plan in {len(failed)} of {len(rollout.plan)} steps, first: {first}"
    metrics = {str(name): value for name, value in row.items()}
    return {"reason": reason, "wall_time": perf_counter() - start, **metrics}


def _keep(rollout: Rollout, name: str, path: Path) -> None:
    if name.startswith(SUMO):
        table = rollout.sumo[name.removeprefix(SUMO)]
    elif name == "ego":
        table = rollout.trajectory
        table = table[table["vehicle"] == EGO].drop(columns=["vehicle", "visible"])
    else:
        table = getattr(rollout, name)
    table = table.assign(run=pd.Categorical([path.stem] * len(table), [path.stem]))
    new = path.with_name(f".{path.name}.{uuid.uuid4().hex}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            table.to_parquet(new, index=False)
            new.replace(path)
        finally:
            new.unlink(missing_ok=True)
    except OSError as error:
        raise StorageError(
            f"{path.parent}: cannot be written ({error.strerror or error})"
        ) from None
