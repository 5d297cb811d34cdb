"""The demand of one run: what a scenario and its seed change in it, and what they leave alone."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sumo_cohesion.errors import UserError
from sumo_cohesion.traffic.demand import CheckedDemand, build_demand, check_demand, check_human_type
from sumo_cohesion.traffic.demand_files import read_demand
from sumo_cohesion.traffic.library import vehicle_type_attributes
from sumo_cohesion.traffic.network import Network
from sumo_cohesion.traffic.settings import EgoDemand, Randomization
from tests.conftest import ROOT

EGO = EgoDemand(origin="west", destination="east", lane=0, position=100.0, speed=25.0)
HIGHWAY = Network(ROOT / "networks" / "highway.net.xml")
Build = Callable[..., ET.Element]
Check = Callable[..., CheckedDemand]


@pytest.fixture
def build(tmp_path: Path) -> Build:
    """Demand of a route file whose stalled car is no human."""

    def call(
        text: str,
        human_type: dict[str, float | str] | None = None,
        randomize: Randomization | None = None,
        seed: int = 0,
        additional: str = "",
    ) -> ET.Element:
        return build_demand(
            read_demand(*files(tmp_path, text, additional)),
            HIGHWAY,
            ["west", "east"],
            EGO,
            randomize or Randomization(),
            human_type or {},
            fixed={"stalled"},
            seed=seed,
        ).routes

    return call


@pytest.fixture
def check(tmp_path: Path) -> Check:
    """Check a route file as a run does before it starts."""

    def call(text: str, additional: str = "", ego: EgoDemand = EGO, **varied: Any) -> CheckedDemand:
        demand = read_demand(*files(tmp_path, text, additional))
        return check_demand(HIGHWAY, demand, ego, Randomization(**varied), {"f.0"}, set())

    return call


def files(folder: Path, text: str, additional: str) -> tuple[list[Path], list[Path]]:
    (folder / "mine.rou.xml").write_text(f"<routes>{text}</routes>")
    (folder / "mine.add.xml").write_text(f"<additional>{additional}</additional>")
    return [folder / "mine.rou.xml"], [folder / "mine.add.xml"] if additional else []


def cars(demand: ET.Element) -> dict[str, ET.Element]:
    """All that drive but the ego, by name."""
    tags = ("vehicle", "trip", "flow")
    return {e.get("id", ""): e for e in demand if e.tag in tags and e.get("id") != "ego"}


def places(demands: Iterable[ET.Element], name: str) -> list[float]:
    return [float(cars(demand)[name].get("departPos", "nan")) for demand in demands]


def types(demand: ET.Element) -> dict[str, dict[str, str]]:
    return {kind.get("id", ""): dict(kind.attrib) for kind in demand.iter("vType")}


TEXT = """
<vType id="car" lcSigma="0.1" width="1.8"/>
<vType id="truck"/>
<vType id="broken_down" lcSigma="0.0"/>
<vType id="unused"/>
<vehicle id="a" type="car"/>
<flow id="b" type="truck"/>
<vehicle id="stalled" type="broken_down"/>
"""


def test_types_of_humans_are_changed_and_no_others(build: Build) -> None:
    before, after = types(build(TEXT)), types(build(TEXT, {"lcSigma": 0.3, "color": "red"}))
    assert after["car"] == {"id": "car", "lcSigma": "0.3", "width": "1.8", "color": "red"}
    assert after["truck"] == {"id": "truck", "lcSigma": "0.3", "color": "red"}
    for name in ("broken_down", "unused", "ego"):
        assert after[name] == before[name]


def test_a_shared_type_is_a_human_type(build: Build) -> None:
    text = '<vType id="car"/><vehicle id="a" type="car"/><vehicle id="stalled" type="car"/>'
    assert types(build(text, {"lcSigma": 0.3}))["car"]["lcSigma"] == "0.3"


def test_distributions_and_the_default_type(build: Build) -> None:
    text = """
    <vType id="slow"/>
    <vTypeDistribution id="mix" vTypes="slow DEFAULT_TAXITYPE"><vType id="fast"/>
    </vTypeDistribution>
    <vehicle id="a" type="mix"/>
    <trip id="b"/>
    """
    demand = build(text, {"sigma": 0.25})
    found = types(demand)
    assert {found[name]["sigma"] for name in found if name != "ego"} == {"0.25"}
    assert {*found} == {"slow", "fast", "DEFAULT_VEHTYPE", "DEFAULT_TAXITYPE", "ego"}
    assert "sigma" not in found["ego"]
    # SUMO reads in order: a type comes before the vehicles that have it.
    tags = [(element.tag, element.get("id")) for element in demand]
    assert tags.index(("vType", "DEFAULT_VEHTYPE")) < tags.index(("trip", "b"))


def test_a_type_of_no_route_file_is_a_clear_error(build: Build) -> None:
    with pytest.raises(
        UserError, match="no route file or additional file has the vehicle type 'alien'"
    ):
        build('<vehicle id="a" type="alien"/>', {"sigma": 0.25})


def test_randomized_desired_speeds_are_drawn_from_the_changed_type(build: Build) -> None:
    text = '<vType id="car" speedDev="0.1"/><vehicle id="a" type="car" departPos="10"/>'
    demand = build(text, {"speedFactor": 1.2, "speedDev": 0}, Randomization(speed=1e-6))
    (human,) = (v for v in demand.iter("vehicle") if v.get("id") == "a")
    assert float(human.get("speedFactor", 0)) == pytest.approx(1.2, rel=1e-5)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf"), "nan", " -Infinity"])
def test_numbers_must_be_finite(value: float | str) -> None:
    with pytest.raises(UserError, match=r"human_type\.lcSigma = .* is not a finite number"):
        check_human_type({"lcSigma": value})


def test_departures_are_sorted_however_their_time_is_written(build: Build) -> None:
    times = ("1:00:00:00", "00:10:00", "300", "00:01:30.5", "triggered")
    departures = [f'<vehicle id="v{i}" depart="{time}"/>' for i, time in enumerate(times)]
    demand = build("".join(departures))
    order = [v.get("depart") for v in demand.iter("vehicle") if v.get("id") != "ego"]
    # What is no time stays in front: SUMO says what it thinks of it.
    assert order == ["triggered", "00:01:30.5", "300", "00:10:00", "1:00:00:00"]


def test_names_are_those_of_sumos_schema() -> None:
    assert {"lcSigma", "sigma", "tau", "speedDev", "color"} <= vehicle_type_attributes()
    check_human_type({"lcSigma": 0.3, "carFollowModel": "IDM"})
    with pytest.raises(UserError, match="no attribute 'lcSigmo'; did you mean 'lcSigma'"):
        check_human_type({"lcSigmo": 0.3})


WAY = '<route id="r" edges="west east"/>'


def car(name: str, tag: str = "vehicle", **attributes: object) -> str:
    """Write a car from west to east, in the ego's lane at its time unless said otherwise."""
    way = {"vehicle": {"route": "r"}, "trip": {"from": "west", "to": "east"}}
    given = {"id": name, "depart": 0, "departLane": 0, **way.get(tag, {}), **attributes}
    return f"<{tag} " + " ".join(f'{key}="{value}"' for key, value in given.items()) + "/>"


