"""Recordings of files: SUMO's own output, tables, CommonRoad scenes; and files that are none."""

from __future__ import annotations

import gzip
import tracemalloc
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sumo_cohesion.demonstrations.checking import checked
from sumo_cohesion.demonstrations.commonroad import read_commonroad
from sumo_cohesion.demonstrations.fcd import read_fcd, read_sumo_table
from sumo_cohesion.demonstrations.matching import Matcher
from sumo_cohesion.demonstrations.reading import read
from sumo_cohesion.demonstrations.sizes import BY_CLASS, CAR
from sumo_cohesion.demonstrations.table import read_csv
from sumo_cohesion.errors import UserError
from sumo_cohesion.learning.recording import COLUMNS, Recording
from sumo_cohesion.road import Road
from sumo_cohesion.traffic.library import load_libsumo
from sumo_cohesion.traffic.network import Network
from sumo_cohesion.traffic.outputs import SumoOutputs
from sumo_cohesion.traffic.xml_files import each_element, parse_xml
from tests.conftest import NETWORKS, ROOT

CURVE = NETWORKS / "curve.net.xml"
HIGHWAY = ROOT / "networks" / "highway.net.xml"
DEMAND = """<routes>
    <vType id="own" length="4.2" width="1.7" laneChangeModel="SL2015"/>
    <vType id="lorry" vClass="truck" length="9.5"/>
    <route id="through" edges="straight bend_1 bend_2"/>
    <route id="off" edges="straight bend_1 ramp"/>
    <vehicle id="a" type="own" route="through" depart="0" departLane="1" departSpeed="20"/>
    <vehicle id="b" type="own" route="off" depart="0" departLane="0" departSpeed="20"/>
    <vehicle id="c" route="through" depart="3" departLane="0" departSpeed="15"/>
    <vehicle id="d" type="lorry" route="off" depart="6" departLane="1" departSpeed="10"/>
</routes>"""


def drive(folder: Path, suffix: str = ".xml", precision: int = 9) -> tuple[Path, pd.DataFrame]:
    """Drive DEMAND along CURVE; return SUMO's file, and what SUMO says of each vehicle itself."""
    demand, output = folder / "d.rou.xml", folder / f"fcd{suffix}"
    demand.write_text(DEMAND)
    sumo = load_libsumo()
    options = {"net-file": CURVE, "route-files": demand, "step-length": 0.1, "fcd-output": output}
    options |= {"precision": precision, "lateral-resolution": 0.8}
    pairs = [text for key, value in options.items() for text in (f"--{key}", str(value))]
    sumo.start(["sumo", *pairs, "--no-step-log", "--no-warnings"])
    said = []
    try:
        while sumo.simulation.getMinExpectedNumber() and sumo.simulation.getTime() < 60.0:
            sumo.simulationStep()
            for name in sumo.vehicle.getIDList():
                front = sumo.vehicle.getPosition(name)
                heading = radians(90.0 - sumo.vehicle.getAngle(name))
                half = sumo.vehicle.getLength(name) / 2
                x, y = front[0] - half * cos(heading), front[1] - half * sin(heading)
                size = sumo.vehicle.getLength(name), sumo.vehicle.getWidth(name)
                said.append((sumo.simulation.getTime() - 0.1, name, x, y, *size))
    finally:
        sumo.close()
    table = pd.DataFrame(said, columns=list(COLUMNS))
    return output, table.sort_values(["vehicle", "time"], ignore_index=True)


def assert_same_road(road: Road, other: Road) -> None:
    for name in ("x", "y", "lane_centre", "lane_width", "speed_limit"):
        assert np.array_equal(getattr(road, name), getattr(other, name), equal_nan=True)


@pytest.fixture(scope="module")
def network() -> Network:
    return Network(CURVE)


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pd.DataFrame]:
    return drive(tmp_path_factory.mktemp("driven"))


@pytest.fixture(scope="module")
def recording(driven: tuple[Path, pd.DataFrame], network: Network) -> Recording:
    return read_fcd(driven[0], network, [driven[0].parent / "d.rou.xml"])


