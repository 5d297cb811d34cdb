"""A user's mistake ends with status 2 and one line; no traceback, nothing half-written."""

from __future__ import annotations

import importlib
import os
import shutil
import stat
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sumo_cohesion import cli
from sumo_cohesion.batches import workers
from tests.conftest import ROOT

Invoke = Callable[..., tuple[int, str, str]]


def call_here(task: str, *arguments: object) -> object:
    """Call a task as workers.call_apart does, but here."""
    module, _, name = task.partition(":")
    return getattr(importlib.import_module(module), name)(*arguments)


@pytest.fixture
def invoke(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Invoke:
    """Call the command line in an empty folder: (status, stdout, stderr).

    In this one process, which is quicker; test_own_process.py has the rest.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(workers, "call_apart", call_here)

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["sumo-cohesion", *map(str, arguments)])
        status = 0
        try:
            cli.main()
        except SystemExit as stop:
            status = int(str(stop.code))
        return status, *capfd.readouterr()

    return call


@pytest.fixture
def scenario(tmp_path: Path) -> Callable[..., Path]:
    """Write a scenario with its own files, changed as asked."""

    def write(
        old: str = "", new: str = "", net: str | None = None, routes: str | None = None
    ) -> Path:
        text = (ROOT / "scenarios" / "stalled.toml").read_text()
        assert old in text
        (tmp_path / "mine.toml").write_text(text.replace(old, new) if old else text)
        if net is not None:
            (tmp_path / "highway.net.xml").write_text(net)
        if routes is not None:
            (tmp_path / "stalled.rou.xml").write_text(routes)
        return tmp_path / "mine.toml"

    return write


def assert_one_line(result: tuple[int, str, str], *needles: str) -> None:
    status, out, err = result
    assert status == 2, err
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    for needle in needles:
        assert needle in err


NET = (ROOT / "networks" / "highway.net.xml").read_text()
ROUTES = (ROOT / "routes" / "stalled.rou.xml").read_text()


@pytest.mark.parametrize(
    ("old", "new", "needles"),
    [
        ('network = "highway.net.xml"', 'network = "gone.net.xml"', ["gone.net.xml", "beside it"]),
        ('"stalled.rou.xml"', '"gone.rou.xml"', ["gone.rou.xml"]),
        ("duration = 40.0", 'duration = "long"', ["duration", "number", "'long'"]),
        ("duration = 40.0", "duration = -1.0", ["duration", "greater than"]),
        ("duration = 40.0", "duration = nan", ["duration"]),
        ("duration = 40.0", "duraton = 40.0", ["duraton", "duration"]),
        ("duration = 40.0", "duration = 40\nlateral_resolution = 1e-6", ["lateral_resolution"]),
        ("speed = 25.0", "speed = 25.0\ndepart = 1e9", ["ego.depart", "604800"]),
        ("speed = 25.0", "sped = 25.0", ["ego.sped", "speed"]),
        ("lane = 0", "lane = 7", ["ego.lane = 7", "lanes 0 to 2"]),
        ("lane = 0", "lane = -1", ["ego.lane"]),
        ("lane = 0", "lane = 0.5", ["ego.lane", "integer"]),
        ("position = 100.0", "position = 5000.0", ["ego.position", "1000.0 m long"]),
        ('origin = "west"', 'origin = "nowhere"', ["no edge 'nowhere'", "east, west"]),
        ('destination = "east"', 'destination = "west"\n', []),
        ('hidden = ["stalled"]', 'hidden = ["ghost"]', ["'ghost'"]),
        ("collision = false", "colision = false", ["colision", "collision"]),
        ("distance = { min = 620.0 }", "distance = { least = 620.0 }", ["success.distance"]),
        ("humans = [3, 7]", "humans = [7, 3]", ["randomize", "low <= high"]),
        ("speed = 0.02", "speed = 2.0", ["randomize.speed"]),
        ("[success]", "[success]\nsuccess = true", ["success", "itself"]),
        ("[success]", "[success]\noutcome = { min = 1 }", ["outcome", "no number"]),
        (
            "[success]",
            "[success]\nnominal_speed_deviation = { max = 1 }",
            ["compare", "twin_speed"],
        ),
        ("[success]", "[success]\ntwin_speed_deviation = { max = 1 }", ["reference = true"]),
        ("[success]", "[human_type]\nlcSigmo = 1\n[success]", ["'lcSigmo'", "'lcSigma'"]),
        ("[success]", "[human_type]\nlcSigma = nan\n[success]", ["human_type.lcSigma", "finite"]),
        ("[success]", "[human_type]\nlcSigma = 'x'\n[success]", ["lcSigma"]),
        ("[success]", "[human_type]\nlcSigma = [1]\n[success]", ["human_type.lcSigma", "number"]),
        ("[success]", "[fleet]\npenetration = 1.5\n[success]", ["fleet.penetration", "1.5"]),
        ("[success]", "[fleet]\npenetration = nan\n[success]", ["fleet.penetration", "nan"]),
        ("[success]", "[fleet]\nshare = 0.5\n[success]", ["fleet.share", "penetration"]),
        ("[ego]", "[ego", ["not valid TOML"]),
    ],
)
def test_scenario_files(
    invoke: Invoke, scenario: Callable[..., Path], old: str, new: str, needles: list[str]
) -> None:
    path = scenario(old, new)
    if not needles:  # valid: the route is one edge; it must simply run
        assert invoke("run", path, "--set", "duration=1.0")[0] == 0
        return
    assert_one_line(invoke("run", path), *needles)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "text", "needles"),
    [
        ("net", '<net><edge id="a"', ["highway.net.xml", "not well-formed"]),
        ("net", NET[: len(NET) // 2], ["highway.net.xml", "truncated"]),
        ("net", "", ["highway.net.xml", "not well-formed"]),
        ("net", "<routes/>", ["highway.net.xml", "<routes>", "<net>"]),
        ("net", "<net/>", ["highway.net.xml", "netconvert"]),
        (
            "net",
            NET.replace('numLanes="3"', "").replace('index="1"', 'index="x"'),
            ["highway.net.xml"],
        ),
        ("routes", ROUTES[: len(ROUTES) // 2], ["stalled.rou.xml", "truncated"]),
        ("routes", "no xml at all", ["stalled.rou.xml", "not well-formed"]),
        ("routes", ROUTES.replace('edges="west east"', 'edges="west moon"'), ["'moon'"]),
        ("routes", ROUTES.replace('departLane="2"', 'departLane="9"'), ["departLane", "other_1"]),
        ("routes", ROUTES.replace('type="human"', 'type="alien"'), ["alien"]),
        ("routes", ROUTES.replace('departPos="160"', 'departPos="far"'), ["lead_1", "departPos"]),
        ("routes", ROUTES.replace('departPos="160"', 'departPos="nan"'), ["lead_1", "departPos"]),
        ("routes", ROUTES.replace('id="lead_1"', 'id="ego"'), ["'ego'"]),
        ("routes", ROUTES.replace('id="lead_1"', 'id="lead_2"'), ["lead_2"]),
    ],
)
def test_broken_network_and_route_files(
    invoke: Invoke, scenario: Callable[..., Path], kind: str, text: str, needles: list[str]
) -> None:
    path = scenario(**{kind: text})
    assert_one_line(invoke("run", path, "--out", "result"), *needles)
    assert not Path("result").exists()
    assert invoke("run", "stalled", "--set", "duration=1.0")[0] == 0, "the process must live on"


@pytest.mark.parametrize(
    ("arguments", "needles"),
    [
        (["run", "staled"], ["'staled'", "did you mean 'stalled'"]),
        (["run", "nowhere.toml"], ["nowhere.toml", "No such file"]),
        (["run", "stalled", "--planner", "fast"], ["'fast'", "nominal, cohesive"]),
        (["run", "stalled", "--seed", "-1"], ["seed -1"]),
        (["run", "stalled", "--seed", "x"], ["'x'"]),
        (["run", "stalled", "--set", "cohesion.bta=1"], ["cohesion", "bta", "beta"]),
        (["run", "stalled", "--set", "cohesion.beta=nan"], ["cohesion", "beta"]),
        (["run", "stalled", "--set", "cohesion.interval=x"], ["settings: interval: "]),
        (["run", "stalled", "--set", "planner.horizon=0"], ["horizon", "greater than"]),
        (["run", "stalled", "--set", "planner.solver=magic"], ["solver", "fatrop"]),
        (["run", "stalled", "--set", "beta"], ["name=value"]),
        (["run", "stalled", "--set", "beta=1"], ["did you mean 'cohesion.beta'"]),
        (["run", "stalled", "--set", "planner=nominal"], ["planner.horizon", "--planner"]),
        (["run", "stalled", "--set", "egg.lane=1"], ["did you mean 'ego.lane'"]),
        (["run", "stalled", "--set", "weather=1"], ["planner.*", "cohesion.*", "duration"]),
        (["run", "stalled", "--set", "planner.reward=@theta.toml"], ["theta.toml", "No such file"]),
        (["compare", "stalled", "--set", "cohesion.beta=@."], [".: ", "Is a directory"]),
        (
            ["scenario", "export", "stalled", "--out", "x", "--set", "planner.reward=@"],
            ["name a TOML file"],
        ),
        (["run", "stalled", "--set", ".duration=5"], ["unknown setting", "'.duration'"]),
        (
            ["run", "stalled", "--set", 'success.min_gap={"min" = 2.0, "max" = 1.0}'],
            ["success.min_gap: min 2 is more than max 1"],
        ),
        (["run", "stalled", "--set", f"planner.horizon={'9' * 500}"], ["horizon", "999..."]),
        (["run", "stalled", "--sed", "1"], ["--sed"]),
        (["compare", "stalled", "--seeds", "5:5"], ["5:5", "empty"]),
        (["compare", "stalled", "--seeds", "a:b"], ["0:20"]),
        (["compare", "stalled", "--seeds", "1,1"], ["seed 1", "twice"]),
        (["compare", "stalled", "--planners", ","], ["at least one planner"]),
        (["compare", "stalled", "--planners", "nominal,wrong"], ["'wrong'"]),
        (["compare", "stalled", "--workers", "0"], ["workers"]),
        (["metrics", "nothing"], ["no runs"]),
        (["figure", "nothing"], ["nothing"]),
        (["scenario", "export", "staled", "--out", "x"], ["'staled'"]),
        (["flyy"], ["flyy"]),
    ],
)
def test_arguments(invoke: Invoke, arguments: list[str], needles: list[str]) -> None:
    assert_one_line(invoke(*arguments), *needles)
    assert not any(Path().iterdir())


@pytest.mark.parametrize("command", ["run", "compare", "export"])
def test_folders_that_hold_something_else_are_left_alone(invoke: Invoke, command: str) -> None:
    mine = Path("thesis")
    mine.mkdir()
    (mine / "chapter.tex").write_text("years of work")
    arguments = {
        "run": ["run", "stalled", "--set", "duration=1.0"],
        "compare": ["compare", "stalled", "--seeds", "0:1", "--set", "duration=1.0"],
        "export": ["scenario", "export", "stalled"],
    }[command]
    assert_one_line(invoke(*arguments, "--out", mine), "thesis", "choose another --out")
    assert [p.name for p in mine.iterdir()] == ["chapter.tex"]


def test_a_file_in_the_way_of_the_folder(invoke: Invoke) -> None:
    Path("taken").write_text("a file")
    for out in ("taken", "taken/inside"):
        result = invoke("run", "stalled", "--set", "duration=1.0", "--out", out)
        assert_one_line(result, "taken")
    assert Path("taken").read_text() == "a file"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_folder(invoke: Invoke) -> None:
    locked = Path("locked")
    locked.mkdir()
    locked.chmod(stat.S_IRUSR | stat.S_IXUSR)
    result = invoke("run", "stalled", "--set", "duration=1.0", "--out", locked / "run")
    assert_one_line(result, "locked", "cannot write")


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs Linux")
def test_a_folder_that_cannot_be_made_is_said_before_the_drive(
    invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sumo_cohesion.simulation.run.simulate", None)
    result = invoke("run", "stalled", "--out", "/proc/nowhere/run")
    assert_one_line(result, "/proc/nowhere/run", "cannot write there")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux")
def test_a_full_disk_leaves_nothing_half_written(
    invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pandas as pd

    def full(self: pd.DataFrame, path: Path, **_: object) -> None:
        Path(path).write_bytes(b"half a table")
        with Path("/dev/full").open("wb", buffering=0) as disk:
            disk.write(b"x")  # raises what a full disk raises

    monkeypatch.setattr(pd.DataFrame, "to_parquet", full)
    result = invoke("run", "stalled", "--set", "duration=1.0", "--out", "run")
    assert_one_line(result, "run", "No space left")
    assert not any(Path().iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="screens are found otherwise elsewhere")
def test_no_screen_for_the_window(invoke: Invoke, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    assert_one_line(invoke("run", "stalled", "--gui"), "--gui", "scenario export")


@pytest.mark.parametrize(
    ("key", "size"), [("length", "inf"), ("width", "inf"), ("width", "1e308"), ("length", "2e4")]
)
def test_a_vehicle_of_no_possible_size(
    invoke: Invoke, scenario: Callable[..., Path], key: str, size: str
) -> None:
    Path("more.add.xml").write_text(
        f'<additional><vType id="endless" laneChangeModel="SL2015" {key}="{size}"/>'
        '<vehicle id="odd" type="endless" depart="0" departLane="2" departPos="300">'
        '<route edges="west east"/></vehicle></additional>'
    )
    path = scenario("duration = 40.0", 'duration = 2.0\nadditional = ["more.add.xml"]')
    assert_one_line(
        invoke("run", path, "--planner", "sumo"), "'odd'", f"{float(size):g} m", "mend its type"
    )


@pytest.mark.slow
def test_damaged_results_say_so(invoke: Invoke) -> None:
    import pandas as pd

    assert invoke("run", "stalled", "--set", "duration=1.0", "--out", "run")[0] == 0
    table = Path("run") / "trajectory.parquet"
    whole = pd.read_parquet(table)
    for damaged in (whole.drop(columns="d"), whole.iloc[:0], whole.iloc[:1]):
        damaged.to_parquet(table)
        assert_one_line(invoke("figure", "run"), "run", "not those that were written", "run it")
    (Path("run") / "trajectory.parquet").write_bytes(b"junk")
    assert_one_line(invoke("figure", "run"), "not a complete run")
    (Path("run") / "metrics.parquet").write_bytes(b"junk")
    assert_one_line(invoke("metrics", "run"), "not a readable table")
    shutil.rmtree("run")
