"""The fleet's pure parts: who is equipped, and what each of many sees."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sumo_cohesion.perception.observation import Sensor
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.fleet import Fleet, _near_another, is_equipped
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.social.features import social_features
from sumo_cohesion.social.memory import SharedFeatures
from sumo_cohesion.state import CartesianState, Scene
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


def scene_of(n: int) -> Scene:
    """Put the ego among n others."""
    ids, states, sizes = crowd(n)
    return Scene(3.0, CartesianState(200.0, -5.0, 0.02, 21.0), (5.0, 1.8), ids, states, sizes)


def test_what_each_sees_is_who_is_near_and_not_hidden(highway: Road, curve: Road) -> None:
    """Of ego and others alike: against the definition, car by car."""
    scene = scene_of(40)
    sensor = Sensor(100.0, hidden={"c3", "c8", "c11"}, special={"c1", "c2"})
    names = (*scene.ids, "ego")
    states = np.vstack((scene.states, scene.ego))
    sizes = np.vstack((scene.sizes, scene.ego_size))
    for road in (highway, curve):
        overview = sensor.survey(scene, road, not_followed={"c5"})
        frenet, bends = road.to_frenet(states)
        for i, name in enumerate(names):
            if name in sensor.hidden:
                continue
            seen = overview.seen_by(name)
            apart = np.linalg.norm(states[:, :2] - states[i, :2], axis=1)
            rows = [
                j
                for j, other in enumerate(names)
                if j != i and apart[j] <= 100.0 and other not in sensor.hidden
            ]
            assert seen.ids == tuple(names[j] for j in rows)
            assert np.array_equal(seen.states, frenet[rows])
            assert np.array_equal(seen.sizes, sizes[rows])
            assert np.array_equal(seen.curvature, bends[rows])
            assert tuple(seen.ego) == tuple(frenet[i])
            assert seen.ego_size == tuple(sizes[i])
            voters = [names[j] for j in rows if names[j] not in ("c1", "c2", "c5")]
            assert [n for n, v in zip(seen.ids, seen.voter, strict=True) if v] == voters


def test_a_ghost_sees_what_the_ego_would_see_in_its_place(highway: Road) -> None:
    scene = scene_of(40)
    elsewhere = CartesianState(260.0, -8.0, -0.01, 12.0)
    sensor = Sensor(80.0)
    ghost = sensor.survey(scene, highway).seen_from(elsewhere)
    there = sensor.survey(replace(scene, ego=elsewhere), highway).seen_by("ego")
    for name in ("states", "sizes", "curvature"):
        assert np.array_equal(getattr(ghost, name), getattr(there, name))
    for name in ("time", "ego", "ego_size", "ids", "voter"):
        assert getattr(ghost, name) == getattr(there, name)


def test_what_is_shared_cannot_be_written_to(highway: Road) -> None:
    """One planner's slip must not reach the other runs of its process, nor the record."""
    scene = scene_of(4)
    seen = Sensor(400.0).survey(scene, highway).seen_by("ego")
    shared = [scene.states, scene.sizes, seen.states, seen.sizes, seen.curvature]
    shared += [highway.x, highway.y, highway.tangent_x, highway.tangent_y, highway.curvature]
    shared += [highway.lane_centre, highway.lane_width, highway.speed_limit]
    shared += [*highway.ahead(100.0, 0.0, 2.5, 11)]
    for array in shared:
        with pytest.raises(ValueError, match="read-only"):
            array *= 0.9


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
    request = RunRequest("stalled", "tests.scenarios.test_fleet:Straight", 0, overrides)
    setup = prepare(request)
    fleet = Fleet(setup)
    ids = ("way", "nowhere", "stops", "stalled")
    states = np.array([[100.0 + 20.0 * i, -8.75, 0.0, 20.0] for i in range(4)])
    scene = Scene(
        1.0, CartesianState(50.0, -8.75, 0.0, 20.0), (5.0, 1.8), ids, states, np.full((4, 2), 2.0)
    )
    for _ in range(3):
        fleet.meet(scene, Vehicles())
        overview = setup.sensor.survey(scene, setup.road, fleet.not_followed)
        assert set(fleet.drive(scene, overview)) == {"way"}
    assert list(fleet.summary()["without_road"]) == ["nowhere"]
    assert "gone" in fleet.summary()["without_road"]["nowhere"]
