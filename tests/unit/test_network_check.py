"""What makes no sense in a network is one line before SUMO, which it may crash, sees it."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import pytest

from sumo_cohesion import UserError
from sumo_cohesion.traffic.network import Network
from sumo_cohesion.traffic.network_check import check_network
from tests.conftest import NETWORKS, ROOT

CURVE = (NETWORKS / "curve.net.xml").read_text()
SOUND = [*sorted((ROOT / "networks").glob("*.net.xml")), NETWORKS / "curve.net.xml"]


@pytest.fixture(scope="module")
def generate(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Let netgenerate write a network."""
    program = shutil.which("netgenerate") or shutil.which(
        "netgenerate", path=str(Path(sys.executable).parent)
    )
    if program is None:
        pytest.skip("netgenerate, which ships with eclipse-sumo, is not there")

    def write(options: str) -> Path:
        path = tmp_path_factory.mktemp("net") / "made.net.xml"
        subprocess.run([program, *options.split(), "-o", path], check=True, capture_output=True)
        return path

    return write


@pytest.mark.parametrize("path", SOUND, ids=lambda p: str(p.name))
def test_networks_of_ours_are_sound(path: Path) -> None:
    check_network(ET.parse(path).getroot(), path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        "--grid --grid.number 4 -L 2 --tls.guess",
        "--grid --grid.number 3 -L 2 --sidewalks.guess --crossings.guess --walkingareas",
        "--grid --grid.number 3 -L 2 --bikelanes.guess --lefthand --tls.default-type actuated",
        "--grid --grid.number 3 -j allway_stop --grid.attach-length 50 --geometry.split",
        "--spider --spider.omit-center -j traffic_light",
        "--rand --rand.iterations 60 --seed 3 -L 3 --turn-lanes 1 --tls.guess -j zipper",
        "--rand --rand.iterations 60 --seed 5 --no-internal-links",
        "--rand --rand.iterations 60 --seed 7 --no-turnarounds --tls.layout incoming --tls.guess",
    ],
)
def test_networks_of_sumos_own_program_are_sound(
    generate: Callable[..., Path], options: str
) -> None:
    path = generate(options)
    check_network(ET.parse(path).getroot(), path)


def changed(text: str, pattern: str, new: str) -> str:
    result, n = re.subn(pattern, new, text, count=1, flags=re.DOTALL)
    assert n == 1
    assert result != text
    return result


OUT = r'    <connection from=":n1_0" [^\n]*\n'


