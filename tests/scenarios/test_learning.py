"""Reward weights are learned from real runs: from plans, from what was driven, from humans."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sumo_cohesion as sc
from sumo_cohesion.demonstrations.folders import runs_in
from sumo_cohesion.errors import UserError
from sumo_cohesion.learning.example import Example
from sumo_cohesion.learning.likelihood import quadratics
from sumo_cohesion.learning.segments import make_segments
from sumo_cohesion.learning.source import Kind
from sumo_cohesion.learning.tracks import Cutting
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.mpc import Mpc
from sumo_cohesion.planning.solvers.transcription import Transcription
from sumo_cohesion.planning.stage import CONTROL_SCALE, StageParameters
from sumo_cohesion.state import EGO, FloatArray

pytestmark = pytest.mark.slow  # they all learn from runs that are driven for them

SHORT = {"duration": 8.0}
RUNS = (("stalled", 1), ("speeding", 2), ("ambulance", 3))
THETA = np.array(RewardWeights().theta)
SHAPE = PlannerSettings(reward=RewardWeights().shape)


def examples(folder: Path, kind: Kind, how: Cutting | None = None) -> Sequence[Example]:
    (run,) = runs_in(folder)
    return run.source(kind).examples(how or Cutting(steps=10))


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of three short runs of the nominal planner."""
    folder = tmp_path_factory.mktemp("learning") / "demos"
    for scenario, seed in RUNS:
        sc.run(scenario, "nominal", seed, overrides=SHORT, out=folder / scenario)
    return folder


@pytest.fixture(scope="module")
def cohesive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("learning") / "cohesive"
    sc.run("speeding", "cohesive", 1, overrides=SHORT, out=folder)
    return folder


@pytest.fixture(scope="module")
def by_sumo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("learning") / "by_sumo"
    sc.run("speeding", "sumo", 1, overrides=SHORT, out=folder)
    return folder


@pytest.mark.parametrize("scenario", ["stalled", "exit"])
def test_instances_rebuilt_from_tables_are_those_that_the_planner_solved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scenario: str
) -> None:
    written: dict[tuple[float, ...], tuple[FloatArray, ...]] = {}
    controls: dict[tuple[float, ...], FloatArray] = {}
    write, solve = Transcription.write, Mpc.solve

    def note_instance(self: Transcription, problem: Any) -> Any:
        instance = write(self, problem)
        assert instance is not None
        written[tuple(problem.ego)] = tuple(np.array(part) for part in instance)
        return instance

    def note_solution(self: Mpc, problem: Any) -> Any:
        solution = solve(self, problem)
        controls[tuple(problem.ego)] = np.array(solution.controls)
        return solution

    with monkeypatch.context() as patched:
        patched.setattr(Transcription, "write", note_instance)
        patched.setattr(Mpc, "solve", note_solution)
        sc.run(scenario, "nominal", 4, overrides=SHORT, out=tmp_path / "run")
    told = examples(tmp_path / "run", "plans")
    assert [e.time for e in told] == pytest.approx(0.5 * np.arange(16) + told[0].time)
    assert not any(e.unusable for e in told)
    segments = make_segments(told, SHAPE)
    layout = StageParameters(SHAPE, told[0].road.lane_centre.shape[1])
    same = np.ones(layout.size, dtype=bool)
    for name in ("theta", "constraint_weight"):
        same[layout.columns(name)] = False
    for i, example in enumerate(told):
        start, stages, low, high, change = written[tuple(example.ego)]
        assert np.array_equal(segments.start[i], start)
        assert np.array_equal(segments.stages[i][:, same], stages[:, same])
        assert np.array_equal(segments.low[i], low)
        assert np.array_equal(segments.high[i], high)
        assert np.array_equal(segments.change[i], change)
        assert segments.controls[i] * CONTROL_SCALE == pytest.approx(
            controls[tuple(example.ego)], abs=1e-9
        )
    assert (segments.dropped == "").sum() >= 12


