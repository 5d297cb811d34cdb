"""Options that several commands have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import click

PLANNER_HELP = (
    "nominal, cohesive, paper, sumo, or your own as module:Class, file.py:Class or "
    "'module:Class(gain=2.5)'."
)


@dataclass
class Asked:
    """What a command was asked for besides its work; None if it has no such option."""

    traceback: bool | None = None


def _remember(context: click.Context, _: click.Parameter, value: bool) -> None:
    asked = context.find_object(Asked)
    if asked is not None:
        asked.traceback = value


traceback = click.option(
    "--traceback",
    is_flag=True,
    expose_value=False,
    callback=_remember,
    help="If a planner of your own raises: show where, in full.",
)
changes = click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="NAME=VALUE",
    help="Change a setting, e.g. cohesion.beta=0.05, planner.horizon=10, ego.speed=20.",
)
workers = click.option(
    "--workers", type=click.IntRange(min=1), help="Processes. Default: one per core."
)


def parsed_overrides(given: Sequence[str]) -> dict[str, Any]:
    """Return settings by dotted name, from the values of --set."""
    from sumo_cohesion.simulation.scenario import parse_overrides

    return parse_overrides(given)
