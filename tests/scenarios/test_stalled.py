"""The main job on real SUMO traffic, and that it can be repeated and written down."""

from __future__ import annotations

import inspect
import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import sumo_cohesion
from sumo_cohesion import Rollout, compare, load_metrics, run
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.tables.columns import TABLES
from tests.conftest import ROOT
from tests.waiting import Gate, is_running, started, wait_for

TIMED = ["plan_ms_median", "plan_ms_p99"]
REPEATABLE = ("trajectory", "plan", "agreement")


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both planners on two seeds of each scenario, as a user would compare them."""
    folder = tmp_path_factory.mktemp("pair")
    for scenario in ("stalled", "stalled_swerve"):
        compare(scenario, seeds=(1000, 1001), workers=2, out=folder / scenario)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["stalled", "stalled_swerve"])
def test_nominal_hits_the_car_it_cannot_see_and_cohesive_does_not(
    pair: Path, scenario: str
) -> None:
    runs = load_metrics(pair / scenario).set_index(["planner", "seed"])
    assert runs.loc["nominal", "collision"].all()
    assert (runs.loc["nominal", "collision_with"] == "stalled").all()
    assert runs.loc["nominal", "sumo_collision"].all()
    assert not runs.loc["cohesive", "collision"].any()
    assert runs.loc["cohesive", "success"].all()
    assert (runs["plan_failures"] <= 2).all()


@pytest.mark.slow
def test_the_agreement_table_says_why(pair: Path) -> None:
    rollout = Rollout.read(pair / "stalled" / "cohesive" / "seed_1000")
    ego = rollout.trajectory[rollout.trajectory["vehicle"] == "ego"]
    moving = ego[(ego["d"] > 0.5) & (ego["s"] < 680.0)]["time"]
    rows = rollout.agreement[rollout.agreement["time"].between(moving.min(), moving.max())]
    steering = rows[rows["feature"].isin(["lateral", "heading", "direction"])]
    pull = steering.groupby("group")["pull"].sum()
    assert pull.idxmax() == "position"
    at_place = rows[(rows["group"] == "position") & (rows["feature"] == "lateral")]
    assert at_place["mean"].mean() > 0.1  # to the left, as everybody went


@pytest.mark.slow
def test_tables_have_the_documented_columns_and_no_surprises(pair: Path) -> None:
    rollout = Rollout.read(pair / "stalled" / "cohesive" / "seed_1000")
    for name, columns in TABLES.items():
        documented = [c.name for c in columns if not c.name.endswith("*")]
        if name == "plan":
            documented += [f"reward_{part}" for part in RewardWeights().parts]
        assert list(getattr(rollout, name).columns) == documented
    assert np.isfinite(rollout.trajectory.select_dtypes("number")).all().all()
    assert rollout.info["versions"]["libsumo"]
    hidden = rollout.trajectory[rollout.trajectory["vehicle"] == "stalled"]
    assert len(hidden) > 0
    assert not hidden["visible"].any()
    steps = rollout.plan["time"].diff().dropna()
    assert steps.to_numpy() == pytest.approx(0.1)


@pytest.mark.slow
def test_steering_is_smooth_if_its_change_costs() -> None:
    changes, shift = [], []
    for weight in (0.0, 20000.0):
        overrides = {"duration": 25.0, "planner.reward.curvature_change": weight}
        rollout = run("stalled_swerve", "cohesive", 1000, overrides=overrides)
        plan = rollout.plan
        assert ("reward_curvature_change" in plan.columns) == (weight > 0.0)
        assert (plan["status"] == "solved").all()
        changes.append(float((plan["curvature"].diff() ** 2).sum()))
        shift.append(rollout.trajectory.query("vehicle == 'ego'")["d"].max())
    assert changes[1] < 0.9 * changes[0]
    assert min(shift) > 0.5  # both swerve


@pytest.mark.slow
def test_the_same_seed_gives_the_same_tables(pair: Path) -> None:
    first = Rollout.read(pair / "stalled" / "cohesive" / "seed_1001")
    again = run("stalled", "cohesive", 1001)  # another process, after other runs
    for name in REPEATABLE:
        pd.testing.assert_frame_equal(getattr(first, name), getattr(again, name), check_exact=True)
    pd.testing.assert_frame_equal(
        first.metrics.drop(columns=TIMED), again.metrics.drop(columns=TIMED), check_exact=True
    )


@pytest.mark.slow
def test_one_worker_and_two_give_the_same_rows(tmp_path: Path) -> None:
    tables = [
        compare(
            "stalled",
            seeds=(1002, 1003),
            workers=workers,
            overrides={"duration": 5.0},
            out=tmp_path / str(workers),
        ).runs
        for workers in (1, 2)
    ]
    pd.testing.assert_frame_equal(
        tables[0].drop(columns=TIMED), tables[1].drop(columns=TIMED), check_exact=True
    )
    for planner in ("nominal", "cohesive"):
        for name in REPEATABLE:
            files = [tmp_path / w / planner / "seed_1002" / f"{name}.parquet" for w in ("1", "2")]
            assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.slow
def test_other_seeds_give_other_traffic_but_every_planner_the_same() -> None:
    short = {"duration": 2.0}
    start = {}
    for planner in ("nominal", "cohesive", "sumo"):
        for seed in (1, 2):
            table = run("stalled", planner, seed, overrides=short).trajectory
            humans = table[(table["vehicle"] != "ego") & (table["time"] == table["time"].min())]
            start[planner, seed] = humans.reset_index(drop=True)
    pd.testing.assert_frame_equal(start["nominal", 1], start["cohesive", 1])
    pd.testing.assert_frame_equal(start["nominal", 1], start["sumo", 1])
    assert not start["nominal", 1].equals(start["nominal", 2])


@pytest.mark.slow
def test_sumo_drives_its_own_ego_around_what_it_sees() -> None:
    row = run("stalled", "sumo", 1000).metrics.iloc[0]
    assert row["success"]
    assert row["plan_failures"] == 0


class Straight:
    """A user's planner: straight on, for ever."""

    def reset(self, road: object) -> None:
        """Nothing to prepare."""

    def plan(self, observation: object, history: object) -> object:
        """Hold the speed against friction."""
        from sumo_cohesion.state import Control, Plan

        control = Control(0.0, 0.1 * observation.ego.speed)  # type: ignore[attr-defined]
        return Plan(controls=(control,), states=np.zeros((0, 4)), status="straight")


