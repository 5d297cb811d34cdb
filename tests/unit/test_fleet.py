"""The fleet's pure parts: who is equipped, and what each of many sees."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sumo_cohesion.perception.observation import Overview, Sensor
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.fleet import Fleet, _near_another, is_equipped
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.social.features import social_features
from sumo_cohesion.social.memory import SharedFeatures
from sumo_cohesion.state import CartesianState, Observation, Scene
from sumo_cohesion.traffic.contact import contacts

SHARE = st.floats(0.0, 1.0)


@given(st.text(min_size=1), st.integers(0, 2**31 - 1), SHARE, SHARE)
def test_who_is_equipped_at_one_share_is_so_at_every_higher_one(
    name: str, seed: int, a: float, b: float
) -> None:
    low, high = sorted((a, b))
    assert is_equipped(name, seed, low) <= is_equipped(name, seed, high)
    assert not is_equipped(name, seed, 0.0)
    assert is_equipped(name, seed, 1.0)


def test_the_share_is_met_and_cars_are_drawn_independently() -> None:
    first, second = (
        np.array([is_equipped(f"lead_{i}", seed, 0.3) for seed in range(4000)]) for i in (1, 2)
    )
    assert first.mean() == pytest.approx(0.3, abs=0.03)
    assert (first & second).mean() == pytest.approx(0.09, abs=0.02)
    of_one_run = [is_equipped(f"flow.{i}", 7, 0.3) for i in range(4000)]
    assert np.mean(of_one_run) == pytest.approx(0.3, abs=0.03)


def crowd(n: int) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Cars on the first hundreds of metres of the highway: ids, states, sizes."""
    rng = np.random.default_rng(0)
    places = rng.uniform((0.0, -10.0), (400.0, 0.0), (n, 2))
    motion = rng.uniform((-0.1, 0.0), (0.1, 30.0), (n, 2))
    sizes = rng.uniform((3.0, 1.5), (12.0, 2.5), (n, 2))
    return tuple(f"c{i}" for i in range(n)), np.hstack((places, motion)), sizes


def test_what_one_of_many_sees_is_what_a_sensor_sees(highway: Road, curve: Road) -> None:
    ids, states, sizes = crowd(40)
    voter = tuple(i % 3 > 0 for i in range(40))
    special = {name for name, votes in zip(ids, voter, strict=True) if not votes}
    for road in (highway, curve):
        overview = Overview.along(road, 3.0, ids, states, sizes, voter)
        for i in range(40):
            rest = np.arange(40) != i
            length, width = sizes[i].tolist()
            scene = Scene(
                time=3.0,
                ego=CartesianState(*states[i].tolist()),
                ego_size=(length, width),
                ids=tuple(name for j, name in enumerate(ids) if j != i),
                states=states[rest],
                sizes=sizes[rest],
            )
            expected = Sensor(road, 100.0, special=special).observe(scene)
            assert_same(overview.seen_by(i, 100.0), expected)
            also = Sensor(road, 100.0).observe(scene, not_followed=special)
            assert_same(also, expected)


def assert_same(a: Observation, b: Observation) -> None:
    for name in ("states", "sizes", "curvature"):
        assert np.array_equal(getattr(a, name), getattr(b, name))
    for name in ("time", "ego", "ego_size", "ids", "voter"):
        assert getattr(a, name) == getattr(b, name)


def test_the_quick_look_misses_no_contact() -> None:
    _, states, sizes = crowd(80)
    rows = list(range(0, 80, 2))
    near = _near_another(rows, states, sizes)
    for i in rows:
        length, width = sizes[i].tolist()
        touched = contacts(CartesianState(*states[i].tolist()), (length, width), states, sizes)
        assert i in touched
        assert len(touched) == 1 or i in near
    assert 0 < len(near) < len(rows)


def test_shared_features_are_the_features() -> None:
    shared = SharedFeatures()
    before, after = (0.0, 0.0, 0.1, 20.0), (10.0, 0.5, 0.05, 21.0)
    for curvature in (0.0, 0.002, 0.0):
        expected = social_features(before, after, 0.5, curvature)
        assert shared(before, after, 0.5, curvature) == expected
    assert shared(before, after, 0.5, 0.0) is shared(before, after, 0.5, 0.0)
    shared.next_step()
    assert shared(before, after, 0.5, 0.0) == social_features(before, after, 0.5, 0.0)


class Vehicles:
    """A simulation's answers about its vehicles."""

    routes: ClassVar = {"way": ("west", "east"), "nowhere": ("gone",), "stops": ("west", "east")}

    def route(self, vehicle: str) -> tuple[str, ...]:
        return self.routes[vehicle]

    def has_stop(self, vehicle: str) -> bool:
        return vehicle == "stops"


def test_who_cannot_be_planned_stays_human() -> None:
    overrides = {"fleet.penetration": 1.0}
    fleet = Fleet(prepare("stalled", "tests.scenarios.test_fleet:Straight", 0, overrides))
    ids = ("way", "nowhere", "stops", "stalled")
    states = np.array([[100.0 + 20.0 * i, -8.75, 0.0, 20.0] for i in range(4)])
    scene = Scene(
        1.0, CartesianState(50.0, -8.75, 0.0, 20.0), (5.0, 1.8), ids, states, np.full((4, 2), 2.0)
    )
    for _ in range(3):
        fleet.meet(scene, Vehicles())
        assert set(fleet.drive(scene)) == {"way"}
    assert list(fleet.summary()["without_road"]) == ["nowhere"]
    assert "gone" in fleet.summary()["without_road"]["nowhere"]
