"""Commands about scenarios: what there is, and one for plain SUMO."""

from __future__ import annotations

from pathlib import Path

import click

from sumo_cohesion.cli import options


@click.command()
def scenarios() -> None:
    """List the bundled scenarios, one line each."""
    from sumo_cohesion.simulation.scenario import load_scenario, scenario_files

    for path in scenario_files():
        click.echo(f"{path.stem:20} {load_scenario(path.stem).summary}")


@click.group()
def scenario() -> None:
    """Work with one scenario."""


@scenario.command("export")
@click.argument("name", metavar="SCENARIO")
@click.option("--seed", type=int, default=0, show_default=True)
@options.changes
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder to write.")
def export(name: str, seed: int, changes: tuple[str, ...], out: Path) -> None:
    """Write SCENARIO for plain SUMO: sumo-gui -c OUT/scenario.sumocfg."""
    from sumo_cohesion.simulation.export import export_scenario

    click.echo(export_scenario(name, out, seed=seed, overrides=options.parsed_overrides(changes)))