@pytest.mark.parametrize("tag", ["vehicle", "trip"])
def test_vehicles_and_trips_are_varied_alike(build: Build, tag: str) -> None:
    text = WAY + "".join(car(f"v{i}", tag, departPos=200 + 50 * i) for i in range(5))
    varied = Randomization(position=10, speed=0.02, humans=(1, 4))
    demands = [build(text, {"speedDev": 0}, varied, seed) for seed in range(40)]
    assert {len(cars(demand)) for demand in demands} == {1, 2, 3, 4}
    assert all(
        list(cars(demand)) == [f"v{i}" for i in range(len(cars(demand)))] for demand in demands
    )
    first = places(demands, "v0")
    assert 190 <= min(first) < 193
    assert 207 < max(first) <= 210
    factors = [float(v.get("speedFactor", 0)) for d in demands for v in cars(d).values()]
    assert 0.98 <= min(factors) < 0.985
    assert 1.015 < max(factors) <= 1.02


@pytest.mark.parametrize("tag", ["vehicle", "trip"])
def test_lead_spacing_moves_those_that_start_ahead_of_the_ego_with_it(
    build: Build, tag: str
) -> None:
    elsewhere = '<route id="e" edges="east"/>'
    text = (
        WAY
        + elsewhere
        + car("lead_2", tag, departPos=400)
        + car("lead_1", tag, departPos=-850, depart="0:00:00.5")
        + car("an_hour_later", tag, departPos=130, depart=3600)
        + car("when_triggered", tag, departPos=130, depart="triggered")
        + car("other_lane", tag, departPos=130, departLane=1)
        + car("behind", tag, departPos=50)
        + (car("other_edge", departPos=120, route="e") if tag == "vehicle" else "")
        + (car("other_edge", tag, departPos=120, **{"from": "east"}) if tag == "trip" else "")
    )
    demand = build(text, randomize=Randomization(lead_spacing=(40, 40)))
    after = {name: element.get("departPos") for name, element in cars(demand).items()}
    assert after == {
        "lead_1": "140.000",
        "lead_2": "180.000",
        "an_hour_later": "130",
        "when_triggered": "130",
        "other_lane": "130",
        "behind": "50",
        "other_edge": "120",
    }


