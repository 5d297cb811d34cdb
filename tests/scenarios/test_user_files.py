"""What users bring, in SUMO itself: files wherever they lie, and what SUMO writes for them."""

from __future__ import annotations

import gzip
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import pytest

from sumo_cohesion import cli
from sumo_cohesion.errors import UserError
from sumo_cohesion.simulation.export import export_scenario
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.run import run
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.tables.folders import MARKER
from sumo_cohesion.traffic.simulator import Simulator
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

WAY = '<route id="r" edges="west east"/>'
HUMAN = "<vType id='h' laneChangeModel='SL2015' speedFactor='0.8' speedDev='0'/>"
LEAD = (
    "<vehicle id='lead' type='h' route='r' "
    'depart="0" departLane="0" departPos="150" '
    'departSpeed="desired" insertionChecks="none"/>'
)
SCENARIO = """
name = "mine"
summary = "A user's own files."
network = "{network}"
routes = ["{routes}"]
additional = [{additional}]
duration = 3.0

[ego]
origin = "west"
destination = "east"
lane = 0
position = 100.0
speed = 20.0

[sensing]
range = 200.0

[success]
collision = false
"""
LOOP = '<inductionLoop id="{0}" lane="west_0" pos="155" period="1" file="{1}"/>'

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Write a scenario with its own files into a folder."""

    def call(
        folder: str = "mine",
        network: str = "my.net.xml",
        routes: str = f"<routes>{HUMAN}{WAY}{LEAD}</routes>",
        **additional: str,
    ) -> Path:
        here = tmp_path / folder
        here.mkdir(exist_ok=True)
        net = (ROOT / "networks" / "highway.net.xml").read_bytes()
        (here / network).write_bytes(gzip.compress(net) if network.endswith(".gz") else net)
        (here / "my.rou.xml").write_text(routes)
        names = []
        for name, text in additional.items():
            names.append(f'"{name}.add.xml"')
            (here / f"{name}.add.xml").write_text(f"<additional>{text}</additional>")
        (here / "mine.toml").write_text(
            SCENARIO.format(network=network, routes="my.rou.xml", additional=", ".join(names))
        )
        return here / "mine.toml"

    return call


def called(name: str, text: str) -> str:
    """Give the type another name."""
    return text.replace("'h'", f"'{name}'")


def drive(scenario: Path, folder: Path, seconds: float = 3.0, seed: int = 0) -> list[str]:
    """Let SUMO drive a scenario; returns which vehicles there were, and what SUMO wrote."""
    setup = prepare(RunRequest(scenario, "sumo", seed))
    sumo_run = setup.write_inputs(folder)
    with Simulator(sumo_run, setup.ego_size, setup.read_radius) as sumo:
        sumo.insert_ego(1.0)
        for _ in range(round(seconds * 10)):
            sumo.step(None)
        vehicles = sorted(sumo.vehicles())
    written = sumo_run.output_folder
    return (
        vehicles + sorted(path.name for path in written.iterdir() if written)
        if written
        else vehicles
    )


def plain_sumo(config: Path) -> set[str]:
    """Vehicles that SUMO's own program drives when it opens a configuration."""
    program = Path(sys.executable).parent / "sumo"
    if not program.exists():
        pytest.skip("SUMO's programs are in the extra [gui]")
    trips = config.parent.parent / "trips.xml"
    asked = ["--end", "3", "--tripinfo-output", trips, "--tripinfo-output.write-unfinished"]
    done = subprocess.run([program, "-c", config, *asked], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return {trip.get("id", "") for trip in ET.parse(trips).iter("tripinfo")}


@pytest.mark.parametrize("root", ["trips", "additional", "additionals"])
def test_roots_that_sumo_takes(write: Write, tmp_path: Path, root: str) -> None:
    trip = '<trip id="a" depart="0" from="west" to="east"/>'
    assert drive(write(routes=f"<{root}>{trip}</{root}>"), tmp_path) == ["a"]


def test_gzipped_network_and_demand(write: Write, tmp_path: Path) -> None:
    scenario = write(network="my.net.xml.gz", loops="")
    for name in ("my.rou.xml", "loops.add.xml"):
        path = scenario.with_name(name)
        path.write_bytes(gzip.compress(path.read_bytes()))
    assert drive(scenario, tmp_path) == ["lead"]
    rollout = run(scenario, "nominal")
    assert rollout.metrics["outcome"].iloc[0] == "finished"


def test_types_included_beside_the_route_file(write: Write, tmp_path: Path) -> None:
    scenario = write(routes=f'<routes><include href="sub/types.xml"/>{WAY}{LEAD}</routes>')
    (scenario.parent / "sub").mkdir()
    (scenario.parent / "sub" / "types.xml").write_text(f"<routes>{HUMAN}</routes>")
    assert drive(scenario, tmp_path) == ["lead"]


def test_a_comma_in_a_folders_name(write: Write, tmp_path: Path) -> None:
    scenario = write("a, b", detectors=LOOP.format("l", "loop.xml"), poi="", gz="")
    assert drive(scenario, tmp_path) == ["lead", "loop.xml"]
    assert sorted(path.name for path in scenario.parent.glob("*.xml")) == [
        "detectors.add.xml", "gz.add.xml", "my.net.xml", "my.rou.xml", "poi.add.xml",
    ]  # fmt: skip


def test_a_comma_in_the_temporary_folder_is_named(write: Write, tmp_path: Path) -> None:
    (tmp_path / "x,y").mkdir()
    with pytest.raises(UserError, match=r"splits names of files at commas.*TMPDIR"):
        drive(write(), tmp_path / "x,y")
    with pytest.raises(UserError, match=r"splits names of files at commas.*choose another --out"):
        export_scenario(write(), tmp_path / "out,put")


def test_a_type_called_ego_is_the_users(write: Write, tmp_path: Path) -> None:
    kind = '<vType id="ego" laneChangeModel="SL2015" length="9"/>'
    scenario = write(routes=f"<routes>{kind}{WAY}{called('ego', LEAD)}</routes>")
    assert drive(scenario, tmp_path) == ["lead"]


def test_human_types_of_additional_files(write: Write, tmp_path: Path) -> None:
    scenario = write(routes=f"<routes>{WAY}{LEAD}</routes>", types=HUMAN)
    setup = prepare(RunRequest(scenario, "sumo", 0, {"human_type.speedFactor": 0.4}))
    with Simulator(setup.write_inputs(tmp_path), setup.ego_size, setup.read_radius) as sumo:
        scene = sumo.insert_ego(1.0)
        for _ in range(100):
            sumo.step(None)
            scene = sumo.read()
    assert scene.ids == ("lead",)
    assert scene.states[0][3] == pytest.approx(0.4 * 25.0, abs=1.0)


def test_human_types_that_are_built_in(write: Write, tmp_path: Path) -> None:
    mine = LEAD.replace("type='h'", "")
    early = mine.replace("lead", "early").replace('departLane="0"', 'departLane="1"')
    way = WAY.replace('"r"', '"q"')
    scenario = write(routes=f"<routes>{WAY}{mine}</routes>", cars=way + early.replace("'r'", "'q'"))
    setup = prepare(RunRequest(scenario, "sumo", 0, {"human_type.length": 7.5}))
    with Simulator(setup.write_inputs(tmp_path), setup.ego_size, setup.read_radius) as sumo:
        scene = sumo.insert_ego(1.0)
    assert dict(zip(scene.ids, scene.sizes[:, 0], strict=True)) == {"lead": 7.5, "early": 7.5}


def test_cars_of_a_flow_want_different_speeds(write: Write, tmp_path: Path) -> None:
    flow = (
        '<flow id="f" type="h" begin="0" period="0.5" from="west" to="east" departLane="random"/>'
    )
    scenario = write(routes=f"<routes>{HUMAN}{flow}</routes>")
    setup = prepare(RunRequest(scenario, "sumo", 0, {"randomize.speed": 0.1}))
    factors: dict[str, float] = {}
    with Simulator(setup.write_inputs(tmp_path), setup.ego_size, setup.read_radius) as sumo:
        sumo.insert_ego(1.0)
        for _ in range(300):
            sumo.step(None)
            vehicle = sumo._sumo.vehicle
            factors |= {name: vehicle.getSpeedFactor(name) for name in sumo.vehicles()}
    assert len(factors) > 30
    assert 0.72 <= min(factors.values()) < 0.76
    assert 0.84 < max(factors.values()) <= 0.88


def test_what_detectors_write_is_the_runs_own(write: Write, tmp_path: Path) -> None:
    scenario = write(
        routes=f"<routes>{HUMAN}{WAY}{LEAD}</routes>",
        detectors=LOOP.format("a", "loops.xml")
        + LOOP.format("b", "loops.xml")
        + '<edgeData id="e" period="1" file="sub/edges.xml"/><include href="more/more.xml"/>'
        + '<variableSpeedSign id="v" lanes="east_0" file="signs.xml"/>',
    )
    home = scenario.parent
    (home / "more").mkdir()
    (home / "more" / "more.xml").write_text(
        f"<additional>{LOOP.format('c', 'loops.xml')}</additional>"
    )
    (home / "signs.xml").write_text('<vss><step time="0" speed="13"/></vss>')
    before = {path: path.stat().st_mtime_ns for path in home.rglob("*")}
    for seed in (0, 1):
        folder = tmp_path / f"run_{seed}"
        folder.mkdir()
        assert drive(scenario, folder, seed=seed) == [
            "lead", "edges.xml", "loops.xml", "loops_2.xml",
        ]  # fmt: skip
        loops = ET.parse(folder / "outputs" / "loops.xml").getroot()
        assert {interval.get("id") for interval in loops} == {"a", "b"}
        (other,) = {
            interval.get("id")
            for interval in ET.parse(folder / "outputs" / "loops_2.xml").getroot()
        }
        assert other == "c"
    assert {path: path.stat().st_mtime_ns for path in home.rglob("*")} == before


def test_devices_of_types_write_into_the_runs_folder(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    device = '<param key="has.ssm.device" value="1"/><param key="device.ssm.file" value="my.xml"/>'
    human = HUMAN.replace("/>", f">{device}</vType>")
    scenario = write(routes=f"<routes>{human}{WAY}{LEAD}</routes>")
    assert drive(scenario, tmp_path) == ["lead", "my.xml"]
    assert not (tmp_path / "my.xml").exists()


def test_a_run_without_outputs_has_no_folder_for_them(write: Write, tmp_path: Path) -> None:
    sumo_run = prepare(RunRequest(write(poi='<poi id="p" x="0" y="0"/>'), "sumo")).write_inputs(
        tmp_path
    )
    assert sumo_run.output_folder is None
    assert [path.name for path in tmp_path.glob("*.xml")] == ["demand.rou.xml"]


def test_export_of_all_that_the_files_name(write: Write, tmp_path: Path) -> None:
    scenario = write(
        "R&D, 50%20 'new'",
        "a&b, c%20.net.xml",
        one=LOOP.format("a", "loops.xml")
        + '<include href="more/types.xml"/>'
        + '<variableSpeedSign id="v" lanes="east_0" file="more/one.add.xml"/>'
        + '<variableSpeedSign id="w" lanes="east_1" file="signs.xml"/>',
        **{"two&": LOOP.format("b", "loops.xml")},
        routes=f"<routes>{WAY}{called('inner', LEAD)}</routes>",
    )
    home = scenario.parent
    (home / "more").mkdir()
    (home / "more" / "types.xml").write_text(f"<routes>{called('inner', HUMAN)}</routes>")
    (home / "more" / "one.add.xml").write_text('<vss><step time="0" speed="13"/></vss>')
    (home / "signs.xml").write_text('<vss><step time="0" speed="14"/></vss>')
    config = export_scenario(scenario, tmp_path / "out")
    shutil.rmtree(home)
    shutil.move(tmp_path / "out", tmp_path / "moved")
    assert plain_sumo(tmp_path / "moved" / config.name) == {"ego", "lead"}
    names = {path.name for path in (tmp_path / "moved").iterdir()} - {MARKER}
    assert names == {
        "scenario.sumocfg", "demand.rou.xml", "a&b_ c_20.net.xml", "one.add.xml", "two&.add.xml",
        "one_2.add.xml", "signs.xml", "loops.xml",
    }  # fmt: skip


def test_export_of_files_of_one_name(write: Write, tmp_path: Path) -> None:
    scenario = write(network="demand.rou.xml", same=LOOP.format("a", "loops.xml"))
    (scenario.parent / "sub").mkdir()
    other = '<additional><poi id="p" x="0" y="0"/></additional>'
    (scenario.parent / "sub" / "same.add.xml").write_text(other)
    text = scenario.read_text().replace('"same.add.xml"', '"same.add.xml", "sub/same.add.xml"')
    scenario.write_text(text)
    config = export_scenario(scenario, tmp_path / "out")
    assert plain_sumo(config) == {"ego", "lead"}
    assert {path.name for path in config.parent.iterdir()} - {MARKER} == {
        "scenario.sumocfg", "demand.rou.xml", "demand_2.rou.xml", "same.add.xml",
        "same_2.add.xml", "loops.xml",
    }  # fmt: skip


@pytest.fixture
def invoke(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str]]:
    """Call the command line: its status, and what it said."""

    def call(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["sumo-cohesion", *map(str, arguments)])
        status = 0
        try:
            cli.main()
        except SystemExit as stop:
            status = int(str(stop.code))
        return status, capfd.readouterr().err

    return call


FLOW = '<flow id="f" type="h" begin="0" period="2" from="west" to="east" departPos="200"/>'


@pytest.mark.parametrize(
    ("old", "new", "setting", "needles"),
    [
        ("", "", "ego.speed=40", ["ego.speed = 40", "'west'", "25.00 m/s"]),
        ("SL2015", "LC2013", "duration=1", ["vType 'h'", "'LC2013'", "SL2015"]),
        (LEAD, FLOW, "randomize.humans=[1,2]", ["randomize.humans", "flow 'f'", "<trip>"]),
        (LEAD, FLOW, "randomize.position=5", ["randomize.position", "flow 'f'", "random"]),
        (HUMAN, "", "human_type.sigma=0.2", ["or additional file", "'h'"]),
        ("", "", "ego.origin=123#0", ["no edge '123#0'"]),
        ("", "", "ego.origin=145354574", ["no edge '145354574'"]),
    ],
)
def test_mistakes_are_one_line_that_helps(
    invoke: Callable[..., tuple[int, str]],
    write: Write,
    old: str,
    new: str,
    setting: str,
    needles: list[str],
) -> None:
    text = f"<routes>{HUMAN}{WAY}{LEAD}</routes>"
    status, said = invoke("run", write(routes=text.replace(old, new)), "--set", setting)
    assert status == 2
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    for needle in needles:
        assert needle in said


def test_additional_files_come_first(invoke: Callable[..., tuple[int, str]], write: Write) -> None:
    calibrator = (
        '<calibrator id="k" edge="east" pos="0"><flow begin="0" end="9" route="r" type="h"/>'
    )
    status, said = invoke("run", write(k=f"{calibrator}</calibrator>"))
    assert status == 2
    assert "k.add.xml: uses the vehicle type 'h' of a route file, but SUMO reads additional" in said


def test_a_run_says_what_its_seed_leaves_alone(
    invoke: Callable[..., tuple[int, str]], write: Write
) -> None:
    trip = '<trip id="t" type="h" depart="0" from="west" to="east"/>'
    scenario = write(routes=f"<routes>{HUMAN}{trip}</routes>")
    status, said = invoke("run", scenario, "--planner", "sumo", "--set", "randomize.position=5")
    assert status == 0
    assert "note: randomize.position leaves trip 't' where SUMO puts it" in said


def test_a_scenario_with_a_byte_order_mark(write: Write, tmp_path: Path) -> None:
    scenario = write()
    scenario.write_bytes(b"\xef\xbb\xbf" + scenario.read_bytes())
    assert drive(scenario, tmp_path) == ["lead"]
