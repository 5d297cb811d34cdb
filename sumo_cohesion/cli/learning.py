"""The command that learns reward weights from driving."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal, get_args

import click

from sumo_cohesion.cli import options
from sumo_cohesion.cli.terminal import clean_stdout, progress_bar, records
from sumo_cohesion.errors import UserError

Kind = Literal["plans", "driven", "humans"]
"""As in learning.source, which the command line does not load before it has to."""


@click.command()
@click.argument("demos", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("theta.toml"),
    show_default=True,
    help="File for the weights.",
)
@click.option(
    "--report", type=click.Path(path_type=Path), help="Folder for tables and figures, too."
)
@click.option(
    "--from",
    "source",
    type=click.Choice(get_args(Kind)),
    default="plans",
    show_default=True,
    help="Of runs: a planner's plans, what it has driven, or the humans around it.",
)
@click.option(
    "--network", type=click.Path(path_type=Path), help="SUMO network that files were driven on."
)
@click.option(
    "--demand",
    multiple=True,
    type=click.Path(path_type=Path),
    help="File with the types of SUMO's vehicles, for their sizes.",
)
@click.option(
    "--steps",
    type=click.IntRange(2, 100),
    help="Of 0.1 s per segment. Default: the plans' horizon; 10.",
)
@click.option(
    "--smooth",
    metavar="ALONG,ACROSS",
    help="Seconds; faster oscillations are noise. Default: 1,2 for humans, 0,0 for planners.",
)
@click.option(
    "--desired",
    type=click.Choice(("limit", "own")),
    default="limit",
    show_default=True,
    help="What drivers would like to drive: the limit, or the speed of their own.",
)
@click.option("--also", metavar="TERMS", default="", help="Terms to learn that are off by default.")
@click.option("--fix", multiple=True, metavar="TERM=WEIGHT", help="A weight that is not learned.")
@click.option(
    "--keep",
    type=click.FloatRange(0.1, 1.0),
    help="Share of the segments to fit. Default: 0.85; 0.95 of humans.",
)
@click.option(
    "--hold-out",
    type=click.FloatRange(0.0, 0.9),
    default=0.25,
    show_default=True,
    help="Share of runs to try it on.",
)
@click.option(
    "--bootstrap",
    "draws",
    type=click.IntRange(0, 100_000),
    default=100,
    show_default=True,
    help="Draws; 0: no intervals.",
)
@options.changes
@click.option("--json", "as_json", is_flag=True, help="Print weights and fit as JSON.")
def learn(
    demos: tuple[Path, ...],
    out: Path,
    report: Path | None,
    source: Kind,
    network: Path | None,
    demand: tuple[Path, ...],
    steps: int | None,
    smooth: str | None,
    desired: str,
    also: str,
    fix: tuple[str, ...],
    keep: float | None,
    hold_out: float,
    draws: int,
    changes: tuple[str, ...],
    as_json: bool,
) -> None:
    """Learn the reward weights theta from driving: DEMOS are folders of runs, or files.

    Files: SUMO's FCD output (any network), tables with time, vehicle, x and y, CommonRoad scenes.
    Use what was learned anywhere: --set planner.reward=@theta.toml. Then tune beta to it.
    """
    from sumo_cohesion.demonstrations import learn as learning
    from sumo_cohesion.learning.learned import require_writable
    from sumo_cohesion.tables.folders import require_replaceable
    from sumo_cohesion.user_input import split_names

    require_writable(out)
    if report is not None:
        require_replaceable(report, "--report")
    with clean_stdout(), progress_bar("learn") as progress:

        def follow(what: str, done: int, total: int) -> None:
            progress(done, total, what=what)

        learned = learning.learn(
            demos,
            source=source,
            network=network,
            demand=demand,
            steps=steps,
            smooth=_smooth(smooth),
            desired=desired,
            also=split_names(also),
            fix=dict(map(_weight, fix)),
            keep=keep,
            hold_out=hold_out,
            draws=draws,
            overrides=options.parsed_overrides(changes),
            progress=follow,
        )
        try:
            if report is not None:  # first: the file may lie in its folder
                from sumo_cohesion.report.learned import write_report

                progress(0, 1, what="drawing")
                write_report(learned, report)
        finally:
            learned.write(out)
    for note in (*learned.about["notes"], *learned.warnings):
        click.echo(f"note: {note}", err=True)
    if as_json:
        document = {"weights": records(learned.weights), "fit": records(learned.fit)}
        click.echo(json.dumps({**document, "temperature": learned.temperature}, ensure_ascii=False))
    else:
        click.echo(learned.summary())
    click.echo(f"weights in {out}; drive with --set planner.reward=@{out}", err=True)


def _smooth(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        along, across = (float(part) for part in text.split(","))
    except ValueError:
        raise UserError(
            f"--smooth {text!r}: write two times in seconds, along and across the road, e.g. 1,2"
        ) from None
    return along, across


def _weight(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise UserError(f"--fix {text!r}: write it as TERM=WEIGHT, e.g. edge=500") from None