def test_places_counted_from_the_end_of_the_edge(build: Build) -> None:
    text = WAY + car("a", departPos=-20) + car("b", departPos=-2) + car("c", departPos=2)
    demands = [build(text, randomize=Randomization(position=5), seed=seed) for seed in range(60)]
    a, b, c = (places(demands, name) for name in "abc")
    assert 975 <= min(a) < 976
    assert 984 < max(a) <= 985
    assert 993 <= min(b) < 994
    assert max(b) == 1000  # not beyond the end
    assert min(c) == 0
    assert 6 < max(c) <= 7


def test_stops_on_the_edge_move_with_the_car(build: Build) -> None:
    stops = '<stop lane="west_0" startPos="-320" endPos="700"/><stop lane="east_0" endPos="50"/>'
    text = WAY + car("stalled", departPos=700).replace("/>", f">{stops}</vehicle>")
    demand = build(text, randomize=Randomization(position=10))
    here, there = cars(demand)["stalled"].iter("stop")
    at = float(cars(demand)["stalled"].get("departPos", 0))
    assert at != 700
    assert float(here.get("endPos", 0)) == pytest.approx(at)
    assert float(here.get("startPos", 0)) == pytest.approx(at - 20)
    assert there.get("endPos") == "50"


def factors(build: Build, text: str, kind: str, additional: str = "") -> np.ndarray:
    """Speed factors of 2000 vehicles of a type."""
    text += WAY + "".join(car(f"v{i}", type=kind, departPos=10) for i in range(2000))
    demand = build(text, randomize=Randomization(speed=1e-9), additional=additional)
    return np.array([float(v.get("speedFactor", "nan")) for v in cars(demand).values()])