@pytest.mark.slow  # SUMO drives for all of them
class TestFloatingCarData:
    def test_centres_and_sizes_are_those_of_the_simulation(
        self, driven: tuple[Path, pd.DataFrame], recording: Recording
    ) -> None:
        said = driven[1]
        assert tuple(recording.table.columns) == COLUMNS
        assert recording.interval == 0.1
        assert recording.table["vehicle"].tolist() == said["vehicle"].tolist()
        assert set(recording.table["vehicle"]) == {"a", "b", "c", "d"}
        numbers = ["time", "x", "y", "length", "width"]
        assert recording.table[numbers].to_numpy() == pytest.approx(
            said[numbers].to_numpy(), abs=1e-6
        )

    def test_roads_are_those_that_the_vehicles_drove(
        self, recording: Recording, network: Network
    ) -> None:
        assert set(recording.roads) == {"a", "b", "c"}
        through = network.road(["straight", "bend_1", "bend_2"])
        assert_same_road(recording.roads["a"], through)
        assert_same_road(recording.roads["b"], network.road(["straight", "bend_1", "ramp"]))
        assert recording.roads["a"] is recording.roads["c"]
        assert recording.notes == ("1 vehicle does not demonstrate (d): does not drive as cars do",)

    def test_without_types_all_are_cars_of_the_usual_size_and_a_note_says_so(
        self, driven: tuple[Path, pd.DataFrame], network: Network, recording: Recording
    ) -> None:
        found = read_fcd(driven[0], network)
        assert set(found.roads) == {"a", "b", "c", "d"}
        assert (found.table["length"] == 5.0).all()
        assert found.notes[0].startswith(
            "it does not say how long vehicles of the types lorry, own are: taken for cars of 5 x"
        )
        known = found.table["vehicle"] == "c"
        assert found.table[known].equals(recording.table[known])

    @pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet", ".xml.gz"])
    def test_other_forms_say_the_same(
        self, suffix: str, tmp_path: Path, network: Network, recording: Recording
    ) -> None:
        path, _ = drive(tmp_path, suffix)
        found = read(path, network, [tmp_path / "d.rou.xml"])
        # Angles are single precision in Parquet.
        pd.testing.assert_frame_equal(found.table, recording.table, rtol=0.0, atol=1e-5)
        assert set(found.roads) == set(recording.roads)
        assert (found.interval, found.notes) == (recording.interval, recording.notes)

    def test_a_table_that_a_run_keeps_says_the_same(
        self, driven: tuple[Path, pd.DataFrame], network: Network, recording: Recording
    ) -> None:
        table = SumoOutputs(("fcd",), driven[0].parent).read()["fcd"]
        found = read_sumo_table(table, network, "run", [driven[0].parent / "d.rou.xml"])
        pd.testing.assert_frame_equal(found.table, recording.table)
        assert set(found.roads) == set(recording.roads)

    def test_rounded_positions_are_told(self, tmp_path: Path, network: Network) -> None:
        path, _ = drive(tmp_path, precision=2)
        assert "--precision 6" in read_fcd(path, network, [tmp_path / "d.rou.xml"]).notes[0]

    def test_who_was_on_a_lane_for_others_does_not_demonstrate(
        self, driven: tuple[Path, pd.DataFrame], tmp_path: Path
    ) -> None:
        text = CURVE.read_text()
        assert text.count('id="straight_1" index="1"') == 1
        closed = tmp_path / "closed.net.xml"
        closed.write_text(
            text.replace('id="straight_1" index="1"', 'id="straight_1" index="1" allow="bus"')
        )
        found = read_fcd(driven[0], Network(closed), [driven[0].parent / "d.rou.xml"])
        assert "a" not in found.roads
        assert any("(a): was on a lane that is not for cars" in note for note in found.notes)

    def test_a_way_around_and_back_does_not_demonstrate(self, tmp_path: Path) -> None:
        network = Network(ROOT / "networks" / "highway.net.xml")
        rows = [
            f'<timestep time="{k / 10}"><vehicle id="a" x="{900 + 2 * k}" y="-5.25" angle="90" '
            f'lane="{"west" if k < 50 else "east"}_1"/>'
            f'<vehicle id="b" x="{1050 - 2 * k}" y="-5.25" angle="270" '
            f'lane="{"east" if k < 25 else "west"}_1"/></timestep>'
            for k in range(60)
        ]
        path = tmp_path / "f.xml"
        path.write_text(f"<fcd-export>{''.join(rows)}</fcd-export>")
        found = read_fcd(path, network)
        assert set(found.roads) == {"a"}
        assert any("(b): (" in n and "no way for a car from edge 'east'" in n for n in found.notes)

    def test_gaps_are_bridged_the_shortest_way(self, tmp_path: Path, network: Network) -> None:
        road = network.road(["straight", "bend_1", "bend_2"])
        s = np.arange(20.0, road.length - 10.0, 2.0)
        xy = road.to_cartesian(np.column_stack((s, 0 * s, 0 * s, 0 * s + 20.0)))
        rows = []
        for k, (x, y, heading, _) in enumerate(xy):
            lane = "straight_0" if s[k] < 95.0 else "bend_2_0"
            if s[k] < 95.0 or s[k] > 550.0:
                rows.append(
                    f'<timestep time="{k / 10}"><vehicle id="a" x="{x}" y="{y}" '
                    f'angle="{90 - np.degrees(heading)}" lane="{lane}"/></timestep>'
                )
        path = tmp_path / "f.xml"
        path.write_text(f"<fcd-export>{''.join(rows)}</fcd-export>")
        found = read_fcd(path, network)
        assert_same_road(found.roads["a"], road)
        assert found.notes[0].startswith("it does not say how long its vehicles are: taken for")

    def test_default_sizes_are_those_of_sumo(self, tmp_path: Path) -> None:
        types = "".join(f'<vType id="of_{name}" vClass="{name}"/>' for name in BY_CLASS)
        (tmp_path / "t.rou.xml").write_text(f"<routes>{types}</routes>")
        sumo = load_libsumo()
        sumo.start(["sumo", "-n", str(CURVE), "-r", str(tmp_path / "t.rou.xml"), "--no-step-log"])
        try:
            kind = sumo.vehicletype
            for name, (length, width, _) in BY_CLASS.items():
                found = (kind.getLength(f"of_{name}"), kind.getWidth(f"of_{name}"))
                assert found == pytest.approx((length, width)), name
        finally:
            sumo.close()

    def test_a_long_file_is_never_held_as_a_tree(self, tmp_path: Path) -> None:
        path = tmp_path / "f.xml"
        row = '<vehicle id="a" x="1.00" y="2.00" angle="90.00" lane="west_1"/>'
        step = f'<timestep time="0.10">{row * 20}</timestep>'
        path.write_text(f"<fcd-export>{step * 500}</fcd-export>")
        peaks = []
        for work in (lambda: parse_xml(path), lambda: list(map(len, each_step(path)))):
            tracemalloc.start()
            work()
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        assert peaks[1] < 0.2 * peaks[0]


