"""Paired comparison: the same seeds, the same traffic, several planners, side by side."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd

from sumo_cohesion.batches.workers import NO_LIMITS, CallFailedError, Workers, processors
from sumo_cohesion.errors import SimulationError, UserError
from sumo_cohesion.planning.registry import make_planner
from sumo_cohesion.simulation.run import simulate
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.state import EGO
from sumo_cohesion.tables.folders import require_replaceable, whole_folder
from sumo_cohesion.tables.intervals import summarize
from sumo_cohesion.tables.metrics import deviation
from sumo_cohesion.tables.rollout import RUN_FILE, Rollout
from sumo_cohesion.user_input import parse_seeds, refuse_repeats, split_names

COMPARISON_FILE = "comparison.json"
Progress = Callable[[int, int], None]
"""Called with (runs done, runs in all)."""


@dataclass(frozen=True, repr=False)
class Comparison:
    """One metrics row per run, and rates and means with 95 % intervals per planner."""

    runs: pd.DataFrame
    summary: pd.DataFrame
    folder: Path | None

    def __repr__(self) -> str:
        scenario, where = (
            self.runs["scenario"].iloc[0],
            f", in {self.folder}" if self.folder else "",
        )
        successes = self.runs.groupby("planner", sort=False)["success"].agg(["sum", "count"])
        rates = [f"{planner} {done} of {of}" for planner, done, of in successes.itertuples()]
        more = f" and {len(rates) - 4} more" if len(rates) > 4 else ""
        return f"<Comparison {scenario}, successes: {', '.join(rates[:4])}{more}{where}>"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>{self.summary.to_html(index=False)}"


class _Result(NamedTuple):
    """One run's metrics row, and the ego's path: columns time (s), d (m), speed (m/s)."""

    metrics: pd.DataFrame
    path: pd.DataFrame


@dataclass(frozen=True)
class _Job:
    scenario: str
    planner: str
    seed: int
    overrides: tuple[tuple[str, Any], ...]
    out: Path | None


def compare(
    scenario: str | Path,
    planners: str | Sequence[str] = ("nominal", "cohesive"),
    seeds: str | Sequence[int] = "0:20",
    *,
    overrides: Mapping[str, Any] | None = None,
    workers: int | None = None,
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Run every planner on every seed.

    Parameters
    ----------
    scenario, overrides : as for run().
    planners : names as for run(); one text may hold several, separated by commas.
    seeds : a list, a range, or "0:20" (half-open); each gives all planners the same traffic.
    workers : processes; one simulation runs in each. Default: one per processor.
    out : folder for all runs, their metrics, the summary and a picture. It must not exist, be
        empty, or hold an earlier comparison, which is replaced when all runs are done.
    progress : called after each run.

    Raises
    ------
    UserError
        If the input is wrong; nothing has been run then.
    SimulationError
        If a run or its process failed, or Ctrl-C was pressed. Finished runs are then kept in
        a folder that the message names.
    """
    planners = split_names(planners) if isinstance(planners, str) else planners
    seeds = parse_seeds(seeds, "seeds")
    if not planners or not seeds:
        raise UserError("nothing to compare: give at least one planner and one seed")
    for what, values in (("planner", planners), ("seed", seeds)):
        try:
            refuse_repeats(values)
        except ValueError as error:
            raise UserError(f"{what} {error}") from None
    for planner in planners:
        for seed in (min(seeds), max(seeds)):
            prepare(scenario, planner, seed, overrides)
    folder = Path(out) if out is not None else None
    settings = tuple(sorted((overrides or {}).items()))
    if folder is None:
        jobs = [_Job(str(scenario), p, s, settings, None) for p in planners for s in seeds]
        return _compared(jobs, _run_all(jobs, workers, progress), None)
    require_replaceable(folder, COMPARISON_FILE)
    with whole_folder(folder) as new:
        jobs = [
            _Job(str(scenario), p, s, settings, run_folder(new, p, s))
            for p in planners
            for s in seeds
        ]
        try:
            results = _run_all(jobs, workers, progress)
        except (SimulationError, UserError, KeyboardInterrupt) as error:
            kept = _keep(new, folder)
            if kept is None:
                raise
            kind = UserError if isinstance(error, UserError) else SimulationError
            reason = str(error) or "interrupted"
            raise kind(f"{reason}; finished runs are kept in {kept}") from error
        comparison = _compared(jobs, results, folder)
        comparison.runs.to_parquet(new / "metrics.parquet", index=False)
        comparison.summary.to_parquet(new / "summary.parquet", index=False)
        about = {
            "scenario": str(scenario),
            "planners": list(planners),
            "seeds": list(seeds),
            "overrides": dict(settings),
        }
        (new / COMPARISON_FILE).write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    return comparison


_LONGEST = 150
"""Characters of a folder's name."""


def run_folder(folder: Path, planner: str, seed: int) -> Path:
    """Folder of one run within a comparison's folder."""
    name = quote(planner.replace(":", ".", 1), safe="()=', ")
    if len(name) > _LONGEST:
        name = f"{name[:_LONGEST]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return folder / name / f"seed_{seed:04d}"


def _keep(new: Path, folder: Path) -> Path | None:
    """Move the finished runs of a comparison that broke off beside its folder."""
    if not any(new.rglob(RUN_FILE)):
        return None
    kept = folder.with_name(folder.name + ".unfinished")
    shutil.rmtree(kept, ignore_errors=True)
    new.rename(kept)
    return kept


def _compared(jobs: Sequence[_Job], results: Sequence[_Result], folder: Path | None) -> Comparison:
    runs = pd.concat([result.metrics for result in results], ignore_index=True)
    nominal = {j.seed: r.path for j, r in zip(jobs, results, strict=True) if j.planner == "nominal"}
    for i, (job, result) in enumerate(zip(jobs, results, strict=True)):
        if job.seed in nominal:
            runs.loc[i, ["nominal_lateral_deviation", "nominal_speed_deviation"]] = deviation(
                result.path, nominal[job.seed]
            )
    return Comparison(runs, summarize(runs), folder)


def _run_all(jobs: Sequence[_Job], workers: int | None, progress: Progress | None) -> list[_Result]:
    """Run all jobs; results in the order of the jobs, whatever the number of workers."""
    count = min(workers or processors(), len(jobs))
    done: dict[int, _Result] = {}
    for i, result in _results(jobs, count):
        done[i] = result
        if progress is not None:
            progress(len(done), len(jobs))
    return [done[i] for i in range(len(jobs))]


def _results(jobs: Sequence[_Job], count: int) -> Iterator[tuple[int, _Result]]:
    workers = Workers(f"{__name__}:_run_job", NO_LIMITS)
    executor = ThreadPoolExecutor(count)
    try:
        waiting = {executor.submit(workers.call, job): i for i, job in enumerate(jobs)}
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
    except CallFailedError as error:
        raise SimulationError(error.reason) from None
    finally:
        workers.close()  # first, so that no thread waits for a run
        executor.shutdown(cancel_futures=True)


def _run_job(job: _Job) -> _Result:
    setup = prepare(job.scenario, job.planner, job.seed, dict(job.overrides))
    rollout: Rollout = simulate(setup, make_planner(job.planner, setup.settings, setup.cohesion))
    if job.out is not None:
        rollout.write(job.out)
    table = rollout.trajectory
    return _Result(rollout.metrics, table.loc[table["vehicle"] == EGO, ["time", "d", "speed"]])