@pytest.mark.parametrize(
    ("text", "mean", "deviation", "low", "high"),
    [
        ('<vType id="h" speedFactor="1.2" speedDev="0.05"/>', 1.2, 0.05, 0.2, 2.0),
        ('<vType id="h" speedFactor="1.2"/>', 1.2, 0.1, 0.2, 2.0),
        ('<vType id="h" vClass="truck"/>', 1.0, 0.05, 0.2, 2.0),
        ('<vType id="h" vClass="bus"/>', 1.0, 0.0, 0.2, 2.0),
        ('<vType id="h" speedFactor="normc(1.00,0.10,0.20,2.00)"/>', 1.0, 0.1, 0.2, 2.0),
        ('<vType id="h" speedFactor="normc(1.1, 0.2, 0.9, 1.3)"/>', 1.1, 0.108, 0.9, 1.3),
        ('<vType id="h" speedFactor="norm(1.1,0.2)"/>', 1.1, 0.2, 0.0, 9.0),
        ('<vType id="h" speedFactor="norm(1.5)"/>', 1.5, 0.0, 1.5, 1.5),
        ('<vType id="h" speedFactor="normc(1.1,0.2,0.9,2)" speedDev="0.01"/>', 1.1, 0.01, 0.9, 2.0),
    ],
)
@pytest.mark.parametrize("where", ["routes", "additional"])
def test_desired_speeds_are_those_of_the_type(
    build: Build, text: str, mean: float, deviation: float, low: float, high: float, where: str
) -> None:
    found = factors(
        build, text if where == "routes" else "", "h", text if where != "routes" else ""
    )
    # SUMO 1.28 itself, 400 vehicles: normc(1.1,0.2,0.9,1.3) has a deviation of 0.104.
    assert found.mean() == pytest.approx(mean, abs=0.012)
    assert found.std() == pytest.approx(deviation, abs=0.008)
    assert low - 1e-6 <= found.min()
    assert found.max() <= high + 1e-6


@pytest.mark.parametrize(
    ("kind", "deviation"),
    [("DEFAULT_VEHTYPE", 0.1), ("DEFAULT_TAXITYPE", 0.05), ("DEFAULT_RAILTYPE", 0.0)],
)
def test_desired_speeds_of_built_in_types(build: Build, kind: str, deviation: float) -> None:
    found = factors(build, "", kind)
    assert found.mean() == pytest.approx(1.0, abs=0.01)
    assert found.std() == pytest.approx(deviation, abs=0.006)


def test_an_unknown_distribution_is_a_clear_error(build: Build) -> None:
    with pytest.raises(UserError, match=r"vType 'h': speedFactor 'uniform\(1,2\)'.*normc"):
        factors(build, '<vType id="h" speedFactor="uniform(1,2)"/>', "h")


@pytest.mark.slow
@pytest.mark.parametrize(
    "mix",
    [
        '<vTypeDistribution id="mix"><vType id="slow" speedFactor="0.5" speedDev="0" '
        'probability="3"/><vType id="fast" speedFactor="1.5" speedDev="0"/></vTypeDistribution>',
        '<vType id="slow" speedFactor="0.5" speedDev="0"/><vType id="fast" speedFactor="1.5" '
        'speedDev="0"/><vTypeDistribution id="mix" vTypes="slow fast" probabilities="0.75 0.25"/>',
    ],
)
@pytest.mark.parametrize("where", ["routes", "additional"])
def test_each_vehicle_of_a_distribution_gets_one_of_its_types(
    build: Build, mix: str, where: str
) -> None:
    text = WAY + "".join(car(f"v{i}", type="mix", departPos=10) for i in range(2000))
    parts = (mix + text, "") if where == "routes" else (text, mix)
    demands = [
        build(parts[0], randomize=Randomization(speed=0.01), seed=seed, additional=parts[1])
        for seed in (0, 0, 1)
    ]
    kinds = [[v.get("type") for v in cars(demand).values()] for demand in demands]
    assert kinds[0] == kinds[1] != kinds[2]
    assert kinds[0].count("slow") / 2000 == pytest.approx(0.75, abs=0.03)
    for vehicle in cars(demands[0]).values():
        own = {"slow": 0.5, "fast": 1.5}[vehicle.get("type", "")]
        assert float(vehicle.get("speedFactor", 0)) == pytest.approx(own, rel=0.0101)


def test_settings_do_not_shift_each_others_draws(build: Build) -> None:
    text = WAY + "".join(car(f"v{i}", departPos=200 + 50 * i) for i in range(5))
    alone = cars(build(text, randomize=Randomization(position=10)))
    mixed = cars(build(text, randomize=Randomization(position=10, speed=0.1, humans=(5, 5))))
    assert [v.get("departPos") for v in alone.values()] == [
        v.get("departPos") for v in mixed.values()
    ]