def each_step(path: Path) -> Any:
    return each_element(path, "fcd-export", "timestep")


class TestTables:
    def test_a_table_of_what_sumo_drove_gives_the_same_roads(
        self, recording: Recording, tmp_path: Path, network: Network
    ) -> None:
        path = tmp_path / "t.csv"
        recording.table.to_csv(path, index=False)
        found = read_csv(path, network)
        pd.testing.assert_frame_equal(found.table, recording.table)
        assert set(found.roads) == {"a", "b", "c", "d"}  # a table knows no lorries
        for vehicle, road in recording.roads.items():
            assert_same_road(found.roads[vehicle], road)

    @pytest.mark.parametrize("separator", [",", ";", "\t"])
    def test_noise_order_and_separators_do_not_matter(
        self, separator: str, recording: Recording, tmp_path: Path, network: Network
    ) -> None:
        rng = np.random.default_rng(0)
        table = recording.table[["time", "vehicle", "x", "y"]].copy()
        table[["x", "y"]] += rng.normal(0.0, 0.5, (len(table), 2))
        path = tmp_path / "t.csv.gz"
        table.sample(frac=1.0, random_state=1).to_csv(path, index=False, sep=separator)
        found = read(path, network)
        assert (found.table["length"] == CAR.length).all()
        assert (found.table["width"] == CAR.width).all()
        for vehicle, road in recording.roads.items():
            assert_same_road(found.roads[vehicle], road)

    def test_who_stands_in_noise_or_is_seen_astray_once_keeps_the_road(
        self, recording: Recording, network: Network
    ) -> None:
        rng = np.random.default_rng(0)
        table = recording.table[recording.table["vehicle"] == "a"].reset_index(drop=True)
        for column in ("x", "y"):
            table.loc[100:250, column] = table[column][100] + rng.normal(0.0, 0.3, 151)
        table.loc[60, "x"] += 9.0
        table.loc[260:261, "y"] += 9.0
        passed = Matcher(network.for_cars()).passed(table[["x", "y"]].to_numpy())
        assert passed == ["straight", "bend_1", "bend_2"]

    def test_headings_tell_who_drives_in_which_direction(self, tmp_path: Path) -> None:
        """A car that hardly moves is on the side of the street that it faces."""
        city = Matcher(
            [
                edge._replace(name=f"{way}{edge.name}", lanes=lanes, onward=frozenset())
                for edge in Network(HIGHWAY).for_cars()
                for way, lanes in (("", edge.lanes), ("-", tuple(x[::-1] for x in edge.lanes)))
            ]
        )
        still = np.tile([500.0, -5.25], (10, 1))
        assert city.passed(still, np.zeros(10)) == ["west"]
        assert city.passed(still, np.full(10, np.pi)) == ["-west"]

    def test_text_ids_and_parquet(
        self, recording: Recording, tmp_path: Path, network: Network
    ) -> None:
        table = recording.table.replace({"vehicle": {"a": "007", "b": "NA", "c": "7"}})
        for path in (tmp_path / "t.csv", tmp_path / "t.parquet"):
            if path.suffix == ".csv":
                table.to_csv(path, index=False)
            else:
                table.to_parquet(path)
            assert set(read(path, network).roads) == {"007", "NA", "7", "d"}

    def test_columns_that_are_not_read_are_told(
        self, recording: Recording, tmp_path: Path, network: Network
    ) -> None:
        path = tmp_path / "t.csv"
        recording.table.assign(speed=1.0, comment="x").to_csv(path, index=False)
        assert read_csv(path, network).notes == ("not read: column comment",)

    def test_one_car_alone_is_a_recording(self, tmp_path: Path) -> None:
        path = tmp_path / "t.csv"
        pd.DataFrame(
            {"time": np.arange(50) / 10, "vehicle": 1, "x": 100 + 2.5 * np.arange(50), "y": -1.75}
        ).to_csv(path, index=False)
        found = read_csv(path, Network(HIGHWAY))
        assert set(found.roads) == {"1"}
        assert found.notes == ()


