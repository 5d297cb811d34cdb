"""The sound inputs that are damaged: files, and the commands that read them."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

from sumo_cohesion import batch, compare, run

ROOT = Path(__file__).resolve().parent.parent
STREETS = ("--set", "planner.max_curvature=0.2", "--set", "planner.max_curvature_rate=1.0")

_ADDITIONAL = """<additional>
    <vType id="slow" vClass="truck" length="12" laneChangeModel="SL2015" speedFactor="0.8"/>
    <route id="behind" edges="{edges}"/>
    <inductionLoop id="loop" lane="{lane}" pos="50" period="10" file="NUL"/>
    <variableSpeedSign id="sign" lanes="{lane}"><step time="0" speed="30"/></variableSpeedSign>
    <parkingArea id="park" lane="{lane}" startPos="20" endPos="60" roadsideCapacity="4"/>
    <busStop id="halt" lane="{lane}" startPos="60" endPos="80"/>
    <rerouter id="reroute" edges="{first}">
        <interval begin="0" end="5"><destProbReroute id="{last}"/></interval>
    </rerouter>
    <vehicle id="truck" type="slow" route="behind" depart="0" departPos="5" departLane="0"/>
</additional>
"""

_GRID = """name = "grid"
summary = "Around a corner, with traffic lights."
network = "grid.net.xml"
routes = ["grid.rou.xml"]
additional = ["grid.add.xml"]
duration = 30.0
lateral_resolution = 0.8

[ego]
origin = "A0A1"
destination = "B1B2"
lane = 0
position = 20.0
speed = 5.0
depart = 1.0

[sensing]
range = 100.0
hidden = ["lead"]
special = ["other"]

[fleet]
penetration = 0.5

[randomize]
position = 2.0
speed = 0.05
humans = [1, 4]

[human_type]
lcSigma = 0.2
minGap = 2.0

[[events]]
at = 0.5
who = ["lead"]
speed_factor = [0.5, 0.6]

[success]
collision = false
distance = { min = 10.0 }
"""

_GRID_DEMAND = """<routes>
    <vType id="human" laneChangeModel="SL2015" speedDev="0.05"/>
    <vTypeDistribution id="mix">
        <vType id="car" laneChangeModel="SL2015" probability="0.7"/>
        <vType id="bus" vClass="bus" laneChangeModel="SL2015" length="12" probability="0.3"/>
    </vTypeDistribution>
    <route id="along" edges="A0A1 A1B1 B1B2"/>
    <vehicle id="lead" type="human" route="along" depart="0" departPos="60" departLane="0"/>
    <vehicle id="other" type="human" depart="0" departPos="80" departSpeed="5" departLane="1">
        <route edges="A0A1 A1A2"/>
        <stop lane="A1A2_1" startPos="20" endPos="30" duration="2"/>
    </vehicle>
    <trip id="trip" type="mix" depart="0.5" from="B0B1" to="A1A2" departLane="best"/>
    <flow id="flow" type="mix" begin="0" end="20" period="2" from="C1B1" to="A1A0"/>
    <person id="walker" depart="0"><walk from="A0A1" to="A1A0"/></person>
</routes>
"""

_CURVE = """name = "curve"
summary = "A bend."
network = "curve.net.xml"
routes = ["curve.rou.xml"]
duration = 20.0

[ego]
origin = "straight"
destination = "bend_2"
lane = 0
position = 20.0
speed = 10.0

[success]
off_road = false
"""

_CURVE_DEMAND = """<routes>
    <vType id="human" laneChangeModel="SL2015"/>
    <vehicle id="a" type="human" depart="0" departPos="60" departLane="0">
        <route edges="straight bend_1 bend_2"/>
    </vehicle>
</routes>
"""

_EXPERIMENT = """name = "beta"
summary = "Two values of beta."
scenarios = ["mine.toml"]
planners = ["nominal", "sumo"]
seeds = "0:2"
keep = ["ego", "plan"]
sumo_outputs = ["tripinfo"]

