"""What is asked for: one run, before anything is looked up or checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sumo_cohesion.planning.registry import AnyPlanner


@dataclass(frozen=True)
class RunRequest:
    """One run.

    Attributes
    ----------
    scenario : bundled name, or path of a TOML file.
    planner : its name; or its class or an object, which cannot leave the process.
    seed : varies the traffic; the same seed gives every planner the same traffic.
    overrides : settings by dotted name.
    """

    scenario: str | Path
    planner: AnyPlanner = "cohesive"
    seed: int = 0
    overrides: Mapping[str, Any] = field(default_factory=dict)
