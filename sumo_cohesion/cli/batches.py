"""Commands that do experiments: many runs, and what is left of them."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sumo_cohesion.cli import options
from sumo_cohesion.cli.terminal import clean_stdout, print_summary, progress_bar, records
from sumo_cohesion.errors import UserError

if TYPE_CHECKING:
    import pandas as pd


@click.command("batch")
@click.argument("experiment", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Default: results/EXPERIMENT.")
@options.workers
@click.option("--dask", metavar="ADDRESS", help="Run on a Dask cluster; 'local' starts one here.")
@click.option(
    "--shard", metavar="I/N", default="1/1", help="Only the I-th of N parts (job arrays)."
)
@click.option("--retry-failed", is_flag=True, help="Also run again what has failed before.")
@click.option("--dry-run", is_flag=True, help="Run nothing: say how many runs there are.")
@click.option(
    "--estimate",
    is_flag=True,
    help="Say how long they take, too: one run of each scenario and planner is measured.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the runs as JSON.")
@options.traceback
def run_batch(
    experiment: Path,
    out: Path | None,
    workers: int | None,
    dask: str | None,
    shard: str,
    retry_failed: bool,
    dry_run: bool,
    estimate: bool,
    as_json: bool,
) -> None:
    """Do all runs of EXPERIMENT (a TOML file) that are not done yet.

    Interrupt it when you like, and run it again to go on. Exit status 1 if a run has no result.
    """
    from sumo_cohesion.batches import batch as batches
    from sumo_cohesion.batches.workers import processors

    folder = out if out is not None else Path("results") / experiment.stem
    if dry_run or estimate:
        with clean_stdout():
            plan = batches.dry_run(experiment, folder, estimate=estimate)
        _print_plan(plan, folder, workers or processors(), as_json=as_json)
        return
    failed: Counter[str] = Counter()
    with clean_stdout(), progress_bar(experiment.stem) as show:

        def follow(progress: batches.Progress) -> None:
            show(progress.done, progress.total, progress.failed)
            if progress.reason:
                failed[progress.reason] += 1

        rows = batches.batch(
            experiment,
            folder,
            workers=workers,
            dask=dask,
            shard=_parse_shard(shard),
            retry_failed=retry_failed,
            progress=follow,
        )
    for reason, count in failed.most_common(10):
        click.echo(f"note: {count} runs have failed now: {reason}", err=True)
    left = rows[rows["status"] != "done"].drop_duplicates("run")
    if len(left):
        click.echo(f"note: {len(left)} runs have no result; see status and reason", err=True)
    if as_json:
        click.echo(json.dumps({"runs": records(rows)}, ensure_ascii=False))
    else:
        print_summary(_summary(rows))
    click.echo(f"metrics in {folder / 'metrics.parquet'}", err=True)
    # Of all shards' runs one part is this command's: what has failed now.
    if failed or (len(left) and shard == "1/1"):
        sys.exit(1)


def _parse_shard(text: str) -> tuple[int, int]:
    try:
        index, count = (int(part) for part in text.split("/"))
    except ValueError:
        raise UserError(f"--shard {text!r}: write 1/4 to 4/4 for four parts") from None
    return index, count


def _summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Rates and means of every point of the grid: scenario, planner and parameters."""
    from sumo_cohesion.tables.intervals import summarize

    done, columns = rows[rows["status"] == "done"], list(rows.columns)
    grid = columns[columns.index("planner") + 1 : columns.index("seed")]
    names = done["planner"]
    if done["scenario"].nunique() > 1:
        names = done["scenario"] + ", " + names
    for name in grid:
        if done[name].nunique() > 1:
            names = names + f", {name}=" + done[name].astype(str)
    return summarize(done.assign(planner=names))


def _print_plan(plan: pd.DataFrame, folder: Path, workers: int, *, as_json: bool) -> None:
    # One unknown time makes an unknown sum.
    hours = plan["seconds"].sum(skipna=False) / workers / 3600
    if as_json:
        known = None if math.isnan(hours) else hours
        document = {"plan": records(plan), "workers": workers, "hours": known}
        click.echo(json.dumps(document, ensure_ascii=False))
        return
    if math.isnan(hours):
        plan, long = plan.drop(columns="seconds"), "; --estimate says how long they take"
    else:
        long = f": about {_duration(3600 * hours)} with {workers} workers"
    click.echo(plan.round(0).to_string(index=False))
    click.echo(f"{plan['left'].sum()} of {plan['runs'].sum()} runs are left for {folder}{long}")


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
