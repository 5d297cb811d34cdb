"""A closed-loop step's rooms, and what the cohesive ego adds to a scenario of 50 human cars.

    python -m benchmarks.loop [--seeds 8] [--repeats 5] [--seconds 60]

The same traffic three times per seed, in turns: bare SUMO (libsumo's steps and nothing else), the
closed loop with SUMO driving the ego, and with the cohesive planner. Medians over the seeds of the
fastest of some repeats: CPU time of whole runs (start, loop, tables), and milliseconds per step of
every room.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from math import inf
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.rooms import SCENARIO, write_highway
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.run import simulate
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.tables.rollout import Rollout
from sumo_cohesion.traffic.library import load_libsumo
from sumo_cohesion.versions import versions

HUMANS, EGO_PLACE = 50, 25
PLANNERS = ("sumo", "cohesive")


def write_platoon(folder: Path, seconds: float) -> Path:
    """Write a highway and 50 humans on three lanes, the ego in their middle."""
    last = write_highway(folder, seconds)
    cars = "".join(
        f'<vehicle id="h{i}" type="human" route="all" depart="0" departLane="{i % 3}" '
        f'departPos="{_place(i)}" departSpeed="25"/>'
        for i in range(HUMANS + 1)
        if i != EGO_PLACE
    )
    route = " ".join(f"e{i}" for i in range(last + 1))
    (folder / "stream.rou.xml").write_text(
        '<routes><vType id="human" laneChangeModel="SL2015" speedDev="0.02"/>'
        f'<route id="all" edges="{route}"/>{cars}</routes>'
    )
    path = folder / "platoon.toml"
    text = SCENARIO.format(duration=seconds, last=last).replace("depart = 30.0", "depart = 0.0")
    path.write_text(text.replace("position = 100.0", f"position = {_place(EGO_PLACE)}"))
    return path


def _place(i: int) -> int:
    """Metres: far enough apart that all are put on the road at once."""
    return 20 + 45 * (i // 3) + 15 * (i % 3)


def bare(path: Path, seed: int, steps: int) -> float:
    """CPU seconds of SUMO alone: the same start and as many steps."""
    setup = prepare(RunRequest(path, "sumo", seed))
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        sumo = load_libsumo()
        sumo.start(["sumo", *setup.write_inputs(Path(folder)).options()])
        for _ in range(steps):
            sumo.simulationStep()
        sumo.close()
        return time.process_time() - start


def looped(path: Path, planner: str, seed: int) -> tuple[float, Rollout]:
    """CPU seconds of a run in the closed loop, its planner ready."""
    setup = prepare(RunRequest(path, planner, seed))
    setup.make_planner().reset(setup.road)  # solvers are built once
    start = time.process_time()
    rollout = simulate(setup)
    return time.process_time() - start, rollout


def rooms(rollout: Rollout) -> dict[str, float]:
    """Milliseconds per step, medians."""
    t = rollout.timing
    planner = t["plan_ms"] - t["social_ms"] - t["solver_ms"]
    return {
        "perception": t["perception_ms"].median(),
        "social": t["social_ms"].median(),
        "solver": t["solver_ms"].median(),
        "rest of the planner": planner.median(),
        "SUMO: move, step, read": t["sumo_ms"].median(),
    }


def measure(path: Path, seed: int, repeats: int) -> tuple[dict[str, float], dict[str, Any]]:
    """CPU seconds of one seed's runs, and their rooms: the fastest of some repeats.

    What else the machine does can only add.
    """
    spent: dict[str, float] = {}
    shares: dict[str, Any] = {}
    for repeat in range(repeats):
        # In turns: whoever comes second finds a machine of another speed.
        for planner in PLANNERS[:: 1 if repeat % 2 else -1]:
            seconds, rollout = looped(path, planner, seed)
            if seconds < spent.get(planner, inf):
                spent[planner], shares[planner] = seconds, rooms(rollout)
        steps = round(rollout.trajectory["time"].iloc[-1] / 0.1)
        spent["bare SUMO"] = min(bare(path, seed, steps), spent.get("bare SUMO", inf))
    return spent, shares


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=60.0)
    given = parser.parse_args()
    print("versions:", versions())
    with tempfile.TemporaryDirectory() as folder:
        path = write_platoon(Path(folder), given.seconds)
        measure(path, 0, 1)  # warms up
        found = [measure(path, seed, given.repeats) for seed in range(given.seeds)]
    rows = [spent for spent, _ in found]
    shares = {planner: [of[planner] for _, of in found] for planner in PLANNERS}
    runs = pd.DataFrame(rows)
    print(
        f"{HUMANS} human cars, {len(runs)} seeds, {given.seconds:g} s; CPU s per run, the fastest "
        f"of {given.repeats}, medians:"
    )
    print(runs.median().round(2).to_string())
    added = runs["cohesive"] / runs["sumo"] - 1.0
    print(f"the cohesive ego adds {100 * added.median():.0f} % to SUMO driving the ego in the loop")
    print(f"  of each seed: {', '.join(f'{100 * a:.0f}' for a in added)}")
    ours = runs["cohesive"] / runs["bare SUMO"]
    print(f"the loop with the cohesive ego takes {ours.median():.2f} x bare SUMO")
    print("\nms per step")
    table = pd.DataFrame({name: pd.DataFrame(rows).median() for name, rows in shares.items()})
    for name in PLANNERS:
        table[f"share, {name}"] = table[name] / table[name].sum()
    print(table.round(3).to_string())


if __name__ == "__main__":
    main()
