"""The demand of one run: what a scenario's human_type changes, and what it leaves alone."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import pytest

from sumo_cohesion.errors import UserError
from sumo_cohesion.traffic.demand import (
    EgoDemand,
    Randomization,
    build_demand,
    check_human_type,
)
from sumo_cohesion.traffic.library import vehicle_type_attributes

EGO = EgoDemand(origin="west", destination="east", lane=0, position=100.0, speed=25.0)
Build = Callable[..., ET.Element]


@pytest.fixture
def build(tmp_path: Path) -> Build:
    """Demand of a route file whose stalled car is no human."""

    def call(
        text: str, human_type: dict[str, float | str], randomize: Randomization | None = None
    ) -> ET.Element:
        path = tmp_path / "mine.rou.xml"
        path.write_text(f"<routes>{text}</routes>")
        return build_demand(
            [path],
            ["west", "east"],
            EGO,
            randomize or Randomization(),
            human_type,
            fixed={"stalled"},
            seed=0,
        )

    return call


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
    before, after = types(build(TEXT, {})), types(build(TEXT, {"lcSigma": 0.3, "color": "red"}))
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
    <vTypeDistribution id="mix" vTypes="slow"><vType id="fast"/></vTypeDistribution>
    <vehicle id="a" type="mix"/>
    <trip id="b"/>
    """
    demand = build(text, {"sigma": 0.25})
    found = types(demand)
    assert {found[name]["sigma"] for name in ("slow", "fast", "DEFAULT_VEHTYPE")} == {"0.25"}
    assert "sigma" not in found["ego"]
    # SUMO reads in order: a type comes before the vehicles that have it.
    tags = [(element.tag, element.get("id")) for element in demand]
    assert tags.index(("vType", "DEFAULT_VEHTYPE")) < tags.index(("trip", "b"))


def test_a_type_of_no_route_file_is_a_clear_error(build: Build) -> None:
    with pytest.raises(UserError, match="no route file has the vehicle type 'alien'"):
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
    demand = build("".join(departures), {})
    order = [v.get("depart") for v in demand.iter("vehicle") if v.get("id") != "ego"]
    # What is no time stays in front: SUMO says what it thinks of it.
    assert order == ["triggered", "00:01:30.5", "300", "00:10:00", "1:00:00:00"]


def test_names_are_those_of_sumos_schema() -> None:
    assert {"lcSigma", "sigma", "tau", "speedDev", "color"} <= vehicle_type_attributes()
    check_human_type({"lcSigma": 0.3, "carFollowModel": "IDM"})
    with pytest.raises(UserError, match="no attribute 'lcSigmo'; did you mean 'lcSigma'"):
        check_human_type({"lcSigmo": 0.3})