def test_a_plan_has_no_gradient_at_the_planners_own_weights(planned: Path) -> None:
    for scenario, _ in RUNS:
        told = examples(planned / scenario, "plans")
        segments = make_segments(told, SHAPE)
        data = quadratics(segments.where(segments.dropped == ""), SHAPE)
        data = data.where(data.penalty == 0.0)
        assert len(data.penalty) >= 10
        own = np.abs(np.einsum("k,nki->ni", THETA, data.gradient))
        parts = np.abs(THETA[:, None] * data.gradient).sum(axis=1).max(axis=1)
        assert np.median(own.max(axis=1) / parts) < 1e-4


def test_plans_of_three_runs_tell_the_planners_weights_but_for_the_edge(
    planned: Path, tmp_path: Path
) -> None:
    found = sc.learn(planned, draws=10)
    table = found.weights.set_index("term")
    assert table.loc["edge", "kept_default"] == "the demonstrations do not tell it"
    assert list(found.weights.loc[found.weights["identified"], "term"]) == [
        "lane",
        "speed",
        "car",
        "curvature",
        "acceleration",
    ]
    assert table["learned"].to_numpy() == pytest.approx(THETA, rel=0.03)
    assert found.temperature < 1e-6
    assert found.about["runs"] == 3
    assert len(found.segments) == found.about["segments"] == 48
    assert found.segments["kept"].sum() == found.about["kept"]
    assert set(found.segments["run"]) == {f"demos/{scenario}" for scenario, _ in RUNS}
    # The same driving gives the same file, byte for byte.
    again = sc.learn(planned, draws=10)
    first, second = found.write(tmp_path / "a.toml"), again.write(tmp_path / "b.toml")
    assert first.read_bytes() == second.read_bytes()
    # And it can be driven with.
    with_it = {"planner.reward": f"@{first}", "duration": 1.0}
    assert len(sc.run("speeding", "nominal", overrides=with_it).plan) == 10


def test_without_draws_only_the_anchor_is_what_others_are_relative_to(planned: Path) -> None:
    found = sc.learn(planned, draws=0)
    assert found.anchor == "lane"
    for text in (found.summary(), found.to_toml()):
        assert text.count("what the others are relative to") == 1


def test_a_term_that_is_off_by_default_is_learned_from_a_planner_that_has_it(
    tmp_path: Path,
) -> None:
    reward = {"acceleration_change": 1e-4, "curvature_change": 5.0}
    for scenario, seed in RUNS:
        overrides = SHORT | {f"planner.reward.{name}": value for name, value in reward.items()}
        sc.run(scenario, "nominal", seed, overrides=overrides, out=tmp_path / "runs" / scenario)
    found = sc.learn(tmp_path / "runs", also=list(reward), draws=0, hold_out=0.0)
    table = found.weights.set_index("term")["learned"]
    for name, value in {**reward, "speed": 0.037, "curvature": 80.0}.items():
        assert table[name] == pytest.approx(value, rel=0.05)


def test_batches_and_comparisons_demonstrate_like_runs(planned: Path, tmp_path: Path) -> None:
    """A grid of settings that a file has, and one whose points come to the same for nominal."""
    theta = tmp_path / "theta.toml"
    theta.write_text("[planner.reward]\nspeed = 0.037\nacceleration = 1.2e-4\n")
    experiment = {
        "name": "demos",
        "scenarios": ["stalled", "speeding"],
        "planners": ["nominal"],
        "seeds": "1:3",
        "set": {"duration": 8.0},
        "keep": ["trajectory", "plan", "horizon"],
        "grid": {
            "planner.reward": [f"@{theta}"],
            "planner.reward.car": [100, 100.5],
            "cohesion.beta": [0.1, 0.2],
        },
    }
    sc.batch(experiment, out=tmp_path / "batch", workers=2)
    runs = runs_in(tmp_path / "batch")
    assert len(runs) == len({run.name for run in runs}) == 2 * 2 * 2
    assert {run.settings.reward.car for run in runs} == {100.0, 100.5}
    found = sc.learn(tmp_path / "batch", draws=0)
    assert found.about["runs"] == 8
    table = found.weights.set_index("term")
    assert table["learned"].to_numpy() == pytest.approx(THETA, rel=0.05)
    assert table.loc["edge", "kept_default"]
    sc.compare("speeding", "nominal", "1:3", overrides=SHORT, out=tmp_path / "comparison")
    compared = sc.learn([tmp_path / "comparison", planned / "stalled"], draws=0)
    assert compared.about["runs"] == 3
    assert compared.weights.set_index("term").loc["speed", "learned"] == pytest.approx(
        0.037, rel=0.05
    )


