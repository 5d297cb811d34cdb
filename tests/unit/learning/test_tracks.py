"""Tracks become examples: cut at gaps, resampled, in the road's frame, with the others around."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest

from sumo_cohesion.learning.recording import COLUMNS, Recording
from sumo_cohesion.learning.tracks import Cutting, cut
from sumo_cohesion.road import Road
from sumo_cohesion.state import FloatArray
from tests.unit.learning.making import straight

HOW = Cutting(steps=5)


def track(
    vehicle: str,
    times: FloatArray,
    s: FloatArray,
    d: FloatArray | float = 1.75,
    road: Road | None = None,
) -> pd.DataFrame:
    """Return a vehicle's rows at places along a road."""
    road = straight() if road is None else road
    frenet = np.column_stack((s, np.broadcast_to(d, len(s)), np.zeros((len(s), 2))))
    x, y = road.to_cartesian(frenet)[:, :2].T
    size = {"length": 4.4, "width": 1.7}
    table = pd.DataFrame({"time": times, "vehicle": vehicle, "x": x, "y": y, **size})
    return table[list(COLUMNS)]


def recording(
    *tracks: pd.DataFrame,
    interval: float = 0.1,
    road: Road | None = None,
    of: tuple[str, ...] = ("a",),
) -> Recording:
    road = straight() if road is None else road
    table = pd.concat(tracks, ignore_index=True)
    return Recording("scene", table, dict.fromkeys(of, road), interval)


def times(n: int, interval: float = 0.1, first: float = 0.0) -> FloatArray:
    return first + interval * np.arange(n)


def accelerating(t: FloatArray) -> FloatArray:
    return 20.0 + 15.0 * t + 0.4 * t**2


def test_windows_follow_one_another_without_overlap() -> None:
    t = times(28)
    found = cut(recording(track("a", t, accelerating(t))), HOW)
    # The first two places only tell speed and control.
    assert [e.time for e in found] == pytest.approx([0.2, 0.7, 1.2, 1.7, 2.2])
    for one, after in pairwise(found):
        assert one.states.shape == (5, 4)
        assert tuple(one.states[-1]) == pytest.approx(tuple(after.ego))
    assert found[-1].states[-1, 0] == pytest.approx(accelerating(t)[-1])
    assert len(cut(recording(track("a", t[:27], accelerating(t[:27]))), HOW)) == 4


def test_an_example_says_what_was_driven() -> None:
    t = times(20)
    (first, *_) = cut(recording(track("a", t, accelerating(t))), HOW)
    # Semi-implicit: the speed at a place is that of the way to it.
    speed = np.diff(accelerating(t)) / 0.1
    assert first.ego == pytest.approx((accelerating(t)[2], 1.75, 0.0, speed[1]), abs=1e-9)
    assert first.states[:, 0] == pytest.approx(accelerating(t)[3:8])
    assert first.states[:, 3] == pytest.approx(speed[2:7])
    assert first.driven is not None
    assert first.driven == pytest.approx((0.0, (speed[1] - speed[0]) / 0.1 + 0.1 * speed[0]))
    assert first.ego_size == (4.4, 1.7)
    assert (first.run, first.vehicle, first.desired_speed) == ("scene", "a", None)


def test_a_gap_parts_a_track_in_two() -> None:
    t = np.delete(times(40), slice(12, 20))
    found = cut(recording(track("a", t, accelerating(t))), HOW)
    assert [e.time for e in found] == pytest.approx([0.2, 2.2, 2.7, 3.2])
    for example in found:
        assert np.diff(example.states[:, 0]).max() < 2.5


@pytest.mark.parametrize("interval", [0.04, 0.2])
def test_other_intervals_are_resampled(interval: float) -> None:
    t = times(round(2.4 / interval) + 1, interval)
    found = cut(recording(track("a", t, accelerating(t)), interval=interval), HOW)
    assert [e.time for e in found] == pytest.approx([0.2, 0.7, 1.2, 1.7])
    fine = accelerating(times(25))
    for example in found:
        first = round(example.time / 0.1)
        assert example.states[:, 0] == pytest.approx(fine[first + 1 : first + 6], abs=1e-6)


def test_on_a_bend_the_frame_is_the_roads() -> None:
    road = straight(bend=0.01)
    t = times(20)
    (first, *_) = cut(recording(track("a", t, 20.0 + 15.0 * t, 4.0, road), road=road), HOW)
    assert first.states[:, 1] == pytest.approx(np.full(5, 4.0), abs=1e-3)
    assert first.states[:, 2] == pytest.approx(np.zeros(5), abs=1e-3)
    # Four metres to the left of the line it drives less than along the line.
    assert first.states[:, 3] == pytest.approx(np.full(5, 15.0 * 0.96), rel=1e-3)


