"""The Frenet frame: closed-form answers on a straight and on a 500 m curve."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sumo_cohesion.errors import UserError
from sumo_cohesion.road import Road
from sumo_cohesion.traffic.network import Network
from tests.conftest import NETWORKS, ROOT


def test_round_trip_on_a_500_m_curve_is_within_2_cm(curve: Road) -> None:
    rng = np.random.default_rng(1)
    states = np.column_stack(
        [
            rng.uniform(0, curve.length, 3000),
            rng.uniform(-15, 15, 3000),
            rng.uniform(-1, 1, 3000),
            rng.uniform(0, 30, 3000),
        ]
    )
    cartesian = curve.to_cartesian(states)
    back, _ = curve.to_frenet(cartesian)
    again = curve.to_cartesian(back)
    assert np.abs(again[:, :2] - cartesian[:, :2]).max() < 0.02
    assert np.abs(back - states).max() < 1e-6


def test_curve_has_the_radius_it_was_drawn_with(curve: Road) -> None:
    # networks/curve: 100 m straight, then a left curve whose edge line has a radius of 500 m;
    # the rightmost of two 3.5 m lanes runs 5.25 m outside it.
    assert curve.curvature_at(50.0) == pytest.approx(0.0, abs=1e-6)
    middle = curve.curvature[curve.index(np.arange(200, 450))]
    assert np.median(middle) == pytest.approx(1 / 505.25, rel=0.02)


def test_a_circle_driven_at_constant_offset_keeps_its_distance(curve: Road) -> None:
    # Points on a circle of radius 510 m about (0, 500): 4.75 m outside the reference lane.
    angle = np.linspace(0.3, 0.6, 200)
    points = np.column_stack([510 * np.sin(angle), 500 - 510 * np.cos(angle)])
    states = np.column_stack([points, angle, np.full(200, 20.0)])
    frenet, _ = curve.to_frenet(states)
    # The edge is drawn with chords of 10 m (2.5 cm inside the arc), and the frame rounds them.
    assert frenet[:, 1] == pytest.approx(-4.75, abs=0.05)
    assert frenet[:, 2] == pytest.approx(0.0, abs=0.003)
    # 510 m radius seen from a line of 505.25 m: s advances by the ratio of the radii.
    assert np.diff(frenet[:, 0]) == pytest.approx(np.diff(angle) * 505.25, rel=0.01)


def test_s_is_continuous_on_both_sides_of_a_curve(curve: Road) -> None:
    for radius in (490.0, 520.0):
        angle = np.linspace(0.2, 0.7, 5000)
        states = np.column_stack(
            [radius * np.sin(angle), 500 - radius * np.cos(angle), angle, np.ones(5000)]
        )
        step = np.diff(curve.to_frenet(states)[0][:, 0])
        assert step.min() > 0.5 * step.mean()
        assert step.max() < 1.5 * step.mean()


@given(x=st.floats(-90, 2090), y=st.floats(-60, 60))
def test_straight_road_is_the_identity(x: float, y: float) -> None:
    road = straight_road()
    s, d, heading, curvature = road.project(x, y)
    assert (s, d) == pytest.approx((x, y + 8.75), abs=1e-6)
    assert (heading, curvature) == pytest.approx((0.0, 0.0), abs=1e-9)


@cache
def straight_road() -> Road:
    return Network(ROOT / "networks" / "highway.net.xml").road(["west", "east"])


def test_lanes_edges_and_limit_of_the_highway(highway: Road) -> None:
    assert highway.length == pytest.approx(2000.0)
    assert highway.lanes_at([0, 999.9, 1000.1, 1999])[:, :3] == pytest.approx(
        np.tile([0.0, 3.5, 7.0], (4, 1))
    )
    right, left = highway.drivable_at([500.0], [0.0])
    assert (right[0], left[0]) == pytest.approx((-1.75, 8.75))
    assert highway.lane_index([10, 10, 10], [1.7, 1.8, 20]).tolist() == [0, 1, 2]
    assert [highway.lane_of(10, d) for d in (1.7, 1.8, 20)] == [0, 1, 2]
    assert highway.speed_limit_at(700.0) == 25.0


def test_an_exit_is_drivable_until_it_has_parted(curve: Road) -> None:
    assert curve.n_route_lanes == 2
    exit_lane = curve.lane_centre[:, 2]
    begins = curve.s0 + np.flatnonzero(~np.isnan(exit_lane))[0]
    assert begins > 480.0
    # Beside the gore the exit is part of the strip; farther on it is a strip of its own.
    right, _ = curve.drivable_at([begins + 20.0], [0.0])
    assert right[0] < -1.8
    right, left = curve.drivable_at([begins + 100.0], [0.0])
    assert (right[0], left[0]) == pytest.approx((-1.75, 5.25), abs=0.1)
    assert curve.speed_limit_at([400.0, 600.0]).tolist() == [25.0, 20.0]


def test_a_real_motorway_maps_without_holes() -> None:
    sumo = pytest.importorskip("sumo", reason="ships with eclipse-sumo")
    path = Path(sumo.__file__).parent / "tools" / "game" / "highway" / "highway.net.xml"
    if not path.is_file():
        pytest.skip("this eclipse-sumo does not ship the motorway")
    network = Network(path)
    road = network.road(network.route("145354574", "153177820"))
    inside = slice(int(-road.s0), int(road.length - road.s0))
    assert not np.isnan(np.nanmin(road.lane_centre[inside], axis=1)).any()
    assert np.isfinite(road.speed_limit).all()


@pytest.mark.slow
def test_a_way_through_a_city_has_few_columns_of_lanes(
    city: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exits of one crossing after the other share columns: what a road costs grows with them."""
    network = Network(city)
    route = network.route("A0A1", "G7H7")
    road = network.road(route)
    monkeypatch.setattr("sumo_cohesion.road_shape._pack", lambda extents: range(len(extents)))
    apart = network.road(route)
    assert len(route) > 12
    assert apart.lane_centre.shape[1] > 30
    assert road.lane_centre.shape[1] <= 8
    assert (road.length, road.n_route_lanes) == (apart.length, apart.n_route_lanes)
    k = road.n_route_lanes
    assert np.array_equal(road.lane_centre[:, :k], apart.lane_centre[:, :k], equal_nan=True)
    # Every exit is still there, beside the same places.
    few, many = (np.sort(r.lane_centre[:, k:], axis=1) for r in (road, apart))  # NaN come last
    assert np.array_equal(few, many[:, : few.shape[1]], equal_nan=True)
    assert np.isnan(many[:, few.shape[1] :]).all()


