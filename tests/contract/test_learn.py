"""The command learn: what is wrong is one line, and nothing of the user's is touched."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path

import pytest

import sumo_cohesion as sc
from sumo_cohesion.cli import terminal
from sumo_cohesion.tables.columns import LEARNED
from tests.contract import test_wrong_input
from tests.contract.test_wrong_input import Invoke, assert_one_line

invoke = test_wrong_input.invoke

RUNS = [("stalled_swerve", 1000), ("stalled_swerve", 1001), ("speeding", 1000), ("speeding", 1001)]
QUICK = ("--bootstrap", "2")
FIGURES = {"weights.png", "misfit.png", "predictions.png"}
REPORT = {".sumo-cohesion.json", "theta.toml", *FIGURES, *[f"{name}.parquet" for name in LEARNED]}


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("learn") / "demos"
    for scenario, seed in RUNS:
        rollout = sc.run(scenario, "nominal", seed, overrides={"duration": 3.0})
        rollout.write(folder / f"{scenario}-{seed}")
    return folder


@pytest.mark.parametrize(
    ("arguments", "needles"),
    [
        ([], ["DEMOS", "(sumo-cohesion learn --help)"]),
        (["nothere"], ["nothere", "no such file or folder"]),
        (["x", "--from", "me"], ["--from", "plans", "driven", "humans"]),
        (["x", "--steps", "1"], ["--steps", "2<=x<=100"]),
        (["x", "--keep", "85"], ["--keep", "0.1<=x<=1"]),
        (["x", "--keep", "nan"], ["keep nan"]),
        (["x", "--hold-out", "1"], ["--hold-out", "0.0<=x<=0.9"]),
        (["x", "--bootstrap", "-1"], ["--bootstrap", "0<=x<=100000"]),
        (["x", "--smooth", "1"], ["--smooth '1'", "two times", "1,2"]),
        (["x", "--smooth", "1,-2"], ["smooth", "two times"]),
        (["x", "--fix", "edge"], ["--fix 'edge'", "edge=500"]),
        (["x", "--fix", "edge=much"], ["--fix 'edge=much'", "edge=500"]),
        (["x", "--set", "ego.speed=20"], ["ego.speed", "planner.*"]),
        (["x", "--set", "planner.horizn=20"], ["did you mean 'horizon'"]),
    ],
)
def test_a_wrong_option_is_one_line(
    invoke: Invoke, arguments: list[str], needles: list[str]
) -> None:
    assert_one_line(invoke("learn", *arguments), *needles)
    assert not any(Path().iterdir())


@pytest.mark.slow
def test_what_these_runs_cannot_be_asked_is_one_line(invoke: Invoke, demos: Path) -> None:
    assert_one_line(invoke("learn", demos, "--fix", "egde=1"), "no term 'egde'", "edge")
    misspelt = invoke("learn", demos, "--also", "curvature_chnge")
    assert_one_line(misspelt, "'curvature_chnge'", "did you mean 'curvature_change'")
    assert_one_line(invoke("learn", demos, "--steps", "5"), "10 steps long", "--from driven")
    assert_one_line(invoke("learn", demos, "--from", "driven", "--steps", "90"), "fewer --steps")
    Path("tracks.csv").write_text("time,vehicle,x,y\n")
    assert_one_line(invoke("learn", demos, "tracks.csv"), "files hold humans", "--from humans")
    assert_one_line(invoke("learn", "tracks.csv"), "--network")
    Path("empty").mkdir()
    assert_one_line(invoke("learn", "empty"), "empty")
    assert {path.name for path in Path().iterdir()} == {"tracks.csv", "empty"}


def test_a_file_of_somebody_else_stays(invoke: Invoke) -> None:
    mine = Path("theta.toml")
    mine.write_text("[planner.reward]\nlane = 2.0  # thought about for a week\n")
    before = mine.read_bytes()
    # Told before anything is read: there is nothing to learn from.
    assert_one_line(invoke("learn", "nothere"), "theta.toml: was not written by learn", "--out")
    assert_one_line(invoke("learn", "nothere", "--out", "."), "is a folder", "--out")
    assert mine.read_bytes() == before


def test_a_folder_of_somebody_else_stays(invoke: Invoke) -> None:
    Path("thesis").mkdir()
    Path("thesis/chapter.tex").write_text("years of work")
    Path("taken").write_text("a file")
    for folder in ("thesis", "taken"):
        result = invoke("learn", "nothere", "--report", folder)
        assert_one_line(result, folder, "choose another --report")
    assert {p.name for p in Path("thesis").iterdir()} == {"chapter.tex"}
    assert Path("taken").read_text() == "a file"
    assert not Path("theta.toml").exists()


@pytest.mark.slow
def test_weights_and_report_are_replaced_and_notes_beside_them_stay(
    invoke: Invoke, demos: Path
) -> None:
    out = ("--out", "found/theta.toml", "--report", "found", *QUICK)
    status, shown, said = invoke("learn", demos, *out)
    assert status == 0, said
    found = Path("found")
    assert {path.name for path in found.iterdir()} == REPORT
    assert shown.startswith("term ")
    assert "--set planner.reward=@found/theta.toml" in said
    first = (found / "theta.toml").read_text()
    assert tomllib.loads(first)["learned"]["runs"] == len(RUNS)

    (found / "notes.md").write_text("looks good")
    (found / "fit.parquet").write_text("old")
    status, _, said = invoke("learn", demos, *out, "--hold-out", "0")
    assert status == 0, said
    # Nothing held out, nothing to draw of it; and the same weights as before.
    assert {p.name for p in found.iterdir()} == REPORT - {"predictions.png"} | {"notes.md"}
    assert (found / "theta.toml").read_text() == first
    assert (found / "notes.md").read_text() == "looks good"


@pytest.mark.slow
def test_weights_are_kept_if_the_report_cannot_be(
    invoke: Invoke, demos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sumo_cohesion.report import learned

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(learned, "save", full)
    result = invoke("learn", demos, "--report", "found", *QUICK)
    assert_one_line(result, "found", "No space left", "another --report")
    assert {path.name for path in Path().iterdir()} == {"theta.toml"}


@pytest.mark.slow
def test_json_is_all_of_stdout_and_notes_are_not(invoke: Invoke, demos: Path) -> None:
    status, out, err = invoke("learn", demos, "--json", *QUICK)
    assert status == 0, err
    said = json.loads(out)
    assert set(said) == {"weights", "fit", "temperature"}
    for name in ("weights", "fit"):
        columns = [column.name for column in LEARNED[name]]
        assert [list(row) for row in said[name]] == [columns] * len(said[name])
    lane = next(row for row in said["weights"] if row["term"] == "lane")
    assert lane["learned"] == 1.0
    assert lane["low"] is None
    assert any(line.startswith("note: ") for line in err.splitlines())
    theta = tomllib.loads(Path("theta.toml").read_text())["planner"]["reward"]
    for row in said["weights"]:
        assert theta[row["term"]] == pytest.approx(row["learned"], rel=1e-3)


@pytest.mark.slow
def test_progress_is_told_where_there_is_no_terminal(
    invoke: Invoke, demos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "_QUIET", -1.0)
    shutil.copytree(demos / "speeding-1000", "runs/one")
    shutil.copytree(demos / "speeding-1001", "runs/two")
    status, _, err = invoke("learn", "runs", "--report", "found", *QUICK)
    assert status == 0, err
    told = [line for line in err.splitlines() if line.startswith("learn: ")]
    assert told[:2] == ["learn: cutting: 1 of 2", "learn: cutting: 2 of 2"]
    for what in ("weighing: 1 of 1", "drawing runs: 2 of 2", "drawing: 0 of 1"):
        assert f"learn: {what}" in told