def test_only_what_is_driven_along_the_road_counts() -> None:
    t = times(30)
    past_the_end = cut(recording(track("a", t, 385.0 + 15.0 * t)), HOW)
    assert past_the_end[-1].states[-1, 0] <= 400.0 < 385.0 + 15.0 * t[-1]
    across = track("a", t, np.full(30, 50.0), -10.0 + 8.0 * t)
    assert cut(recording(across), HOW) == []
    back = track("a", t, 200.0 - 10.0 * t)
    assert cut(recording(back), HOW) == []
    assert cut(recording(track("a", t[:3], 20.0 + t[:3])), HOW) == []
    assert cut(recording(track("b", t, accelerating(t))), HOW) == []  # has no road


def test_who_stands_is_still_somewhere() -> None:
    t = times(20)
    found = cut(recording(track("a", t, np.full(20, 50.0))), HOW)
    assert [e.ego.speed for e in found] == [0.0] * len(found)
    assert len(found) == 3


def test_whose_a_run_is() -> None:
    t = times(20)
    both = recording(
        track("a", t, accelerating(t)), track("b", t, accelerating(t), 5.25), of=("a", "b")
    )
    assert {e.run for e in cut(both, HOW)} == {"scene"}
    alone = cut(both, Cutting(steps=5, by_vehicle=True))
    assert {e.run for e in alone} == {"scene/a", "scene/b"}


def test_own_speed_is_the_fast_part_of_a_drivers_speeds() -> None:
    t = times(60)
    found = cut(recording(track("a", t, accelerating(t))), Cutting(steps=5, own_speed=True))
    speeds = np.diff(accelerating(t)) / 0.1
    assert found[0].desired_speed == pytest.approx(np.quantile(speeds, 0.9))
    assert len({e.desired_speed for e in found}) == 1


def test_smoothing_is_along_and_across_by_their_own_periods() -> None:
    t = times(60)
    wave = 0.05 * np.sin(2.0 * np.pi * t / 0.5)
    table = track("a", t, 20.0 + 15.0 * t + wave, 1.75 + wave)
    along, across = (cut(recording(table), Cutting(5, smooth=s)) for s in ((2.0, 0.0), (0.0, 2.0)))

    def roughness(examples: list, column: int) -> float:  # type: ignore[type-arg]
        places = np.concatenate([e.states[:, column] for e in examples])
        return float(np.abs(np.diff(places, 2)).max())

    assert roughness(along, 0) < 0.02 * roughness(across, 0)
    assert roughness(across, 1) < 0.02 * roughness(along, 1)


@pytest.mark.parametrize("phase", [0.0, 0.05, 0.03])
@pytest.mark.parametrize("interval", [0.1, 0.04, 0.2])
def test_others_are_where_they_are_at_that_time(phase: float, interval: float) -> None:
    """Whatever part of an interval the recording, or one of its vehicles, begins with."""
    n = round(3.0 / interval)
    t, u = times(n, interval, 7.0 + interval / 2), times(n, interval, 7.0 + phase)
    behind, beside = (
        track("b", u, 5.0 + 17.0 * u - 7.0 * 17.0, 1.75),
        track("c", t, 30.0 + 14.0 * (t - 7.0), 5.25 - 0.5 * (t - 7.0)),
    )
    found = cut(
        recording(track("a", t, 20.0 + 15.0 * (t - 7.0)), behind, beside, interval=interval), HOW
    )
    assert len(found) >= 4
    for example in found[:-1]:
        ago = example.time - 7.0
        assert len(example.cars) == 2
        cars = example.cars[example.cars[:, 1].argsort()]
        heading, speed = np.arctan2(-0.5, 14.0), np.hypot(14.0, 0.5)
        size = [4.4, 1.7, 0.0]
        assert cars[0] == pytest.approx([5.0 + 17.0 * ago, 1.75, 0.0, 17.0, *size], abs=1e-6)
        assert cars[1] == pytest.approx(
            [30.0 + 14.0 * ago, 5.25 - 0.5 * ago, heading, speed, *size], abs=1e-6
        )


def test_others_are_seen_nearest_first_and_not_from_far_away() -> None:
    t = times(20)
    tracks = [track(n, t, s + 15.0 * t, 5.25) for n, s in (("b", 170.0), ("c", 40.0), ("d", 24.0))]
    table = [track("a", t, 20.0 + 15.0 * t), *tracks]
    (first, *_) = cut(recording(*table), Cutting(5, sensing_range=100.0))
    assert first.cars[:, 0] == pytest.approx([27.0, 43.0])
    (first, *_) = cut(recording(*table), Cutting(5, sensing_range=200.0))
    assert first.cars[:, 0] == pytest.approx([27.0, 43.0, 173.0])


def test_who_stands_has_no_heading_and_who_is_there_once_no_speed() -> None:
    t = times(20)
    jitter = 0.01 * (-1.0) ** np.arange(20)
    stands = track("b", t, np.full(20, 60.0), 5.25 + jitter)
    once = track("c", t[2:3], np.array([70.0]), 5.25)
    (first, *_) = cut(recording(track("a", t, 20.0 + 15.0 * t), stands, once), HOW)
    assert first.cars[:, 2].tolist() == [0.0, 0.0]
    assert first.cars[:, 3] == pytest.approx([0.0, 0.0], abs=0.3)
