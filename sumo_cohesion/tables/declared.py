"""Which metrics there are: declared where they are worked out (tables.metrics), evaluated here."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from sumo_cohesion.state import EGO, STOPPED
from sumo_cohesion.tables.column import Column

if TYPE_CHECKING:
    import pandas as pd

SUCCESS = Column("success", "bool", "", "every condition of the scenario's [success] holds")
METRICS: list[Column] = [
    Column("scenario", "string", "", "scenario name"),
    Column("planner", "string", "", "planner name"),
    Column("seed", "int64", "", "seed of demand and SUMO"),
    SUCCESS,
]
"""All columns of the table, in order: which run it is, then what follows below."""
OF_REFERENCE: list[str] = []
"""Metrics that need a scenario's ``reference``."""


class Measured(NamedTuple):
    """What a metric may be worked out from: its arguments bear these names.

    Attributes
    ----------
    info : the run's run.json.
    ego, others : rows of the trajectory.
    humans : those of the others that SUMO drove and that are neither hidden nor special.
    plan, agreement, timing, reference : the tables.
    speed_features : social features that set the speed and do not steer.
    """

    info: Mapping[str, Any]
    ego: pd.DataFrame
    others: pd.DataFrame
    humans: pd.DataFrame
    plan: pd.DataFrame
    agreement: pd.DataFrame
    timing: pd.DataFrame
    reference: pd.DataFrame
    speed_features: Collection[str]


Function = TypeVar("Function", bound=Callable[..., Any])
_FUNCTIONS: list[tuple[Callable[..., Any], tuple[str, ...], tuple[str, ...]]] = []
"""Functions, the names of their columns and those of their arguments."""


def metric(*columns: Column) -> Callable[[Function], Function]:
    """Declare the columns that a function fills."""

    def declared(function: Function) -> Function:
        needs, names = tuple(inspect.signature(function).parameters), [c.name for c in columns]
        _FUNCTIONS.append((function, tuple(names), needs))
        METRICS.extend(columns)
        if "reference" in needs:
            OF_REFERENCE.extend(names)
        return function

    return declared


def run_metrics(
    info: Mapping[str, Any],
    trajectory: pd.DataFrame,
    plan: pd.DataFrame,
    agreement: pd.DataFrame,
    timing: pd.DataFrame,
    reference: pd.DataFrame,
) -> dict[str, Any]:
    """All metrics of one run, by name."""
    ego = trajectory[trajectory["vehicle"] == EGO]
    others = trajectory[trajectory["vehicle"] != EGO]
    # A planned car that has touched something is handed to SUMO, but is no human's to drive.
    not_human = [*info["hidden"], *info["special"], *info["fleet"]["touched"]]
    humans = others[~(others["vehicle"].isin(not_human) | others["planned"])]
    speed = [name for name, steers in info["features"].items() if not steers]
    measured = Measured(info, ego, others, humans, plan, agreement, timing, reference, speed)
    row: dict[str, Any] = {
        "scenario": info["scenario"]["name"],
        "planner": info["planner"],
        "seed": info["seed"],
    }
    for function, names, needs in _FUNCTIONS:
        found = function(**{name: getattr(measured, name) for name in needs})
        row |= found if isinstance(found, Mapping) else {names[0]: found}
    row["success"] = succeeded(row, info["scenario"]["success"])
    return row


def succeeded(row: Mapping[str, Any], conditions: Mapping[str, Any]) -> bool:
    """Tell whether every condition of a scenario's [success] holds; a NaN never does.

    Of a run that SUMO stopped nobody knows how it would have ended: it is no success.

    >>> succeeded({"collision": False, "distance": 640.0}, {"distance": {"min": 600}})
    True
    """
    if row.get("outcome") == STOPPED:
        return False
    for name, wanted in conditions.items():
        value = row[name]
        if isinstance(wanted, Mapping):
            low, high = wanted.get("min"), wanted.get("max")
            if not (low is None or value >= low) or not (high is None or value <= high):
                return False
        elif value != wanted:
            return False
    return True
