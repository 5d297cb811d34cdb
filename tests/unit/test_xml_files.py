"""Files are read as SUMO reads them: gzipped or not, with what they include."""

from __future__ import annotations

import gzip
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from sumo_cohesion.errors import UserError
from sumo_cohesion.simulation.scenario import Scenario
from sumo_cohesion.traffic.demand_files import read_demand
from sumo_cohesion.traffic.network import Network
from sumo_cohesion.traffic.xml_files import files_behind, named_files, read_with_includes
from sumo_cohesion.user_input import parse_override, read_toml, text_settings
from tests.conftest import ROOT

NET = (ROOT / "networks" / "highway.net.xml").read_bytes()


@pytest.mark.parametrize("name", ["a.net.xml.gz", "a.net.xml"])
def test_gzipped_networks_are_read_whatever_their_name(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(gzip.compress(NET))
    assert Network(tmp_path / name).route("west", "east") == ["west", "east"]


@pytest.mark.parametrize("part", [20, -20])
def test_damaged_gzipped_files_say_so(tmp_path: Path, part: int) -> None:
    (tmp_path / "a.net.xml.gz").write_bytes(gzip.compress(NET)[:part])
    with pytest.raises(UserError, match=r"a\.net\.xml\.gz: gzipped, but truncated or damaged"):
        Network(tmp_path / "a.net.xml.gz")


@pytest.mark.parametrize("root", ["routes", "trips", "additional", "additionals", "mine"])
def test_any_wrapping_that_sumo_takes(tmp_path: Path, root: str) -> None:
    (tmp_path / "a.xml").write_text(f'<{root}><trip id="a"/><trip id="b"/></{root}>')
    (tmp_path / "b.xml").write_text('<trip id="c"/>')
    routes = read_demand([tmp_path / "a.xml", tmp_path / "b.xml"]).routes
    assert [trip.get("id") for trip in routes] == ["a", "b", "c"]


def test_a_network_is_no_demand(tmp_path: Path) -> None:
    (tmp_path / "a.net.xml").write_bytes(NET)
    with pytest.raises(UserError, match=r"a\.net\.xml: its root element is <net>, expected"):
        read_demand([tmp_path / "a.net.xml"])


def test_includes_are_found_beside_the_file_that_includes(tmp_path: Path) -> None:
    (tmp_path / "sub" / "deep").mkdir(parents=True)
    (tmp_path / "a.xml").write_text(
        '<routes><include href="sub/b.xml"/><interval begin="0"><include href="flow.xml"/>'
        "</interval></routes>"
    )
    (tmp_path / "sub" / "b.xml").write_text(
        '<additional><vType id="x"/><include href="deep/c.xml.gz"/><vType id="z"/></additional>'
    )
    (tmp_path / "sub" / "deep" / "c.xml.gz").write_bytes(gzip.compress(b'<vType id="y"/>'))
    (tmp_path / "flow.xml").write_text('<routes><flow id="f"/></routes>')
    routes = read_demand([tmp_path / "a.xml"]).routes
    assert [(e.tag, e.get("id")) for e in routes.iter() if e.get("id")] == [
        ("vType", "x"),
        ("vType", "y"),
        ("vType", "z"),
        ("flow", "f"),
    ]


def test_includes_that_cannot_be_are_clear_errors(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text('<routes><include href="b.xml"/></routes>')
    with pytest.raises(
        UserError, match=r"b\.xml: cannot be read \(No such file.*included by .*a\.xml"
    ):
        read_demand([tmp_path / "a.xml"])
    (tmp_path / "b.xml").write_text('<routes><include href="a.xml"/></routes>')
    with pytest.raises(UserError, match=r"a\.xml: includes itself"):
        read_demand([tmp_path / "a.xml"])


def test_which_files_a_file_reads_and_writes(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.xml").write_text(
        """<additional><include href="sub/b.xml"/>
        <inductionLoop file="loop.xml"/><edgeData file="/dev/null"/><laneData file="NUL"/>
        <edgeData file="stdout"/><routeProbe file="localhost:8080"/>
        <edgeData file="e.xml" edgesFile="edges.txt"/><timedEvent dest="tls.xml"/>
        <calibrator file="flows.xml" output="cali.xml"/><rerouter file="rerouter.xml"/>
        <vType id="x" imgFile="car.png"><param key="device.ssm.file" value="ssm.xml"/>
        <param key="has.ssm.device" value="true"/></vType></additional>"""
    )
    (tmp_path / "sub" / "b.xml").write_text(
        '<additional><variableSpeedSign file="vss.xml"/><inductionLoop file="loop.xml"/>'
        "</additional>"
    )
    named = list(named_files(read_with_includes(tmp_path / "a.xml")))
    here = {str(n.path.relative_to(tmp_path)): n.written for n in named}
    assert {name for name, written in here.items() if written} == {
        "loop.xml", "sub/loop.xml", "e.xml", "tls.xml", "cali.xml", "ssm.xml",
    }  # fmt: skip
    assert {name for name, written in here.items() if not written} == {
        "sub/vss.xml", "edges.txt", "flows.xml", "rerouter.xml", "car.png",
    }  # fmt: skip


def test_demand_of_another_encoding(tmp_path: Path) -> None:
    text = '<?xml version="1.0" encoding="ISO-8859-1"?><routes><vType id="käfer"/></routes>'
    (tmp_path / "a.xml").write_bytes(text.encode("latin-1"))
    assert isinstance(
        read_demand([tmp_path / "a.xml"]).routes.find("vType[@id='käfer']"), ET.Element
    )


def test_a_byte_order_mark_in_toml(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfname = 'a'\n")
    assert read_toml(tmp_path / "a.toml") == {"name": "a"}


@pytest.mark.parametrize(
    "value", ["145354574", "145354574.120", "123#0", "-123#1", "1_0", "1e5", "true", "2020-01-01"]
)
def test_an_edge_may_be_called_anything(value: str) -> None:
    texts = text_settings(Scenario)
    assert parse_override(f"ego.origin={value}", texts) == ("ego.origin", value)
    assert parse_override(f'ego.destination="{value}"', texts) == ("ego.destination", value)


def test_numbers_stay_numbers() -> None:
    texts = text_settings(Scenario)
    assert parse_override("ego.speed=20", texts) == ("ego.speed", 20)
    assert parse_override("randomize.humans=[0,0]", texts) == ("randomize.humans", [0, 0])
    assert parse_override("planner.solver=ipopt", texts) == ("planner.solver", "ipopt")


def test_files_behind_a_file_decide_a_run_too(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.xml").write_text(
        '<additional><include href="sub/b.xml"/><inductionLoop file="loop.xml"/></additional>'
    )
    (tmp_path / "sub" / "b.xml").write_text(
        '<additional><variableSpeedSign file="vss.xml"/><include href="../a.xml"/></additional>'
    )
    (tmp_path / "sub" / "vss.xml").write_text("<vss/>")
    (tmp_path / "loop.xml").write_text("<written/>")
    found = {path.resolve() for path in files_behind(tmp_path / "a.xml")}
    assert found - {tmp_path / "a.xml"} == {tmp_path / "sub" / n for n in ("b.xml", "vss.xml")}


def test_what_users_bring_is_read_without_pandas_and_scipy() -> None:
    code = (
        "import sys, sumo_cohesion.traffic.demand, sumo_cohesion.user_input;"
        "print(sorted({'libsumo', 'sumolib', 'casadi', 'pandas', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
