"""Several planned cars at once, on real SUMO: who, for how long, and what is told of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sumo_cohesion import Rollout, run
from sumo_cohesion.perception.history import History
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.fleet import is_equipped
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.state import Control, Observation, Plan

pytestmark = pytest.mark.slow

HERE = "tests.scenarios.test_fleet"
TIMED = ["plan_ms_median", "plan_ms_p99"]
ALL = {"fleet.penetration": 1.0}
Write = Callable[..., Path]


class Straight:
    """Keeps its course at 20 m/s or less."""

    def reset(self, road: Road) -> None:
        self.road = road

    def plan(self, observation: Observation, history: History) -> Plan:
        ego = observation.ego
        control = Control(0.0, 0.1 * ego.speed + min(20.0 - ego.speed, 0.0))
        return Plan((control,), np.array([ego]), "straight")


class FallsBehind(Straight):
    """Brakes to 10 m/s, but in the left lane."""

    def plan(self, observation: Observation, history: History) -> Plan:
        plan, ego = super().plan(observation, history), observation.ego
        if ego.d > 5.0 or ego.speed < 10.0:
            return plan
        braking = plan.controls[0]._replace(acceleration=0.1 * ego.speed - 3.0)
        return Plan((braking,), plan.states, "behind")


class LooksAround(Straight):
    """Remembers whom it might follow."""

    seen: tuple[tuple[str, bool], ...] = ()

    def plan(self, observation: Observation, history: History) -> Plan:
        votes = zip(observation.ids, observation.voter, strict=True)
        LooksAround.seen = (*LooksAround.seen, *votes)
        return super().plan(observation, history)


class SwervesRight(Straight):
    """Leaves the middle lane for the right one, whoever is there."""

    def plan(self, observation: Observation, history: History) -> Plan:
        plan, ego = super().plan(observation, history), observation.ego
        away = 2.0 < ego.d < 5.0 and ego.heading > -0.1
        return Plan((plan.controls[0]._replace(curvature=-0.02 * away),), plan.states, "right")


class FailsInTheMiddle(Straight):
    """Raises, or returns nonsense, in the middle lane."""

    def plan(self, observation: Observation, history: History) -> Plan:
        plan = super().plan(observation, history)
        if 2.0 < observation.ego.d < 5.0:
            if round(10 * observation.time) % 2:
                raise ValueError("out of ideas")
            return Plan((Control(float("inf"), 0.0),), plan.states, "nonsense")
        return plan


class NowAndThen(Straight):
    """Drives itself in every other second only."""

    def plan(self, observation: Observation, history: History) -> Plan:
        plan = super().plan(observation, history)
        return plan if int(observation.time) % 2 else Plan((), plan.states, "sumo")


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Write a scenario: the ego at 300 m in lane 2, others as (id, lane, m, m/s, <stop>)."""

    def scenario(
        *cars: tuple[str, int, float, float, str], reach: float = 200.0, extra: str = ""
    ) -> Path:
        demand = "".join(
            f'<vehicle id="{name}" type="car" route="r" depart="0" departLane="{lane}" '
            f'departPos="{at}" departSpeed="{speed}" insertionChecks="none">{stop}</vehicle>'
            for name, lane, at, speed, stop in cars
        )
        (tmp_path / "cars.rou.xml").write_text(
            '<routes><vType id="car" laneChangeModel="SL2015" speedDev="0" speedFactor="0.9"/>'
            f'<route id="r" edges="west east"/>{demand}</routes>'
        )
        path = tmp_path / "cars.toml"
        path.write_text(
            'name = "cars"\nsummary = "cars"\nnetwork = "highway.net.xml"\n'
            'routes = ["cars.rou.xml"]\nduration = 4.0\n'
            '[ego]\norigin = "west"\ndestination = "east"\nlane = 2\nposition = 300.0\n'
            f"speed = 20.0\n[sensing]\nrange = {reach}\n[success]\ncollision = false\n{extra}"
        )
        return path

    return scenario


def others(rollout: Rollout) -> pd.DataFrame:
    """Rows of the other cars in the steps that were driven."""
    table = rollout.trajectory
    return table[(table["vehicle"] != "ego") & (table["time"] < table["time"].max())]


def one(rollout: Rollout, name: str) -> pd.DataFrame:
    """Rows of one car."""
    return rollout.trajectory[rollout.trajectory["vehicle"] == name]


def test_without_a_fleet_the_ego_is_alone_and_whom_egos_follow_is_nothing_to_it() -> None:
    short = {"duration": 5.0}
    plain = run("stalled_swerve", "cohesive", 1000, overrides=short)
    none = run(
        "stalled_swerve",
        "cohesive",
        1000,
        overrides={**short, "fleet.penetration": 0.0, "cohesion.follow_egos": True},
    )
    for name in ("trajectory", "plan", "agreement"):
        pd.testing.assert_frame_equal(getattr(plain, name), getattr(none, name), check_exact=True)
    table, row = plain.trajectory, plain.metrics.iloc[0]
    assert (table["planned"] == (table["vehicle"] == "ego")).all()
    assert plain.info["fleet"] == none.info["fleet"]
    assert row["fleet_size"] == row["fleet_collisions"] == row["fleet_failures"] == 0
    assert 0.0 < row["penetration"] < 0.5  # the ego alone


