"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

from sumo_cohesion.road import Road
from sumo_cohesion.traffic.network import Network

# A busy machine is no failure.
settings.register_profile("any_machine", deadline=None)
settings.register_profile("thorough", deadline=None, max_examples=2500)
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
