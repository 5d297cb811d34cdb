"""Streets: crossings, sharp turns, cross traffic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sumo_cohesion import UserError, cli, run
from sumo_cohesion.perception.history import History
from sumo_cohesion.road import Road
from sumo_cohesion.state import Control, Observation, Plan

SCENARIO = """
name = "city"
summary = "Around two corners of a city."
network = "city.net.xml"
routes = ["city.rou.xml"]
duration = 50.0
[ego]
origin = "A0A1"
destination = "{destination}"
lane = {lane}
position = 20.0
speed = 5.0
[success]
collision = false
"""
DEMAND = """
<routes>
  <vType id="human" laneChangeModel="SL2015" speedDev="0.05"/>
  <route id="along" edges="A0A1 A1B1 B1B2 B2B3"/>
  <vehicle id="lead_0" type="human" route="along" depart="0" departPos="60" departLane="0"/>
  <vehicle id="lead_1" type="human" route="along" depart="0" departPos="80" departLane="0"/>
</routes>
"""
BRIEF = ("--set", "duration=1.0")
STREETS = {"planner.max_curvature": 0.2, "planner.max_curvature_rate": 1.0}


def scenario(folder: Path, city: Path, destination: str, lane: int) -> Path:
    (folder / "city.net.xml").write_bytes(city.read_bytes())
    (folder / "city.rou.xml").write_text(DEMAND)
    path = folder / "city.toml"
    path.write_text(SCENARIO.format(destination=destination, lane=lane))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("planner", ["nominal", "cohesive"])
def test_the_ego_turns_at_a_crossing(tmp_path: Path, city: Path, planner: str) -> None:
    path = scenario(tmp_path, city, "A1B1", 0)
    rollout = run(path, planner, overrides=STREETS)
    metrics = rollout.metrics.iloc[0]
    assert metrics["outcome"] == "route_end"
    assert not metrics["exited"]
    assert metrics["plan_failures"] == 0
    ego = rollout.trajectory.query("vehicle == 'ego'").merge(rollout.plan, on="time")
    # Within a crossing the road is no wider than the lanes across it, and parts with them.
    beyond = np.maximum(ego["d"] + 0.9 - ego["road_left"], ego["road_right"] - ego["d"] + 0.9)
    assert beyond.max() < 0.3
    # It slows down for the corner by itself: 8 m/s² sideways at a radius of some 10 m.
    corner = ego[(ego["s"] > 135.0) & (ego["s"] < 150.0)]
    assert corner["speed"].min() < 10.0 < ego["speed"].max()


@pytest.mark.slow
def test_a_turn_that_is_too_sharp_for_the_planner_says_so(tmp_path: Path, city: Path) -> None:
    path = scenario(tmp_path, city, "A1B1", 0)
    with pytest.raises(UserError, match=r"radius of \d+ m, and planner.max_curvature = 0.01"):
        run(path, "nominal")
    # What is too far away to be reached does not matter, nor does it to SUMO's driver.
    assert len(run(path, "nominal", overrides={"duration": 1.0}).plan) == 10
    assert len(run(path, "sumo", overrides={"duration": 15.0}).plan) == 150


@pytest.mark.slow
def test_the_lights_that_the_planner_does_not_know_are_said(
    tmp_path: Path, city: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    path = scenario(tmp_path, city, "A3A4", 1)
    lights = run(path, "sumo", overrides={"duration": 1.0}).info["traffic_lights"]
    assert lights
    assert set(lights) <= {"A1", "A2", "A3"}
    monkeypatch.setattr(
        "sys.argv", ["sumo-cohesion", "run", str(path), "--planner", "nominal", *BRIEF]
    )
    cli.main()
    assert f"passes {len(lights)} traffic lights" in capfd.readouterr().err


class StraightOn:
    """Does not turn where the route does."""

    def reset(self, road: Road) -> None:
        pass

    def plan(self, observation: Observation, history: History) -> Plan:
        return Plan((Control(0.0, 0.1 * observation.ego.speed),), [], "straight on")


@pytest.mark.slow
def test_a_run_ends_when_the_ego_has_left_its_route_and_every_lane_off_it(
    tmp_path: Path, city: Path
) -> None:
    path = scenario(tmp_path, city, "A1B1", 0)
    rollout = run(path, f"{__name__}:StraightOn", overrides={"ego.speed": 13.0})
    metrics = rollout.metrics.iloc[0]
    assert metrics["outcome"] == "left_route"
    assert metrics["exited"]
    # Straight on there is a street, along which it may go as far as that is known.
    assert metrics["travel_time"] > 12.0
    assert rollout.trajectory["time"].max() < 45.0


@pytest.mark.slow
def test_what_a_road_cannot_be_told_of_or_driven_along_says_so(tmp_path: Path, city: Path) -> None:
    path = scenario(tmp_path, city, "A1A0", 0)  # back the same way: a U-turn
    for planner in ("nominal", "sumo"):
        with pytest.raises(UserError, match="comes back to where it was before"):
            run(path, planner)


@pytest.mark.slow
def test_the_scenario_speaks_of_a_flows_vehicles_not_of_the_flow(
    tmp_path: Path, city: Path
) -> None:
    path = scenario(tmp_path, city, "A1B1", 1)
    flow = '<flow id="f" type="human" route="along" begin="0" end="9" period="3"/></routes>'
    (tmp_path / "city.rou.xml").write_text(DEMAND.replace("</routes>", flow))
    overrides = {"duration": 5.0, "sensing.hidden": ["f"]}
    with pytest.raises(UserError, match=r"'f', which is a flow; name its vehicles: f.0, f.1"):
        run(path, "sumo", overrides=overrides)
    overrides["sensing.hidden"] = ["f.0"]
    seen = run(path, "sumo", overrides=overrides).trajectory.groupby("vehicle")["visible"].any()
    assert (seen["f.0"], seen["f.1"]) == (False, True)
