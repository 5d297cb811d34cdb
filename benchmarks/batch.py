"""What a batch costs beside a bare loop over run(), what a second worker gives, and 10,000 runs.

    python -m benchmarks.batch [--tiny 10000]

All ratios are of the same runs on the same machine, one after the other. The runs of the first two
parts are 60 s of a stream of traffic, about 5 s of wall time each; the tiny ones are 1 s of
`stalled` with SUMO driving.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import sumo_cohesion as sc
from benchmarks.rooms import write_long_highway
from sumo_cohesion.batches.batch import Progress
from sumo_cohesion.versions import versions

RUNS = 24

BARE = """
import json, sys, time
import sumo_cohesion as sc
scenario, first, last = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
sc.run(scenario, "cohesive", 10**6, overrides={"duration": 1.0})
cpu, wall = time.process_time(), time.perf_counter()
for seed in range(first, last):
    sc.run(scenario, "cohesive", seed, overrides={"duration": 60.0})
print(json.dumps([time.process_time() - cpu, time.perf_counter() - wall]))
"""


def bare(scenario: Path, first: int, last: int) -> subprocess.Popen[str]:
    """Start a bare loop over run() in one warm process; it prints its CPU and wall time."""
    command = [sys.executable, "-c", BARE, str(scenario), str(first), str(last)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def result(process: subprocess.Popen[str]) -> tuple[float, float]:
    said = process.communicate()[0]
    cpu, wall = json.loads(said.splitlines()[-1])
    return float(cpu), float(wall)


class Batched(NamedTuple):
    """CPU and wall time (s) of a whole batch with its start, and runs per second without it."""

    cpu: float
    wall: float
    rate: float


def batched(scenario: Path, folder: Path, workers: int) -> Batched:
    experiment: dict[str, Any] = {
        "scenarios": [str(scenario)],
        "planners": ["cohesive"],
        "seeds": list(range(RUNS)),
        "set": {"duration": 60.0},
    }
    ends: list[float] = []
    before, start = _cpu(), perf_counter()
    rows = sc.batch(
        experiment, folder, workers=workers, progress=lambda _: ends.append(perf_counter())
    )
    wall, cpu = perf_counter() - start, _cpu() - before
    assert (rows["status"] == "done").all()
    # From the first result of every worker on: what a long batch tends to.
    return Batched(cpu, wall, (RUNS - workers) / (ends[-1] - ends[workers - 1]))


def _cpu() -> float:
    """Seconds of CPU of this process and of its children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def overhead_and_throughput(folder: Path) -> None:
    scenario = write_long_highway(folder, minutes=1.5)
    cpu, wall = result(bare(scenario, 0, RUNS))
    print(f"bare loop, one process  {cpu / RUNS:6.2f} s CPU, {wall / RUNS:5.2f} s per run")
    one = batched(scenario, folder / "one", 1)
    print(f"batch, one worker       {one.cpu / RUNS:6.2f} s CPU, {one.wall / RUNS:5.2f} s per run")
    print(f"CPU per run, batch / bare: {one.cpu / cpu:.3f}")
    half = RUNS // 2
    both = [bare(scenario, 0, half), bare(scenario, half, RUNS)]
    machine = wall / max(result(process)[1] for process in both)
    print(f"two bare loops at once: {machine:.2f} times the throughput of one")
    two = batched(scenario, folder / "two", 2)
    print(f"two workers: {two.rate / one.rate:.2f} times the throughput of one worker")
    print(f"two workers / two bare loops: {two.rate / one.rate / machine:.2f}")
    print(f"two workers, start of all processes included: {one.wall / two.wall:.2f}")


def resident() -> float:
    """MB that this process holds now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def many_tiny(folder: Path, n: int) -> None:
    experiment = folder / "tiny.toml"
    experiment.write_text(
        f'scenarios = ["stalled"]\nplanners = ["sumo"]\nseeds = "0:{n}"\nset.duration = 1.0\n'
    )
    held: list[float] = []

    def note(progress: Progress) -> None:
        if progress.done % (n // 10) == 0:
            held.append(resident())

    start = perf_counter()
    rows = sc.batch(experiment, folder / "tiny", workers=2, progress=note)
    took = perf_counter() - start
    assert len(rows) == n
    print(f"{n} tiny runs: {n / took:.1f} per second with two workers")
    print("MB held by the parent, at each tenth:", " ".join(f"{mb:.0f}" for mb in held))
    code = (
        "from time import perf_counter as t; import pandas, sumo_cohesion as s;"
        f"a = t(); n = len(s.load_metrics({str(folder / 'tiny')!r})); print(n, t() - a)"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    print(f"load_metrics of {said[0]} rows: {float(said[1]):.2f} s")
    start = perf_counter()
    command = [sys.executable, "-m", "sumo_cohesion", "batch", str(experiment)]
    subprocess.run([*command, "--out", str(folder / "tiny")], check=True, stdout=subprocess.DEVNULL)
    print(
        f"running the finished batch again: {perf_counter() - start:.2f} s, Python's start included"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tiny", type=int, default=10_000)
    given = parser.parse_args()
    print("versions:", versions(), "processors:", os.cpu_count())
    with tempfile.TemporaryDirectory() as folder:
        overhead_and_throughput(Path(folder))
        if given.tiny:
            many_tiny(Path(folder), given.tiny)


if __name__ == "__main__":
    main()