def test_sumo_drives_everybody_whatever_the_penetration() -> None:
    tables = [
        run("stalled", "sumo", 1, overrides={"duration": 2.0, "fleet.penetration": p}).trajectory
        for p in (0.0, 1.0)
    ]
    pd.testing.assert_frame_equal(*tables, check_exact=True)
    assert not tables[0]["planned"].any()


def test_all_cars_in_range_are_planned_and_nobody_is_left_to_follow() -> None:
    short = {"duration": 4.0, "randomize.humans": [6, 6], **ALL}
    cohesive = run("stalled_swerve", "cohesive", 1000, overrides=short)
    seen = others(cohesive)
    assert (seen["planned"] >= (seen["visible"] & (seen["vehicle"] != "stalled"))).all()
    assert not one(cohesive, "stalled")["planned"].any()
    row = cohesive.metrics.iloc[0]
    assert row["penetration"] == 1.0
    assert row["fleet_size"] == seen[seen["planned"]]["vehicle"].nunique() == 6
    assert (cohesive.timing["fleet_ms"] > 0.0).all()
    assert (cohesive.agreement["n"] == 0).all()
    assert (cohesive.agreement["pull"] == 0.0).all()
    nominal = run("stalled_swerve", "nominal", 1000, overrides=short)
    columns = ["vehicle", "x", "y", "heading", "speed"]
    pd.testing.assert_frame_equal(cohesive.trajectory[columns], nominal.trajectory[columns])
    followed = run(
        "stalled_swerve", "cohesive", 1000, overrides={**short, "cohesion.follow_egos": True}
    )
    assert followed.agreement["n"].max() > 1


def test_the_measured_penetration_and_the_same_tables_again() -> None:
    overrides = {"duration": 4.0, "fleet.penetration": 0.5}
    first, again = (run("stalled_dense", "cohesive", 3, overrides=overrides) for _ in range(2))
    for name in ("trajectory", "plan", "agreement"):
        pd.testing.assert_frame_equal(getattr(first, name), getattr(again, name), check_exact=True)
    pd.testing.assert_frame_equal(
        first.metrics.drop(columns=TIMED), again.metrics.drop(columns=TIMED), check_exact=True
    )
    seen = others(first)
    seen = seen[seen["visible"]]
    equipped = [is_equipped(name, 3, 0.5) for name in seen["vehicle"]]
    assert (seen["planned"] == equipped).all()
    by_time = seen.groupby("time")["planned"]
    share = ((by_time.sum() + 1) / (by_time.size() + 1)).mean()
    assert 0.1 < share < 0.9
    assert first.metrics["penetration"].iloc[0] == pytest.approx(share)


def test_a_car_that_falls_behind_is_handed_back_and_drives_on(write: Write) -> None:
    path = write(("b", 0, 310.0, 20.0, ""), ("c", 1, 290.0, 20.0, ""), reach=40.0)
    rollout = run(path, f"{HERE}:FallsBehind", overrides={"duration": 12.0, **ALL})
    ego = one(rollout, "ego").set_index("time")["s"]
    for name, centre in (("b", 0.0), ("c", 3.5)):
        car = one(rollout, name)
        planned = car["planned"].to_numpy()
        last = np.flatnonzero(planned)[-1]
        assert planned[: last + 1].all()
        behind = ego[car["time"]].to_numpy() - car["s"].to_numpy()
        assert 57.0 < behind[last] < 60.0  # the range and 20 m more
        after = car[~planned]
        assert len(after) > 10  # as far as it is recorded
        assert after["speed"].is_monotonic_increasing  # as SUMO likes it
        step = car["s"].diff().dropna().to_numpy()
        assert step == pytest.approx(0.1 * car["speed"].to_numpy()[1:], abs=0.05)
        assert car["d"].to_numpy() == pytest.approx(centre, abs=0.05)


@pytest.mark.parametrize("follow", [False, True])
def test_whom_planned_cars_may_follow(write: Write, follow: bool) -> None:
    path = write(("b", 0, 310.0, 20.0, ""), ("c", 1, 330.0, 20.0, ""), ("d", 1, 280.0, 20.0, ""))
    LooksAround.seen = ()
    overrides = {"duration": 1.0, "cohesion.follow_egos": follow, **ALL}
    run(path, f"{HERE}:LooksAround", overrides=overrides)
    assert {name for name, _ in LooksAround.seen} == {"ego", "b", "c", "d"}
    assert {vote for _, vote in LooksAround.seen} == {follow}
    seed = next(
        s
        for s in range(100)
        if is_equipped("b", s, 0.5) and not (is_equipped("c", s, 0.5) or is_equipped("d", s, 0.5))
    )
    LooksAround.seen = ()
    run(path, f"{HERE}:LooksAround", seed, overrides={**overrides, "fleet.penetration": 0.5})
    votes = dict(LooksAround.seen)
    assert votes == {"ego": follow, "b": follow, "c": True, "d": True}