@pytest.mark.slow
def test_through_a_city_positions_tell_the_edges(city: Path, tmp_path: Path) -> None:
    """Turns, crossings, streets side by side: by positions alone as by SUMO's own lanes."""
    network = Network(city)
    rng = np.random.default_rng(3)
    names = [name for name in network.edges() if name[0] in "BCDEF" and name[2] in "BCDEF"]
    trips = ""
    for k in range(12):
        a, b = rng.choice(names, 2, replace=False)
        trips += f'<trip id="v{k}" depart="{k}" from="{a}" to="{b}" departLane="best"/>'
    (tmp_path / "d.rou.xml").write_text(f"<routes>{trips}</routes>")
    sumo = load_libsumo()
    pairs = {"-n": city, "-r": tmp_path / "d.rou.xml", "--fcd-output": tmp_path / "f.xml"}
    pairs |= {"--step-length": 0.1, "--precision": 6}
    sumo.start(["sumo", *(str(x) for p in pairs.items() for x in p), "--no-step-log"])
    try:
        while sumo.simulation.getMinExpectedNumber() and sumo.simulation.getTime() < 300.0:
            sumo.simulationStep()
    finally:
        sumo.close()
    told = read_fcd(tmp_path / "f.xml", network)
    told.table.to_csv(tmp_path / "t.csv", index=False)
    found = read_csv(tmp_path / "t.csv", network)
    assert set(found.roads) == set(told.roads)
    assert len(told.roads) > 6
    for vehicle, road in told.roads.items():
        assert_same_road(found.roads[vehicle], road)


# A CommonRoad scene: two lanes, 60 m straight and then a left curve of 200 m radius (the bounds of
# the right lane 201.75 and 198.25 m), in two lanelets each.
RADIUS, LANE = 200.0, 3.5


def place(s: float, d: float) -> tuple[float, float]:
    """Where one is after s metres, d to the left of the right lane's centre."""
    if s < 60.0:
        return s, d
    angle = (s - 60.0) / RADIUS
    return 60.0 + (RADIUS - d) * sin(angle), RADIUS - (RADIUS - d) * cos(angle)


def point(s: float, d: float) -> str:
    x, y = place(s, d)
    return f"<point><x>{x:.9f}</x><y>{y:.9f}</y></point>"


def lanelet(name: int, lane: int, first: float, last: float, links: str) -> str:
    s = np.arange(first, last + 0.1, 5.0)
    left = "".join(point(k, (lane + 0.5) * LANE) for k in s)
    right = "".join(point(k, (lane - 0.5) * LANE) for k in s)
    return (
        f'<lanelet id="{name}"><leftBound>{left}</leftBound><rightBound>{right}</rightBound>'
        f"{links}</lanelet>"
    )


