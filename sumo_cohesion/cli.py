"""The command line. Everything it does is one call in Python."""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

# The matrices here are tiny; threads of the linear algebra library would only cost time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import click

from sumo_cohesion.errors import SimulationError, UserError

if TYPE_CHECKING:
    import pandas as pd

    from sumo_cohesion.batches.single import Driven
    from sumo_cohesion.batches.workers import CallFailedError

PLANNER_HELP = "nominal, cohesive, paper, sumo, or your own as module:Class(gain=2.5)."
_SIDE_BY_SIDE = 4
"""Planners, or points of a grid, that a summary shows beside each other."""
_IN_SHORT = ("success", "collision", "off_road", "mean_speed", "plan_failures")
"""What it shows of more than these."""
_QUIET = 60.0
"""Seconds between two lines of progress where there is no terminal."""
SET_HELP = "Change a setting, e.g. cohesion.beta=0.05, planner.horizon=10, ego.speed=20."


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="sumo-cohesion")
def app() -> None:
    """Socially cohesive driving in SUMO: an ego car that follows what nearby humans agree on."""


@app.command()
def scenarios() -> None:
    """List the bundled scenarios, one line each."""
    from sumo_cohesion.simulation.scenario import load_scenario, scenario_files

    for path in scenario_files():
        click.echo(f"{path.stem:20} {load_scenario(path.stem).summary}")


@app.command()
@click.argument("scenario")
@click.option("--planner", default="cohesive", show_default=True, help=PLANNER_HELP)
@click.option("--seed", type=int, default=0, show_default=True, help="Varies the traffic.")
@click.option("--set", "changes", multiple=True, metavar="NAME=VALUE", help=SET_HELP)
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the run's tables.")
@click.option("--gui", is_flag=True, help="Show SUMO's window (needs sumo-cohesion[gui]).")
@click.option("--json", "as_json", is_flag=True, help="Print the metrics as JSON.")
def run(
    scenario: str,
    planner: str,
    seed: int,
    changes: tuple[str, ...],
    out: Path | None,
    gui: bool,
    as_json: bool,
) -> None:
    """Drive SCENARIO (a bundled name or a TOML file) once."""
    driven = _drive(scenario, planner, seed, _overrides(changes), out, gui)
    for note in driven.notes:
        click.echo(f"note: {note}", err=True)
    if as_json:
        click.echo(json.dumps({"metrics": driven.metrics}, ensure_ascii=False))
    else:
        for name, value in driven.metrics.items():
            click.echo(f"{name:26} {_shown(value)}")
    if out is not None:
        click.echo(f"tables written to {out}", err=True)


def _drive(
    scenario: str, planner: str, seed: int, overrides: dict[str, Any], out: Path | None, gui: bool
) -> Driven:
    """Drive in a process of its own, so that what crashes SUMO is an error like others.

    The window is shown from this process: SUMO's own is another anyway.
    """
    from sumo_cohesion.batches.single import TASK, drive
    from sumo_cohesion.batches.workers import CallFailedError, call_apart

    if gui:
        with _clean_stdout():
            return drive(scenario, planner, seed, overrides, out, gui=True)
    try:
        driven: Driven = call_apart(TASK, scenario, planner, seed, overrides, out)
    except CallFailedError as error:
        raise _lost(error, scenario, planner) from None
    return driven


def _lost(error: CallFailedError, scenario: str, planner: str) -> UserError | SimulationError:
    """Say what to do about a run whose process gave no result."""
    own = ":" in planner
    if error.kind != "crash" or error.signal == signal.SIGKILL or not (error.signal or own):
        return SimulationError(error.reason)
    who = f"planner {planner!r} (try --planner nominal) or SUMO" if own else "SUMO"
    return UserError(
        f"{who} crashed on these files: {error.reason}; to see whether SUMO does so by itself: "
        f"sumo-cohesion scenario export {scenario} --out x, sumo -c x/scenario.sumocfg; then "
        "rebuild the network with netconvert, or take routes and additional files out one by one"
    )


