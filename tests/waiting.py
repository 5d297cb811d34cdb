"""Waiting for events, never for a time: no test may depend on how fast the machine is.

What a test waits for comes, however late, or whoever should bring it has ended: then it never
will, and the test fails at once. Runs in other processes wait in turn at a `Gate`, so that no batch
ends before the test has done to it what it is about.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

HANGS = 600.0
"""Seconds after which a test hangs for good. No expectation: no event takes a tenth of it."""
_PAUSE = 0.01
Found = TypeVar("Found")


def wait_for(
    event: Callable[[], Found], process: subprocess.Popen[str] | None = None, what: str = "it"
) -> Found:
    """Return what ``event`` returns, once that is true.

    Fails if ``process``, which should bring it about, has ended without.
    """
    deadline = time.monotonic() + HANGS
    while True:
        ended = process is not None and process.poll() is not None  # asked first: it may be its end
        if found := event():
            return found
        if ended:
            raise AssertionError(f"the process ended before {what} came: {said_by(process)}")
        if time.monotonic() > deadline:
            raise AssertionError(f"{what} has not come in {HANGS:g} s: something hangs")
        time.sleep(_PAUSE)


def said_by(process: subprocess.Popen[str] | None) -> str:
    """Exit status of a process that has ended, and what it said on standard error."""
    assert process is not None
    error = process.stderr.read() if process.stderr is not None else ""
    return f"status {process.returncode} {error.strip()}"


def end_of(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Wait for a process to end by itself; its exit status and what it said on standard error."""
    try:
        _, error = process.communicate(timeout=HANGS)
    except subprocess.TimeoutExpired:
        raise AssertionError(f"the process has not ended in {HANGS:g} s: it hangs") from None
    return process.returncode, error or ""


@contextlib.contextmanager
def started(command: Sequence[str | Path], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Start a program in a session of its own; whatever the test does, it is gone afterwards."""
    process = subprocess.Popen(
        command, text=True, stderr=subprocess.PIPE, start_new_session=True, **options
    )
    with process:  # closes its pipe
        try:
            yield process
        finally:
            kill(process)


def kill(process: subprocess.Popen[str]) -> None:
    """Kill a process that `started` made, and its group, as a batch system does at last."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def is_running(pid: int) -> bool:
    """Tell whether there is such a process, other than as a zombie (Linux)."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


class Gate:
    """A folder at which runs, in whatever process, wait until the test lets them pass."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)

    def open(self) -> None:
        """Let everybody pass."""
        (self.folder / "open").touch()

    def let_pass(self, runs: int) -> None:
        """Let so many runs pass, and hold the others."""
        for i in range(runs):
            (self.folder / f"pass-{i}").touch()

    def waiting(self) -> set[int]:
        """Ids of the processes that wait, or did when they ended."""
        return {int(path.stem.rpartition("-")[2]) for path in self.folder.glob("waits-*")}

    def wait_here(self) -> None:
        """Wait: the other side, called in a run."""
        me = self.folder / f"waits-{os.getpid()}"
        me.touch()
        while not self._may_pass():
            time.sleep(_PAUSE)
        me.unlink()

    def _may_pass(self) -> bool:
        if (self.folder / "open").exists():
            return True
        for one in self.folder.glob("pass-*"):
            with contextlib.suppress(FileNotFoundError):  # another run was quicker
                one.unlink()
                return True
        return False


def hold(folder: str) -> None:
    """Wait at a gate: a task for workers."""
    Gate(Path(folder)).wait_here()