def test_runs_of_a_batch_that_failed_are_left_out(tmp_path: Path) -> None:
    experiment = {
        "name": "some",
        "scenarios": ["speeding"],
        "planners": ["nominal"],
        "seeds": "1:4",
        "set": {"duration": 1.0},
        "keep": ["trajectory", "plan", "horizon"],
    }
    sc.batch(experiment, out=tmp_path / "batch", workers=1)
    part = next((tmp_path / "batch" / "runs").glob("*.parquet"))
    rows = pd.read_parquet(part)
    for failed in (1, 3):
        rows.loc[: failed - 1, "status"] = "timeout"
        rows.to_parquet(part, index=False)
        if failed < 3:
            assert len(runs_in(tmp_path / "batch")) == 2
    with pytest.raises(UserError, match="no run of the batch was done"):
        runs_in(tmp_path / "batch")


def test_plans_that_cohesion_had_a_part_in_are_dropped_and_counted(cohesive: Path) -> None:
    plan = pd.read_parquet(cohesive / "plan.parquet").iloc[::5]
    drawn = plan["reward_cohesion"] != 0.0
    assert drawn.tolist() == [False] + [True] * 15  # nobody has been seen for long enough at first
    told = examples(cohesive, "plans")
    assert [e.unusable == "cohesion had a part in it" for e in told] == drawn.tolist()
    found = sc.learn(cohesive, draws=0)
    assert found.about["dropped"] == {"cohesion had a part in it": 15}
    assert any("cohesion had a part in it: 15" in warning for warning in found.warnings)


def test_humans_are_seen_as_the_run_saw_them(by_sumo: Path) -> None:
    """Places and frames against the trajectory's own columns."""
    table = pd.read_parquet(by_sumo / "trajectory.parquet")
    told = examples(by_sumo, "humans", Cutting(steps=10, by_vehicle=True))
    assert {e.vehicle for e in told} == set(table["vehicle"])  # the ego is SUMO's, too
    at = {round(time, 3): frame for time, frame in table.groupby("time")}
    for example in told:
        now = at[round(float(example.time), 3)].set_index("vehicle")
        own = now.loc[example.vehicle]
        assert example.ego[:2] == pytest.approx((own["s"], own["d"]), abs=1e-6)
        # The speed is that of the last step's way; SUMO reports it so, too.
        assert example.ego.speed == pytest.approx(own["speed"], abs=0.05)
        assert example.ego.heading == pytest.approx(own["road_heading"], abs=0.02)
        others = now.drop(example.vehicle)
        near = np.hypot(others["x"] - own["x"], others["y"] - own["y"]) <= 150.0
        others = others[near]
        assert len(example.cars) == len(others)
        distance = (others["s"] - own["s"]) ** 2 + (others["d"] - own["d"]) ** 2
        others = others.loc[distance.sort_values(kind="stable").index]
        columns = ["s", "d", "length", "width"]
        assert example.cars[:, [0, 1, 4, 5]] == pytest.approx(others[columns], abs=1e-6)
        assert example.cars[:, 3] == pytest.approx(others["speed"], abs=0.3)
        assert example.cars[:, 2] == pytest.approx(others["road_heading"], abs=0.05)