def state(tag: str, k: int, s: float, d: float) -> str:
    return (
        f"<{tag}><position>{point(s, d)}</position><orientation><exact>0.0</exact></orientation>"
        f"<time><exact>{k}</exact></time><velocity><intervalStart>9</intervalStart>"
        f"<intervalEnd>11</intervalEnd></velocity></{tag}>"
    )


def obstacle(name: int, kind: str, speed: float, start: float, d: Any, version: str) -> str:
    states = [(k, start + 0.1 * speed * k, d(k)) for k in range(100)]
    tag = "obstacle" if version == "2018b" else "dynamicObstacle"
    role = "<role>dynamic</role>" if version == "2018b" else ""
    later = "".join(state("state", *one) for one in states[1:])
    return (
        f'<{tag} id="{name}">{role}<type>{kind}</type><shape><rectangle><length>4.5</length>'
        f"<width>1.8</width></rectangle></shape>{state('initialState', *states[0])}"
        f"<trajectory>{later}</trajectory></{tag}>"
    )


def scene(version: str = "2020a", limit: float | None = None, last: str = "car") -> str:
    def beside(side: str, other: int) -> str:
        return f'<adjacent{side} ref="{other}" drivingDir="same"/>'

    limited = ""
    if limit is not None and version == "2018b":
        limited = f"<speedLimit>{limit}</speedLimit>"
    elif limit is not None:
        limited = '<trafficSignRef ref="90"/>'
    successor = '<successor ref="{}"/>'
    lanes = (
        lanelet(1, 0, 0.0, 60.0, successor.format(3) + beside("Left", 2) + limited)
        + lanelet(2, 1, 0.0, 60.0, successor.format(4) + beside("Right", 1))
        + lanelet(3, 0, 60.0, 260.0, beside("Left", 4) + '<predecessor ref="1"/>')
        + lanelet(4, 1, 60.0, 260.0, beside("Right", 3) + '<predecessor ref="2"/>' + limited)
        + lanelet(5, 2, 60.0, 260.0, "<laneletType>sidewalk</laneletType>")
    )
    sign = (
        '<trafficSign id="90"><trafficSignElement><trafficSignID>274</trafficSignID>'
        f"<additionalValue>{limit}</additionalValue></trafficSignElement></trafficSign>"
    )
    return (
        f'<commonRoad commonRoadVersion="{version}" benchmarkID="ZAM_Test-1_1_T-1" '
        f'timeStepSize="0.1">{lanes}{sign if limit is not None else ""}'
        + obstacle(11, "car", 10.0, 5.0, lambda _: 0.0, version)
        + obstacle(12, "car", 12.0, 20.0, lambda k: LANE * min(max((k - 20) / 40, 0), 1), version)
        + obstacle(13, last, 8.0, 60.0, lambda _: LANE, version)
        + "</commonRoad>"
    )


