"""The loop: SUMO, perception, planner, and back, once per step."""

from __future__ import annotations

import gc
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

from sumo_cohesion.errors import SimulationError, StoppedError
from sumo_cohesion.planning.registry import AnyPlanner
from sumo_cohesion.simulation.car import PlannedCar
from sumo_cohesion.simulation.episode import Episode, Listener
from sumo_cohesion.simulation.recorder import Recorder
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.setup import Setup, prepare
from sumo_cohesion.simulation.twin import Twin
from sumo_cohesion.social.memory import new_history
from sumo_cohesion.state import STEP
from sumo_cohesion.tables.folders import require_replaceable
from sumo_cohesion.tables.rollout import Rollout
from sumo_cohesion.traffic.outputs import Output, SumoOutputs


def run(
    scenario: str | Path,
    planner: AnyPlanner = "cohesive",
    seed: int = 0,
    *,
    overrides: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    sumo_outputs: Sequence[Output] = (),
    gui: bool = False,
    listeners: Sequence[Listener] = (),
) -> Rollout:
    """Drive one scenario once.

    Parameters
    ----------
    scenario : bundled name or path of a TOML file.
    planner : "nominal", "cohesive", "paper", "sumo", "module:Class(...)"; or a planner's class,
        made anew for this run, or an object, used as it is.
    seed : varies the traffic; the same seed gives every planner the same traffic.
    overrides : settings by dotted name, e.g. {"cohesion.beta": 0.05}.
    out : folder to write the run's tables to; nothing is written without it.
    sumo_outputs : SUMO's own outputs to add as tables: "fcd", "tripinfo", "ssm".
    gui : show SUMO's window.
    listeners : who hears of every step, besides the recorder (simulation.episode.Listener).

    Returns
    -------
    The rollout: its tables as DataFrames, its metrics as one row.

    Raises
    ------
    UserError
        If the input is wrong. Where SUMO found it in the middle of the run, what was recorded
        until then is in ``out``.
    SimulationError
        If the simulation cannot be trusted; likewise.
    """
    folder = None if out is None else Path(out)
    if folder is not None:  # before the drive, not after
        require_replaceable(folder)
    setup = prepare(RunRequest(scenario, planner, seed, overrides or {}))
    return record(setup, folder, sumo_outputs=sumo_outputs, gui=gui, listeners=listeners)


def record(
    setup: Setup,
    folder: Path | None,
    *,
    sumo_outputs: Sequence[Output] = (),
    gui: bool = False,
    listeners: Sequence[Listener] = (),
) -> Rollout:
    """Simulate, and write all that the run leaves to a folder, also if SUMO stops it."""
    if folder is None:
        return simulate(setup, sumo_outputs=sumo_outputs, gui=gui, listeners=listeners)
    with tempfile.TemporaryDirectory() as outputs:
        users = Path(outputs)
        try:
            rollout = simulate(
                setup, sumo_outputs=sumo_outputs, gui=gui, listeners=listeners, outputs=users
            )
        except (StoppedError, SimulationError) as error:
            if not isinstance(error.rollout, Rollout):
                raise
            error.rollout.write(folder, users)
            raise error.said(f"what was recorded until then is in {folder}") from None
        rollout.write(folder, users)
    return rollout


def simulate(
    setup: Setup,
    *,
    sumo_outputs: Sequence[Output] = (),
    gui: bool = False,
    listeners: Sequence[Listener] = (),
    outputs: Path | None = None,
) -> Rollout:
    """Run the loop, and add SUMO's own outputs to its tables.

    ``outputs`` is a folder for what the user's additional files make SUMO write.
    """
    if not sumo_outputs:
        return drive(setup, gui=gui, listeners=listeners, outputs=outputs)
    with tempfile.TemporaryDirectory() as folder:
        asked = SumoOutputs(tuple(sumo_outputs), Path(folder))
        asking = replace(setup, outputs=asked)
        try:
            rollout = drive(asking, gui=gui, listeners=listeners, outputs=outputs)
        except (StoppedError, SimulationError) as error:
            if isinstance(error.rollout, Rollout):
                with suppress(ParseError):  # SUMO may not have come to its end
                    error.rollout = replace(error.rollout, sumo=asked.read())
            raise
        return replace(rollout, sumo=asked.read())


def drive(
    setup: Setup,
    *,
    gui: bool = False,
    listeners: Sequence[Listener] = (),
    outputs: Path | None = None,
) -> Rollout:
    """Run the loop: observe, remember, plan, drive, step SUMO; until contact or the end."""
    history = new_history(setup.cohesion, STEP)
    ego = PlannedCar(setup.make_planner(), setup.road, history, setup.settings)
    twin: list[Twin] = [Twin(setup)] if setup.scenario.reference else []
    recorder = Recorder(setup, twin[0].rows if twin else [])
    run = Episode(setup, [*twin, recorder, *listeners], gui=gui, outputs=outputs)
    with _older_objects_left_alone(), run as episode:
        try:
            observation = episode.reset()
            while not episode.outcome:
                plan = ego.step(observation)
                observation = episode.step(plan, ego.spent)
        except (StoppedError, SimulationError) as error:
            error.rollout = recorder.rollout() if recorder.heard else None
            raise
    return recorder.rollout()


@contextmanager
def _older_objects_left_alone() -> Iterator[None]:
    """Let the garbage collector look through the run's own objects only.

    What is imported is several times as much, and looking through it can take as long as all of a
    run's solves.
    """
    if gc.get_freeze_count():  # somebody else's
        yield
        return
    gc.collect()  # or what earlier runs left would stay, too
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