def test_what_was_driven_is_what_the_ego_saw_and_did(planned: Path, tmp_path: Path) -> None:
    """Cars that the ego did not see are nothing to it."""
    folder = copy(planned / "speeding", tmp_path / "run")
    table = pd.read_parquet(folder / "trajectory.parquet")
    unseen = (table["vehicle"] != EGO) & (table["time"] > table["time"].iloc[0] + 4.0)
    table = table.assign(visible=~unseen)
    table.to_parquet(folder / "trajectory.parquet", index=False)
    plan = pd.read_parquet(folder / "plan.parquet")
    told = examples(folder, "driven")
    assert {e.vehicle for e in told} == {EGO}
    assert all(e.bounded for e in examples(folder, "driven", Cutting(steps=10, bounded=True)))
    states = table[table["vehicle"] == EGO].set_index("time")[["s", "d", "road_heading", "speed"]]
    times = states.index.to_numpy()
    for example in told:
        i = int(np.abs(times - example.time).argmin())
        assert example.states[:, :2] == pytest.approx(
            states.to_numpy()[i + 1 : i + 11, :2], abs=1e-6
        )
        assert example.driven == pytest.approx(
            plan[["curvature", "acceleration"]].to_numpy()[i - 1], abs=1e-3
        )
        seen = table[(np.abs(table["time"] - example.time) < 1e-3) & table["visible"]]
        assert len(example.cars) == len(seen) - 1
    assert {len(example.cars) > 0 for example in told} == {False, True}
    learned = sc.learn(folder, source="driven", draws=0)
    assert learned.about["source"] == "driven"


def test_humans_are_neither_special_nor_planned(planned: Path) -> None:
    told = examples(planned / "ambulance", "humans")
    special = set(json.loads((planned / "ambulance" / "run.json").read_text())["special"])
    assert special
    vehicles = {e.vehicle for e in told}
    assert vehicles
    assert not vehicles & (special | {EGO})


def test_tracks_shorter_than_predictions_are_learned_from_all_the_same(by_sumo: Path) -> None:
    """Nothing of them can be compared 3 s ahead."""
    table = pd.read_parquet(by_sumo / "trajectory.parquet")
    table = table[table["time"] <= table["time"].min() + 2.55]
    folder = by_sumo.parent / "short"
    shutil.copytree(by_sumo, folder)
    table.to_parquet(folder / "trajectory.parquet", index=False)
    found = sc.learn(folder, source="humans", steps=5, draws=0)
    assert found.fit["windows"].eq(0).all()
    assert found.fit["off_1s"].isna().all()
    assert found.fit["log_likelihood"].notna().any()


def copy(folder: Path, to: Path) -> Path:
    return Path(shutil.copytree(folder, to))


def refused(*args: Any, **options: Any) -> str:
    """Return what is said, in one line."""
    with pytest.raises(UserError) as caught:
        sc.learn(*args, **options)
    message = str(caught.value)
    assert message
    assert "\n" not in message
    return message


def test_there_must_be_something_to_learn_from(
    tmp_path: Path, planned: Path, by_sumo: Path
) -> None:
    assert "nothing to learn from" in refused([])
    assert "no runs there" in refused(tmp_path)
    assert "no such file or folder" in refused(tmp_path / "missing")
    assert "no such file or folder" in refused([planned, tmp_path / "missing"])
    (tmp_path / "notes.md").write_text("no recording")
    assert "notes.md" in refused(tmp_path / "notes.md")
    said = refused(by_sumo)
    assert "planner sumo left no plans" in said
    assert "--from driven" in said
    assert "cut" in refused(planned, steps=5)
    assert "no segment of 100 steps" in refused(planned / "stalled", source="driven", steps=100)


def test_nothing_counts_twice(planned: Path, tmp_path: Path) -> None:
    assert "given twice" in refused([planned, planned])
    assert "given twice" in refused([planned, planned / "stalled" / ".."])
    assert "would count twice" in refused([planned, planned / "stalled"])


def test_runs_of_one_name_are_told_apart(planned: Path, tmp_path: Path) -> None:
    both = [copy(planned / name, tmp_path / name / "run") for name in ("stalled", "speeding")]
    found = sc.learn(both, draws=0)
    assert found.about["runs"] == 2
    assert set(found.segments["run"]) == {"run", "run (2)"}