class TestCommonRoad:
    @pytest.mark.parametrize("version", ["2018b", "2020a"])
    def test_a_scene_reads_back(self, version: str, tmp_path: Path) -> None:
        path = tmp_path / "scene.xml"
        path.write_text(scene(version, limit=13.9))
        found = read(path)
        assert tuple(found.table.columns) == COLUMNS
        assert (found.interval, found.notes) == (0.1, ())
        assert found.table.groupby("vehicle").size().to_dict() == {"11": 100, "12": 100, "13": 100}
        assert (found.table[["length", "width"]].to_numpy() == [4.5, 1.8]).all()
        expected = [place(5.0 + k, 0.0) for k in range(100)]
        first = found.table[found.table["vehicle"] == "11"]
        assert first[["x", "y"]].to_numpy() == pytest.approx(np.array(expected), abs=1e-8)
        assert first["time"].to_numpy() == pytest.approx(np.arange(100) / 10)
        # Two lanes, in the frame of the right one's centre: d of each car is what it drove.
        assert set(found.roads) == {"11", "12", "13"}
        assert found.roads["11"] is found.roads["12"]
        road = found.roads["11"]
        assert road.n_route_lanes == 2
        assert road.length == pytest.approx(260.0, abs=1.0)
        assert (road.speed_limit == 13.9).all()
        s = np.arange(5.0, 255.0)
        assert road.lanes_at(s)[:, 0] == pytest.approx(0.0, abs=0.06)
        assert road.lanes_at(s)[:, 1] == pytest.approx(LANE, abs=0.06)
        assert road.lane_width[road.index(s)] == pytest.approx(LANE, abs=0.01)
        assert np.median(road.curvature_at(s[80:])) == pytest.approx(1 / RADIUS, rel=0.02)
        second = found.table[found.table["vehicle"] == "12"][["x", "y"]].to_numpy()
        d = road.to_frenet(np.column_stack((second, np.zeros((100, 2)))))[0][:, 1]
        assert d[[0, 40, 99]] == pytest.approx([0.0, LANE / 2, LANE], abs=0.06)

    def test_without_a_limit_it_is_what_was_driven(self, tmp_path: Path) -> None:
        path = tmp_path / "scene.xml"
        path.write_text(scene())
        found = read_commonroad(path)
        for road in found.roads.values():
            assert np.isfinite(road.speed_limit).all()
            assert road.speed_limit[0] == pytest.approx(12.0, abs=0.3)
        assert found.notes == (
            "it does not say the speed limit of every road; taken for one is "
            f"{found.roads['11'].speed_limit[0]:.1f} m/s, the 0.9 quantile of the speeds driven",
        )

    def test_only_cars_demonstrate(self, tmp_path: Path) -> None:
        path = tmp_path / "scene.xml"
        path.write_text(scene(limit=10.0, last="truck"))
        found = read_commonroad(path)
        assert set(found.roads) == {"11", "12"}
        assert "13" in set(found.table["vehicle"])
        assert found.notes == ("1 vehicle does not demonstrate (13): does not drive as cars do",)

    def test_a_trajectory_may_repeat_the_initial_state(self, tmp_path: Path) -> None:
        path, again = tmp_path / "scene.xml", tmp_path / "again.xml"
        text = scene(limit=10.0)
        path.write_text(text)
        first = state("state", 0, 5.0, 0.0)
        again.write_text(text.replace("<trajectory>", f"<trajectory>{first}", 1))
        assert read_commonroad(path).table.equals(read_commonroad(again).table)


def table(**columns: Any) -> pd.DataFrame:
    rows = {
        "time": np.arange(20) / 10,
        "vehicle": ["a"] * 10 + ["b"] * 10,
        "x": np.arange(20.0),
        "y": 0.0,
        "length": 5.0,
        "width": 1.8,
    }
    return pd.DataFrame(rows | columns)


def at(row: int, value: Any, column: str) -> dict[str, Any]:
    values = table()[column].astype(object).tolist()
    values[row] = value
    return {column: values}


class TestChecked:
    def test_a_sound_table_is_sorted(self) -> None:
        found, interval = checked(table().sample(frac=1.0, random_state=0), "f")
        assert interval == 0.1
        assert found.equals(table()[list(COLUMNS)])

    def test_gaps_are_allowed(self) -> None:
        gap = table().drop(index=[3, 4, 5, 14])
        assert checked(gap.reset_index(drop=True), "f")[1] == 0.1

    def test_times_may_be_rounded_a_little(self) -> None:
        times = np.round(np.arange(20) / 29.97, 3)
        assert checked(table(time=times), "f")[1] == pytest.approx(1 / 29.97, abs=1e-3)

    @pytest.mark.parametrize(
        ("columns", "said"),
        [
            (at(4, np.nan, "x"), "f: row 5: x is not a number (nan); mend it or take the row out"),
            (at(7, "far", "y"), "f: row 8: y is not a number (far); mend it or take the row out"),
            (at(0, np.inf, "time"), "f: row 1: time is not a number (inf)"),
            (at(3, -1e9, "y"), "f: row 4: y is nowhere on Earth (-1000000000.0)"),
            (at(2, 0.0, "length"), "f: row 3: length is not positive (0.0)"),
            (at(2, " ", "vehicle"), "f: row 3: vehicle is empty; mend it"),
            (at(2, None, "vehicle"), "f: row 3: vehicle is empty; mend it"),
            (
                {"vehicle": "a", "time": np.repeat(np.arange(10), 2) / 10},
                "f: overlapping ids: vehicle 'a' is there twice at 0 s; give every vehicle an id",
            ),
            (
                at(6, 0.63, "time"),
                "f: times are not regular: vehicle 'a' is there at 0.5 and 0.63 s, but its rows "
                "are 0.1 s apart",
            ),
            (
                {"time": np.arange(20.0)},
                "f: its rows are 1 s apart; learning needs 0.02 to 0.2 s; record it again "
                "(SUMO: --step-length 0.1) or resample it",
            ),
            ({"time": np.arange(20.0) / 100}, "f: its rows are 0.01 s apart; learning needs"),
            (
                {"vehicle": [str(k) for k in range(20)]},
                "f: no vehicle is there more than once, so that none drives",
            ),
        ],
    )
    def test_what_makes_no_sense_is_one_line(self, columns: dict[str, Any], said: str) -> None:
        with pytest.raises(UserError) as caught:
            checked(table(**columns), "f")
        assert str(caught.value).startswith(said)

    def test_no_rows(self) -> None:
        with pytest.raises(UserError, match="f: holds no vehicles"):
            checked(table().iloc[:0], "f")


