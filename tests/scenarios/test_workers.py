"""Worker processes: what a call starts ends with it, and no file of a user's breaks them."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from sumo_cohesion.batches.workers import NO_LIMITS, CallFailedError, Limits, Workers
from tests.conftest import ROOT
from tests.waiting import HANGS, wait_for

pytestmark = pytest.mark.slow

TASKS = "tests.scenarios.faulty_tasks:"

needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux")


def is_running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def failure_of(workers: Workers, *arguments: object) -> CallFailedError:
    """Make a call that must fail, in a thread: a call that never returns fails the test."""
    failures: list[CallFailedError] = []

    def call() -> None:
        try:
            workers.call(*arguments)
        except CallFailedError as error:
            failures.append(error)

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(timeout=HANGS)
    assert failures, "the call has not come back"
    return failures[0]


@needs_proc
def test_a_time_limit_ends_what_the_call_has_forked_and_does_not_wait_for_it(
    tmp_path: Path,
) -> None:
    child = tmp_path / "child"
    for seconds in (1.0, 4.0, 16.0, 64.0):  # until it was enough to get as far as the fork
        workers = Workers(TASKS + "fork_and_wait", Limits(seconds, float("inf")))
        assert failure_of(workers, str(child)).kind == "timeout"
        if child.exists():
            break
    pid = int(child.read_text())
    wait_for(lambda: not is_running(pid), what="the end of the forked child")
    workers.close()


@needs_proc
def test_a_crash_ends_what_the_call_has_forked_and_does_not_wait_for_it(tmp_path: Path) -> None:
    child = tmp_path / "child"
    workers = Workers(TASKS + "fork_and_crash", NO_LIMITS)
    failure = failure_of(workers, str(child))
    assert failure.kind == "crash"
    assert "SIGSEGV" in failure.reason
    pid = int(child.read_text())
    wait_for(lambda: not is_running(pid), what="the end of the forked child")
    workers.close()


@needs_proc
def test_what_a_call_has_forked_ends_when_the_parent_is_killed(tmp_path: Path) -> None:
    child = tmp_path / "child"
    code = (
        "from sumo_cohesion.batches.workers import NO_LIMITS, Workers\n"
        f"Workers({TASKS + 'fork_and_wait'!r}, NO_LIMITS).call({str(child)!r})\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    wait_for(child.exists, what="the fork")
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    pid = int(child.read_text())
    wait_for(lambda: not is_running(pid), what="the end of the forked child")


def test_a_run_cannot_read_the_calls() -> None:
    workers = Workers(TASKS + "read_standard_input", NO_LIMITS)
    done: list[str] = []
    thread = threading.Thread(target=lambda: done.append(workers.call()), daemon=True)
    thread.start()
    thread.join(timeout=HANGS)
    assert done == [""]
    workers.close()


OWN_PLANNER = """
import numpy as np

from sumo_cohesion.state import Control, Plan


class Straight:
    def reset(self, road):
        pass

    def plan(self, observation, history):
        return Plan((Control(0.0, 0.5),), np.array([observation.ego]), "solved")
"""


def test_modules_of_any_name_in_the_users_folder_break_no_worker(tmp_path: Path) -> None:
    """The user's own planner is still found there."""
    for name in ("calendar", "random", "queue", "pandas", "click", "sumolib", "sumo_cohesion"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('of another kind altogether')\n")
    (tmp_path / "mine.py").write_text(OWN_PLANNER)
    arguments = ["compare", "stalled", "--planners", "sumo,mine:Straight", "--seeds", "0:1"]
    arguments += ["--set", "duration=1.0", "--workers", "1"]
    # As the installed command starts: without the current folder on the path.
    code = f"import sys; sys.argv[1:] = {arguments!r}; from sumo_cohesion.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "results" / "stalled" / "comparison.json").is_file()


def test_why_a_call_failed_can_be_sent_elsewhere() -> None:
    """Dask does so with what a run on another machine came to."""
    failure = CallFailedError("crash", "killed by SIGSEGV", signal.SIGSEGV)
    again = pickle.loads(pickle.dumps(failure))
    assert (again.kind, again.reason, again.signal, str(again)) == (
        "crash",
        "killed by SIGSEGV",
        signal.SIGSEGV,
        "killed by SIGSEGV",
    )