def test_damaged_tables_are_named(planned: Path, tmp_path: Path) -> None:
    def damaged(table: str, column: str, row: int) -> str:
        folder = copy(planned / "speeding", tmp_path / f"{table}-{column}")
        path = folder / f"{table}.parquet"
        frame = pd.read_parquet(path)
        frame.loc[frame.index[row], column] = np.nan
        frame.to_parquet(path, index=False)
        return refused(folder)

    for table, column in (
        ("trajectory", "s"),
        ("trajectory", "x"),
        ("trajectory", "width"),
        ("horizon", "speed"),
        ("plan", "time"),
    ):
        said = damaged(table, column, 7)
        assert f"table {table} is damaged ({column} in row 8" in said
        assert "run it again" in said


def test_tables_that_make_no_sense_are_one_line(planned: Path, tmp_path: Path) -> None:
    folder = copy(planned / "speeding", tmp_path / "none")
    path = folder / "trajectory.parquet"
    pd.read_parquet(path).assign(visible=None).to_parquet(path, index=False)
    said = refused(folder, source="driven")
    assert "its tables are not those that were written" in said


def test_tables_of_another_kind_are_named(planned: Path, tmp_path: Path) -> None:
    folder = copy(planned / "speeding", tmp_path / "torn")
    data = (folder / "horizon.parquet").read_bytes()
    (folder / "horizon.parquet").write_bytes(data[: len(data) // 2])
    assert "horizon.parquet: not a readable table" in refused(folder)
    (folder / "horizon.parquet").unlink()
    assert "horizon.parquet: is missing" in refused(folder)
    shutil.copy(folder / "plan.parquet", folder / "horizon.parquet")
    assert "its table horizon has no 's'" in refused(folder)
    other = copy(planned / "speeding", tmp_path / "mixed")
    frame = pd.read_parquet(other / "plan.parquet")
    frame.assign(time=frame["time"] + 100.0).to_parquet(other / "plan.parquet", index=False)
    assert "tables are of different runs" in refused(other)


@pytest.mark.parametrize(
    "change",
    [
        lambda info: info.pop("network"),
        lambda info: info.update(network=3),
        lambda info: info["settings"].update(horizon=-1),
        lambda info: info.update(route=["west", "nowhere"]),
        lambda info: info.update(network="gone.net.xml"),
        lambda info: info.update(hidden=None),
    ],
)
def test_a_run_that_makes_no_sense_is_named(planned: Path, tmp_path: Path, change: Any) -> None:
    folder = copy(planned / "speeding", tmp_path / "run")
    info = json.loads((folder / "run.json").read_text())
    change(info)
    (folder / "run.json").write_text(json.dumps(info))
    refused(folder)


def test_a_network_that_has_changed_is_noticed(planned: Path, tmp_path: Path) -> None:
    folder = copy(planned / "speeding", tmp_path / "run")
    info = json.loads((folder / "run.json").read_text())
    network = Path(info["network"])
    text = network.read_text().replace('shape="0.00,', 'shape="-7.00,')
    assert text != network.read_text()
    (tmp_path / "moved.net.xml").write_text(text)
    info["network"] = str(tmp_path / "moved.net.xml")
    (folder / "run.json").write_text(json.dumps(info))
    assert "network has changed" in refused(folder)


def test_runs_of_different_settings_are_not_mixed(planned: Path, tmp_path: Path) -> None:
    overrides = {"duration": 1.0, "planner.friction": 0.2}
    sc.run("speeding", "nominal", 1, overrides=overrides, out=tmp_path / "other")
    said = refused([planned / "speeding", tmp_path / "other"])
    assert "speeding and other differ in planner.friction (0.1 and 0.2)" in said


def test_a_batch_that_kept_no_plans_is_named(tmp_path: Path) -> None:
    experiment = {
        "name": "demos",
        "scenarios": ["speeding"],
        "planners": ["nominal"],
        "seeds": "1:2",
        "set": {"duration": 1.0},
        "keep": ["trajectory", "plan"],
    }
    sc.batch(experiment, out=tmp_path / "batch", workers=1)
    said = refused(tmp_path / "batch")
    assert "kept no table 'horizon'" in said
    assert 'keep = ["trajectory", "plan", "horizon"]' in said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"source": "people"}, "choose plans, driven or humans"),
        ({"desired": "fast"}, "choose limit or own"),
        ({"steps": 1}, "2 to 100 steps"),
        ({"smooth": (1.0, -1.0)}, "smooth"),
        ({"smooth": (1.0,)}, "smooth"),
        ({"smooth": (float("nan"), 1.0)}, "smooth"),
        ({"keep": 0.0}, "keep"),
        ({"keep": float("nan")}, "keep"),
        ({"hold_out": 1.0}, "hold_out"),
        ({"hold_out": float("nan")}, "hold_out"),
        ({"draws": -1}, "draws"),
        ({"fix": {"edge": -1.0}}, "fix edge=-1"),
        ({"fix": {"edge": float("nan")}}, "fix edge=nan"),
        ({"fix": {"edge": float("inf")}}, "fix edge=inf"),
        ({"fix": {"egde": 1.0}}, "no term 'egde'"),
        ({"fix": {"curvature_change": 1.0}}, "no term 'curvature_change' in use"),
        ({"also": ["curvature_chang"]}, "did you mean"),
        ({"overrides": {"planner.reward.edge": 3.0}}, "weights are learned here"),
        ({"overrides": {"planner.reward": {"edge": 3.0}}}, "weights are learned here"),
        ({"overrides": {"cohesion.beta": 3.0}}, "planner.* settings only"),
        ({"overrides": {"duration": 3.0}}, "planner.* settings only"),
        ({"overrides": {"planner.horizont": 3}}, "horizon"),
        (
            {"also": ["net_acceleration"], "overrides": {"planner.friction": 10.0}},
            "needs a friction below",
        ),
    ],
)
def test_wrong_options_are_named(planned: Path, options: dict[str, Any], said: str) -> None:
    assert said in refused(planned, **options)