class Broken(Straight):
    """A user's planner that sometimes raises and sometimes returns nonsense."""

    calls = 0

    def plan(self, observation: object, history: object) -> object:
        """Raise in every third call, and return NaN or what no car can do in every fifth."""
        from dataclasses import replace

        from sumo_cohesion.state import Control

        self.calls += 1
        if self.calls % 3 == 0:
            raise RuntimeError("out of ideas")
        plan = super().plan(observation, history)
        if self.calls % 5 == 0:
            bad = float("nan") if self.calls % 2 else -1e300
            return replace(plan, controls=(Control(bad, 0.0),))  # type: ignore[type-var]
        return plan


@pytest.mark.slow
def test_a_users_planner_drives() -> None:
    rollout = run("stalled", "tests.scenarios.test_stalled:Straight", 1000)
    row = rollout.metrics.iloc[0]
    assert row["collision_with"] == "stalled"
    assert row["mean_speed"] == pytest.approx(25.0, abs=0.01)


@pytest.mark.slow
def test_where_plans_led_is_kept_and_a_users_planner_need_not_say() -> None:
    rollout = run("stalled", "cohesive", 1, overrides={"duration": 3.0})
    horizon = rollout.horizon.set_index(["time", "stage"])
    assert len(horizon) == 10 * len(rollout.plan)
    # What was driven first is where the ego is a step later.
    ego = rollout.trajectory.query("vehicle == 'ego'").set_index("time")
    first = horizon.xs(1, level="stage")
    later = ego.iloc[1 : len(first) + 1][["s", "d", "speed"]].to_numpy()
    assert first[["s", "d", "speed"]].to_numpy() == pytest.approx(later, abs=1e-6)
    for planner in ("Straight", "Vague"):
        name = f"tests.scenarios.test_stalled:{planner}"
        assert run("stalled", name, 0, overrides={"duration": 1.0}).horizon.empty


