"""Socially cohesive driving in SUMO: an ego car that follows what nearby humans agree on.

Importing this package loads neither SUMO nor CasADi; they are loaded where they are used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sumo_cohesion.errors import SimulationError, UserError
    from sumo_cohesion.experiments.comparison import Comparison, compare, load_metrics
    from sumo_cohesion.experiments.export import export_scenario
    from sumo_cohesion.experiments.rollout import Rollout
    from sumo_cohesion.experiments.scenario import load_scenario
    from sumo_cohesion.experiments.simulation import run

_HOME = {
    "Comparison": "experiments.comparison",
    "Rollout": "experiments.rollout",
    "SimulationError": "errors",
    "UserError": "errors",
    "compare": "experiments.comparison",
    "export_scenario": "experiments.export",
    "load_metrics": "experiments.comparison",
    "load_scenario": "experiments.scenario",
    "run": "experiments.simulation",
}

__all__ = [
    "Comparison",
    "Rollout",
    "SimulationError",
    "UserError",
    "compare",
    "export_scenario",
    "load_metrics",
    "load_scenario",
    "run",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
