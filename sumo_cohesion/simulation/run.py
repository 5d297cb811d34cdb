"""The loop: SUMO, perception, planner, and back, once per step."""

from __future__ import annotations

import gc
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import inf
from pathlib import Path
from time import perf_counter
from typing import Any

from sumo_cohesion.perception.observation import Sensor
from sumo_cohesion.planning.planners import Planner, start
from sumo_cohesion.planning.registry import make_planner
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.car import END_OF_ROUTE, ask, drive
from sumo_cohesion.simulation.fleet import Fleet
from sumo_cohesion.simulation.recorder import Ending, Recorder, Seconds
from sumo_cohesion.simulation.setup import Setup, prepare
from sumo_cohesion.social.memory import new_history
from sumo_cohesion.state import STEP, CartesianState, RoadState
from sumo_cohesion.tables.folders import require_replaceable, require_writable
from sumo_cohesion.tables.rollout import RUN_FILE, Rollout
from sumo_cohesion.traffic.contact import contacts
from sumo_cohesion.traffic.drivers import Drivers
from sumo_cohesion.traffic.outputs import Output, SumoOutputs
from sumo_cohesion.traffic.simulator import Simulator

_LOST = 10.0
"""Metres from the nearest lane of its route, or off it, beyond which the ego has left both."""


def run(
    scenario: str | Path,
    planner: str = "cohesive",
    seed: int = 0,
    *,
    overrides: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    sumo_outputs: Sequence[Output] = (),
    gui: bool = False,
) -> Rollout:
    """Drive one scenario once.

    Parameters
    ----------
    scenario : bundled name or path of a TOML file.
    planner : "nominal", "cohesive", "paper", "sumo" or "module:Class(...)".
    seed : varies the traffic; the same seed gives every planner the same traffic.
    overrides : settings by dotted name, e.g. {"cohesion.beta": 0.05}.
    out : folder to write the run's tables to; nothing is written without it.
    sumo_outputs : SUMO's own outputs to add as tables: "fcd", "tripinfo", "ssm".
    gui : show SUMO's window.

    Returns
    -------
    The rollout: its tables as DataFrames, its metrics as one row.

    Raises
    ------
    UserError
        If the input is wrong.
    SimulationError
        If the simulation cannot be trusted.
    """
    if out is not None:  # before the drive, not after
        require_replaceable(Path(out), RUN_FILE)
        require_writable(Path(out))
    setup = prepare(scenario, planner, seed, overrides)
    driver = make_planner(planner, setup.settings, setup.cohesion)
    rollout = simulate_with_outputs(setup, driver, sumo_outputs, gui=gui)
    if out is not None:
        rollout.write(Path(out))
    return rollout


def simulate_with_outputs(
    setup: Setup, planner: Planner, sumo_outputs: Sequence[Output], *, gui: bool = False
) -> Rollout:
    """Run the loop and add SUMO's own outputs to its tables."""
    if not sumo_outputs:
        return simulate(setup, planner, gui=gui)
    with tempfile.TemporaryDirectory() as folder:
        outputs = SumoOutputs(tuple(sumo_outputs), Path(folder))
        rollout = simulate(replace(setup, outputs=outputs), planner, gui=gui)
        return replace(rollout, sumo=outputs.read())


def simulate(setup: Setup, planner: Planner, *, gui: bool = False) -> Rollout:
    """Run the loop: observe, remember, plan, drive, step SUMO; until contact or the end."""
    scenario, road, sensing = setup.scenario, setup.road, setup.scenario.sensing
    sensor = Sensor(road, sensing.range, sensing.hidden, sensing.special)
    history = new_history(setup.cohesion, STEP)
    recorder, fleet = Recorder(setup, sensor), Fleet(setup)
    start(planner, road)
    with (
        _older_objects_left_alone(),
        tempfile.TemporaryDirectory() as folder,
        Simulator(setup.write_inputs(Path(folder), gui), setup.ego_size, setup.read_radius) as sumo,
    ):
        scene = sumo.insert_ego(latest=scenario.ego.depart + 60.0)
        drivers = Drivers(scenario.events, setup.not_human, setup.seed, scene.time)
        end, outcome = scene.time + scenario.duration, ""
        while not outcome:
            fleet.meet(scene, sumo)
            t0 = perf_counter()
            observation = sensor.observe(scene, fleet.not_followed)
            history.push(observation)
            t1 = perf_counter()
            plan = ask(planner, observation, history, road, setup.settings)
            t2 = perf_counter()
            others = fleet.drive(scene)
            t3 = perf_counter()
            ego = drive(scene.ego, plan, setup.settings)
            drivers.act(scene.time, sumo, others)
            sumo.step(ego, others)
            following = sumo.read()
            seconds = Seconds(t1 - t0, t2 - t1, t3 - t2, perf_counter() - t3)
            recorder.add(scene, observation, history, plan, others, seconds)
            scene = following
            touched = contacts(scene.ego, scene.ego_size, scene.states, scene.sizes)
            finished = scene.time > end - STEP / 2
            outcome = _outcome(bool(touched.size), observation.ego, scene.ego, road, finished)
        fleet.meet(scene, sumo)  # who touched whom in the last step
        names, told = [scene.ids[i] for i in touched], sumo.reported_contacts()
        return recorder.finish(
            scene, Ending(outcome, names, told, drivers.triggered, fleet.summary())
        )


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


def _outcome(
    touched: bool, ego: RoadState, there: CartesianState, road: Road, finished: bool
) -> str:
    """Why the run ends here; empty if it goes on."""
    if touched:
        return "collision"
    aside = abs(ego.d - road.nearest_lane(ego.s, ego.d))
    if _LOST < aside < inf and road.away(there.x, there.y) > _LOST:
        return "left_route"
    if ego.s > road.length - END_OF_ROUTE:
        on_route = road.lane_of(ego.s, ego.d) < road.n_route_lanes
        return "route_end" if on_route else "left_route"
    return "finished" if finished else ""