def test_a_planner_that_fails_is_braked_for_and_counted() -> None:
    rollout = run("stalled", "tests.scenarios.test_stalled:Broken", 0, overrides={"duration": 3.0})
    failed = rollout.plan[rollout.plan["fallback"]]
    assert len(failed) == rollout.metrics["plan_failures"].iloc[0] == 14
    line = inspect.getsourcelines(Broken.plan)[1] + 8
    assert set(failed["status"]) == {
        f"RuntimeError: out of ideas (test_stalled.py:{line})",
        "control is not finite, or not that of a car",
    }
    assert np.isfinite(rollout.trajectory.select_dtypes("number")).all().all()


@pytest.mark.slow
def test_settings_by_dotted_name_reach_their_rooms() -> None:
    overrides = {
        "cohesion.beta": 0.07,
        "planner.horizon": 3,
        "planner.reward.car": 55.0,
        "randomize.lead_spacing": [40.0, 40.0],
        "duration": 1.0,
    }
    info = run("stalled", overrides=overrides).info
    assert info["cohesion"]["beta"] == 0.07
    assert info["settings"]["horizon"] == 3
    assert info["settings"]["reward"]["car"] == 55.0
    assert info["scenario"]["randomize"]["lead_spacing"] == [40.0, 40.0]


@pytest.mark.slow
def test_a_run_survives_writing_and_reading(tmp_path: Path) -> None:
    rollout = run("stalled", seed=5, overrides={"duration": 1.0}, out=tmp_path / "run")
    again = Rollout.read(tmp_path / "run")
    assert again.info == json.loads(json.dumps(rollout.info))
    for name in TABLES:
        pd.testing.assert_frame_equal(getattr(rollout, name), getattr(again, name))
    run("stalled", seed=6, overrides={"duration": 1.0}, out=tmp_path / "run")  # replaces it
    assert Rollout.read(tmp_path / "run").info["seed"] == 6
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_public_names_exist() -> None:
    for name in sumo_cohesion.__all__:
        assert getattr(sumo_cohesion, name) is not None
    with pytest.raises(AttributeError, match="nothing"):
        _ = sumo_cohesion.nothing  # type: ignore[attr-defined]


class Vague(Straight):
    """Says nonsense of where it leads."""

    def plan(self, observation: object, history: object) -> object:
        """Drive straight on all the same."""
        from dataclasses import replace

        return replace(super().plan(observation, history), states=[[1.0], "far"])  # type: ignore[type-var]


class Dying(Straight):
    """A user's planner that takes its process with it."""

    def plan(self, observation: object, history: object) -> object:
        """End the process, as a segmentation fault would."""
        import os

        os._exit(1)


@pytest.mark.slow
def test_a_dead_worker_is_one_line_and_finished_runs_are_kept(tmp_path: Path) -> None:
    with pytest.raises(sumo_cohesion.SimulationError, match="worker process died") as error:
        compare(
            "stalled",
            ("sumo", "tests.scenarios.test_stalled:Dying"),
            (0, 1),
            workers=1,
            overrides={"duration": 1.0},
            out=tmp_path / "result",
        )
    assert "\n" not in str(error.value)
    assert not (tmp_path / "result").exists()
    kept = load_metrics(tmp_path / "result.unfinished")
    assert kept["seed"].tolist() == [0, 1]
    assert (kept["planner"] == "sumo").all()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux")
def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    gate = Gate(tmp_path / "gate")
    planner = f"tests.scenarios.faulty_planners:Held(gate='{gate.folder}')"
    code = (
        f'from sumo_cohesion import compare; compare("stalled", ["{planner}"], [0, 1], workers=2)'
    )
    with started([sys.executable, "-c", code], cwd=ROOT) as parent:
        workers = wait_for(
            lambda: pids if len(pids := gate.waiting()) == 2 else None, parent, "both runs"
        )
        assert all(map(is_running, workers))
        parent.kill()
        parent.wait()
        wait_for(lambda: not any(map(is_running, workers)), what="the workers' end")
