"""The loop: SUMO, perception, planner, and back, once per step."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from sumo_cohesion.experiments.rollout import (
    RUN_FILE,
    Ending,
    Recorder,
    Rollout,
    require_replaceable,
)
from sumo_cohesion.experiments.setup import Setup, prepare
from sumo_cohesion.perception.history import History
from sumo_cohesion.perception.observation import Sensor
from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.fallback import fallback
from sumo_cohesion.planning.planners import Planner, make_planner
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.social.memory import new_history
from sumo_cohesion.state import CartesianState, Observation, Plan, Scene
from sumo_cohesion.traffic.contact import contacts
from sumo_cohesion.traffic.drivers import Drivers
from sumo_cohesion.traffic.outputs import Output, SumoOutputs
from sumo_cohesion.traffic.simulator import STEP_LENGTH, Simulator

END_OF_ROUTE = 20.0
"""Metres before the end of the route at which a run is over; SUMO would remove the ego there."""


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
    planner : "nominal", "cohesive", "paper", "sumo" or "module:Class".
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
    if out is not None:
        require_replaceable(Path(out), RUN_FILE)  # before the drive, not after
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
    scenario, road = setup.scenario, setup.road
    sensing, size = scenario.sensing, (scenario.ego.length, scenario.ego.width)
    sensor = Sensor(road, sensing.range, sensing.hidden, sensing.special)
    history = new_history(setup.cohesion, STEP_LENGTH)
    recorder = Recorder(setup, sensor)
    planner.reset(road)
    with (
        tempfile.TemporaryDirectory() as folder,
        Simulator(setup.write_inputs(Path(folder), gui), size, sensing.range + 50.0) as sumo,
    ):
        scene = sumo.insert_ego(latest=scenario.ego.depart + 60.0)
        drivers = Drivers(scenario.events, setup.not_human, setup.seed, scene.time)
        end, outcome = scene.time + scenario.duration, ""
        while not outcome:
            t0 = perf_counter()
            observation = sensor.observe(scene)
            history.push(observation)
            t1 = perf_counter()
            plan = _plan(planner, observation, history, setup)
            t2 = perf_counter()
            ego = _drive(scene, plan, setup.settings)
            drivers.act(scene.time, sumo)
            sumo.step(ego)
            following = sumo.read()
            t3 = perf_counter()
            recorder.add(scene, observation, history, plan, (t1 - t0, t2 - t1, t3 - t2))
            scene = following
            touched = contacts(scene.ego, scene.ego_size, scene.states, scene.sizes)
            if touched.size:
                outcome = "collision"
            elif observation.ego.s > road.length - END_OF_ROUTE:
                outcome = "route_end"
            elif scene.time > end - STEP_LENGTH / 2:
                outcome = "finished"
        names = [scene.ids[i] for i in touched]
        ended = Ending(outcome, names, sumo.reported_contacts(), drivers.triggered)
        return recorder.finish(scene, ended)


def _plan(planner: Planner, observation: Observation, history: History, setup: Setup) -> Plan:
    """Ask the planner; whatever goes wrong in it, the ego gets a plan and it is counted."""
    try:
        plan = planner.plan(observation, history)
        usable = all(math.isfinite(v) for control in plan.controls[:1] for v in control)
        status = "control is not finite"
    except MemoryError:
        raise  # a car cannot drive on without memory; the run ends
    except Exception as error:
        usable, status = False, f"{type(error).__name__}: {error}"
    return plan if usable else fallback(observation, setup.road, setup.settings, status)


def _drive(scene: Scene, plan: Plan, settings: PlannerSettings) -> CartesianState | None:
    """Where the first planned control takes the ego; None if SUMO drives it."""
    if not plan.controls:
        return None
    x, y, heading, speed = dynamics.step(
        scene.ego, plan.controls[0], STEP_LENGTH, settings.friction
    )
    return CartesianState(float(x), float(y), float(heading), max(float(speed), 0.0))
