"""The command that tunes beta to reward weights."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import click

from sumo_cohesion.cli import options
from sumo_cohesion.cli.terminal import clean_stdout, progress_bar, records


@click.command()
@click.argument("weights", metavar="[WEIGHTS]", required=False, type=click.Path(path_type=Path))
@click.option("--scenario", default="speeding", show_default=True, help="Where it is tuned.")
@click.option(
    "--metric", default="speed_gap_closed", show_default=True, help="One that grows with beta."
)
@click.option(
    "--target", type=float, default=0.6, show_default=True, help="Its median over the seeds."
)
@click.option("--planner", default="cohesive", show_default=True, help="cohesive or paper.")
@click.option(
    "--seeds", default="1000:1010", show_default=True, help="None that are reported later."
)
@options.changes
@options.workers
@click.option("--json", "as_json", is_flag=True, help="Print all of it as JSON.")
def tune(
    weights: Path | None,
    scenario: str,
    metric: str,
    target: float,
    planner: str,
    seeds: str,
    changes: tuple[str, ...],
    workers: int | None,
    as_json: bool,
) -> None:
    """Find the beta that belongs to reward weights, and write it into their file.

    WEIGHTS is a TOML file with a table [planner.reward], as learn writes it; beta is put into its
    table [cohesion]. Without it, those of --set are tuned for, and nothing is written.

    Beta is such that the median over the seeds of --metric is --target: by default, a cohesive ego
    in the scenario speeding closes 0.6 of the gap to the humans' speed.
    """
    from sumo_cohesion.batches import tuning
    from sumo_cohesion.user_input import parse_seeds

    with clean_stdout(), progress_bar(f"tune {scenario}") as progress:
        found = tuning.tune(
            weights,
            scenario=scenario,
            metric=metric,
            target=target,
            planner=planner,
            seeds=parse_seeds(seeds),
            overrides=options.parsed_overrides(changes),
            workers=workers,
            progress=progress,
        )
    if as_json:
        click.echo(json.dumps({"beta": found.beta, "tried": records(found.tried)}))
    else:
        click.echo(f"{'beta':>8}  {metric:24} {'n':>4} {'success':>8}")
        for r in found.tried.itertuples():
            value = f"{r.value:.3f} [{r.low:.3f}, {r.high:.3f}]"
            click.echo(f"{r.beta:8g}  {value:24} {r.n:4} {r.successes:8}")
        click.echo(f"beta = {found.beta:g}")
    if not found.reached:
        click.echo(f"note: {metric} jumps over {target:g}; this is the nearest", err=True)
    click.echo("note: chosen on these seeds, which are no evidence for it: report others", err=True)
    if weights is not None:
        names = ("planner.reward", "cohesion.beta")
        use = " ".join(f"--set {shlex.quote(f'{name}=@{weights}')}" for name in names)
        click.echo(f"written into {weights}; drive with {use}", err=True)
