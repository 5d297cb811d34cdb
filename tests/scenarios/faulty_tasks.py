"""Calls for worker processes that start children of their own; files say what has happened."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path


def fork_and_wait(pid_file: str) -> None:
    """Never return, and leave a child that never ends and holds all that this process holds."""
    _fork(pid_file)
    signal.pause()


def fork_and_crash(pid_file: str) -> None:
    """Die and leave such a child."""
    _fork(pid_file)
    os.kill(os.getpid(), signal.SIGSEGV)


def read_standard_input() -> str:
    """Return what there is to read: nothing, as the calls are not for it."""
    return sys.stdin.read()


def _fork(pid_file: str) -> None:
    child = os.fork()
    if not child:
        signal.pause()
    new = Path(pid_file).with_suffix(".new")
    new.write_text(str(child))
    new.rename(pid_file)