def test_two_planned_cars_that_touch_are_counted_once_and_the_run_goes_on(write: Write) -> None:
    path = write(("b", 0, 250.0, 20.0, ""), ("c", 1, 250.0, 20.0, ""))
    rollout = run(path, f"{HERE}:SwervesRight", overrides=ALL)
    row = rollout.metrics.iloc[0]
    assert rollout.info["fleet"]["touched"] == {"b": ["c"], "c": ["b"]}
    assert row["fleet_collisions"] == row["fleet_size"] == 2
    assert row["outcome"] == "finished"
    assert not row["collision"]
    assert row["human_hard_brakes"] == 0  # what SUMO does with wrecks is no human's doing
    for name in "bc":
        planned = one(rollout, name)["planned"].tolist()
        assert planned[0]
        assert not planned[-1]
        assert planned == sorted(planned, reverse=True)  # never again


def test_a_planner_that_fails_in_one_car_is_braked_for_and_counted(write: Write) -> None:
    path = write(("b", 0, 250.0, 20.0, ""), ("c", 1, 300.0, 20.0, ""))
    rollout = run(path, f"{HERE}:FailsInTheMiddle", overrides={**ALL, "duration": 2.0})
    row = rollout.metrics.iloc[0]
    assert row["outcome"] == "finished"
    assert row["plan_failures"] == 0
    assert row["fleet_failures"] == len(rollout.plan)
    assert one(rollout, "c")["speed"].iloc[-1] == pytest.approx(12.0, abs=0.5)  # 4 m/s² for 2 s
    assert one(rollout, "b")["speed"].iloc[-1] == pytest.approx(20.0, abs=0.1)
    assert np.isfinite(rollout.trajectory.select_dtypes("number")).all().all()


def test_who_leaves_a_step_to_sumo_is_driven_by_sumo(write: Write) -> None:
    path = write(("b", 0, 250.0, 15.0, ""))
    rollout = run(path, f"{HERE}:NowAndThen", overrides=ALL)
    b, ego = one(rollout, "b"), one(rollout, "ego")
    assert b["planned"].nunique() == 2
    assert (b["planned"].to_numpy() == ego["planned"].to_numpy()).all()
    faster = b["speed"].diff().shift(-1)
    assert (faster[~b["planned"]].dropna() > 0.05).all()  # SUMO wants 22.5 m/s
    assert (faster[b["planned"]].dropna().abs() < 0.05).all()


def test_stops_and_ends_of_routes_are_for_sumo(write: Write) -> None:
    stop = '<stop lane="west_1" startPos="480" endPos="500" duration="5"/>'
    path = write(
        ("b", 0, 960.0, 20.0, ""),  # comes to the end of its route
        ("c", 1, 400.0, 20.0, stop),
    )
    text = (path.parent / "cars.rou.xml").read_text()
    short = text.replace(
        '<vehicle id="b" type="car" route="r"', '<vehicle id="b" type="car" route="w"'
    )
    (path.parent / "cars.rou.xml").write_text(
        short.replace("<route id=", '<route id="w" edges="west"/><route id=', 1)
    )
    overrides = {**ALL, "ego.position": 800.0, "sensing.range": 500.0}
    rollout = run(path, f"{HERE}:Straight", overrides=overrides)
    b, c = one(rollout, "b"), one(rollout, "c")
    assert b["planned"].iloc[0]
    assert b["s"][b["planned"]].max() == pytest.approx(980.0, abs=2.5)
    assert b["s"].max() > 990.0  # SUMO drove it to its end
    assert b["time"].max() < c["time"].max()
    assert not c["planned"].any()


def test_every_member_drives_its_own_way() -> None:
    """At the exit, the ego's way goes on; the humans' leads to the ramp, planned or not."""
    rollout = run("exit", "nominal", 1000, overrides={"duration": 20.0, **ALL})
    ramp = prepare(RunRequest("exit", "nominal", 1000)).road_along(("before", "ramp"))
    lead = one(rollout, "lead_3")
    lead = lead[lead["planned"]]
    states, _ = ramp.to_frenet(lead[["x", "y", "heading", "speed"]].to_numpy())
    assert states[-1, 0] > 1100.0
    assert abs(states[-1, 1]) < 0.5  # in its lane on the ramp
    assert lead["d"].iloc[-1] < -5.0  # far right of the ego's own road
    assert rollout.metrics["fleet_collisions"].iloc[0] == 0


def test_events_are_for_humans() -> None:
    """Nobody is told to make way: all who could hear it are planned."""
    overrides = {"duration": 11.5, **ALL}
    told = run("ambulance", f"{HERE}:Straight", 1000, overrides={"duration": 11.5})
    planned = run("ambulance", f"{HERE}:Straight", 1000, overrides=overrides)
    assert planned.info["events"] == told.info["events"] != {}

    def aside(rollout: Rollout) -> float:
        humans = others(rollout)[lambda t: t["visible"] & (t["vehicle"] != "ambulance")]
        return float(humans.groupby("vehicle")["d"].agg(np.ptp).max())

    assert aside(told) > 1.0
    assert aside(planned) < 0.1
