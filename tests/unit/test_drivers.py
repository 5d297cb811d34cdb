"""Orders to human drivers: when, to whom, and the same for every planner."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from pydantic import ValidationError

from sumo_cohesion.traffic.drivers import Drivers, Event

HUMANS = ["a", "b", "c"]


class Recording:
    """Commands that only remember what was ordered."""

    def __init__(self, distances: dict[float, float] | None = None) -> None:
        self.orders: list[tuple[float, str, str, float]] = []
        self.time = 0.0
        self.distances = distances or {}

    def vehicles(self) -> list[str]:
        return ["ambulance", *HUMANS]

    def distance_to_ego(self, vehicle: str) -> float:
        return self.distances.get(round(self.time, 1), inf)

    def order_lane(self, vehicle: str, lane: int, seconds: float) -> None:
        self.orders.append((self.time, vehicle, "lane", lane))

    def order_sublane(self, vehicle: str, metres: float) -> None:
        self.orders.append((self.time, vehicle, "sublane", metres))

    def order_speed_factor(self, vehicle: str, factor: float) -> None:
        self.orders.append((self.time, vehicle, "speed_factor", factor))

    def order_keep_lane(self, vehicle: str) -> None:
        self.orders.append((self.time, vehicle, "keep_lane", 0.0))


def act(event: Event, seconds: float, seed: int = 0, **kwargs: dict[float, float]) -> Recording:
    sumo, drivers = Recording(**kwargs), Drivers([event], {"ambulance"}, seed, start=0.0)
    for k in range(round(seconds * 10)):
        sumo.time = round(0.1 * k, 1)
        drivers.act(sumo.time, sumo)
    return sumo


def test_a_common_event_reaches_every_human_once_after_its_own_reaction() -> None:
    event = Event(near="ambulance", distance=140.0, reaction=1.0, reaction_std=0.3, lane=0)
    orders = act(event, 8.0, distances={3.0: 139.0}).orders
    assert sorted(name for _, name, _, _ in orders) == HUMANS  # once each, the ambulance not
    times = [time for time, *_ in orders]
    assert len(set(times)) > 1
    assert all(3.0 <= t <= 6.0 for t in times)
    assert act(event, 8.0).orders == []  # it never came near


def test_only_those_named_are_ordered() -> None:
    orders = act(Event(at=0.5, who=("ambulance",), keep_lane=True), 2.0).orders
    assert orders == [(0.5, "ambulance", "keep_lane", 0.0)]


def test_repeated_orders_keep_their_intervals_and_bounds() -> None:
    orders = act(Event(every=(2.0, 4.0), sublane=(1.0, 3.5)), 200.0).orders
    for name in HUMANS:
        mine = [(t, value) for t, vehicle, _, value in orders if vehicle == name]
        gaps = np.diff([t for t, _ in mine])
        assert gaps.min() >= 1.9
        assert gaps.max() <= 4.2
        values = np.array([value for _, value in mine])
        assert (np.abs(values) >= 1.0).all()
        assert (np.abs(values) <= 3.5).all()
        assert 0.3 < (values > 0).mean() < 0.7


def test_who_is_planned_hears_what_is_due_when_a_human_drives_again() -> None:
    sumo, drivers = Recording(), Drivers([Event(at=0.0, lane=0)], {"ambulance"}, 0, start=0.0)
    for k in range(50):
        sumo.time = round(0.1 * k, 1)
        drivers.act(sumo.time, sumo, planned={"b"} if k < 30 else ())
    assert [(time, name) for time, name, *_ in sumo.orders] == [(0.0, "a"), (0.0, "c"), (3.0, "b")]


def test_the_same_seed_gives_the_same_orders_whoever_else_is_there() -> None:
    event = Event(every=(2.0, 4.0), speed_factor=(0.75, 1.2))
    all_orders = [o for o in act(event, 20.0, seed=5).orders if o[1] == "b"]
    only_b = act(event.model_copy(update={"who": ("b",)}), 20.0, seed=5).orders
    assert all_orders == only_b
    assert all_orders != [o for o in act(event, 20.0, seed=6).orders if o[1] == "b"]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"at": 1.0}, "exactly one of lane"),
        ({"lane": 0}, "exactly one of at"),
        ({"at": 1.0, "near": "x", "lane": 0}, "exactly one of at"),
        ({"at": 1.0, "lane": 0, "keep_lane": True}, "exactly one of lane"),
        ({"every": [4.0, 2.0], "sublane": [1.0, 2.0]}, "low <= high"),
    ],
)
def test_events_that_say_too_little_or_too_much(keys: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Event.model_validate(keys)
