"""Beta is tuned to reward weights on real traffic."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import sumo_cohesion as sc
from tests.contract import test_wrong_input
from tests.contract.test_wrong_input import Invoke, assert_one_line

invoke = test_wrong_input.invoke

# Learned from SUMO's humans: control is dear, and with the package's own beta nobody follows.
THETA = """[planner.reward]
speed = 0.012
car = 2.3
curvature = 1.1e6
acceleration = 0.0063
"""
SHORT = {"duration": 16.0}


@pytest.mark.slow
def test_the_tuned_beta_closes_the_share_that_was_asked_for(
    invoke: Invoke, capfd: pytest.CaptureFixture[str]
) -> None:
    path = Path("theta.toml")
    path.write_text(THETA)
    few = ("--seeds", "1000:1003", "--set", "duration=16.0", "--workers", "2")
    status, out, err = invoke("tune", "theta.toml", *few, "--json")
    assert status == 0, err
    said = json.loads(out)
    first = next(row for row in said["tried"] if row["beta"] == 0.09)
    assert first["value"] < 0.4
    assert [row["n"] for row in said["tried"]] == [3] * len(said["tried"])
    assert "no evidence" in err
    assert "--set planner.reward=@theta.toml --set cohesion.beta=@theta.toml" in err
    assert path.read_text().startswith(THETA + "\n[cohesion]\nbeta = ")
    assert path.read_text().endswith("with cohesive in speeding, seeds 1000:1003, duration=16.0\n")

    files = {"planner.reward": "@theta.toml", "cohesion.beta": "@theta.toml"}
    runs = sc.compare("speeding", "cohesive", "1000:1003", overrides=SHORT | files).runs
    closed = float(runs["speed_gap_closed"].median())
    assert closed == pytest.approx(0.6, abs=0.02)
    (row,) = (row for row in said["tried"] if row["beta"] == said["beta"])
    assert row["value"] == closed
    assert row["low"] <= closed <= row["high"]
    assert row["successes"] == runs["success"].sum()


@pytest.mark.slow
def test_without_a_file_the_settings_are_tuned_for_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done: list[tuple[int, int]] = []
    found = sc.tune(
        seeds=[1000],
        target=0.9,
        overrides=SHORT,
        workers=1,
        progress=lambda *so_far: done.append(so_far),
    )
    assert found.beta > 0.09
    assert found.reached
    assert list(found.tried["beta"]) == sorted(found.tried["beta"])
    assert done == [(i + 1, i + 1) for i in range(len(found.tried))]
    assert "seeds 1000:1001" in repr(found)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_what_is_not_defined_or_not_reached_is_one_line(invoke: Invoke) -> None:
    one = ("--seeds", "1000:1001", "--workers", "1", "--set", "duration=1.0")
    assert_one_line(invoke("tune", *one), "speed_gap_closed is not defined in any run of speeding")
    impossible = ("--metric", "mean_speed", "--target", "90")
    result = invoke("tune", *one, *impossible)
    assert_one_line(
        result, "speeding, seeds 1000:1001: mean_speed does not come to 90", "nearest is 2"
    )


def test_what_is_wrong_with_the_file_is_told_before_anything_is_driven(invoke: Invoke) -> None:
    assert_one_line(invoke("tune", "theta.toml"), "theta.toml: cannot be read", "No such file")
    assert_one_line(invoke("tune", "speeding"), "no such file of weights", "--scenario")
    Path("theta.toml").write_text("[learned]\nn = 1\n")
    assert_one_line(invoke("tune", "theta.toml"), "has no planner.reward; it has learned")
    Path("theta.toml").write_text(THETA + "[cohesion]\nbeta = 1.0\n")
    assert_one_line(invoke("tune", "theta.toml"), "has a cohesion.beta that is not of tune")
    assert_one_line(invoke("tune", "--set", "cohesion.beta=1"), "is what is looked for")
    assert_one_line(invoke("tune", "--target", "much"), "'much'")
    assert_one_line(invoke("tune", "--seeds", "5:5"), "5:5", "empty")