@pytest.mark.parametrize(
    ("pattern", "new", "needles"),
    [
        # Each of the first two ends the process inside SUMO.
        (r'    <connection from="straight"[^\n]*\n', "", ["into lane ':n1_0_0'"]),
        (r'via=":n1_0_0"', "", ["into lane ':n1_0_0'"]),
        (OUT, "", ["on from lane ':n1_0_0'"]),
        (r'via=":n1_0_0"', 'via="1e9"', ["by lane '1e9'", "not one within a junction"]),
        (r'via=":n1_0_1"', 'via=":n1_0_0"', ["two connections lead by lane ':n1_0_0'"]),
        (r'to="bend_1"', 'to="moon"', ["edge 'moon'", "not there"]),
        (r'to="bend_1"', 'to="bend_2"', ["'straight' to 'bend_2'", "does not end where"]),
        (r'fromLane="0"', 'fromLane="7"', ["fromLane = '7'", "lanes 0 to"]),
        (r'fromLane="0"', 'fromLane="nan"', ["fromLane = 'nan'"]),
        (r'toLane="0"', "", ["no toLane"]),
        (r'(id="straight_0"[^>]*) length="[^"]*"', r'\1 length="inf"', ["straight_0", "length"]),
        (r'(id="straight_0"[^>]*) length="[^"]*"', r'\1 length="-1"', ["between 0 and"]),
        (r'(id="straight_0"[^>]*) length="[^"]*"', r'\1 length="1e20"', ["between 0 and"]),
        (r'(id="straight_0"[^>]*) length="[^"]*"', r"\1", ["straight_0", "no length"]),
        (r'(id="straight_0"[^>]*) speed="[^"]*"', r'\1 speed="nan"', ["straight_0", "speed"]),
        (r'(id="straight_0"[^>]*) width="[^"]*"', r'\1 width="0"', ["straight_0", "width"]),
        (r'(id="straight_0"[^>]*) shape="[^"]*"', r'\1 shape="1,2"', ["fewer than two points"]),
        (r'(id="straight_0"[^>]*) shape="[^"]*"', r'\1 shape="1,2 3"', ["'3'", "not a point"]),
        (r'(id="straight_0"[^>]*) shape="[^"]*"', r'\1 shape="1,2 3,x"', ["not a list of points"]),
        (r'(id="straight_0"[^>]*) shape="[^"]*"', r'\1 shape="0,0 1e20,0"', ["farther than"]),
        (r'(id="straight_0"[^>]*) shape="[^"]*"', r'\1 shape="0,0 nan,0"', ["farther than"]),
        (r'(id="straight_0"[^>]*) shape="[^"]*"', r"\1", ["straight_0", "no shape"]),
        (r'id="straight_0"', 'id="other_0"', ["lane 0 of edge 'straight'", "'other_0'"]),
        (r'(id="straight_0"[^>]*) index="0"', r'\1 index="1"', ["the index '1'"]),
        (r'(<edge id="straight".*?</edge>)', r"\1\1", ["edge 'straight' is there twice"]),
        (r'(<edge id="straight"[^>]*>).*?(</edge>)', r"\1\2", ["edge 'straight' has no lanes"]),
        (r'(<edge id="straight"[^>]*) to="[^"]*"', r"\1", ["edge 'straight' has no to"]),
        (r'(<edge id="straight"[^>]*) to="[^"]*"', r'\1 to="x"', ["junction 'x'", "not there"]),
        (r'(<junction id="n1"[^>]*) x="[^"]*"', r'\1 x="inf"', ["junction 'n1'", "x = 'inf'"]),
        (r'(<junction id="n1"[^>]*) y="[^"]*"', r'\1 y="1e20"', ["junction 'n1'", "farther"]),
        (r'(<junction id="n1".*?incLanes=")[^"]*"', r'\1a_0"', ["incLanes", "'a_0'"]),
        (r'(<junction id="n1".*?incLanes=")[^"]*"', r'\1bend_1_0"', ["incLanes", "of another"]),
        (r'(<junction id="n1".*?intLanes=")[^"]*"', r'\1:n2_0_0"', ["intLanes", "of another"]),
        (r'(<junction id="n1".*?foes=")', r"\1 0", ["junction 'n1'", "foes = ' 0"]),
        (r'(<junction id="n1".*?response=")[^"]*', r"\1", ["no response"]),
        (r'(<junction id="n1".*?<request index=")0', r"\g<1>5", ["request 0", "the index '5'"]),
        (r'(<junction id="n2".*?</junction>)', r"\1\1", ["junction 'n2' is there twice"]),
    ],
)
def test_nonsense_is_one_line(pattern: str, new: str, needles: list[str], tmp_path: Path) -> None:
    path = tmp_path / "curve.net.xml"
    path.write_text(changed(CURVE, pattern, new))
    with pytest.raises(UserError) as error:
        Network(path)
    assert "\n" not in str(error.value)
    for needle in (str(path), *needles, "netconvert"):
        assert needle in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pattern", "new", "needles"),
    [
        (r'linkIndex="\d+"', 'linkIndex="99"', ["linkIndex = '99'", "links"]),
        (r'linkIndex="\d+"', 'linkIndex="-1"', ["linkIndex = '-1'"]),
        (r' linkIndex="\d+"', "", ["no linkIndex"]),
        (r'(<phase [^>]*/>\s*<phase [^>]*state=")[a-zA-Z]', r"\1", ["state", "letter for each"]),
        (r'(<phase [^>]*state=")[a-zA-Z]', r"\1x", ["state", "letter for each"]),
        (r'(<phase duration=")[^"]*', r"\1nan", ["duration = 'nan'"]),
        (r'(<phase duration=")[^"]*', r"\g<1>0", ["duration = '0'"]),
        (r"(<tlLogic .*?</tlLogic>)", r"\1\1", ["program '0' twice"]),
        (r"(<tlLogic [^>]*>).*?(</tlLogic>)", r"\1\2", ["no phases"]),
    ],
)
def test_nonsense_of_traffic_lights_is_one_line(
    generate: Callable[..., Path], pattern: str, new: str, needles: list[str]
) -> None:
    path = generate("--grid --grid.number 3 --tls.guess -j traffic_light")
    path.write_text(changed(path.read_text(), pattern, new))
    with pytest.raises(UserError) as error:
        Network(path)
    for needle in (str(path), *needles, "netconvert"):
        assert needle in str(error.value)


def test_a_lane_that_leads_to_another_than_its_connection_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "curve.net.xml"
    swapped = changed(CURVE, r'(from=":n1_0" to="bend_1" fromLane="0" toLane=")0', r"\g<1>1")
    path.write_text(swapped)
    with pytest.raises(UserError, match="by ':n1_0_0', which ends on another lane"):
        Network(path)


def test_a_route_that_is_too_long_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "far.net.xml"
    text = (ROOT / "networks" / "highway.net.xml").read_text()
    path.write_text(text.replace("2000.00", "900000.00"))
    network = Network(path)
    with pytest.raises(UserError, match="900 km long, more than 300 km"):
        network.road(network.route("west", "east"))


def test_whatever_else_a_network_causes_is_one_line(
    highway: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = Network(ROOT / "networks" / "highway.net.xml")
    monkeypatch.setattr("sumo_cohesion.road_shape._bare_road", None)
    with pytest.raises(
        UserError, match=r"'west' to edge 'east' \(TypeError: .*netconvert"
    ) as error:
        network.road(["west", "east"])
    assert "highway.net.xml" in str(error.value)
