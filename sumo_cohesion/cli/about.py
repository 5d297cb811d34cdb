"""The command that says what this installation stands on."""

from __future__ import annotations

import click


@click.command()
def info() -> None:
    """Say versions, compiler and folders: what a report of a fault should hold."""
    from sumo_cohesion.planning.solvers.compiled import SWITCH, cache_folder, find_compiler
    from sumo_cohesion.simulation.scenario import bundled
    from sumo_cohesion.versions import versions

    told = versions()
    told["SUMO (libsumo)"] = told.pop("libsumo")
    told["C compiler"] = find_compiler() or "none found; plans are the same, and take longer"
    told["compiled planners"] = f"{cache_folder()} ({SWITCH}=0 does without)"
    told["bundled scenarios"] = str(bundled("scenarios"))
    for name, said in told.items():
        click.echo(f"{name:18} {said}")
