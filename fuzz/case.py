"""One case: which damage, which command, and whether it ended as it must."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, Literal

from fuzz.bases import Base
from fuzz.damage import damage

LIMIT = 300.0
"""Seconds after which a case hangs; most take less than one."""
MEMORY = 6e9
"""Bytes that a case may allocate."""
LONGEST = 2.0
"""Seconds that are driven; what a damaged file asks for beyond that is overruled (bounded)."""

Verdict = Literal["done", "refused", "no result", "TRACEBACK", "DEAD", "HANGS", "UNCLEAR"]
GOOD = ("done", "refused", "no result")


@dataclass(frozen=True)
class Case:
    """Damaged files and a command to read them with; made again from seed and number."""

    number: int
    base: str
    files: dict[str, bytes]
    command: tuple[str, ...]
    what: tuple[str, ...]


@dataclass(frozen=True)
class Ended:
    """How a case ended, and what it said on standard error."""

    verdict: Verdict
    status: int
    said: str
    seconds: float


def make_case(bases: Sequence[Base], seed: int, number: int) -> Case:
    """Damage one of the bases, once to three times."""
    rng = random.Random(f"{seed}/{number}")
    (base,) = rng.choices(bases, [b.weight for b in bases])
    files, what = dict(base.files), []
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        name = rng.choice(base.damaged)
        files[name], how = damage(name, files[name], rng)
        what.append(how)
    command = rng.choice(base.commands)
    return Case(number, base.name, files, bounded(command, files), tuple(what))


def bounded(command: tuple[str, ...], files: dict[str, bytes]) -> tuple[str, ...]:
    """Overrule a scenario's duration and departure that are sound but long.

    A run may last a day and depart after a week: what is tried here is its input, not that.
    """
    if command[0] != "run" or command[1] not in files:
        return command
    text = files[command[1]].decode(errors="replace")
    more = []
    for key, name in (("duration", "duration"), ("depart", "ego.depart")):
        found = re.search(rf"^{key} *= *(\S+)", text, re.MULTILINE)
        with contextlib.suppress(ValueError):
            value = float(found[1]) if found else 0.0
            if isfinite(value) and value > LONGEST:
                more += ["--set", f"{name}={LONGEST}"]
    return (*command, *more)


def warm_up() -> None:
    """Load all that cases need, in the process that they are forked from."""
    import matplotlib as mpl

    mpl.use("Agg")
    for name in (
        "sumo_cohesion.cli",
        "sumo_cohesion.batches.batch",
        "sumo_cohesion.batches.comparison",
        "sumo_cohesion.batches.results",
        "sumo_cohesion.batches.single",
        "sumo_cohesion.demonstrations.learn",
        "sumo_cohesion.demonstrations.reading",
        "sumo_cohesion.report.grid",
        "sumo_cohesion.report.paths",
        "matplotlib.pyplot",
        "matplotlib.backends.backend_agg",
        "rich.progress",
        "sumolib",
    ):
        importlib.import_module(name)
    from sumo_cohesion.simulation.request import RunRequest
    from sumo_cohesion.simulation.setup import prepare
    from sumo_cohesion.traffic.library import load_libsumo

    load_libsumo()
    for scenario in ("stalled", "exit"):  # solvers are made once per number of lanes
        setup = prepare(RunRequest(scenario, "nominal"))
        setup.make_planner().reset(setup.road)
    _drive_here()
    gc.freeze()  # forked processes look through their own objects only


def _drive_here() -> None:
    """Let runs be driven in the process that asks for them: each case has one to itself.

    So a run that crashes is seen as one, and not only as the line that the command makes of it.
    """
    from sumo_cohesion.batches import batch, comparison, workers

    def call_here(task: str, *arguments: Any) -> Any:
        module, _, name = task.partition(":")
        return getattr(importlib.import_module(module), name)(*arguments)

    class Here:
        def __init__(self, task: str, *_: Any, **__: Any) -> None:
            self._task = task

        def call(self, *arguments: Any) -> Any:
            return call_here(self._task, *arguments)

        def close(self) -> None:
            """Nothing is open."""

    workers.call_apart = call_here
    batch.Workers = comparison.Workers = Here  # type: ignore[assignment,misc,attr-defined]


def try_case(case: Case, folder: Path | None = None) -> Ended:
    """Run a case in a forked process and judge how it ended."""
    place = Path(tempfile.mkdtemp(prefix="fuzz-")) if folder is None else folder
    try:
        for name, data in case.files.items():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_bytes(data)
        return _judged(case, place)
    finally:
        if folder is None:
            shutil.rmtree(place, ignore_errors=True)


def _judged(case: Case, place: Path) -> Ended:
    start = time.monotonic()
    child = os.fork()
    if not child:
        _live(case, place)
    status = None
    while status is None and time.monotonic() - start < LIMIT:
        ended, raw = os.waitpid(child, os.WNOHANG)
        status = raw if ended else None
        time.sleep(0.005)
    seconds = time.monotonic() - start
    if status is None:
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return Ended("HANGS", 0, f"not done after {LIMIT:g} s", seconds)
    said = (place / "stderr").read_text(errors="replace")
    code = os.waitstatus_to_exitcode(status)
    return Ended(_verdict(case, code, said), code, said, seconds)


def _verdict(case: Case, status: int, said: str) -> Verdict:
    lines = said.splitlines()
    if status < 0 or status > 2:
        return "DEAD"
    if "Traceback" in said:
        return "TRACEBACK"
    if status == 0:
        return "done"
    if status == 2 and len(lines) == 1 and len(lines[0]) > 20 and lines[0].startswith("error: "):
        return "refused"
    failed = [line for line in lines if line.startswith("note: ")]
    if status == 1 and case.command[0] == "batch" and failed:
        return "no result"
    return "UNCLEAR"


def _live(case: Case, place: Path) -> None:
    """Be the process of a case; never returns."""
    status = 70
    try:
        os.setsid()
        for number, name in ((1, "stdout"), (2, "stderr")):
            file = os.open(place / name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
            os.dup2(file, number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (int(MEMORY), int(MEMORY)))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.chdir(place)
        status = _main(case.command)
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def _main(command: Sequence[str]) -> int:
    import traceback

    from sumo_cohesion import cli

    sys.argv = ["sumo-cohesion", *command]
    try:
        cli.main()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0