@app.command()
@click.argument("scenario")
@click.option("--planners", default="nominal,cohesive", show_default=True, help=PLANNER_HELP)
@click.option("--seeds", default="0:20", show_default=True, help="0:20 is half-open; or 3,7,9.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes. Default: one per core.")
@click.option("--set", "changes", multiple=True, metavar="NAME=VALUE", help=SET_HELP)
@click.option("--out", type=click.Path(path_type=Path), help="Default: results/SCENARIO.")
@click.option("--json", "as_json", is_flag=True, help="Print runs and summary as JSON.")
def compare(
    scenario: str,
    planners: str,
    seeds: str,
    workers: int | None,
    changes: tuple[str, ...],
    out: Path | None,
    as_json: bool,
) -> None:
    """Run several planners on the same seeds of SCENARIO and compare them."""
    from sumo_cohesion.batches.comparison import compare as compare_planners
    from sumo_cohesion.report.paths import draw_comparison
    from sumo_cohesion.user_input import parse_seeds, split_planners

    folder = out if out is not None else Path("results") / Path(scenario).stem
    names, numbers = split_planners(planners), parse_seeds(seeds)
    with _clean_stdout(), _progress(f"{scenario}") as progress:
        result = compare_planners(
            scenario,
            names,
            numbers,
            overrides=_overrides(changes),
            workers=workers,
            out=folder,
            progress=progress,
        )
        picture = draw_comparison(folder)
    for planner, failures in result.runs.groupby("planner", sort=False)["plan_failures"]:
        if failures.any():
            click.echo(
                f"note: {planner} failed in {failures.sum()} steps of {(failures > 0).sum()} runs; "
                "the table plan says why, and 'run' prints it",
                err=True,
            )
    if as_json:
        document = {"runs": _records(result.runs), "summary": _records(result.summary)}
        click.echo(json.dumps(document, ensure_ascii=False))
    else:
        _print_summary(result.summary)
    click.echo(f"runs and tables in {folder}, picture in {picture}", err=True)


