"""Run a batch: every run isolated, every result kept, here or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from sumo_cohesion.batches.experiment import Experiment, Work, load_experiment, spell_out
from sumo_cohesion.batches.job import SUMO, TASK, Job
from sumo_cohesion.batches.store import CHANGED, DONE, Store, joined
from sumo_cohesion.batches.workers import (
    CallFailedError,
    Limits,
    Workers,
    call_here,
    processors,
    search_paths,
    stopped_by_signals,
)
from sumo_cohesion.errors import (
    InputsChangedError,
    SimulationError,
    StorageError,
    UserError,
)
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.versions import versions

_WORTH_RETRYING = ("crash", "timeout", "memory")


class Progress(NamedTuple):
    """How far a batch is: runs of this call, how many have failed, and why the last one did."""

    done: int
    total: int
    failed: int
    reason: str = ""


@dataclass(frozen=True)
class Shard:
    """The ``index``-th of ``count`` equal parts of a batch, counted from 1."""

    index: int = 1
    count: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.index <= self.count:
            raise UserError(f"shard {self.index}/{self.count}: write 1/4 to 4/4 for four parts")

    def __str__(self) -> str:
        return f"{self.index}of{self.count}"


def batch(
    experiment: str | Path | Mapping[str, Any],
    out: str | Path,
    *,
    workers: int | None = None,
    dask: str | None = None,
    shard: tuple[int, int] = (1, 1),
    retry_failed: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> pd.DataFrame:
    """Do every run of an experiment that is not done yet.

    Parameters
    ----------
    experiment : TOML file, or a mapping of the same shape (batches.experiment.Experiment).
    out : folder of the batch (batches.store); call again with the same folder to resume.
    workers : processes on this machine. Default: one per processor.
    dask : address of a Dask scheduler whose workers do the runs instead; they must see the same
        files. "local" stands for a cluster of ``workers`` processes made for this call.
    shard : (i, n): do only the i-th of n parts, for job arrays; all parts share ``out``.
    retry_failed : also do the runs again that have failed before.
    progress : called after each run.

    Returns
    -------
    Metrics, one row per wanted run that was done or has failed, as from load_metrics().

    Raises
    ------
    UserError
        If the input is wrong (nothing has been run then), or the folder cannot be written.
    SimulationError
        If Ctrl-C or SIGTERM stopped it, or the Dask cluster was lost. What is done is kept.
    """
    asked = load_experiment(experiment)
    work = spell_out(asked)
    part, folder = Shard(*shard), Path(out)
    with stopped_by_signals(), Store(folder, str(part)) as store:
        todo = _todo(asked, work, part, store, retry_failed=retry_failed)
        if todo:
            _check(todo)
        about = {
            "experiment": asked.model_dump(mode="json"),
            "folder": str(asked.folder),
            "grid": list(asked.grid),
            "files": work.files,
            "versions": versions(),
        }
        store.write_plan(work.plan, about)
        try:
            with _engine(asked, workers, dask) as engine:
                _run(todo, asked, engine, store, progress)
        except KeyboardInterrupt:
            left = len(todo) - len(store.finished(()) & {job.run for job in todo})
            raise SimulationError(
                f"interrupted with {left} of {len(todo)} runs left; run it again to go on"
            ) from None
        return store.join()


def dry_run(
    experiment: str | Path | Mapping[str, Any], out: str | Path, *, estimate: bool = False
) -> pd.DataFrame:
    """Say what a batch would do: per scenario and planner, how many runs, how many are left.

    ``seconds`` is CPU time for those that are left, from the runs that are done, NaN if there are
    none; with ``estimate`` a first run is done instead, for its time, and not kept.
    """
    asked = load_experiment(experiment)
    work = spell_out(asked)
    folder = Path(out)
    finished, times = set(), pd.Series(dtype=float)
    if (folder / "plan.parquet").is_file():
        rows = joined(folder)
        finished = Store(folder, "").finished(_tables(asked))
        times = rows.groupby(["scenario", "planner"])["wall_time"].median().dropna()
    distinct = work.plan.drop_duplicates("run")
    lines = []
    for (scenario, planner), runs in distinct.groupby(["scenario", "planner"], sort=False):
        left = runs[~runs["run"].isin(finished)]
        seconds = times.get((scenario, planner))
        if seconds is None and len(left) and estimate:
            seconds = _timed(_job(left["run"].iloc[0], int(left["seed"].iloc[0]), asked, work, ""))
        total = len(left) * (float("nan") if seconds is None else seconds) if len(left) else 0.0
        lines.append((scenario, planner, len(runs), len(left), total))
    return pd.DataFrame(lines, columns=["scenario", "planner", "runs", "left", "seconds"])


def _timed(job: Job) -> float:
    workers = Workers(TASK, Limits(600.0, 4.0))
    try:
        return float(workers.call(job._replace(tables=()))["wall_time"])
    except CallFailedError:
        return float("nan")
    finally:
        workers.close()


def _todo(
    asked: Experiment, work: Work, part: Shard, store: Store, *, retry_failed: bool
) -> list[Job]:
    finished = store.finished(_tables(asked), retry_failed=retry_failed)
    distinct = work.plan.drop_duplicates("run")[part.index - 1 :: part.count]
    out = str(store.folder.resolve())
    return [
        _job(run, seed, asked, work, out)
        for run, seed in zip(distinct["run"], distinct["seed"].tolist(), strict=True)
        if run not in finished
    ]


def _tables(asked: Experiment) -> tuple[str, ...]:
    return (*asked.keep, *(SUMO + kind for kind in asked.sumo_outputs))


def _job(run: str, seed: int, asked: Experiment, work: Work, out: str) -> Job:
    return Job(run, work.points[run].request(seed), _tables(asked), out)


def _check(jobs: list[Job]) -> None:
    """Refuse wrong input before anything is run: networks, demand, the range of seeds."""
    by_point: dict[str, list[Job]] = {}
    for job in jobs:
        by_point.setdefault(repr(replace(job.request, seed=0)), []).append(job)
    for some in by_point.values():
        seeds = [job.request.seed for job in some]
        for seed in {min(seeds), max(seeds)}:
            prepare(replace(some[0].request, seed=seed))


class _Engine(NamedTuple):
    """Something that does jobs: where to submit them, as what, and how many to have in hand."""

    executor: Executor
    call: Callable[..., Any]
    at_once: Callable[[], int]


@contextmanager
def _engine(asked: Experiment, workers: int | None, dask: str | None) -> Iterator[_Engine]:
    limits = Limits(asked.limits.run_time, asked.limits.memory)
    count = workers or processors()
    if dask is not None:
        with _dask_engine(dask, count, limits) as engine:
            yield engine
        return
    processes = Workers(TASK, limits)
    executor = ThreadPoolExecutor(count)
    try:
        yield _Engine(executor, processes.call, lambda: count)
    finally:
        processes.close()  # first, so that no thread waits for a run
        executor.shutdown(cancel_futures=True)


@contextmanager
def _dask_engine(address: str, count: int, limits: Limits) -> Iterator[_Engine]:
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise UserError("--dask needs Dask; pip install distributed") from None
    if address == "local":
        with (
            LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):
            yield _over_dask(client, limits)
        return
    try:
        client = Client(address, timeout=20)
    except (OSError, ValueError) as error:
        raise UserError(f"--dask {address}: no scheduler answers there ({error})") from None
    with client:
        yield _over_dask(client, limits)


def _over_dask(client: Any, limits: Limits) -> _Engine:
    paths = search_paths()

    def call(job: Job) -> Any:
        try:
            return call_here(TASK, limits, paths, job)
        except Exception as error:
            return error  # a run that failed is a result: nothing for Dask to warn of

    def at_once() -> int:
        # Workers come and go; a few jobs in hand per thread keep them busy.
        return max(2 * int(sum(client.nthreads().values())), 2)

    # Each run is a task of its own, never shared by key: pure=False. Dask does a task again
    # whose worker was lost.
    return _Engine(client.get_executor(pure=False), call, at_once)


def _run(
    todo: list[Job],
    asked: Experiment,
    engine: _Engine,
    store: Store,
    progress: Callable[[Progress], None] | None,
) -> None:
    """Do the jobs; keep a row of each. Memory does not grow with their number."""
    jobs = iter(todo)
    waiting: dict[Future[Any], tuple[Job, int]] = {}
    done = failed = 0

    def submit(job: Job, attempt: int) -> None:
        waiting[engine.executor.submit(engine.call, job)] = (job, attempt)

    def fill_up() -> None:
        for job in islice(jobs, max(engine.at_once() - len(waiting), 0)):
            submit(job, 1)

    fill_up()
    while waiting:
        for future in wait(waiting, return_when=FIRST_COMPLETED).done:
            job, attempt = waiting.pop(future)
            row = _row(future)
            if row["status"] in _WORTH_RETRYING and attempt <= asked.limits.retries:
                submit(job, attempt + 1)
                continue
            names = {"run": job.run, "planner": job.request.planner, "seed": job.request.seed}
            store.add({**row, **names, "attempts": attempt})
            done, failed = done + 1, failed + (row["status"] != DONE)
            if progress is not None:
                reason = "" if row["status"] == DONE else row["reason"]
                progress(Progress(done, len(todo), failed, reason))
        fill_up()


def _row(future: Future[Any]) -> dict[str, Any]:
    """Return the row of a run, or one that says why there is none."""
    try:
        result = future.result()
        if isinstance(result, Exception):
            raise result
        return {"status": DONE, **result}
    except InputsChangedError as error:
        return {"status": CHANGED, "reason": str(error)}
    except StorageError:
        raise
    except CallFailedError as error:
        return {"status": error.kind, "reason": error.reason}
    except (UserError, SimulationError) as error:
        return {"status": "error", "reason": str(error)}
    except Exception as error:
        # Of the engine itself: Dask gives up a task whose workers died several times.
        if type(error).__name__ == "KilledWorker":
            return {"status": "crash", "reason": "the Dask workers that did this run died"}
        raise SimulationError(
            f"the batch's engine failed: {error}; run it again to go on"
        ) from error