def test_a_flows_speed_varies_by_types_of_its_own(build: Build) -> None:
    text = (
        '<vType id="h" length="4.2" speedFactor="1.2" speedDev="0"/>'
        + car("a", "flow", begin=0, period=2, type="h", **{"from": "west", "to": "east"})
        + '<interval begin="5" end="9">'
        + car("b", "flow", period=2, speedFactor="0.8", **{"from": "west", "to": "east"})
        + "</interval>"
    )
    demand = build(text, randomize=Randomization(speed=0.1))
    for name, own in (("a", 1.2), ("b", 0.8)):
        (flow,) = (f for f in demand.iter("flow") if f.get("id") == name)
        assert flow.get("speedFactor") is None
        (of,) = (d for d in demand.iter("vTypeDistribution") if d.get("id") == flow.get("type"))
        means = [float(k.get("speedFactor", "")[5:].split(",")[0]) for k in of]
        assert np.mean(means) == pytest.approx(own, abs=1e-6)
        assert 0.9 * own <= min(means) < 0.91 * own
        assert 1.09 * own < max(means) <= 1.1 * own
        assert {k.get("length") for k in of} == ({"4.2"} if name == "a" else {None})


FLOW = '<flow id="f" begin="0" period="2" from="west" to="east" departLane="0" {}/>'


@pytest.mark.parametrize(
    ("flow", "varied", "needles"),
    [
        ("", {"humans": (1, 2)}, "randomize.humans .* flow 'f' .* <vehicle> or <trip>"),
        ('departPos="200"', {"position": 5}, "randomize.position: .* flow 'f' .*departPos, 200"),
        ('departPos="200"', {"lead_spacing": (40, 50)}, "randomize.lead_spacing: the flow 'f' "),
        ('departPos="-800"', {"lead_spacing": (40, 50)}, "randomize.lead_spacing: the flow 'f' "),
        ("", {"speed": 0.1}, "randomize.speed: the flow 'f' has a hidden or special car"),
    ],
)
def test_what_a_flow_cannot_is_said(
    check: Check, flow: str, varied: dict[str, Any], needles: str
) -> None:
    with pytest.raises(UserError, match=needles):
        check(FLOW.format(flow), **varied)
    check(FLOW.format(flow))


@pytest.mark.parametrize(
    "flow",
    [
        FLOW.format('departPos="50"'),
        FLOW.format('departPos="200"').replace('"0" period', '"300" period'),
        FLOW.format('departPos="200" end="10"'),
        FLOW.format('departPos="200"').replace('from="west"', 'from="east"'),
        FLOW.format('departPos="200"').replace('departLane="0"', 'departLane="1"'),
    ],
)
def test_other_flows_do_not_disturb_the_spacing(check: Check, flow: str) -> None:
    ego = EGO.model_copy(update={"depart": 60.0})
    lead = WAY + car("a", departPos=200, depart=60)
    assert check(lead + flow, ego=ego, lead_spacing=(40, 50)).notes == ()


def test_what_is_not_varied_is_said(check: Check) -> None:
    text = WAY + car("a") + car("b", "trip", departPos="random") + car("c", departPos=10)
    (note,) = check(text, position=5).notes
    assert "vehicle 'a' (and 1 others)" in note
    assert "departPos is no number" in note
    (note,) = check(text, lead_spacing=(40, 50)).notes
    assert "lead_spacing moves nobody" in note
    (note,) = check(text, humans=(1, 9)).notes
    assert "up to 9, and the route files have 3" in note
    lanes = WAY + car("a", departPos=200) + car("b", departPos=300, departLane="best")
    (note,) = check(lanes, lead_spacing=(40, 50)).notes
    assert "leaves vehicle 'b' where it is, its departLane is no number" in note
    (note,) = check(
        WAY, additional=WAY.replace('"r"', '"q"') + car("x", route="q"), speed=0.1
    ).notes
    assert "vehicle 'x' as it is: it is in mine.add.xml" in note
    assert check(text).notes == ()


