"""The package as a person meets it at a Python prompt."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sumo_cohesion as sc
from sumo_cohesion.batches import comparison

BRIEF = {"duration": 1.0}


def test_tab_shows_what_there_is() -> None:
    assert dir(sc) == sorted(sc.__all__)
    for name in ("Observation", "Plan", "Control", "RoadState", "Planner", "load_rollout"):
        assert name in sc.__all__


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> sc.Comparison:
    """Compare two planners on one seed, shortly."""
    out = tmp_path_factory.mktemp("compared") / "here"
    return sc.compare("stalled", "nominal,sumo", "0:1", overrides=BRIEF, out=out, workers=1)


@pytest.mark.slow
def test_a_run_and_a_comparison_say_themselves_in_a_line(compared: sc.Comparison) -> None:
    assert compared.folder is not None
    rollout = sc.load_rollout(str(compared.folder / "sumo" / "seed_0000"))
    assert repr(rollout) == "<Rollout stalled, sumo, seed 0: finished, no success, 1.0 s>"
    assert repr(compared) == (
        f"<Comparison stalled, successes: nominal 0 of 1, sumo 0 of 1, in {compared.folder}>"
    )
    for said, column in ((rollout, "mean_speed"), (compared, "mean_speed")):
        html = said._repr_html_()
        assert html.startswith("<p>&lt;")
        assert column in html


def test_a_long_name_does_not_make_a_long_line() -> None:
    rows = [
        {
            "scenario": "s",
            "planner": f"m:C(a={'1' * 99}{i})",
            "seed": 0,
            "outcome": "finished",
            "success": True,
        }
        for i in range(9)
    ]
    runs = pd.DataFrame(rows)
    tables: dict[str, Any] = dict.fromkeys(
        ("trajectory", "plan", "horizon", "agreement", "timing", "reference"), runs
    )
    assert len(repr(sc.Rollout(info={}, metrics=runs, **tables))) < 200
    assert len(repr(sc.Comparison(runs, runs, None))) < 600


@pytest.mark.slow
def test_a_folder_is_read_by_its_name(compared: sc.Comparison) -> None:
    folder = str(compared.folder)
    assert sc.Rollout.read(f"{folder}/sumo/seed_0000").info["planner"] == "sumo"
    with pytest.raises(sc.UserError, match=r"holds 2 runs below; name one, e\.g\. .*seed_0000"):
        sc.load_rollout(folder)
    with pytest.raises(sc.UserError, match="no such folder"):
        sc.load_rollout("nothere")


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"seeds": 5}, r"seeds 5: is one number; write \[5\] for it alone, 0:5"),
        ({"seeds": [0.0]}, "0.0 is no valid integer"),
        ({"seeds": [True]}, "True is no valid integer"),
        ({"seeds": "0:x"}, "seeds '0:x': write 0:20"),
        ({"seeds": [1, 2, 1]}, "seed 1 is listed twice"),
        ({"seeds": []}, "at least one planner and one seed"),
        ({"planners": "cohesive,cohesive"}, "planner cohesive is listed twice"),
        ({"planners": "cohesiv"}, "did you mean 'cohesive'"),
        ({"planners": ""}, "at least one planner"),
    ],
)
def test_what_is_asked_wrongly_is_told(asked: dict[str, Any], said: str) -> None:
    with pytest.raises(sc.UserError, match=said):
        sc.compare("stalled", **asked)


@pytest.mark.parametrize("seeds", ["0:2", [0, 1], range(2), np.arange(2), (0, 1)], ids=repr)
def test_seeds_are_read_alike_however_given(seeds: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def stop(jobs: Any, *_: object) -> None:
        asked.extend(job.request.seed for job in jobs)
        raise sc.UserError("enough")

    monkeypatch.setattr(comparison, "_run_all", stop)
    with pytest.raises(sc.UserError, match="enough"):
        sc.compare("stalled", "sumo", seeds)
    assert asked == [0, 1]
    assert all(type(seed) is int for seed in asked)


def test_looking_for_repeats_is_no_work_for_many_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = 0

    class Seed(int):
        def __eq__(self, other: object) -> bool:
            nonlocal compared
            compared += 1
            return int(self) == other

        __hash__ = int.__hash__

    def stop(*_: object) -> None:
        raise sc.UserError("enough")

    monkeypatch.setattr(comparison, "prepare", stop)
    with pytest.raises(sc.UserError, match="enough"):
        sc.compare("stalled", ("nominal", "sumo"), [Seed(i) for i in range(1000)])
    assert compared < 10_000


@pytest.mark.slow
def test_a_planner_that_raises_in_reset_keeps_its_own_exception(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    planner = "tests.scenarios.faulty_planners:RaisesAtOnce"
    with pytest.raises(sc.UserError, match=r"no such road \(faulty_planners\.py:\d+\)") as raised:
        sc.run("stalled", planner, overrides=BRIEF)
    assert isinstance(raised.value.__cause__, ValueError)
    with pytest.raises(sc.UserError, match="no such road") as raised:
        sc.compare("stalled", [planner], [0], overrides=BRIEF)
    assert "raise ValueError" in raised.value.__notes__[-1]


class Asked:
    """SUMO's library, as far as its version is asked for."""

    def __init__(self, version: str) -> None:
        self._version = version

    def getVersion(self) -> tuple[int, str]:  # noqa: N802 - SUMO's name
        return 22, self._version


@pytest.mark.parametrize(
    ("said", "version"),
    [
        ("SUMO 1.24.0", (1, 24)),
        ("SUMO 1.28.0", (1, 28)),
        ("SUMO v1_26_0+0123-abcdef", (1, 26)),
    ],
)
def test_sumos_version_is_that_of_sumo_itself(said: str, version: tuple[int, int]) -> None:
    from sumo_cohesion.traffic.library import sumo_version

    assert sumo_version(Asked(said)) == version


def test_a_sumo_that_is_too_old_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    from sumo_cohesion.traffic.library import load_libsumo

    monkeypatch.setitem(sys.modules, "libsumo", Asked("SUMO 1.22.0"))
    with pytest.raises(sc.UserError, match=r"libsumo 1\.22 is too old; pip install --upgrade"):
        load_libsumo()


@pytest.mark.slow
def test_what_a_settings_file_says_is_kept_with_every_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("theta.toml").write_text("[planner.reward]\nspeed = 0.012\n[cohesion]\nbeta = 0.36\n")
    files = {"planner.reward": "@theta.toml", "cohesion.beta": "@theta.toml"}
    values = {"planner.reward": {"speed": 0.012}, "cohesion.beta": 0.36}
    sc.run("stalled", overrides=BRIEF | files, out="one")
    sc.compare("stalled", "cohesive", [0], overrides=BRIEF | files, out="several", workers=1)
    same = sc.run("stalled", overrides=BRIEF | values)
    for folder in ("one", "several/cohesive/seed_0000"):
        rollout = sc.Rollout.read(folder)
        assert rollout.info["settings"]["reward"]["speed"] == 0.012
        assert rollout.info["cohesion"]["beta"] == 0.36
        pd.testing.assert_frame_equal(rollout.plan, same.plan)
    about = json.loads(Path("several/comparison.json").read_text())
    assert about["overrides"] == BRIEF | values
