"""Fixtures shared by all tests."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

from sumo_cohesion.road import Road
from sumo_cohesion.traffic.network import Network

# A busy machine is no failure.
_ANY_MACHINE = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("any_machine", _ANY_MACHINE)
settings.register_profile("quick", _ANY_MACHINE, max_examples=20)
settings.register_profile("thorough", _ANY_MACHINE, max_examples=2500)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "any_machine"))

ROOT = Path(__file__).resolve().parent.parent
NETWORKS = ROOT / "tests" / "networks"


@pytest.fixture(scope="session")
def highway() -> Road:
    network = Network(ROOT / "networks" / "highway.net.xml")
    return network.road(network.route("west", "east"))


@pytest.fixture(scope="session")
def curve() -> Road:
    network = Network(NETWORKS / "curve.net.xml")
    return network.road(network.route("straight", "bend_2"))


@pytest.fixture(scope="session")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Streets: a network of 8 x 8 crossings with two lanes each way, some with traffic lights."""
    beside = Path(sys.executable).parent
    program = shutil.which("netgenerate", path=f"{beside}{os.pathsep}{os.environ['PATH']}")
    if program is None:
        pytest.skip("netgenerate, which ships with eclipse-sumo, is not there")
    path = tmp_path_factory.mktemp("city") / "city.net.xml"
    grid = [
        "--grid",
        "--grid.number",
        "8",
        "--grid.length",
        "150",
        "-L",
        "2",
        "--tls.guess",
        "true",
    ]
    subprocess.run([program, *grid, "-o", str(path)], check=True, capture_output=True)
    return path