@pytest.mark.slow
def test_where_a_road_turns_too_sharply(curve: Road, city: Path) -> None:
    # The curve's radius is 505 m, from 100 m on.
    assert curve.too_sharp(1 / 490, 0.0, curve.length) is None
    s = curve.too_sharp(1 / 700, 0.0, curve.length)
    assert s is not None
    assert 100.0 < s < 300.0
    assert curve.too_sharp(1 / 700, 0.0, 100.0) is None
    streets = Network(city)
    turn = streets.road(streets.route("A0A1", "A1B1"))
    where = turn.too_sharp(0.01, 0.0, turn.length)
    assert where is not None
    assert 130.0 < where < 160.0  # the crossing
    assert turn.too_sharp(0.2, 0.0, turn.length) is None
    straight = streets.road(streets.route("A0A1", "A2A3"))
    assert straight.too_sharp(0.001, 0.0, straight.length) is None


@pytest.mark.slow
def test_where_a_road_comes_back_to_itself(highway: Road, curve: Road, city: Path) -> None:
    for road in (highway, curve):
        assert road.returns(0.0, road.length) is None
    streets = Network(city)
    block = ("A0A1", "A1B1", "B1B0", "B0A0")
    around = streets.road(block)
    three = streets.road(block[:3])
    assert three.returns(0.0, three.length) is None
    # Around the block and on along the first street: there again after four streets.
    again = streets.road((*block, "A0A1"))
    for first, last in ((0.0, again.length), (20.0, 40.0), (again.length - 50.0, again.length)):
        where = again.returns(first, last)
        assert where is not None
        assert around.length - 15.0 < where
    assert again.returns(around.length / 2, around.length / 2 + 20.0) is None


