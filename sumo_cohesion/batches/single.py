"""One run as the command line does it: its tables written, a small result sent back.

Importing it is cheap: the process that asks for a run loads nothing of what drives it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from sumo_cohesion.tables.rollout import Rollout
    from sumo_cohesion.traffic.outputs import Output

TASK = f"{__name__}:drive"
"""What a worker is asked to do."""


class Driven(NamedTuple):
    """What is told of a run: its metrics as plain values, None where unknown, and notes."""

    metrics: dict[str, Any]
    notes: tuple[str, ...]


def drive(
    scenario: str,
    planner: str,
    seed: int,
    changes: Sequence[str],
    out: Path | None,
    sumo_outputs: Sequence[Output] = (),
    gui: bool = False,
) -> Driven:
    """Drive one scenario once, as simulation.run.run does; ``changes`` are written NAME=VALUE."""
    from sumo_cohesion.simulation.run import run
    from sumo_cohesion.simulation.scenario import parse_overrides

    overrides = parse_overrides(changes)
    rollout = run(
        scenario, planner, seed, overrides=overrides, out=out, sumo_outputs=sumo_outputs, gui=gui
    )
    (row,) = rollout.metrics.to_dict(orient="records")
    metrics = {str(name): _plain(value) for name, value in row.items()}
    return Driven(metrics, tuple(_notes(rollout, planner)))


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _notes(rollout: Rollout, planner: str) -> list[str]:
    """Return what a user should know that the metrics do not say."""
    notes = list(rollout.info["notes"])
    failed = rollout.plan[rollout.plan["fallback"]]
    if len(failed):
        notes.append(
            f"the planner failed in {len(failed)} of {len(rollout.plan)} steps, first with "
            f"{failed['status'].iloc[0]!r}; the ego braked in its lane instead"
        )
    lights = rollout.info["traffic_lights"]
    if lights and planner != "sumo":
        notes.append(
            f"the ego's route passes {len(lights)} traffic lights, which its planner does not know "
            "and does not stop at"
        )
    return notes