def test_files_hold_humans(planned: Path, tmp_path: Path) -> None:
    path = tmp_path / "some.csv"
    path.write_text("time,vehicle,x,y\n")
    assert "files hold humans, not what a planner drove" in refused(path, source="driven")
    assert "files hold humans, not what a planner planned" in refused([planned, path])


def test_weights_that_leave_controls_without_cost_are_refused(planned: Path) -> None:
    nothing = dict.fromkeys(RewardWeights().in_use, 0.0)
    assert "cost nothing" in refused(planned, fix=nothing, draws=0)


def test_one_segment_is_enough_for_a_warning(planned: Path, tmp_path: Path) -> None:
    folder = copy(planned / "speeding", tmp_path / "run")
    plan = pd.read_parquet(folder / "plan.parquet").iloc[:1]
    plan.to_parquet(folder / "plan.parquet", index=False)
    found = sc.learn(folder)
    assert len(found.segments) == 1
    assert "1 segments from 1 runs are few" in found.warnings[0]
    assert np.isfinite(list(found.reward.theta)).all()


def test_plans_that_are_shorter_than_the_horizon_are_counted(planned: Path, tmp_path: Path) -> None:
    """As a planner of one's own may make them."""
    folder = copy(planned / "speeding", tmp_path / "run")
    horizon = pd.read_parquet(folder / "horizon.parquet")
    first = horizon["time"].min()
    horizon = horizon[(horizon["time"] > first) | (horizon["stage"] <= 4)]
    horizon.to_parquet(folder / "horizon.parquet", index=False)
    plan = pd.read_parquet(folder / "plan.parquet").drop(columns="reward_cohesion")
    plan.to_parquet(folder / "plan.parquet", index=False)
    told = examples(folder, "plans")
    assert [e.unusable for e in told] == ["a plan of another length"] + [""] * 15
    assert sc.learn(folder, draws=0).about["dropped"]["a plan of another length"] == 1


def test_segments_that_are_all_dropped_say_why(planned: Path, tmp_path: Path) -> None:
    folder = copy(planned / "speeding", tmp_path / "run")
    plan = pd.read_parquet(folder / "plan.parquet")
    plan.assign(fallback=True).to_parquet(folder / "plan.parquet", index=False)
    said = refused(folder)
    assert "nothing can be learned from 16 segments (not the planner's own optimum: 16)" in said
