"""Commands that drive: one run, and several planners on the same seeds."""

from __future__ import annotations

import json
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import click

from sumo_cohesion.cli import options
from sumo_cohesion.cli.terminal import clean_stdout, print_summary, progress_bar, records, shown
from sumo_cohesion.errors import SimulationError, UserError

if TYPE_CHECKING:
    from sumo_cohesion.batches.single import Driven
    from sumo_cohesion.batches.workers import CallFailedError

Output = Literal["fcd", "tripinfo", "ssm"]
SUMO_OUTPUTS = get_args(Output)
"""As in traffic.outputs, which the command line does not load before it has to."""


@click.command()
@click.argument("scenario")
@click.option("--planner", default="cohesive", show_default=True, help=options.PLANNER_HELP)
@click.option("--seed", type=int, default=0, show_default=True, help="Varies the traffic.")
@options.changes
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the run's tables.")
@click.option("--gui", is_flag=True, help="Show SUMO's window (needs eclipse-sumo).")
@click.option(
    "--sumo-outputs",
    metavar="KINDS",
    default="",
    help="SUMO's own outputs to keep, too: fcd, tripinfo, ssm; several by commas. Needs --out.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the metrics as JSON.")
@options.traceback
def run(
    scenario: str,
    planner: str,
    seed: int,
    changes: tuple[str, ...],
    out: Path | None,
    gui: bool,
    sumo_outputs: str,
    as_json: bool,
) -> None:
    """Drive SCENARIO (a bundled name or a TOML file) once."""
    driven = _drive(
        scenario,
        planner,
        seed,
        changes,
        out,
        _sumo_outputs(sumo_outputs, out),
        gui=gui,
    )
    for note in driven.notes:
        click.echo(f"note: {note}", err=True)
    if as_json:
        click.echo(json.dumps({"metrics": driven.metrics}, ensure_ascii=False))
    else:
        for name, value in driven.metrics.items():
            click.echo(f"{name:26} {shown(value)}")
    if out is not None:
        click.echo(f"tables written to {out}", err=True)


def _drive(
    scenario: str,
    planner: str,
    seed: int,
    changes: Sequence[str],
    out: Path | None,
    sumo_outputs: Sequence[Output],
    *,
    gui: bool,
) -> Driven:
    """Drive in a process of its own, so that what crashes SUMO is an error like others.

    The window is shown from this process: SUMO's own is another anyway.
    """
    from sumo_cohesion.batches.single import TASK, drive
    from sumo_cohesion.batches.workers import CallFailedError, call_apart

    if gui:
        with clean_stdout():
            return drive(scenario, planner, seed, changes, out, sumo_outputs, gui=True)
    try:
        driven: Driven = call_apart(TASK, scenario, planner, seed, changes, out, sumo_outputs)
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


@click.command()
@click.argument("scenario")
@click.option(
    "--planners", default="nominal,cohesive", show_default=True, help=options.PLANNER_HELP
)
@click.option("--seeds", default="0:20", show_default=True, help="0:20 is half-open; or 3,7,9.")
@options.workers
@options.changes
@click.option("--out", type=click.Path(path_type=Path), help="Default: results/SCENARIO.")
@click.option("--json", "as_json", is_flag=True, help="Print runs and summary as JSON.")
@options.traceback
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
    from sumo_cohesion.user_input import parse_seeds, split_names

    folder = out if out is not None else Path("results") / Path(scenario).stem
    names, numbers = split_names(planners), parse_seeds(seeds)
    if seeds.isdecimal():
        note = f"--seeds {seeds} is the one seed {seeds}; 0:{seeds} is {seeds} seeds"
        click.echo(f"note: {note}", err=True)
    with clean_stdout(), progress_bar(scenario, len(names) * len(numbers)) as progress:
        result = compare_planners(
            scenario,
            names,
            numbers,
            overrides=options.parsed_overrides(changes),
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
        document = {"runs": records(result.runs), "summary": records(result.summary)}
        click.echo(json.dumps(document, ensure_ascii=False))
    else:
        print_summary(result.summary)
    click.echo(f"runs and tables in {folder}, picture in {picture}", err=True)


def _sumo_outputs(kinds: str, out: Path | None) -> list[Output]:
    from sumo_cohesion.user_input import closest, split_names

    asked = split_names(kinds)
    known: dict[str, Output] = {kind: kind for kind in SUMO_OUTPUTS}
    for kind in asked:
        if kind not in known:
            hint = closest(kind, SUMO_OUTPUTS) or f"; choose from {', '.join(SUMO_OUTPUTS)}"
            raise UserError(f"--sumo-outputs: SUMO has no output {kind!r} here{hint}")
    if asked and out is None:
        raise UserError("--sumo-outputs are tables; name the folder for them with --out")
    return [known[kind] for kind in asked]