HEADER = "time,vehicle,x,y\n"
FCD = '<fcd-export><timestep time="0.0">{}</timestep></fcd-export>'
FCD_COLUMNS = ["timestep_time", *(f"vehicle_{n}" for n in ("id", "x", "y", "angle", "lane"))]
CAR_1 = '<vehicle id="a" x="5" y="-1.75" angle="90" lane="west_2"/>'


class TestBadFiles:
    @pytest.mark.parametrize(
        ("name", "text", "said"),
        [
            ("f.xml", "<routes/>", ": its root element is <routes>; what can be read is SUMO's"),
            ("f.xml", "", ": not well-formed XML (no element found"),
            ("f.xml", FCD.format(CAR_1)[:-20], ": not well-formed XML ("),
            ("f.xml", "<fcd-export/>", ": holds no vehicles; write it again"),
            ("f.xml", FCD.format('<person id="p" x="1" y="1"/>'), ": holds no vehicles"),
            (
                "f.xml",
                FCD.format('<vehicle id="a" x="5" y="1" lane="west_2"/>'),
                ": angle of vehicle 'a' at 0 s is missing; write it again with SUMO's "
                "--fcd-output.attributes x,y,angle,type,lane",
            ),
            (
                "f.xml",
                FCD.format(CAR_1.replace('"5"', '"here"')),
                ": x of vehicle 'a' at 0 s 'here' is not a number",
            ),
            ("f.xml", FCD.format(CAR_1), ": no vehicle is there more than once"),
            (
                "f.xml",
                FCD.format(CAR_1).replace("</fcd", FCD[12:].format(CAR_1)[:-13] + "</fcd"),
                ": overlapping ids: vehicle 'a' is there twice at 0 s",
            ),
            ("f.csv", ";".join(FCD_COLUMNS), ": holds no vehicles; write it again"),
            ("f.csv", ";".join(FCD_COLUMNS[:-1]), ": has no 'lane'; write it with SUMO's"),
            ("f.csv", "", ": has no column 'time'; it needs time, vehicle, x, y"),
            ("f.csv", HEADER, ": holds no vehicles; write it again"),
            ("f.csv", "time,vehicel,x,y\n", ": unknown column 'vehicel'; did you mean 'vehicle'?"),
            ("f.csv", "time,vehicle,x,y,lenght\n", ": unknown column 'lenght'; did you mean 'leng"),
            ("f.csv", "time,vehicle,x\n", ": has no column 'y'; it needs time, vehicle, x, y"),
            ("f.csv", "time,vehicle,x,y,x\n", ": two columns have one name"),
            ("f.csv", HEADER + "0.0,a,1,\n0.1,a,2,3\n", ": row 1: y is not a number (nan)"),
            ("f.csv", HEADER + "0.0,a,1,one\n0.1,a,2,3\n", ": row 1: y is not a number (one)"),
            (
                "f.csv",
                HEADER + "0,0,a,1,5,2,5\n",
                ": its rows have more values than there are columns",
            ),
            ("f.csv", HEADER + "0,a,1,2\n0,a,1,2,3\n", ": cannot be read as CSV ("),
            (
                "f.csv",
                "time,vehicle,x,y,heading\n0.0,a,1,-2,90\n0.1,a,2,-2,90\n",
                ": row 1: heading 90 looks like degrees; write radians",
            ),
            (
                "f.csv",
                "time,vehicle,x,y,heading\n0.0,a,1,-2,0\n0.1,a,2,-2,\n",
                ": row 2: heading is not a number",
            ),
            (
                "f.csv",
                HEADER + "".join(f"{k / 10},a,{k},5000\n" for k in range(20)),
                ": most of it is farther than 20 m from every lane for cars of ",
            ),
            ("f.parquet", "no parquet", ": is no sound Parquet file ("),
            ("f.txt", HEADER, ": not a kind of file that can be read, which are SUMO's"),
            ("f.xml", scene("2017a"), ": is CommonRoad of the version '2017a'; 2018b and 2020a"),
            (
                "f.xml",
                scene().replace("<x>0.000000000</x>", "<x>nan</x>", 1),
                ": in <point>, x is 'nan', which is no number; write it again",
            ),
            (
                "f.xml",
                scene().replace("<x>0.000000000</x>", "<x>1e12</x>", 1),
                ": lanelet 1 has a bound longer than 300 km; write it again",
            ),
            (
                "f.xml",
                scene().replace('timeStepSize="0.1"', 'timeStepSize="0"'),
                ": timeStepSize is 0, which is not positive; write it again",
            ),
            (
                "f.xml",
                scene().replace('timeStepSize="0.1"', 'timeStepSize="0.5"'),
                ": its rows are 0.5 s apart; learning needs 0.02 to 0.2 s",
            ),
            (
                "f.xml",
                '<commonRoad commonRoadVersion="2020a" timeStepSize="0.1"/>',
                ": holds no lanelets for cars",
            ),
        ],
    )
    def test_what_is_no_recording_is_one_line(
        self, name: str, text: str, said: str, tmp_path: Path
    ) -> None:
        path = tmp_path / name
        path.write_text(text)
        with pytest.raises(UserError) as caught:
            read(path, Network(HIGHWAY))
        assert str(caught.value).startswith(f"{path}{said}")
        assert "\n" not in str(caught.value)

    def test_another_network(self, driven: tuple[Path, pd.DataFrame]) -> None:
        with pytest.raises(UserError) as caught:
            read(driven[0], Network(HIGHWAY))
        assert str(caught.value).endswith(
            f"and {HIGHWAY} has no such edge; give the network that was driven on"
        )

    def test_geo_coordinates(self, driven: tuple[Path, pd.DataFrame], tmp_path: Path) -> None:
        path = tmp_path / "f.csv"
        frame = pd.DataFrame(
            {
                "timestep_time": np.arange(20) / 10,
                "vehicle_id": "a",
                "vehicle_x": 11.5,
                "vehicle_y": 4800.1,
                "vehicle_angle": 0.0,
                "vehicle_lane": "straight_0",
            }
        )
        frame.to_csv(path, index=False, sep=";")
        with pytest.raises(UserError, match=r"coordinates \(SUMO: without --fcd-output.geo"):
            read(path, Network(CURVE))

    def test_no_network(self, driven: tuple[Path, pd.DataFrame]) -> None:
        with pytest.raises(UserError, match="name the SUMO network that was driven on: --network"):
            read(driven[0])

    @pytest.mark.parametrize("name", ["f.xml", "f.csv", "f.csv.gz", "f.parquet"])
    def test_no_file(self, name: str, tmp_path: Path) -> None:
        with pytest.raises(UserError, match=r"cannot be read \([Nn]o such file"):
            read(tmp_path / name, Network(HIGHWAY))

    def test_a_folder(self, tmp_path: Path) -> None:
        with pytest.raises(UserError, match="is a folder; name a file: SUMO's floating car data"):
            read(tmp_path)

    @pytest.mark.parametrize("name", ["f.xml.gz", "f.csv.gz"])
    def test_half_a_gzipped_file(
        self, name: str, driven: tuple[Path, pd.DataFrame], tmp_path: Path, network: Network
    ) -> None:
        text = (
            driven[0].read_bytes() if "xml" in name else b"time,vehicle,x,y\n" + b"0,1,2,3\n" * 9999
        )
        whole = gzip.compress(text)
        (tmp_path / name).write_bytes(whole[: len(whole) // 2])
        with pytest.raises(UserError, match=f"{name}: .*(damaged|cannot be read as CSV)"):
            read(tmp_path / name, network)

    def test_a_type_of_no_size(
        self, driven: tuple[Path, pd.DataFrame], tmp_path: Path, network: Network
    ) -> None:
        demand = tmp_path / "d.rou.xml"
        demand.write_text('<routes><vType id="own" length="long"/></routes>')
        with pytest.raises(UserError, match="vType 'own': its length 'long' is no size; mend it"):
            read_fcd(driven[0], network, [demand])
