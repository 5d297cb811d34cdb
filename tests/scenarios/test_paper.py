"""The paper's other scenarios on real SUMO traffic, one seed each; rates are in analysis/."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from sumo_cohesion import run
from sumo_cohesion.perception.history import History
from sumo_cohesion.road import Road
from sumo_cohesion.state import Control, Observation, Plan

pytestmark = pytest.mark.slow


def test_speeding_nominal_keeps_the_limit_and_cohesive_goes_with_the_flow() -> None:
    nominal = run("speeding", "nominal", 1000).metrics.iloc[0]
    cohesive = run("speeding", "cohesive", 1000).metrics.iloc[0]
    assert nominal["max_speed_shift"] < 0.5
    assert nominal["speed_gap_closed"] == pytest.approx(0.0, abs=0.1)
    assert 0.5 < cohesive["speed_gap_closed"] < 1.0


def test_exit_nominal_stays_and_cohesive_is_tricked() -> None:
    nominal = run("exit", "nominal", 1000)
    cohesive = run("exit", "cohesive", 1000)
    assert not nominal.metrics["exited"].iloc[0]
    assert cohesive.metrics["exited"].iloc[0]
    assert not cohesive.metrics["off_road"].iloc[0]
    # By geometry: far from every lane of the route at the end.
    ego = cohesive.trajectory[cohesive.trajectory["vehicle"] == "ego"]
    assert ego["d"].iloc[-1] < -5.0


class TakesTheRamp:
    """Steers for the rightmost lane that is there in a second."""

    def reset(self, road: Road) -> None:
        self.road = road

    def plan(self, observation: Observation, history: History) -> Plan:
        ego = observation.ego
        aim = float(np.nanmin(self.road.lanes_at([ego.s + ego.speed])[0]))
        turn = np.arctan2(aim - ego.d, ego.speed) - ego.heading
        control = Control(float(np.clip(turn / 5.0, -0.02, 0.02)), 0.1 * ego.speed)
        return Plan((control,), [], "to the right")


def test_the_ego_is_on_the_exit_once_it_is_a_lane_away_from_its_route() -> None:
    start = {"ego.position": 980.0, "ego.speed": 15.0, "duration": 6.0, "randomize": {}}
    rollout = run("exit", f"{__name__}:TakesTheRamp", overrides=start)
    # The route's own rightmost lane is at d = 0 all along, and the ramp is right of it.
    d = rollout.trajectory.query("vehicle == 'ego'")["d"].to_numpy()[:-1]
    assert (rollout.plan["on_exit"] == (d < -3.5)).all()
    assert ((d < -1.0) & (d > -3.5)).sum() > 5
    assert rollout.metrics["exited"].iloc[0]


def test_ambulance_nominal_holds_it_up_and_cohesive_makes_way() -> None:
    nominal = run("ambulance", "nominal", 1000)
    cohesive = run("ambulance", "cohesive", 1000)
    assert nominal.metrics["emergency_delay"].iloc[0] > 2.5
    assert cohesive.metrics["emergency_delay"].iloc[0] < 0.5
    assert cohesive.metrics["yield_time"].iloc[0] < 8.0
    assert set(nominal.info["events"]) == {"0", "1"}
    for rollout in (nominal, cohesive):
        assert not rollout.metrics["collision"].iloc[0]
        # SUMO drives the ambulance: it was told to keep its lane, nothing else.
        ambulance = rollout.trajectory[rollout.trajectory["vehicle"] == "ambulance"]
        assert (ambulance["d"] - 7.0).abs().max() < 0.5


def test_same_speed_only_the_speed_is_followed() -> None:
    nominal = run("same_speed", "nominal", 1000).metrics.iloc[0]
    cohesive = run("same_speed", "cohesive", 1000).metrics.iloc[0]
    assert not nominal["success"]
    assert nominal["speed_gap_closed"] == pytest.approx(0.0, abs=0.1)
    assert cohesive["success"]
    assert cohesive["speed_most_agreed"] > 0.95


def test_rescue_lane_nominal_blocks_it_and_cohesive_lets_the_ambulance_through() -> None:
    nominal = run("ambulance_rescue_lane", "nominal", 1000)
    cohesive = run("ambulance_rescue_lane", "cohesive", 1000)
    sumo = run("ambulance_rescue_lane", "sumo", 1000)
    row = cohesive.metrics.iloc[0]
    assert row["success"]
    assert row["passing_lane"] == 2
    assert 0.4 < row["passing_shift"] < 0.85
    assert abs(nominal.metrics["aside_share"].iloc[0]) < 0.1
    assert pd.isna(nominal.metrics["passing_lane"].iloc[0])
    assert sumo.metrics["aside_share"].iloc[0] == pytest.approx(1.0, abs=0.05)
    # Nobody was told anything: the lane is SUMO's own, left cars left, all others right.
    assert nominal.info["events"] == {}
    level = cohesive.trajectory[cohesive.trajectory["time"].round(1) == 25.0].set_index("vehicle")
    for name, lane, way in (("left_1", 7.0, 0.85), ("middle_1", 3.5, -0.85), ("right_1", 0, -0.85)):
        assert level.loc[name, "d"] == pytest.approx(lane + way, abs=0.05)


def test_noise_disperses_the_humans_and_cohesive_still_follows_them() -> None:
    def straight(level: float) -> pd.Series:
        changes = {"human_type.lcSigma": level}
        cars = run("stalled_noise", "nominal", 1000, overrides=changes).trajectory
        humans = cars[cars["vehicle"].str.startswith("lead")]
        assert humans["vehicle"].nunique() == 3
        return humans[humans["s"].between(350.0, 560.0)]["d"]

    assert straight(0.0).std() < 0.001
    assert 0.03 < straight(0.3).std() < straight(0.6).std()
    noisy = run("stalled_noise", "cohesive", 1000)
    assert noisy.metrics["success"].iloc[0]
    assert noisy.info["scenario"]["human_type"] == {"lcSigma": 0.3}


def test_nothing_to_follow_is_not_followed() -> None:
    cohesive = run("nothing_to_follow", "cohesive", 1000).metrics.iloc[0]
    assert cohesive["success"]
    # It is the drivers' habits that tell: a car that does not know them follows a chance pair.
    naive = {"cohesion.habit": 0.0, "cohesion.speed_weight": 1.0}
    gullible = run("nothing_to_follow", "cohesive", 1000, overrides=naive).metrics.iloc[0]
    assert not gullible["success"]
    assert gullible["twin_speed_deviation"] > cohesive["twin_speed_deviation"] + 0.5
