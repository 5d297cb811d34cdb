"""Damaged inputs end in one line, and the tool that damages them sees what does not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable

import pytest

from sumo_cohesion import cli
from tests.conftest import ROOT

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="cases are forked")


@pytest.mark.slow
def test_two_hundred_damaged_inputs_end_in_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fuzz", "-n", "200"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def _one_line() -> None:
    os.write(2, b"error: beta.toml: cannot be read (no such file)\n")
    sys.exit(2)


def _two_lines() -> None:
    os.write(2, b"Error: this came out of SUMO\n")
    _one_line()


def _status_1() -> None:
    os.write(2, b"error: SUMO stopped: no such edge\n")
    sys.exit(1)


def _raises() -> None:
    raise KeyError("d")


@pytest.mark.parametrize(
    ("main", "verdict"),
    [
        (lambda: None, "done"),
        (_one_line, "refused"),
        (_two_lines, "UNCLEAR"),
        (_status_1, "UNCLEAR"),
        (lambda: sys.exit(2), "UNCLEAR"),
        (_raises, "TRACEBACK"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "DEAD"),
        pytest.param(signal.pause, "HANGS", marks=pytest.mark.slow),
    ],
    ids=["done", "one line", "two lines", "status 1", "nothing said", "raises", "dies", "hangs"],
)
def test_what_ends_otherwise_is_seen(
    main: Callable[[], None], verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fuzz import case

    monkeypatch.setattr(cli, "main", main)
    if verdict == "HANGS":
        monkeypatch.setattr(case, "LIMIT", 1.0)
    tried = case.Case(0, "none", {"x.toml": b""}, ("run", "x.toml"), ())
    assert case.try_case(tried).verdict == verdict


def test_the_same_seed_and_number_make_the_same_case() -> None:
    from fuzz.bases import Base
    from fuzz.case import make_case

    files = {"a.toml": b"duration = 1.0\nlane = 2\n", "b.xml": b'<net><edge id="a"/></net>'}
    bases = [Base("a", files, tuple(files), (("run", "a.toml"), ("metrics", "a")))]
    cases = [make_case(bases, 5, number) for number in range(40)]
    assert cases == [make_case(bases, 5, number) for number in range(40)]
    assert len({str(case.files) for case in cases}) > 20
