"""Cost of the ego's own rooms beside SUMO's step, in one run, with the same traffic.

    python benchmarks/rooms.py

Perception and social together should cost no more than one SUMO step, and their share must not
grow with simulated time. The first table is `stalled`; the second drives ten minutes through a
stream of traffic and compares its first minute with its last.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd

from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.run import simulate
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.traffic.simulator import Simulator
from sumo_cohesion.versions import versions

SCENARIO = """
name = "stream"
summary = "Ten minutes in a stream of traffic on a long highway."
network = "long.net.xml"
routes = ["stream.rou.xml"]
duration = {duration}
[ego]
origin = "e0"
destination = "e{last}"
lane = 1
position = 100.0
speed = 25.0
depart = 30.0
[success]
collision = false
"""


def timed_rollout(scenario: str | Path, seed: int, overrides: dict[str, Any]) -> pd.DataFrame:
    """Return one cohesive run's timing table, with SUMO's bare step (moveToXY and step) added."""
    steps: list[float] = []
    original = Simulator.step

    def step(self: Simulator, ego: Any, others: Any) -> None:
        start = perf_counter()
        original(self, ego, others)
        steps.append(1e3 * (perf_counter() - start))

    Simulator.step = step  # type: ignore[method-assign]
    try:
        setup = prepare(RunRequest(scenario, "cohesive", seed, overrides))
        rollout = simulate(setup)
    finally:
        Simulator.step = original  # type: ignore[method-assign]
    return rollout.timing.assign(step_ms=steps[: len(rollout.timing)])


def write_highway(folder: Path, seconds: float, n_lanes: int = 3, speed: float = 25.0) -> int:
    """Write long.net.xml, straight, in 1 km edges, long enough for the drive; returns its last."""
    n = int(seconds * (speed + 5.0) / 1000) + 3
    nodes = "".join(f'<node id="n{i}" x="{1000 * i}" y="0"/>' for i in range(n + 1))
    edges = "".join(
        f'<edge id="e{i}" from="n{i}" to="n{i + 1}" numLanes="{n_lanes}" width="3.5" '
        f'speed="{speed}"/>'
        for i in range(n)
    )
    (folder / "long.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "long.edg.xml").write_text(f"<edges>{edges}</edges>")
    files = ["-n", "long.nod.xml", "-e", "long.edg.xml", "-o", "long.net.xml"]
    options = ["--offset.disable-normalization", "true", "--no-turnarounds", "true"]
    subprocess.run(["netconvert", *files, *options], cwd=folder, check=True, capture_output=True)
    return n - 1


def write_long_highway(folder: Path, minutes: float) -> Path:
    """Write such a highway with a stream on it."""
    n = write_highway(folder, 60 * minutes) + 1
    route = " ".join(f"e{i}" for i in range(n))
    flows = "".join(
        f'<flow id="f{lane}" type="human" route="all" begin="0" end="40" period="2.5" '
        f'departLane="{lane}" departSpeed="desired"/>'
        for lane in range(3)
    )
    (folder / "stream.rou.xml").write_text(
        '<routes><vType id="human" laneChangeModel="SL2015" speedDev="0.02"/>'
        f'<route id="all" edges="{route}"/>{flows}</routes>'
    )
    path = folder / "stream.toml"
    path.write_text(SCENARIO.format(duration=60 * minutes, last=n - 1))
    return path


def report(name: str, table: pd.DataFrame) -> float:
    """Print medians of one stretch; returns the share own rooms / SUMO's step."""
    own = table["perception_ms"] + table["social_ms"]
    share = float(own.median() / table["step_ms"].median())
    print(
        f"{name:34} perception {1e3 * table['perception_ms'].median():7.0f}  "
        f"social {1e3 * table['social_ms'].median():7.0f}  "
        f"SUMO step {1e3 * table['step_ms'].median():7.0f} µs   ratio {share:.2f}"
    )
    return share


def main() -> None:
    print("versions:", versions())
    shares = []
    for seed in range(5):
        table = timed_rollout("stalled", seed, {})
        shares.append(report(f"stalled, seed {seed}", table))
    print(f"stalled: median ratio of 5 seeds {np.median(shares):.2f}")
    with tempfile.TemporaryDirectory() as folder:
        path = write_long_highway(Path(folder), minutes=10.5)
        table = timed_rollout(path, 0, {"duration": 600.0})
    first, last = table.iloc[:600], table.iloc[-600:]
    a = report("stream, first 60 s of 600 s", first)
    b = report("stream, last 60 s of 600 s", last)
    print(f"growth of the ratio from the first to the last minute: {b / a:.2f}")


if __name__ == "__main__":
    main()
