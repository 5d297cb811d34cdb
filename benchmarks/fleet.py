"""Cost of a hundred planned cars at once, beside SUMO's step: wall time per step.

    python -m benchmarks.fleet [--planner cohesive] [--seconds 20] [--follow-egos]

A dense five-lane highway on which every car is equipped; only steps in which at least a hundred
cars besides the ego are planned count. ``fleet_ms`` is the column of the timing table: perception,
social and planning of all of them, one after the other in one process.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.rooms import write_highway
from sumo_cohesion.perception.observation import Overview, Sensor
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.compiled import BoundCall, compiled
from sumo_cohesion.planning.solvers.ilqr import _backward_pass
from sumo_cohesion.planning.stage import StageParameters, make_stage
from sumo_cohesion.simulation import fleet as fleet_module
from sumo_cohesion.simulation.car import PlannedCar
from sumo_cohesion.simulation.fleet import Fleet
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.run import simulate
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.state import Observation, Plan
from sumo_cohesion.tables.rollout import Rollout
from sumo_cohesion.versions import versions

LANES, SPACING, AT_LEAST = 5, 16.0, 100
SCENARIO = """
name = "crowd"
summary = "A dense highway on which a planner drives every car."
network = "long.net.xml"
routes = ["crowd.rou.xml"]
duration = {duration}
[ego]
origin = "e0"
destination = "e{last}"
lane = 2
position = {position}
speed = 15.0
[sensing]
range = 200.0
[fleet]
penetration = 1.0
[success]
collision = false
"""


def write_crowd(folder: Path, seconds: float) -> Path:
    """Write a straight highway in 1 km edges, filled for a kilometre, the ego in its middle."""
    n = write_highway(folder, seconds, LANES, 15.0) + 1
    rng = np.random.default_rng(0)
    places = np.arange(20.0, 990.0, SPACING)
    middle = places.size // 2
    cars = "".join(
        f'<vehicle id="c{lane}_{i}" type="human" route="all" depart="0" departLane="{lane}" '
        f'departPos="{place + rng.uniform(-2.0, 2.0):.2f}" departSpeed="15" '
        'insertionChecks="none"/>'
        for lane in range(LANES)
        for i, place in enumerate(places)
        if (lane, i) != (2, middle)
    )
    route = " ".join(f"e{i}" for i in range(n))
    (folder / "crowd.rou.xml").write_text(
        '<routes><vType id="human" laneChangeModel="SL2015" tau="0.8" speedDev="0"/>'
        f'<route id="all" edges="{route}"/>{cars}</routes>'
    )
    path = folder / "crowd.toml"
    text = SCENARIO.format(duration=seconds, last=n - 1, position=places[middle])
    path.write_text(text, encoding="utf-8")
    return path


class Clock:
    """Seconds spent in each part of the fleet's work, per step."""

    def __init__(self) -> None:
        self.steps: list[dict[str, float]] = []

    def add(self, part: str, seconds: float) -> None:
        if self.steps:  # the ego looks around before the fleet does
            self.steps[-1][part] += seconds

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function, its wall time counted for a part."""

        def call(*arguments: Any) -> Any:
            start = perf_counter()
            result = function(*arguments)
            self.add(part, perf_counter() - start)
            return result

        return call


@contextmanager
def listening(clock: Clock) -> Iterator[None]:
    """Count what the fleet, and nobody else, spends in each room."""

    class TimedCar(PlannedCar):
        def step(self, observation: Observation) -> Plan:
            plan = super().step(observation)
            remembering, planning = self.spent
            clock.add("memory", remembering)
            clock.add("social", plan.social_time)
            clock.add("solver", plan.wall_time)
            clock.add("rest of the planner", planning - plan.social_time - plan.wall_time)
            return plan

    def drive(self: Fleet, scene: Any, overview: Any) -> Any:
        clock.steps.append(defaultdict(float))
        return whole(self, scene, overview)

    whole = Fleet.drive
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sensor, "survey", clock.timed("projection", Sensor.survey))
        patch.setattr(Overview, "seen_by", clock.timed("perception", Overview.seen_by))
        patch.setattr(fleet_module, "PlannedCar", TimedCar)
        patch.setattr(Fleet, "drive", drive)
        yield


def crowd(planner: str, seconds: float, follow: bool) -> tuple[Rollout, pd.DataFrame]:
    """One run: its rollout, and milliseconds per step and part."""
    clock = Clock()
    with tempfile.TemporaryDirectory() as folder, listening(clock):
        request = RunRequest(
            write_crowd(Path(folder), seconds), planner, 0, {"cohesion.follow_egos": follow}
        )
        setup = prepare(request)
        rollout = simulate(setup)
    table = rollout.trajectory
    others = table[table["planned"] & (table["vehicle"] != "ego")]
    count = others.groupby("time").size().reindex(rollout.timing["time"], fill_value=0)
    parts = 1e3 * pd.DataFrame([dict(step) for step in clock.steps]).fillna(0.0)
    parts["everything (fleet_ms)"] = rollout.timing["fleet_ms"]
    parts["SUMO's step and reading"] = rollout.timing["sumo_ms"]
    return rollout, parts.assign(cars=count.to_numpy())


def one_call(n: int) -> dict[str, float]:
    """Milliseconds of a derivative pass for n problems: n calls, and one of CasADi's map(n)."""
    settings = PlannerSettings()
    one = _backward_pass(
        make_stage(settings, StageParameters(settings, LANES)), settings, exact=True
    )
    functions = {"loop": (one, n), "map": (one.map(n), 1)}
    fast, _ = compiled([one, one.map(n)])
    functions |= {"loop, compiled": (fast[0], n), "map, compiled": (fast[1], 1)}
    found = {}
    for name, (function, calls) in functions.items():
        rng = np.random.default_rng(0)
        given = [rng.uniform(0.1, 1.0, function.numel_in(i)) for i in range(function.n_in())]
        out = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
        run, times = BoundCall(function, given, out), []
        for _ in range(15):
            start = perf_counter()
            for _ in range(calls):
                run()
            times.append(1e3 * (perf_counter() - start))
        found[name] = float(np.median(times))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--planner", default="cohesive")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--follow-egos", action="store_true", help="everybody remembers everybody")
    given = parser.parse_args()
    print("versions:", versions())
    rollout, parts = crowd(given.planner, given.seconds, given.follow_egos)
    full = parts[parts["cars"] >= AT_LEAST]
    row = rollout.metrics.iloc[0]
    print(
        f"{given.planner} ({rollout.info['solver']}), {len(full)} of {len(parts)} steps with at "
        f"least {AT_LEAST} planned cars, {full['cars'].median():.0f} in the median; run: "
        f"{row['outcome']}, fleet_size {row['fleet_size']}, fleet_failures "
        f"{row['fleet_failures']}, fleet_interventions {row['fleet_interventions']}, "
        f"fleet_collisions {row['fleet_collisions']}"
    )
    print(f"most memory used: {getrusage(RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    passes = ", ".join(f"{name} {ms:.1f}" for name, ms in one_call(AT_LEAST).items())
    print(f"derivatives of {AT_LEAST} problems, ms: {passes}")
    print(f"{'ms per step':28} {'median':>8} {'p99':>8} {'median per car':>15}")
    for name in parts.columns.drop("cars"):
        each = (full[name] / full["cars"]).median()
        print(f"{name:28} {full[name].median():8.1f} {full[name].quantile(0.99):8.1f} {each:15.3f}")


if __name__ == "__main__":
    main()
