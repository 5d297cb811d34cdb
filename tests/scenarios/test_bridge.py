"""The bridge on real SUMO: the ego is where it was put, contacts are found, runs repeat."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sumo_cohesion import run
from sumo_cohesion.errors import SimulationError, StoppedError, UserError
from sumo_cohesion.perception.history import History
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.state import CartesianState, Control, Observation, Plan, Scene
from sumo_cohesion.tables.folders import MARKER
from sumo_cohesion.traffic.contact import contacts
from sumo_cohesion.traffic.simulator import Simulator, SumoRun
from tests.conftest import NETWORKS, ROOT
from tests.waiting import HANGS, wait_for

HEAD = (
    '<routes><vType id="car" laneChangeModel="SL2015" length="5" width="1.8" speedDev="0"/>'
    '<route id="r" edges="west east"/>'
)


def vehicle(name: str, lane: int, position: float, speed: float, stop: bool = False) -> str:
    halt = (
        f'<stop lane="west_{lane}" startPos="{position - 10}" endPos="{position}" duration="1e5"/>'
    )
    return (
        f'<vehicle id="{name}" type="car" route="r" depart="0" departLane="{lane}" '
        f'departPos="{position}" departSpeed="{speed}" insertionChecks="none">'
        f"{halt if stop else ''}</vehicle>"
    )


@contextmanager
def simulation(folder: Path, *vehicles: str) -> Iterator[Simulator]:
    demand = folder / "demand.rou.xml"
    demand.write_text(HEAD + "".join(sorted(vehicles)) + "</routes>")
    run = SumoRun(ROOT / "networks" / "highway.net.xml", demand, (), 0, 0.8)
    with Simulator(run, (5.0, 1.8), 250.0) as sumo:
        yield sumo


def test_scene_is_metric_centred_and_counter_clockwise(tmp_path: Path) -> None:
    with simulation(tmp_path, vehicle("ego", 0, 100, 25), vehicle("b", 2, 160, 20)) as sumo:
        scene = sumo.insert_ego(latest=5.0)
    assert scene.ego[:3] == pytest.approx((97.5, -8.75, 0.0))  # front bumper at 100
    assert scene.ids == ("b",)
    assert scene.states[0] == pytest.approx([157.5, -1.75, 0.0, 20.0])
    assert scene.sizes.tolist() == [[5.0, 1.8]]


def test_the_ego_is_where_it_was_put_at_the_speed_it_was_driven(tmp_path: Path) -> None:
    with simulation(tmp_path, vehicle("ego", 1, 100, 25), vehicle("b", 2, 160, 20)) as sumo:
        ego = sumo.insert_ego(latest=5.0).ego
        reported = []
        for k in range(200):
            # Faster than any limit, weaving across the lanes, then a dead stop.
            speed = 45.0 if k < 100 else 0.0
            heading = 0.04 * math.sin(0.1 * k) if k < 100 else ego.heading
            ego = CartesianState(
                ego.x + 0.1 * speed * math.cos(heading),
                ego.y + 0.1 * speed * math.sin(heading),
                heading,
                speed,
            )
            sumo.step(ego)
            scene = sumo.read()  # raises if SUMO's ego is elsewhere
            assert scene.ego == ego
            reported.append(sumo._sumo.vehicle.getSpeed("ego"))
        assert reported[1:100] == pytest.approx([45.0] * 99, abs=0.05)
        assert reported[101:] == pytest.approx([0.0] * 99, abs=0.01)


def test_a_siren_leaves_the_reported_speed_alone(tmp_path: Path) -> None:
    siren = (
        '<vType id="siren" vClass="emergency" laneChangeModel="SL2015" maxSpeed="10">'
        '<param key="has.bluelight.device" value="true"/>'
        '<param key="device.bluelight.reactiondist" value="60"/>'
        '<param key="device.bluelight.reaction-prob-far" value="10"/></vType>'
    )
    behind = vehicle("behind", 1, 900, 10).replace('type="car"', 'type="siren"')
    with simulation(tmp_path, siren, behind, vehicle("ego", 1, 940, 25)) as sumo:
        ego = sumo.insert_ego(latest=5.0).ego
        reported, influenced = [], []
        for _ in range(60):
            ego = CartesianState(ego.x + 4.5, ego.y, 0.0, 45.0)
            sumo.step(ego)
            assert sumo.read().ego == ego
            reported.append(sumo._sumo.vehicle.getSpeed("ego"))
            influenced.append(sumo._sumo.vehicle.getParameter("ego", "rescueLane") == "behind")
    assert any(influenced)
    assert not influenced[-1]  # SUMO has given the ego its type back by now
    assert reported[30:] == pytest.approx([45.0] * 30, abs=0.05)


def test_an_ego_beside_the_road_is_still_where_it_was_put(tmp_path: Path) -> None:
    with simulation(tmp_path, vehicle("ego", 1, 100, 25), vehicle("b", 2, 160, 20)) as sumo:
        ego = sumo.insert_ego(latest=5.0).ego
        for k in range(100):
            ego = CartesianState(ego.x + 2.5, -5.25 + 0.3 * k, 0.1, 25.0)
            sumo.step(ego)
            scene = sumo.read()
            assert scene.ego == ego
            assert scene.ids == ("b",)  # others are seen from there, too


def test_a_place_that_is_no_number_never_reaches_sumo(tmp_path: Path) -> None:
    with simulation(tmp_path, vehicle("ego", 1, 100, 25)) as sumo:
        ego = sumo.insert_ego(latest=5.0).ego
        with pytest.raises(SimulationError, match="no number"):
            sumo.step(ego._replace(x=float("nan")))


def ahead(state: np.ndarray, metres: float, aside: float = 0.0) -> CartesianState:
    """Where a car is after so many metres, at the speed that takes."""
    return CartesianState(state[0] + metres, state[1] + aside, 0.0, 10.0 * metres)


def test_several_cars_are_where_they_were_put_and_driven_on_by_sumo_afterwards(
    tmp_path: Path,
) -> None:
    slow = vehicle("b", 0, 160, 20).replace(">", ' speedFactor="0.8">', 1)
    with simulation(
        tmp_path,
        vehicle("ego", 1, 100, 25),
        slow,
        vehicle("c", 2, 130, 25),
        vehicle("d", 0, 60, 20),
    ) as sumo:
        scene = sumo.insert_ego(latest=5.0)
        before = sumo._sumo.vehicle
        manners = [
            before.getMaxSpeed("b"),
            before.getSpeedFactor("b"),
            before.getSpeedMode("b"),
            before.getLaneChangeMode("b"),
        ]
        for _ in range(30):
            now = dict(zip(scene.ids, scene.states, strict=True))
            moves = {"b": ahead(now["b"], 3.0, 0.05), "c": ahead(now["c"], 2.0)}
            sumo.step(ahead(np.array(scene.ego), 2.5), moves)
            scene = sumo.read()  # raises if one is elsewhere
            for name, row in zip(scene.ids, scene.states, strict=True):
                if name in moves:
                    assert tuple(row) == moves[name]
        assert before.getSpeed("b") == pytest.approx(30.0, abs=0.05)
        released = dict(zip(scene.ids, scene.states, strict=True))["b"]
        for k in range(60):
            sumo.step(ahead(np.array(scene.ego), 2.5))
            scene = sumo.read()
            b = dict(zip(scene.ids, scene.states, strict=True))["b"]
            if k == 0:
                assert b[:2] == pytest.approx([released[0] + 3.0, released[1]], abs=0.5)
        # SUMO has slowed it down to what it wants, in the lane it was left in.
        assert b[3] == pytest.approx(20.0, abs=0.1)
        assert b[1] == pytest.approx(-8.75, abs=1.0) or b[1] == pytest.approx(-5.25, abs=0.1)
        v = sumo._sumo.vehicle
        after = [f("b") for f in (v.getMaxSpeed, v.getSpeedFactor, v.getSpeedMode)]
        assert [*after, v.getLaneChangeMode("b")] == pytest.approx(manners)


def test_another_car_that_is_not_where_it_was_put_is_an_error(tmp_path: Path) -> None:
    with simulation(tmp_path, vehicle("ego", 1, 100, 25), vehicle("b", 2, 160, 20)) as sumo:
        scene = sumo.insert_ego(latest=5.0)
        there = ahead(scene.states[0], 2.0)
        with pytest.raises(SimulationError, match=r"vehicle 'b' would be moved to .* no number"):
            sumo.step(scene.ego, {"b": there._replace(heading=float("inf"))})
        sumo.step(scene.ego, {"b": there})
        sumo._driven["b"] = there._replace(x=there.x + 1.0)
        with pytest.raises(SimulationError, match=r"vehicle 'b' is 1\.00 m from where it was"):
            sumo.read()


def test_another_car_beside_the_road_is_still_seen_until_sumo_has_it_again(tmp_path: Path) -> None:
    with simulation(tmp_path, vehicle("ego", 1, 100, 25), vehicle("b", 0, 160, 25)) as sumo:
        scene = sumo.insert_ego(latest=5.0)
        for _ in range(30):
            there = ahead(scene.states[0], 2.5, -0.3)
            sumo.step(ahead(np.array(scene.ego), 2.5), {"b": there})
            scene = sumo.read()
            assert scene.ids == ("b",)
            assert tuple(scene.states[0]) == there
        sumo.step(ahead(np.array(scene.ego), 2.5))
        assert sumo.read().ids == ()  # it had no lane to drive on
        sumo.step(ahead(np.array(scene.ego), 5.0))  # and the simulation goes on


def test_orders_from_before_do_not_move_a_car_that_is_put(tmp_path: Path) -> None:
    with simulation(tmp_path, vehicle("ego", 2, 100, 25), vehicle("b", 0, 160, 25)) as sumo:
        scene = sumo.insert_ego(latest=5.0)
        sumo.order_lane("b", 2, 30.0)
        for _ in range(20):
            sumo.step(ahead(np.array(scene.ego), 2.5), {"b": ahead(scene.states[0], 2.5)})
            scene = sumo.read()


def test_one_simulation_per_process(tmp_path: Path) -> None:
    with simulation(tmp_path, vehicle("ego", 1, 100, 25)) as sumo:
        sumo.insert_ego(latest=5.0)
        with pytest.raises(SimulationError, match="already running"), simulation(tmp_path):
            pass
        sumo.step(None)  # the first one is unharmed
        assert sumo.read().time == pytest.approx(0.2)


class InTheMiddle:
    """Drives straight on; in the middle of its run it says so, and waits to be let go."""

    there, go = threading.Event(), threading.Event()

    def reset(self, road: Road) -> None:
        self.steps = 0

    def plan(self, observation: Observation, history: History) -> Plan:
        self.steps += 1
        if self.steps == 10:
            self.there.set()
            assert self.go.wait(HANGS)
        return Plan((Control(0.0, 0.1 * observation.ego.speed),), [], "straight on")


@pytest.mark.slow
def test_two_threads_never_share_a_simulation() -> None:
    """One of them gets its own run, whole; the other is told."""

    def drive() -> pd.DataFrame:
        return run("stalled", f"{__name__}:InTheMiddle", 3, overrides={"duration": 2.0}).trajectory

    InTheMiddle.go.set()
    alone = drive()
    InTheMiddle.there.clear()
    InTheMiddle.go.clear()
    with ThreadPoolExecutor(1) as thread:
        try:
            first = thread.submit(drive)
            wait_for(lambda: InTheMiddle.there.is_set() or first.done(), what="its middle")
            with pytest.raises(SimulationError, match="already running"):
                drive()
        finally:
            InTheMiddle.go.set()
        pd.testing.assert_frame_equal(first.result(), alone)


def test_leaving_with_a_move_pending_does_not_crash_the_next_run(tmp_path: Path) -> None:
    for _ in range(3):
        with simulation(tmp_path, vehicle("ego", 1, 100, 25)) as sumo:
            ego = sumo.insert_ego(latest=5.0).ego
            sumo._sumo.vehicle.moveToXY("ego", "", -1, ego.x + 5, ego.y, 90.0, 2)
            sumo._stepped = False


def test_a_step_that_fails_with_a_move_pending_does_not_crash_the_next_run(tmp_path: Path) -> None:
    bad = vehicle("late", 9, 100, 25).replace('depart="0"', 'depart="1"')
    for _ in range(3):
        with (  # noqa: PT012 - what raises is the step at which SUMO inserts the bad vehicle
            simulation(tmp_path, vehicle("ego", 1, 100, 25), bad) as sumo,
            pytest.raises(StoppedError, match="departLane definition for vehicle 'late'"),
        ):
            ego = sumo.insert_ego(latest=5.0).ego
            for _ in range(20):
                ego = ego._replace(x=ego.x + 2.5)
                sumo.step(ego)


def test_an_ego_that_would_start_inside_a_car_is_reported(tmp_path: Path) -> None:
    with (
        simulation(tmp_path, vehicle("ego", 1, 100, 25), vehicle("b", 1, 98, 25)) as sumo,
        pytest.raises(UserError, match="overlap vehicle 'b'"),
    ):
        sumo.insert_ego(latest=3.0)


def test_an_ego_that_cannot_depart_is_reported(tmp_path: Path) -> None:
    with (
        simulation(tmp_path, vehicle("b", 1, 100, 25)) as sumo,
        pytest.raises(UserError, match="has not inserted the ego"),
    ):
        sumo.insert_ego(latest=3.0)


def approach(lateral: float, heading: float = 0.0) -> Callable[[float], CartesianState]:
    """Ego driving at 15 m/s at a lateral offset from lane 0's centre, from x = 150."""
    return lambda t: CartesianState(150 + 15 * t, -8.75 + lateral, heading, 15.0)


