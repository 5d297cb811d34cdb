"""Socially cohesive driving in SUMO: an ego car that follows what nearby humans agree on.

Importing this package loads neither SUMO nor CasADi; they are loaded where they are used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sumo_cohesion.batches.batch import batch
    from sumo_cohesion.batches.comparison import Comparison, compare
    from sumo_cohesion.batches.results import load_metrics, load_rollout, load_trajectories
    from sumo_cohesion.batches.tuning import Tuning, tune
    from sumo_cohesion.demonstrations.learn import learn
    from sumo_cohesion.errors import SimulationError, UserError
    from sumo_cohesion.learning.learned import Learned
    from sumo_cohesion.planning.planners import Planner
    from sumo_cohesion.simulation.episode import Episode
    from sumo_cohesion.simulation.export import export_scenario
    from sumo_cohesion.simulation.request import RunRequest
    from sumo_cohesion.simulation.run import run
    from sumo_cohesion.simulation.scenario import load_scenario
    from sumo_cohesion.simulation.setup import prepare
    from sumo_cohesion.state import Control, Observation, Plan, RoadState
    from sumo_cohesion.tables.paired import compare_planners
    from sumo_cohesion.tables.rollout import Rollout

_HOME = {
    "Comparison": "batches.comparison",
    "Control": "state",
    "Episode": "simulation.episode",
    "Learned": "learning.learned",
    "Observation": "state",
    "Plan": "state",
    "Planner": "planning.planners",
    "RoadState": "state",
    "Rollout": "tables.rollout",
    "RunRequest": "simulation.request",
    "SimulationError": "errors",
    "Tuning": "batches.tuning",
    "UserError": "errors",
    "batch": "batches.batch",
    "compare": "batches.comparison",
    "compare_planners": "tables.paired",
    "export_scenario": "simulation.export",
    "learn": "demonstrations.learn",
    "load_metrics": "batches.results",
    "load_rollout": "batches.results",
    "load_scenario": "simulation.scenario",
    "load_trajectories": "batches.results",
    "prepare": "simulation.setup",
    "run": "simulation.run",
    "tune": "batches.tuning",
}

__all__ = [
    "Comparison",
    "Control",
    "Episode",
    "Learned",
    "Observation",
    "Plan",
    "Planner",
    "RoadState",
    "Rollout",
    "RunRequest",
    "SimulationError",
    "Tuning",
    "UserError",
    "batch",
    "compare",
    "compare_planners",
    "export_scenario",
    "learn",
    "load_metrics",
    "load_rollout",
    "load_scenario",
    "load_trajectories",
    "prepare",
    "run",
    "tune",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
