"""One run stepped from outside, planners as objects, listeners, and runs that SUMO stops."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sumo_cohesion import Rollout, SimulationError, UserError, compare, run
from sumo_cohesion.errors import StoppedError
from sumo_cohesion.planning.registry import make_planner
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.car import PlannedCar
from sumo_cohesion.simulation.episode import Ending, Episode, Moment
from sumo_cohesion.simulation.recorder import Recorder
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.setup import Setup, prepare
from sumo_cohesion.social.memory import new_history
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.state import STEP, Control, Observation, Plan, Scene
from sumo_cohesion.traffic.simulator import Simulator
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

SHORT = {"duration": 2.0}


def setup_of(scenario: str = "stalled", planner: str = "cohesive", **overrides: Any) -> Setup:
    return prepare(RunRequest(scenario, planner, 3, {**SHORT, **overrides}))


def same(a: Rollout, b: Rollout) -> None:
    for name in ("trajectory", "plan", "horizon", "agreement"):
        pd.testing.assert_frame_equal(getattr(a, name), getattr(b, name))


def test_stepped_from_outside_it_is_the_run_again_and_again() -> None:
    setup, expected = setup_of(), run("stalled", "cohesive", 3, overrides=SHORT)
    recorder = Recorder(setup)
    with Episode(setup, [recorder]) as episode:
        assert not episode.truncated
        for _ in range(2):
            ego = PlannedCar(
                setup.make_planner(), setup.road, new_history(setup.cohesion, STEP), setup.settings
            )
            observation = episode.reset()
            assert not episode.terminated
            assert not episode.truncated
            while not episode.outcome:
                assert observation is episode.observation
                observation = episode.step(ego.step(observation))
            assert episode.outcome == "finished"
            assert episode.truncated
            assert not episode.terminated
            for _ in range(2):
                same(recorder.rollout(), expected)


def test_a_control_drives_the_ego_and_none_leaves_it_to_sumo() -> None:
    with Episode(setup_of()) as episode:
        with pytest.raises(SimulationError, match="not started"):
            episode.step(None)
        before = episode.reset().ego
        after = episode.step(Control(0.0, 2.0 + 0.1 * before.speed)).ego
        assert after.speed == pytest.approx(before.speed + 0.2)
        assert after.s == pytest.approx(before.s + STEP * after.speed)
        time = episode.scene.time
        episode.step(None)
        assert episode.scene.time == pytest.approx(time + STEP)
        while not episode.outcome:
            episode.step(Control(0.0, -100.0))
        assert episode.observation.ego.speed == 0.0  # and no car reverses
        with pytest.raises(SimulationError, match=r"the episode is over \(finished\)"):
            episode.step(None)


def test_a_closed_episode_drives_nobody_elses_run() -> None:
    with Episode(setup_of()) as first:
        first.reset()
    assert first.outcome == "closed"
    assert first.truncated
    with Episode(setup_of()) as second:
        second.reset()
        before = second.scene.time
        with pytest.raises(SimulationError, match="closed"):
            first.step(None)
        second.step(None)
        assert second.scene.time == pytest.approx(before + STEP)


def test_a_collision_terminates() -> None:
    class Ear:
        heard: list[Moment]
        ending: Ending | None = None

        def on_step(self, moment: Moment) -> None:
            self.heard.append(moment)

        def on_end(self, ending: Ending) -> None:
            self.ending = ending

    ear = Ear()
    ear.heard = []
    with Episode(setup_of(duration=60.0), [ear]) as episode:
        episode.reset()
        while not episode.outcome:
            episode.step(Control(0.0, 2.5))  # straight on
        assert episode.terminated
        assert not episode.truncated
    assert ear.ending is not None
    assert ear.ending.outcome == "collision"
    assert ear.ending.touched == ("stalled",)
    times = [moment.scene.time for moment in ear.heard]
    assert np.diff(times) == pytest.approx(STEP)
    assert ear.ending.scene.time == pytest.approx(times[-1] + STEP)


class Steady:
    """Keeps its speed; says of itself what the tables do not know."""

    made = 0

    def __init__(self) -> None:
        type(self).made += 1
        self.resets = 0

    def reset(self, road: Road) -> None:
        self.resets += 1
        self.states = np.zeros((2, 4))

    def plan(self, observation: Observation, history: object) -> Plan:
        self.states[:] = observation.ego  # the same array for every plan
        return Plan(
            controls=(Control(0.0, 0.1 * observation.ego.speed),),
            states=self.states,
            status="steady",
            reward={"comfort": observation.ego.s, "mood": "good"},  # type: ignore[dict-item]
        )


def test_a_planner_may_be_a_class_or_an_object() -> None:
    planner, made = Steady(), Steady.made
    by_object = run("stalled", planner, 3, overrides=SHORT)
    assert planner.resets == 1
    assert Steady.made == made
    by_class = run("stalled", Steady, 3, overrides=SHORT)
    assert Steady.made == made + 1
    same(by_object, by_class)
    name = f"{__name__}:Steady"
    assert by_object.metrics["planner"].iloc[0] == name
    same(run("stalled", name, 3, overrides=SHORT), by_class)


def test_a_built_in_planner_may_be_an_object_too() -> None:
    planner = make_planner("cohesive", PlannerSettings(), CohesionSettings())
    same(
        run("stalled", planner, 3, overrides=SHORT), run("stalled", "cohesive", 3, overrides=SHORT)
    )


def test_compare_takes_objects_among_names(tmp_path: Path) -> None:
    out = tmp_path / "out"
    runs = compare("stalled", ("nominal", Steady), (3, 4), overrides=SHORT, out=out).runs
    assert runs["planner"].tolist() == ["nominal"] * 2 + [f"{__name__}:Steady"] * 2
    alone = run("stalled", Steady, 4, overrides=SHORT).metrics
    assert runs["distance"].iloc[3] == alone["distance"].iloc[0]
    with pytest.raises(UserError, match="Steady is listed twice"):
        compare("stalled", (Steady(), Steady()), (3,), overrides=SHORT)


def test_a_fleet_needs_a_planner_that_can_be_made_anew() -> None:
    fleet = {**SHORT, "fleet.penetration": 1.0}
    with pytest.raises(UserError, match="give the planner's class or name"):
        run("stalled", Steady(), 3, overrides=fleet)
    assert run("stalled", Steady, 3, overrides=fleet).metrics["fleet_size"].iloc[0] > 1


class Untold(Steady):
    """Says nothing of itself that could be worked with."""

    def plan(self, observation: Observation, history: object) -> Plan:
        plan = super().plan(observation, history)
        odd: dict[str, Any] = {"wall_time": None, "social_time": "", "solver": None}
        return replace(plan, states=np.zeros((11, 2)), **odd)


def test_what_a_planner_does_not_say_is_unknown() -> None:
    rollout = run("stalled", Untold, 3, overrides={**SHORT, "reference": True})
    assert rollout.timing[["social_ms", "solver_ms"]].isna().all().all()
    assert rollout.reference["plan_lateral"].isna().all()
    assert rollout.horizon.empty


def test_a_comparison_loses_nothing_whatever_a_planner_does(tmp_path: Path) -> None:
    class Leaves(Steady):
        def plan(self, observation: Observation, history: object) -> Plan:
            raise SystemExit(3)

    out, horizon = tmp_path / "out", {**SHORT, "planner.horizon": np.int64(10)}
    with pytest.raises(SimulationError, match=r"SystemExit: 3; finished runs are kept in") as error:
        compare("stalled", (Steady, Leaves), (3,), overrides=horizon, out=out)
    kept = tmp_path / "out.unfinished"
    assert str(kept) in str(error.value)
    assert len(list(kept.rglob("run.json"))) == 1
    assert len(compare("stalled", (Steady,), np.arange(2), overrides=horizon, out=out).runs) == 2
    assert (
        run("stalled", Steady, np.int64(3), overrides=SHORT, out=tmp_path / "run").info["seed"] == 3
    )


def test_what_is_no_planner_is_one_line() -> None:
    for wrong in (object(), int, 3):
        with pytest.raises(UserError, match=r"needs the methods reset\(road\) and plan"):
            run("stalled", wrong, 3, overrides=SHORT)  # type: ignore[arg-type]


def test_what_a_users_planner_says_is_kept(tmp_path: Path) -> None:
    rollout = run("stalled", Steady, 3, overrides=SHORT, out=tmp_path / "out")
    ego = rollout.trajectory.query("vehicle == 'ego'")["s"].to_numpy()[:-1]
    for found in (rollout, Rollout.read(tmp_path / "out")):
        assert found.plan["reward_comfort"].to_numpy() == pytest.approx(ego)
        assert found.plan["reward_mood"].isna().all()
        assert found.plan["reward_lane"].isna().all()
        assert found.horizon["s"].to_numpy() == pytest.approx(ego)  # each as it was when planned


class Greedy(Steady):
    """Writes into what all runs of a process share."""

    def reset(self, road: Road) -> None:
        super().reset(road)
        limit = road.speed_limit
        limit *= 0.9


def test_a_planners_slip_does_not_reach_another_run() -> None:
    with pytest.raises(UserError, match="read-only"):
        run("speeding", Greedy, 1000, overrides=SHORT)
    assert run("speeding", "sumo", 1000, overrides=SHORT).plan["speed_limit"].eq(25.0).all()


@pytest.fixture
def late_mistake(tmp_path: Path) -> Path:
    """Write a scenario whose demand has a mistake that SUMO meets a second after the start."""
    text = (ROOT / "scenarios" / "stalled.toml").read_text()
    (tmp_path / "mine.toml").write_text(text)
    routes = (ROOT / "routes" / "stalled.rou.xml").read_text()
    late = (
        '<vehicle id="late" type="human" depart="1" departLane="9"><route edges="west"/></vehicle>'
    )
    (tmp_path / "stalled.rou.xml").write_text(routes.replace("</routes>", f"{late}</routes>"))
    return tmp_path / "mine.toml"


def test_a_mistake_that_sumo_meets_later_loses_nothing(late_mistake: Path) -> None:
    out, everybody = late_mistake.parent / "out", {**SHORT, "randomize.humans": [99, 99]}
    with pytest.raises(
        StoppedError, match=r"SUMO stopped at 1 s: .*'late'.*mend the demand"
    ) as error:
        run(late_mistake, "nominal", 3, overrides=everybody, out=out)
    assert f"what was recorded until then is in {out}" in str(error.value)
    kept = Rollout.read(out)
    assert kept.info["outcome"] == "stopped"
    assert len(kept.plan) >= 8
    row = kept.metrics.iloc[0]
    assert row["outcome"] == "stopped"
    assert not row["success"]
    # The process lives on, and without a folder the record is the error's.
    with pytest.raises(StoppedError) as again:
        run(late_mistake, "nominal", 3, overrides=everybody)
    assert isinstance(again.value.rollout, Rollout)
    same(again.value.rollout, kept)


def test_a_comparison_that_sumo_stops_says_where_everything_is(late_mistake: Path) -> None:
    out, everybody = late_mistake.parent / "out", {**SHORT, "randomize.humans": [99, 99]}
    with pytest.raises(UserError, match="SUMO stopped at 1 s") as error:
        compare(late_mistake, "nominal", (3,), overrides=everybody, out=out, workers=1)
    kept = late_mistake.parent / "out.unfinished" / "nominal" / "seed_0003"
    assert f"what was recorded until then is in {kept}" in str(error.value)
    assert Rollout.read(kept).info["outcome"] == "stopped"


def test_a_run_that_cannot_be_trusted_keeps_what_came_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where a calibrator takes the ego out of the simulation."""
    real, reads = Simulator.read, iter(range(100))

    def read(self: Simulator) -> Scene:
        if next(reads) == 6:
            raise SimulationError("SUMO has removed the ego")
        return real(self)

    monkeypatch.setattr(Simulator, "read", read)
    with pytest.raises(SimulationError, match="recorded until then is in") as error:
        run("stalled", "nominal", 3, overrides=SHORT, out=tmp_path / "out")
    assert len(Rollout.read(tmp_path / "out").plan) == 5
    sent = pickle.loads(pickle.dumps(error.value))
    assert str(sent) == str(error.value)
    assert sent.rollout is None
