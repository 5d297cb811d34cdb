"""The command ``run`` drives in a process of its own, which nothing in it can take along."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sumo_cohesion import Rollout, cli
from sumo_cohesion.batches import workers
from sumo_cohesion.batches.workers import CallFailedError
from tests.conftest import ROOT
from tests.waiting import wait_for

pytestmark = pytest.mark.slow

FAULTY = "tests.scenarios.faulty_planners:"
SHORT = ("--set", "duration=2.0")


def command(
    *arguments: str, program: str = "from sumo_cohesion.cli import main; main()"
) -> list[str]:
    return [sys.executable, "-c", f"import sys; sys.argv[1:] = {list(arguments)!r}; {program}"]


def done(line: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)


def test_the_command_itself_loads_nothing_that_can_crash(tmp_path: Path) -> None:
    out = tmp_path / "run"
    asked = ("run", "stalled", "--planner", "nominal", "--json", "--out", str(out), *SHORT)
    program = (
        "import atexit, os\n"
        "from sumo_cohesion.cli import main\n"
        "heavy = {'libsumo', 'sumolib', 'casadi', 'pandas', 'numpy', 'scipy'}\n"
        "atexit.register(lambda: os.write(2, repr(sorted(heavy & set(sys.modules))).encode()))\n"
        "main()"
    )
    ended = subprocess.run(
        [sys.executable, "-c", f"import sys\nsys.argv[1:] = {list(asked)!r}\n{program}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert ended.stderr.splitlines()[-1] == "[]"
    metrics = json.loads(ended.stdout)["metrics"]
    (row,) = Rollout.read(out).metrics.to_dict(orient="records")
    assert metrics["mean_speed"] == row["mean_speed"]
    assert metrics["pet"] is None
    assert metrics["seed"] == 0


@pytest.mark.parametrize(
    ("planner", "status", "needles"),
    [
        ("SegmentationFault", 2, ["SIGSEGV", "SegmentationFault", "--planner nominal"]),
        ("Exits", 2, ["exit status 3", "Exits", "--planner nominal"]),
        ("RaisesAtOnce", 2, ["no such road", "--traceback"]),
    ],
)
def test_a_planner_that_ends_its_process_is_one_line(
    planner: str, status: int, needles: list[str], tmp_path: Path
) -> None:
    out = tmp_path / "run"
    ended = done(
        command("run", "stalled", "--planner", FAULTY + planner, "--out", str(out), *SHORT)
    )
    assert ended.returncode == status
    assert ended.stdout == ""
    assert ended.stderr.startswith("error: ")
    assert ended.stderr.count("\n") == 1
    for needle in needles:
        assert needle in ended.stderr
    assert not any(tmp_path.iterdir())


def test_what_a_planner_prints_is_heard() -> None:
    ended = done(command("run", "stalled", "--planner", FAULTY + "Prints", "--json", *SHORT))
    assert ended.returncode == 0
    assert ended.stderr.count("thinking") == 20
    assert json.loads(ended.stdout)["metrics"]["planner"] == FAULTY + "Prints"


def test_a_crash_of_sumo_says_how_to_find_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def crash(*_: object) -> None:
        raise CallFailedError("crash", "killed by SIGSEGV", signal.SIGSEGV)

    monkeypatch.setattr(workers, "call_apart", crash)
    monkeypatch.setattr(sys, "argv", ["sumo-cohesion", "run", "stalled"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("error: SUMO crashed on these files: killed by SIGSEGV; ")
    assert "scenario export stalled" in said
    assert "netconvert" in said
    assert said.count("\n") == 1


def test_a_crash_within_sumo_is_one_line(tmp_path: Path) -> None:
    """SUMO takes a car out that is moved in the same step, and dies of it."""
    (tmp_path / "k.add.xml").write_text(
        '<additional><route id="r" edges="west east"/><calibrator id="k" edge="east" pos="0">'
        '<flow begin="0" end="100" vehsPerHour="0" route="r" type="DEFAULT_VEHTYPE"/>'
        "</calibrator></additional>"
    )
    text = (ROOT / "scenarios" / "nothing_to_follow.toml").read_text()
    text = text.replace("duration =", 'additional = ["k.add.xml"]\nduration =')
    (tmp_path / "mine.toml").write_text(text)
    near = ("--set", "ego.position=950.0", "--set", "duration=5.0", "--planner", "nominal")
    ended = done(command("run", str(tmp_path / "mine.toml"), *near))
    assert ended.returncode == 2, ended.stderr
    assert ended.stderr.startswith("error: ")
    assert ended.stderr.count("\n") == 1


def test_an_interrupt_ends_the_drive(tmp_path: Path) -> None:
    pid = tmp_path / "pid"
    name = f"{FAULTY}Tells(file={str(pid)!r})"
    process = subprocess.Popen(
        command("run", "stalled", "--planner", name, "--out", str(tmp_path / "run")),
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        # Tests that run in the background of a shell inherit that Ctrl-C is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    wait_for(pid.exists, process, "the drive")
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    assert process.returncode == 1
    assert said.strip() == "error: interrupted"
    assert [path.name for path in tmp_path.iterdir()] == ["pid"]
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)