@pytest.mark.parametrize(
    ("lateral", "heading", "expected"),
    [
        (0.0, 0.0, True),  # same lane
        (1.79, 0.0, True),  # side-swipe, centre beyond the lane line
        (1.7, 0.0, True),  # side-swipe, centre still in lane 0: SUMO misses such contacts
        (1.81, 0.0, False),
        (2.2, 0.25, True),  # only a corner, of a slanted ego
        (3.5, 0.0, False),  # passes in the next lane
    ],
)
def test_constructed_contacts_are_found_in_sumo(
    tmp_path: Path, lateral: float, heading: float, expected: bool
) -> None:
    path = approach(lateral, heading)
    found: list[Scene] = []
    with simulation(
        tmp_path, vehicle("ego", 0, 140, 15), vehicle("s", 0, 200, 0, stop=True)
    ) as sumo:
        scene = sumo.insert_ego(latest=5.0)
        for k in range(60):
            sumo.step(path(0.1 * k))
            scene = sumo.read()
            if contacts(scene.ego, scene.ego_size, scene.states, scene.sizes).size:
                found.append(scene)
    assert bool(found) is expected
    if lateral == 0.0:
        # Both stand on one line: contact begins when the bumpers meet, 5 m between centres.
        assert found[0].states[0, 0] - found[0].ego.x == pytest.approx(5.0, abs=1.5)


