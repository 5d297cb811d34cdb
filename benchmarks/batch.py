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
from typing import Any

import sumo_cohesion as sc
from benchmarks.rooms import write_long_highway
from sumo_cohesion.batches.batch import Progress
from sumo_cohesion.experiments.rollout import versions

RUNS = 16

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


def batched(scenario: Path, folder: Path, workers: int) -> tuple[float, float]:
    """CPU and wall time of a whole batch, with the start of its processes."""
    experiment: dict[str, Any] = {
        "scenarios": [str(scenario)],
        "planners": ["cohesive"],
        "seeds": list(range(RUNS)),
        "set": {"duration": 60.0},
    }
    before = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    start = perf_counter()
    rows = sc.batch(experiment, folder, workers=workers)
    wall = perf_counter() - start
    assert (rows["status"] == "done").all()
    after = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu = sum(
        a.ru_utime + a.ru_stime - b.ru_utime - b.ru_stime
        for a, b in zip(after, before, strict=True)
    )
    return cpu, wall


def overhead_and_throughput(folder: Path) -> None:
    scenario = write_long_highway(folder, minutes=1.5)
    cpu, wall = result(bare(scenario, 0, RUNS))
    print(f"bare loop, one process        {cpu / RUNS:6.2f} s CPU, {wall / RUNS:5.2f} s per run")
    one_cpu, one_wall = batched(scenario, folder / "one", 1)
    per_run = f"{one_cpu / RUNS:6.2f} s CPU, {one_wall / RUNS:5.2f} s per run"
    print(f"batch, one worker             {per_run}")
    print(f"CPU per run, batch / bare: {one_cpu / cpu:.3f}")
    half = RUNS // 2
    both = [bare(scenario, 0, half), bare(scenario, half, RUNS)]
    two = max(result(process)[1] for process in both)
    print(f"two bare loops at once: {wall / two:.2f} times the throughput of one")
    _, two_wall = batched(scenario, folder / "two", 2)
    print(f"two workers: {one_wall / two_wall:.2f} times the throughput of one worker")
    print(f"two workers / two bare loops: {(one_wall / two_wall) / (wall / two):.2f}")


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