@pytest.mark.slow
def test_a_point_is_projected_on_the_stretch_that_it_is_beside(city: Path) -> None:
    """Also where another stretch passes nearby, or an extension of the line beyond its end."""
    streets = Network(city)
    for route in (
        ("A0A1", "A1B1", "B1B0", "B0A0"),  # ends beside where it starts
        ("B0B1", "B1C1", "C1C0", "C0B0", "B0A0"),  # crosses its own start's extension
    ):
        road = streets.road(route)
        s = np.arange(20.0, road.length - 20.0, 1.0)
        d = np.linspace(-1.0, 1.0, len(s))
        there = road.to_cartesian(np.column_stack((s, d, np.zeros((len(s), 2)))))
        back, _ = road.to_frenet(there)
        assert np.abs(back[:, 0] - s).max() < 0.01


def test_routes_that_do_not_exist_say_so() -> None:
    network = Network(NETWORKS / "curve.net.xml")
    with pytest.raises(UserError, match="no way for a car from edge 'ramp' to edge 'bend_2'"):
        network.route("ramp", "bend_2")
    with pytest.raises(UserError, match=r"has no edge 'nowhere'; its edges are bend_1"):
        network.route("straight", "nowhere")


@pytest.mark.parametrize("way", ["ramp", "after"])
def test_ahead_keeps_to_the_routes_own_branch_where_a_lane_splits(way: str) -> None:
    """Ramp and through lane begin as one, half a metre apart at first and seven at the end."""
    road = Network(ROOT / "networks" / "exit.net.xml").road(("before", way))
    places = np.arange(1000.0, 1100.0, 5.0)
    right_lane = float(np.nanmin(road.lanes_at(900.0)))
    ahead = road.ahead(1000.0, right_lane, 5.0, len(places))
    route = road.lanes_at(places)[:, : road.n_route_lanes]
    own = route[np.arange(len(places)), np.nanargmin(np.abs(route - right_lane), axis=1)]
    assert np.abs(own - right_lane).max() < 0.3
    # The edges are those of its own branch, and leave room for it.
    right, left = ahead.edges.T
    assert (right < own - 1.7).all()
    assert (left > own + 1.7).all()
    at_end = left[-1] - right[-1]
    assert at_end == pytest.approx(3.5 if way == "ramp" else 10.5, abs=0.1)
    # Between the two there is no lane: the other counts from half a lane's width on.
    others = ahead.rows[:, road.n_route_lanes : road.lane_centre.shape[1]]
    assert np.abs(others - own[:, None]).min() >= 1.7
    assert np.isfinite(others).any()


@pytest.mark.parametrize("d", [-4.0, 0.0, 4.0])
def test_ahead_is_the_same_with_and_without_the_short_cut(d: float) -> None:
    """One look is enough where nothing changes, and only there."""
    road, slow = (
        Network(ROOT / "networks" / "exit.net.xml").road(("before", "after")) for _ in range(2)
    )
    slow._same_until[:] = [-1] * len(slow._same_until)
    middle = float(np.nanmean(road.lanes_at(900.0)))
    short = 0
    for start in np.arange(0.0, road.length, 37.0):
        found = road.ahead(start, middle + d, 3.0, 10)
        expected = slow.ahead(start, middle + d, 3.0, 10)
        assert np.array_equal(found.rows, expected.rows)
        assert np.array_equal(found.edges, expected.edges)
        assert found.rows[:, -1] == pytest.approx(
            road.curvature_at(start + np.arange(0.0, 30.0, 3.0))
        )
        short += found is road.ahead(start, middle + d, 3.0, 10)
    assert 0 < short < road.length / 37.0


def test_the_lane_of_one_point_is_the_lane_of_many() -> None:
    road = Network(ROOT / "networks" / "exit.net.xml").road(("before", "after"))
    rng = np.random.default_rng(0)
    s, d = rng.uniform(-10.0, road.length + 50.0, 3000), rng.uniform(-30.0, 12.0, 3000)
    one = [road.lane_of(*point) for point in zip(s.tolist(), d.tolist(), strict=True)]
    assert one == road.lane_index(s, d).tolist()
    assert len(set(one)) == road.lane_centre.shape[1]