def test_own_contacts_agree_with_sumo_in_the_same_lane(tmp_path: Path) -> None:
    own, reported = [], []
    with simulation(
        tmp_path, vehicle("ego", 0, 140, 15), vehicle("s", 0, 200, 0, stop=True)
    ) as sumo:
        sumo.insert_ego(latest=5.0)
        for k in range(60):
            sumo.step(approach(0.0)(0.1 * k))
            scene = sumo.read()
            own.append(bool(contacts(scene.ego, scene.ego_size, scene.states, scene.sizes).size))
            reported.append(sumo.reported_contacts() == ["s"])
    # SUMO reports the same steps, to within one at either end.
    assert abs(sum(own) - sum(reported)) <= 2
    assert own.index(True) == pytest.approx(reported.index(True), abs=1)


@pytest.mark.slow
def test_curved_road_in_closed_loop(tmp_path: Path) -> None:
    """The nominal ego keeps its lane around a 500 m curve and across a junction."""
    (tmp_path / "curve.toml").write_text(
        'name = "curve"\nsummary = "curve"\nnetwork = "curve.net.xml"\n'
        'routes = ["curve.rou.xml"]\nduration = 40.0\n'
        '[ego]\norigin = "straight"\ndestination = "bend_2"\nlane = 1\n'
        "position = 20.0\nspeed = 20.0\n"
        "[success]\noff_road = false\n"
    )
    (tmp_path / "curve.rou.xml").write_text(
        '<routes><vType id="car" laneChangeModel="SL2015"/><vehicle id="a" type="car" depart="0" '
        'departLane="0" departPos="60"><route edges="straight bend_1 bend_2"/></vehicle></routes>'
    )
    (tmp_path / "curve.net.xml").write_text((NETWORKS / "curve.net.xml").read_text())
    from sumo_cohesion.simulation.run import run

    rollout = run(tmp_path / "curve.toml", "nominal")
    row = rollout.metrics.iloc[0]
    assert row["outcome"] == "route_end"
    assert not row["collision"]
    assert not row["off_road"]
    ego = rollout.trajectory[rollout.trajectory["vehicle"] == "ego"]
    assert np.abs(ego["d"] - 3.5).max() < 0.3
    # The limit falls from 25 to 20 m/s on the second half of the curve.
    assert ego["speed"].iloc[-1] == pytest.approx(20.0, abs=0.5)
    assert ego["speed"].max() > 22.0


