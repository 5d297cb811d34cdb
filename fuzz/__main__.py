"""Damage inputs and see that each ends in one clear line: ``python -m fuzz``."""

from __future__ import annotations

import argparse
import os
import pickle
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from fuzz.bases import Base, make_bases
from fuzz.case import GOOD, Case, Ended, make_case, try_case, warm_up


def main() -> int:
    """Try N cases; 0 if all ended as they must."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("-n", type=int, default=2000, help="cases")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="one case, by its number; its files are kept")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        bases = make_bases(Path(made))
    warm_up()
    if asked.only is not None:
        case = make_case(bases, asked.seed, asked.only)
        folder = Path(tempfile.mkdtemp(prefix=f"fuzz-{asked.seed}-{asked.only}-"))
        ended = try_case(case, folder)
        print(describe(case, ended, asked.seed), ended.said, f"files in {folder}", sep="\n")
        return ended.verdict not in GOOD
    verdicts: Counter[str] = Counter()
    slowest = 0.0
    for case, ended in try_all(bases, asked.seed, range(asked.n), asked.jobs):
        verdicts[ended.verdict] += 1
        slowest = max(slowest, ended.seconds)
        if ended.verdict not in GOOD:
            print(describe(case, ended, asked.seed), flush=True)
    print(f"seed {asked.seed}: {dict(sorted(verdicts.items()))}, slowest {slowest:.1f} s")
    return any(verdict not in GOOD for verdict in verdicts)


def try_all(
    bases: Sequence[Base], seed: int, numbers: Sequence[int], jobs: int
) -> Iterator[tuple[Case, Ended]]:
    """Try cases in some processes, forked from this one so that all is loaded already."""
    pipes = []
    for job in range(jobs):
        read, write = os.pipe()
        if not os.fork():
            os.close(read)
            with os.fdopen(write, "wb") as pipe:
                for number in numbers[job::jobs]:
                    case = make_case(bases, seed, number)
                    pickle.dump((number, try_case(case)), pipe)
                    pipe.flush()
            os._exit(0)
        os.close(write)
        pipes.append(os.fdopen(read, "rb"))
    open_pipes = list(pipes)
    while open_pipes:
        for pipe in list(open_pipes):
            try:
                number, ended = pickle.load(pipe)
            except EOFError:
                open_pipes.remove(pipe)
                continue
            yield make_case(bases, seed, number), ended
    for _ in pipes:
        os.wait()


def describe(case: Case, ended: Ended, seed: int) -> str:
    """Say what was done, how it ended, and how to do it again."""
    last = ended.said.strip().splitlines()[-1:] or ["nothing said"]
    return (
        f"{ended.verdict} (status {ended.status}, {ended.seconds:.1f} s): {case.base}: "
        f"{'; '.join(case.what)}\n    {' '.join(case.command)}\n    {last[0][:300]}\n"
        f"    again: python -m fuzz --seed {seed} --only {case.number}"
    )


if __name__ == "__main__":
    sys.exit(main())