[set]
"duration" = 1.0

[grid]
cohesion.beta = [0.03, 0.09]
randomize.humans = [[1, 1], [3, 3]]

[limits]
run_time = 60.0
memory = 8.0
retries = 0
"""


_THETA = """[planner.reward]
lane = 1.0
speed = 0.012
car = 2.3
curvature = 1.1e6

[cohesion]
beta = 0.36
"""


@dataclass(frozen=True)
class Base:
    """Sound files by name, those that may be damaged, and commands to read them with.

    ``weight``: how often it is taken, compared with others.
    """

    name: str
    files: dict[str, bytes]
    damaged: tuple[str, ...]
    commands: tuple[tuple[str, ...], ...]
    weight: float = 1.0


def make_bases(folder: Path) -> list[Base]:
    """Collect the bundled scenarios and make the rest, in a folder for what is made."""
    bases = [_bundled(path) for path in sorted((ROOT / "scenarios").glob("*.toml"))]
    saved = _saved(folder)
    return [*bases, _curve(), _grid(folder), _experiment(), *saved, _weights(), _driving(folder)]


def _run(scenario: str, *more: str) -> tuple[tuple[str, ...], ...]:
    return tuple(("run", scenario, "--planner", p, *more) for p in ("nominal", "sumo"))


def _bundled(path: Path) -> Base:
    text = path.read_text(encoding="utf-8")
    files = {}
    for kind in ("networks", "routes"):
        for file in (ROOT / kind).glob("*.xml"):
            if f'"{file.name}"' in text:
                files[file.name] = file.read_bytes()
    scenario = tomllib.loads(text)
    first, last = scenario["ego"]["origin"], scenario["ego"]["destination"]
    edges = re.search(rf'edges="({first} [^"]*)"', files[scenario["routes"][0]].decode())
    assert edges is not None
    more = _ADDITIONAL.format(edges=edges[1], lane=f"{first}_0", first=first, last=last)
    files["more.add.xml"] = more.encode()
    text = text.replace("duration =", 'additional = ["more.add.xml"]\nduration =', 1)
    files["mine.toml"] = text.encode()
    return Base(path.stem, files, tuple(files), _run("mine.toml"))


def _curve() -> Base:
    files = {
        "curve.toml": _CURVE.encode(),
        "curve.net.xml": (ROOT / "tests" / "networks" / "curve.net.xml").read_bytes(),
        "curve.rou.xml": _CURVE_DEMAND.encode(),
    }
    return Base("curve", files, tuple(files), _run("curve.toml", *STREETS), 3.0)


def _grid(folder: Path) -> Base:
    """Streets with traffic lights, as netgenerate makes them."""
    program = shutil.which("netgenerate") or shutil.which(
        "netgenerate", path=str(Path(sys.executable).parent)
    )
    if program is None:
        raise SystemExit("netgenerate is missing; pip install -e '.[dev]'")
    file = folder / "grid.net.xml"
    grid = ["--grid", "--grid.number", "3", "--grid.length", "120", "-L", "2"]
    options = [*grid, "--tls.guess", "true", "--seed", "1"]
    subprocess.run([program, *options, "-o", str(file)], check=True, capture_output=True)
    edges = "A0A1 A1A2"
    more = _ADDITIONAL.format(edges=edges, lane="A0A1_0", first="A0A1", last="B1B2")
    files = {
        "grid.toml": _GRID.encode(),
        "grid.net.xml": file.read_bytes(),
        "grid.rou.xml": _GRID_DEMAND.encode(),
        "grid.add.xml": more.encode(),
    }
    return Base("grid", files, tuple(files), _run("grid.toml", *STREETS), 6.0)


def _experiment() -> Base:
    scenario = _bundled(ROOT / "scenarios" / "stalled.toml")
    files = {**scenario.files, "beta.toml": _EXPERIMENT.encode()}
    commands = (
        ("batch", "beta.toml", "--out", "out", "--workers", "1"),
        ("batch", "beta.toml", "--out", "out", "--dry-run"),
    )
    return Base("experiment", files, ("beta.toml",), commands, 2.0)


def _saved(folder: Path) -> list[Base]:
    """Folders of results: of a run, a comparison and a batch."""
    short = {"duration": 2.0}
    run("stalled", "nominal", 0, overrides=short, out=folder / "run")
    compare("stalled", ("nominal", "sumo"), (0, 1), overrides=short, out=folder / "pair")
    experiment = {
        "scenarios": ["stalled"],
        "planners": ["sumo"],
        "seeds": "0:2",
        "keep": ["ego"],
        "set": short,
        "grid": {"randomize.humans": [[1, 1], [3, 3]]},
    }
    batch(experiment, folder / "batch")
    grid = ("--metric", "mean_speed", "--over", "randomize.humans", "--out", "x.png")
    return [
        _kept(folder / "run", ("--out", "x.png"), 2.0),
        _kept(folder / "pair", ("--out", "x.png"), 1.0),
        _kept(folder / "batch", grid, 1.0),
    ]


def _kept(folder: Path, figure: tuple[str, ...], weight: float) -> Base:
    files = {
        str(path.relative_to(folder.parent)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }
    damaged = tuple(n for n in files if not n.endswith(".png"))
    commands = (("metrics", folder.name), ("figure", folder.name, *figure))
    learned = [(*_learn(folder.name), "--from", kind) for kind in ("plans", "driven", "humans")]
    return Base(folder.name, files, damaged, (*commands, *learned), weight)


def _learn(*demos: str) -> tuple[str, ...]:
    return ("learn", *demos, "--bootstrap", "0", "--hold-out", "0", "--out", "theta.toml")


def _weights() -> Base:
    """Weights that were learned, and a run with them."""
    values = ("--set", "planner.reward=@theta.toml", "--set", "cohesion.beta=@theta.toml")
    run_with = ("run", "stalled", "--planner", "nominal", "--set", "duration=1.0", *values)
    files = {"theta.toml": _THETA.encode()}
    return Base("weights", files, tuple(files), (run_with,))


def _driving(folder: Path) -> Base:
    """Driving to learn from: SUMO's own output on the streets, and the same as a table."""
    demand, output = folder / "grid.rou.xml", folder / "fcd.xml"
    demand.write_text(_GRID_DEMAND, encoding="utf-8")
    program = shutil.which("sumo", path=str(Path(sys.executable).parent)) or "sumo"
    files = ["-n", str(folder / "grid.net.xml"), "-r", str(demand), "--fcd-output", str(output)]
    options = ["--step-length", "0.1", "--end", "8", "--precision", "6", "--seed", "1"]
    subprocess.run([program, *files, *options], check=True, capture_output=True)
    rows = ["time,vehicle,x,y"]
    time = ""
    for line in output.read_text(encoding="utf-8").splitlines():
        step = re.search(r'<timestep time="([^"]*)"', line)
        time = step[1] if step else time
        car = re.search(r'<vehicle id="([^"]*)" x="([^"]*)" y="([^"]*)"', line)
        if car:
            rows.append(",".join((time, *car.groups())))
    network = "grid.net.xml"
    contents = {
        "fcd.xml": output.read_bytes(),
        "table.csv": "\n".join(rows).encode(),
        network: (folder / network).read_bytes(),
        "grid.rou.xml": demand.read_bytes(),
    }
    commands = (
        (*_learn("fcd.xml"), "--network", network),
        (*_learn("fcd.xml"), "--network", network, "--demand", "grid.rou.xml"),
        (*_learn("table.csv"), "--network", network),
    )
    return Base("driving", contents, tuple(contents), commands, 2.0)
