"""Paired comparison: the same seeds, the same traffic, several planners, side by side."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from html import escape
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from sumo_cohesion.batches.workers import (
    NO_LIMITS,
    CallFailedError,
    Workers,
    processors,
    stopped_by_signals,
)
from sumo_cohesion.errors import SimulationError, UserError
from sumo_cohesion.planning.registry import AnyPlanner, planner_name
from sumo_cohesion.simulation.overrides import read_files
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.run import record
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.state import EGO
from sumo_cohesion.tables.compared import COMPARISON_FILE, run_folder
from sumo_cohesion.tables.folders import keep, require_replaceable, whole_folder
from sumo_cohesion.tables.intervals import summarize
from sumo_cohesion.tables.metrics import deviation
from sumo_cohesion.tables.rollout import RUN_FILE
from sumo_cohesion.user_input import parse_seeds, refuse_repeats, split_names

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
    request: RunRequest
    out: Path | None


def compare(
    scenario: str | Path,
    planners: AnyPlanner | Sequence[AnyPlanner] = ("nominal", "cohesive"),
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
    planners : as for run(); one text may hold several, separated by commas. Classes and objects
        cannot leave this process: their runs are done in it, one after the other, the others' in
        processes of their own.
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
    if not isinstance(planners, Sequence):
        planners = (planners,)
    seeds = parse_seeds(seeds, "seeds")
    if not planners or not seeds:
        raise UserError("nothing to compare: give at least one planner and one seed")
    for what, values in (("planner", [planner_name(p) for p in planners]), ("seed", seeds)):
        try:
            refuse_repeats(values)
        except ValueError as error:
            raise UserError(f"{what} {error}") from None
    settings = read_files(overrides or {})  # once, so that all runs have the same
    requests = [RunRequest(str(scenario), p, s, settings) for p in planners for s in seeds]
    ends = {min(seeds), max(seeds)}
    for request in requests:
        if request.seed in ends:
            prepare(request)
    about = {
        "scenario": str(scenario),
        "planners": [planner_name(planner) for planner in planners],
        "seeds": list(seeds),
        "overrides": settings,
    }
    text = json.dumps(about, indent=2, default=_plain) + "\n"
    with stopped_by_signals():
        if out is None:
            jobs = [_Job(request, None) for request in requests]
            return _compared(jobs, _run_all(jobs, workers, progress), None)
        return _compared_in(Path(out), requests, text, workers, progress)


def _plain(value: Any) -> Any:
    """Return what JSON has for a NumPy number or array, or a text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _compared_in(
    folder: Path,
    requests: Sequence[RunRequest],
    about: str,
    workers: int | None,
    progress: Progress | None,
) -> Comparison:
    """Compare, and write all of it to a folder; whatever happens, finished runs are kept."""
    require_replaceable(folder)
    with whole_folder(folder) as new:
        jobs = [
            _Job(request, run_folder(new, planner_name(request.planner), request.seed))
            for request in requests
        ]
        try:
            comparison = _compared(jobs, _run_all(jobs, workers, progress), folder)
            comparison.runs.to_parquet(new / "metrics.parquet", index=False)
            comparison.summary.to_parquet(new / "summary.parquet", index=False)
            (new / COMPARISON_FILE).write_text(about, encoding="utf-8")
        except BaseException as error:
            if not any(new.rglob(RUN_FILE)):
                raise
            kept = keep(new, folder)
            kind = UserError if isinstance(error, UserError | OSError) else SimulationError
            reason = _reason(error).replace(str(new), str(kept))
            raise kind(f"{reason}; finished runs are kept in {kept}") from error
    return comparison


def _reason(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    known = isinstance(error, UserError | SimulationError)
    return str(error) if known else f"{type(error).__name__}: {error}"


def _compared(jobs: Sequence[_Job], results: Sequence[_Result], folder: Path | None) -> Comparison:
    runs = pd.concat([result.metrics for result in results], ignore_index=True)
    asked = [job.request for job in jobs]
    nominal = {
        a.seed: r.path for a, r in zip(asked, results, strict=True) if a.planner == "nominal"
    }
    for i, (request, result) in enumerate(zip(asked, results, strict=True)):
        if request.seed in nominal:
            runs.loc[i, ["nominal_lateral_deviation", "nominal_speed_deviation"]] = deviation(
                result.path, nominal[request.seed]
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
    by_name = [i for i, job in enumerate(jobs) if isinstance(job.request.planner, str)]
    left, waiting = iter(by_name), dict[Future[_Result], int]()

    def fill_up() -> None:
        for i in islice(left, 2 * count - len(waiting)):
            waiting[executor.submit(_called, workers, jobs[i])] = i

    try:
        fill_up()
        for i in sorted(set(range(len(jobs))) - set(by_name)):
            yield i, _run_job(jobs[i])
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
            fill_up()
    finally:
        workers.close()  # first, so that no thread waits for a run
        executor.shutdown(cancel_futures=True)


def _called(workers: Workers, job: _Job) -> _Result:
    """Run a job in a process of its own; say which it was that failed."""
    try:
        result: _Result = workers.call(job)
    except CallFailedError as error:
        which = f"{planner_name(job.request.planner)}, seed {job.request.seed}"
        raise SimulationError(f"{which}: {error.reason}") from None
    return result


def _run_job(job: _Job) -> _Result:
    rollout = record(prepare(job.request), job.out)
    table = rollout.trajectory
    return _Result(rollout.metrics, table.loc[table["vehicle"] == EGO, ["time", "d", "speed"]])