def test_export_opens_in_plain_sumo(tmp_path: Path) -> None:
    from sumo_cohesion.simulation.export import export_scenario

    config = export_scenario("stalled", tmp_path / "out", seed=3)
    names = {path.name for path in config.parent.iterdir()}
    assert names == {"scenario.sumocfg", "demand.rou.xml", "highway.net.xml", MARKER}
    sumo = Path(sys.executable).parent / "sumo"
    if not sumo.exists():
        pytest.skip("SUMO's programs are in the extra [gui]")
    done = subprocess.run(
        [sumo, "-c", config, "--end", "30", "--fcd-output", tmp_path / "fcd.xml"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    ids = {v.get("id") for v in ET.parse(tmp_path / "fcd.xml").iter("vehicle")}
    assert {"ego", "stalled", "lead_1"} <= ids


def test_demand_varies_with_the_seed_as_the_scenario_says(tmp_path: Path) -> None:
    counts, gaps, speeds, stalls = set(), [], [], []
    for seed in range(60):
        setup = prepare(RunRequest("stalled", "sumo", seed))
        setup.write_inputs(tmp_path)
        vehicles = {v.get("id"): v for v in ET.parse(tmp_path / "demand.rou.xml").iter("vehicle")}
        humans = {k: v for k, v in vehicles.items() if k not in ("ego", "stalled")}
        counts.add(len(humans))
        leads = [100.0] + [float(humans[f"lead_{i}"].get("departPos", 0)) for i in (1, 2, 3)]
        gaps += np.diff(leads).tolist()
        speeds += [float(v.get("speedFactor", 0)) for v in humans.values()]
        (stop,) = vehicles["stalled"].iter("stop")
        stalls.append(float(vehicles["stalled"].get("departPos", 0)))
        assert float(stop.get("endPos", 0)) == pytest.approx(stalls[-1])
    assert counts == {3, 4, 5, 6, 7}
    assert min(gaps) >= 50 - 1e-3
    assert max(gaps) <= 70 + 1e-3
    assert np.ptp(gaps) > 15
    assert min(speeds) >= 0.98
    assert max(speeds) <= 1.02
    assert min(stalls) >= 690
    assert max(stalls) <= 710