@app.command("batch")
@click.argument("experiment", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Default: results/EXPERIMENT.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes. Default: one per core.")
@click.option("--dask", metavar="ADDRESS", help="Run on a Dask cluster; 'local' starts one here.")
@click.option(
    "--shard", metavar="I/N", default="1/1", help="Only the I-th of N parts (job arrays)."
)
@click.option("--retry-failed", is_flag=True, help="Also run again what has failed before.")
@click.option(
    "--dry-run", is_flag=True, help="Say how many runs there are, and how long they take."
)
@click.option("--json", "as_json", is_flag=True, help="Print the runs as JSON.")
def run_batch(
    experiment: Path,
    out: Path | None,
    workers: int | None,
    dask: str | None,
    shard: str,
    retry_failed: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Do all runs of EXPERIMENT (a TOML file) that are not done yet.

    Interrupt it when you like, and run it again to go on. Exit status 1 if a run has no result.
    """
    from sumo_cohesion.batches import batch as batches
    from sumo_cohesion.batches.workers import processors

    folder = out if out is not None else Path("results") / experiment.stem
    if dry_run:
        with _clean_stdout():
            plan = batches.dry_run(experiment, folder)
        _print_plan(plan, folder, workers or processors(), as_json=as_json)
        return
    failed: Counter[str] = Counter()
    with _clean_stdout(), _progress(experiment.stem) as show:

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
        click.echo(json.dumps({"runs": _records(rows)}, ensure_ascii=False))
    else:
        _print_summary(_summary(rows))
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
    hours = plan["seconds"].sum() / workers / 3600
    if as_json:
        document = {"plan": _records(plan), "workers": workers, "hours": hours}
        click.echo(json.dumps(document, ensure_ascii=False))
        return
    click.echo(plan.round({"seconds": 0}).to_string(index=False))
    click.echo(
        f"{plan['left'].sum()} of {plan['runs'].sum()} runs are left for {folder}: about "
        f"{_duration(3600 * hours)} with {workers} workers"
    )


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


@app.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--format",
    "style",
    type=click.Choice(["table", "csv", "parquet", "json"]),
    default="table",
    show_default=True,
)
@click.option("--out", type=click.Path(path_type=Path), help="File to write (parquet needs it).")
def metrics(folder: Path, style: str, out: Path | None) -> None:
    """Print or convert the metrics of all runs below FOLDER."""
    from sumo_cohesion.batches.results import load_metrics
    from sumo_cohesion.tables.damaged import tables_of

    with tables_of(folder):
        frame = load_metrics(folder)
    if style == "parquet":
        if out is None:
            raise UserError("--format parquet writes a file; name it with --out")
        with _writing(out):
            frame.to_parquet(out, index=False)
        return
    if style == "csv":
        text = frame.to_csv(index=False)
    elif style == "json":
        text = json.dumps(_records(frame), ensure_ascii=False) + "\n"
    else:
        text = frame.to_string(index=False) + "\n"
    if out is None:
        click.echo(text, nl=False)
        return
    with _writing(out):
        out.write_text(text, encoding="utf-8")


@app.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Picture file, .png, .pdf or .svg.")
@click.option("--seed", type=int, help="Which seed of a comparison. Default: the first.")
@click.option("--metric", help="Of a batch: what to draw, e.g. success.")
@click.option("--over", help="Of a batch: a name of its grid, the horizontal axis.")
@click.option("--panels", help="Of a batch: another name of its grid, a panel per value.")
def figure(
    folder: Path,
    out: Path | None,
    seed: int | None,
    metric: str | None,
    over: str | None,
    panels: str | None,
) -> None:
    """Draw the picture of a run, a comparison or a batch from its saved tables."""
    from sumo_cohesion.batches.store import is_batch
    from sumo_cohesion.tables.damaged import tables_of

    if is_batch(folder):
        if metric is None or over is None:
            raise UserError(f"{folder}: is a batch; say what to draw with --metric and --over")
        from sumo_cohesion.batches.results import load_metrics
        from sumo_cohesion.report.grid import draw_grid

        picture = out or folder / f"{metric}.png"
        with tables_of(folder):
            path = draw_grid(load_metrics(folder), metric, over, panels, picture)
        click.echo(path)
        return
    from sumo_cohesion.report.paths import draw_comparison, draw_run

    draw = draw_comparison if (folder / "comparison.json").is_file() else draw_run
    if draw is draw_run and seed is not None:
        raise UserError(f"{folder}: one run has one seed; leave --seed out")
    with tables_of(folder):
        both = draw is draw_comparison
        path = draw_comparison(folder, out, seed) if both else draw_run(folder, out)
    click.echo(path)


@app.group()
def scenario() -> None:
    """Work with one scenario."""


@scenario.command("export")
@click.argument("name", metavar="SCENARIO")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--set", "changes", multiple=True, metavar="NAME=VALUE", help=SET_HELP)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder to write.")
def export(name: str, seed: int, changes: tuple[str, ...], out: Path) -> None:
    """Write SCENARIO for plain SUMO: sumo-gui -c OUT/scenario.sumocfg."""
    from sumo_cohesion.simulation.export import export_scenario

    click.echo(export_scenario(name, out, seed=seed, overrides=_overrides(changes)))


def _overrides(changes: Sequence[str]) -> dict[str, Any]:
    from sumo_cohesion.user_input import parse_override

    return dict(parse_override(text) for text in changes)


def _records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows as JSON has them: a number that is not finite is null."""
    return [
        {
            str(k): None if isinstance(v, float) and not math.isfinite(v) else v
            for k, v in row.items()
        }
        for row in frame.to_dict(orient="records")
    ]


def _shown(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _print_summary(summary: pd.DataFrame) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    if summary.empty:
        return
    table = Table(title="95 % confidence intervals: Wilson for rates, bootstrap for means")
    down, across = "metric", "planner"
    if summary["planner"].nunique() > _SIDE_BY_SIDE:  # one below the other, what matters most
        down, across = across, down
        summary = summary[summary["metric"].isin(_IN_SHORT)]
    for name in (down, *summary[across].unique()):
        table.add_column(escape(name), justify="left" if name == down else "right", no_wrap=True)
    for of in summary[down].unique():
        cells = [
            f"{r.value:.2f} [{r.low:.2f}, {r.high:.2f}] n={r.n}" if r.n else "-"
            for r in summary[summary[down] == of].itertuples()
        ]
        table.add_row(escape(of), *cells)
    # Wide enough for the table where the output is a file or a pipe.
    Console(width=None if sys.stdout.isatty() else 140).print(table)


@contextmanager
def _progress(title: str) -> Iterator[Any]:
    """Show a bar with rate and ETA on a terminal, nothing elsewhere; on standard error."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=None)
        told = time.monotonic()

        def show(done: int, total: int, failed: int = 0) -> None:
            nonlocal told
            note = f"{title}, {failed} failed" if failed else title
            bar.update(task, completed=done, total=total, description=note)
            # Where there is no terminal, a line now and then: for the log of a night's batch.
            if bar.disable and time.monotonic() - told > _QUIET:
                told = time.monotonic()
                click.echo(f"{note}: {done} of {total}", err=True)

        yield show


@contextmanager
def _clean_stdout() -> Iterator[None]:
    """Send what native libraries print to standard output to standard error instead."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from None


def main() -> None:
    """Entry point: 0 done, 2 the user's input is wrong, 1 anything else; always one line."""
    try:
        app(standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.exceptions.NoArgsIsHelpError as stop:
        click.echo(stop.ctx.get_help() if stop.ctx else "")
        sys.exit(2)
    except click.ClickException as error:
        _fail(f"{error.format_message()} (sumo-cohesion --help)", 2)
    except UserError as error:
        _fail(str(error), 2)
    except SimulationError as error:
        _fail(str(error), 1)
    except (KeyboardInterrupt, click.Abort):
        _fail("interrupted", 1)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(1)


def _fail(message: str, status: int) -> None:
    click.echo("error: " + " ".join(message.split()), err=True)
    sys.exit(status)