def test_more_leads_than_fit_are_refused(check: Check) -> None:
    text = WAY + "".join(car(f"v{i}", departPos=200 + 10 * i) for i in range(10))
    assert check(text, lead_spacing=(50, 90)).notes == ()
    with pytest.raises(UserError, match=r"10 cars at up to 91 m reach 1010 m, but edge 'west'"):
        check(text, lead_spacing=(50, 91))
    assert check(text, lead_spacing=(50, 91), humans=(3, 9)).notes == ()


def test_types_are_looked_for_in_additional_files(build: Build, tmp_path: Path) -> None:
    demand = read_demand(
        *files(tmp_path, WAY + car("a", type="h"), '<vType id="h"/><vType id="unused"/>')
    )
    varied = Randomization()
    built = build_demand(demand, HIGHWAY, ["west"], EGO, varied, {"sigma": 0.2}, set(), 0)
    (file,) = built.additional
    assert file.changed
    assert [dict(kind.attrib) for kind in file.root] == [
        {"id": "h", "sigma": "0.2"},
        {"id": "unused"},
    ]


def test_a_type_of_the_users_may_be_called_ego(build: Build) -> None:
    for parts in (('<vType id="ego" width="1.5"/>', ""), ("", '<vType id="ego" width="1.5"/>')):
        demand = build(WAY + parts[0] + car("a", type="ego"), additional=parts[1])
        (ego,) = (v for v in demand.iter("vehicle") if v.get("id") == "ego")
        ours = types(demand)[ego.get("type", "")]
        assert ego.get("type") != "ego"
        assert ours["width"] == "1.8"
        assert cars(demand)["a"].get("type") == "ego"


@pytest.mark.parametrize("model", ["LC2013", "DK2008"])
def test_models_without_sublanes_are_named(build: Build, model: str) -> None:
    kind = f'<vType id="old" laneChangeModel="{model}"/>'
    with pytest.raises(UserError, match=f"vType 'old': laneChangeModel '{model}' .* SL2015"):
        build(WAY + kind + car("a", type="old"))
    build(WAY + kind + car("a"))  # nobody has it: SUMO does not mind either
    build(WAY + kind + car("a", type="old"), {"laneChangeModel": "SL2015"})


@pytest.mark.parametrize(
    "additional",
    [
        '<calibrator id="k" edge="east" pos="0"><flow begin="0" end="9" route="q" type="h"/>'
        "</calibrator>",
        '<calibrator id="k" edge="east" pos="0"><flow begin="0" end="9" route="r"/></calibrator>',
        '<rerouter id="k" edges="west"><interval><routeProbReroute id="r"/></interval></rerouter>',
    ],
)
def test_what_additional_files_refer_to_must_be_in_one(check: Check, additional: str) -> None:
    own = '<route id="q" edges="east"/>'
    with pytest.raises(UserError, match=r"mine.add.xml: uses the .* SUMO reads additional files"):
        check(WAY + '<vType id="h"/>', own + additional)
    check("", WAY + '<vType id="h"/>' + own + additional)


def test_the_egos_speed_and_its_limit_are_named(check: Check) -> None:
    with pytest.raises(UserError, match=r"ego.speed = 40, .* 'west' faster than 25.00 m/s"):
        check("", ego=EGO.model_copy(update={"speed": 40.0}))


def test_the_work_grows_with_the_number_of_vehicles(
    build: Build, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared = 0

    class Counting(ET.Element):
        """Counts how often elements are compared: what searching a list of them does."""

        __hash__ = object.__hash__

        def __eq__(self, other: object) -> bool:
            nonlocal compared
            compared += 1
            return self is other

    def parse(source: Any) -> ET.ElementTree:
        builder = ET.TreeBuilder(element_factory=Counting)
        tree: ET.ElementTree = ET.ElementTree()
        tree.parse(source, ET.XMLParser(target=builder))
        return tree

    monkeypatch.setattr(ET, "parse", parse)
    n = 300
    text = WAY + "".join(car(f"v{i}", depart=3 * i, departPos=150 + i) for i in range(n))
    varied = Randomization(lead_spacing=(1, 2), position=1, speed=0.1, humans=(n // 2, n // 2))
    assert len(cars(build(text, randomize=varied))) == n // 2
    assert compared <= n
