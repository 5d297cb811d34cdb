"""What is seen and what is remembered: closed-form answers."""

from __future__ import annotations

from collections.abc import Mapping
from math import atan2, pi

import numpy as np
import pytest

from sumo_cohesion.perception.habit import Habit
from sumo_cohesion.perception.history import History, Path, State, Track
from sumo_cohesion.perception.observation import Sensor
from sumo_cohesion.road import Road
from sumo_cohesion.state import CartesianState, Observation, RoadState, Scene


def observe(
    time: float,
    cars: Mapping[str, tuple[float, ...]],
    ego: tuple[float, float] = (0.0, 0.0),
    curvature: float = 0.0,
    mute: tuple[str, ...] = (),
) -> Observation:
    """Cars by name: s, d, heading, speed."""
    n = len(cars)
    return Observation(
        time=time,
        ego=RoadState(*ego, 0.0, 25.0),
        ego_size=(5.0, 1.8),
        ids=tuple(cars),
        states=np.array(list(cars.values()), dtype=float).reshape(-1, 4),
        sizes=np.tile([5.0, 1.8], (n, 1)),
        curvature=np.full(n, curvature),
        voter=tuple(name not in mute for name in cars),
    )


def told(before: State, after: State, seconds: float, curvature: float) -> tuple[float, ...]:
    """Describe a transition by what it is made of."""
    return (*before, *after, seconds, curvature)


def history(memory: float = 2.0, interval: float = 0.5, window: int = 0) -> History:
    return History(0.1, interval, memory, told, lambda: Habit((7.0,) * 10, window, 0))


def follow(h: History, steps: range, name: str = "a", speed: float = 20.0) -> None:
    for k in steps:
        h.push(observe(0.1 * k, {name: (0.1 * speed * k, 0.0, 0.0, speed)}))


def track_of(h: History, name: str = "a") -> Track:
    return h._tracks[name]


def test_a_transition_is_remembered_for_the_memory_and_no_longer() -> None:
    h = history(memory=2.0)
    assert list(h.in_sight()) == []
    follow(h, range(60))
    # The newest ended in step 59; those of the last twenty steps are there, and that one.
    assert track_of(h).steps == list(range(39, 60))
    for series in ("middle_s", "middle_d", "features", "habits"):
        assert len(getattr(track_of(h), series)) == 21
    assert track_of(h).middle_s[0] == pytest.approx(2.0 * 39 - 5.0)


def test_who_is_gone_is_forgotten_with_its_last_transition() -> None:
    h = history(memory=2.0)
    follow(h, range(10))
    for k in range(10, 30):
        h.push(observe(0.1 * k, {}))
    assert track_of(h).steps == [9]
    assert h.in_sight() == []
    h.push(observe(3.0, {}))
    assert h._tracks == {}
    # Without any transition: as long after it was seen.
    follow(h, range(2), "b")
    for k in range(20):
        h.push(observe(4.0 + 0.1 * k, {}))
        assert "b" in h._tracks, k
    h.push(observe(9.0, {}))
    assert h._tracks == {}


def test_a_transition_spans_whole_steps_and_says_how_long() -> None:
    for interval, lag in ((0.5, 5), (0.1, 1), (0.26, 3), (0.01, 1)):
        h = history(interval=interval)
        follow(h, range(12))
        newest = track_of(h).newest()
        assert newest is not None
        assert newest[4] - newest[0] == pytest.approx(2.0 * lag)
        assert newest[8] == pytest.approx(0.1 * lag)
        assert track_of(h).steps[0] == lag


def test_a_heading_is_that_of_the_way_unless_the_car_hardly_moves() -> None:
    for along, expected in ((2.0, atan2(0.3, 2.0)), (0.011, atan2(0.3, 0.011)), (0.009, 0.5)):
        h = history()
        h.push(observe(0.0, {"a": (10.0, 1.0, 0.5, 20.0)}))
        assert track_of(h).state == (10.0, 1.0, 0.5, 20.0)  # new: as it is reported
        h.push(observe(0.1, {"a": (10.0 + along, 1.3, 0.5, 20.0)}))
        assert track_of(h).state == pytest.approx((10.0 + along, 1.3, expected, 20.0))
    # Beside the line of a bend a metre of s is longer or shorter; nobody turns by going back.
    h = history()
    h.push(observe(0.0, {"a": (10.0, 4.0, 0.5, 20.0)}))
    h.push(observe(0.1, {"a": (12.0, 4.1, 0.5, 20.0)}, curvature=0.05))
    assert track_of(h).state[2] == pytest.approx(atan2(0.1, 2.0 * (1.0 - 0.05 * 4.1)))
    h.push(observe(0.2, {"a": (11.0, 4.1, 0.5, 20.0)}))
    assert track_of(h).state[2] == 0.5


def test_lost_from_sight_a_car_starts_anew() -> None:
    h = history(interval=0.2)
    for k in (0, 1, 2, 4, 5, 6):
        while h._now < k - 1:
            h.push(observe(0.0, {}))
        h.push(observe(0.1 * k, {"a": (2.0 * k, 0.1 * k, 0.3, 20.0)}))
        newest = track_of(h).newest()
        assert (newest is None) is (k not in (2, 6))
        if k == 4:
            assert track_of(h).state[2] == 0.3  # no heading over the gap
    assert track_of(h).steps == [2, 6]
    assert track_of(h).middle_s.tolist() == pytest.approx([2.0, 10.0])
    assert track_of(h).middle_d.tolist() == pytest.approx([0.1, 0.5])


def test_the_newest_is_of_now_or_nothing() -> None:
    h = history()
    follow(h, range(6))
    assert track_of(h).newest() is not None
    h.push(observe(0.6, {}))
    h.push(observe(0.7, {"a": (14.0, 0.0, 0.0, 20.0)}))
    assert track_of(h).newest() is None
    assert h.in_sight() == [track_of(h)]


def test_who_does_not_vote_is_not_remembered_nor_what_it_did_as_a_voter() -> None:
    h = history()
    both = {"b": (50.0, 3.5, 0.0, 20.0), "a": (0.0, 0.0, 0.0, 20.0)}
    h.push(observe(0.0, both))
    assert set(h._tracks) == {"a", "b"}
    h.push(observe(0.1, both, curvature=0.01, mute=("b",)))
    assert list(h._tracks) == ["a"]
    assert h.in_sight() == [track_of(h)]
    assert track_of(h).state[:2] == (0.0, 0.0)


def test_where_a_car_was_when_it_passed() -> None:
    track = Track(1, Habit((0.0,), 0, 0))
    for k, d in enumerate((0.0, 1.0, 3.0)):
        track.see(k, (10.0 * k, d, 0.0, 20.0), 0.0, 0.01, 0.1, told)
    # Middles: 5 m at 0.5, 15 m at 2.
    assert track.d_at(5.0) == 0.5
    assert track.d_at(7.5) == pytest.approx(0.875)
    assert track.d_at(14.999) == pytest.approx(2.0, abs=1e-3)
    assert track.d_at(15.0) is None
    assert track.d_at(4.999) is None


def test_what_a_cars_habit_was_when_it_passed() -> None:
    track = Track(1, Habit((0.0,), 0, 0))
    for k in range(4):
        track.see(k, (10.0 * k, 0.0, 0.0, 20.0), 0.0, 0.01, 0.1, told)
    track.habits[:] = [(1.0,), (2.0,), (3.0,)]  # of middles 5, 15, 25
    for s, habit in ((0.0, 1.0), (5.0, 2.0), (14.0, 2.0), (15.0, 3.0), (25.0, 3.0), (99.0, 3.0)):
        assert track.habit_at(s) == (habit,), s


def test_habits_are_of_transitions_that_do_not_overlap() -> None:
    h = history(interval=0.2, window=9)
    follow(h, range(8))
    # Seen in steps 2, 4 and 6: each changes it.
    habits = track_of(h).habits
    assert track_of(h).steps == [2, 3, 4, 5, 6, 7]
    assert [habits[i] is habits[i + 1] for i in range(5)] == [True, False, True, False, True]


def test_a_habit_by_hand() -> None:
    habit = Habit((1.0, 4.0), window=2, delay=1)
    habit.see((5.0, 0.0))
    assert habit.variance == (1.0, 4.0)  # the newest one does not count
    habit.see((9.0, 0.0))  # 5 counts: the first is its own mean, the prior counts as another
    assert habit.variance == pytest.approx((0.5, 2.0))
    habit.see((0.0, 0.0))  # 9 is 4 off: share 1/3, (1 - 1/3) (0.5 + 16/3); the mean becomes 7
    assert habit.variance == pytest.approx((2 / 3 * (0.5 + 16 / 3), 4 / 3))
    habit.see((0.0, 0.0))  # 0 is 7 off, and the window is full: n stays 2
    before = 2 / 3 * (0.5 + 16 / 3)
    assert habit.variance == pytest.approx((2 / 3 * (before + 49 / 3), 8 / 9))
    habit.see((0.0, 0.0))  # the mean was 3.5
    again = 2 / 3 * (2 / 3 * (before + 49 / 3) + 3.5**2 / 3)
    assert habit.variance == pytest.approx((again, 16 / 27))


def test_the_egos_path_is_bounded_and_never_goes_back() -> None:
    path = Path(3)
    for s, d in ((0.0, 0.0), (2.0, 1.0), (2.0, 9.0), (1.0, 9.0), (4.0, 2.0)):
        path.add(s, d)
    assert path.first == 0.0
    places = ((-1.0, 0.0), (0.0, 0.0), (0.5, 1.0), (2.0, 1.0), (2.1, 2.0), (99.0, 2.0))
    for s, d in places:  # the known place nearest ahead
        assert path.at(s) == d, s
    for k in range(3, 6):
        path.add(2.0 * k, float(k))
    assert path.first == 0.0
    path.add(12.0, 6.0)
    # Six are kept; the seventh drops the three oldest.
    assert path.first == 6.0
    assert path.at(0.0) == 3.0
    assert path.at(12.0) == 6.0


def test_the_history_keeps_the_egos_path_as_long_as_the_memory() -> None:
    h = history(memory=1.0)
    for k in range(21):
        h.push(observe(0.1 * k, {}, ego=(2.0 * k, 0.1 * k)))
    assert h.ego_path.first == 20.0
    assert h.ego_path.at(30.0) == pytest.approx(1.5)


def test_who_made_a_transition_near_a_place() -> None:
    h = history(interval=0.1)
    follow(h, range(11))  # middles 1, 3, ..., 19
    track = track_of(h)
    cases = {
        (10.0, 1.0): range(4, 6),  # 9 and 11: both ends belong to it
        (10.0, 0.9): range(5, 5),  # between two: nobody's middle, but it came past
        (-1.0, 2.0): range(1),
        (22.0, 3.0): range(9, 10),
        (10.0, 100.0): range(10),
    }
    for (s, reach), expected in cases.items():
        ((found, passed),) = h.near(s, reach)
        assert found is track
        assert list(passed) == list(expected), (s, reach)
    assert h.near(-2.0, 2.9) == []
    assert h.near(22.0, 2.9) == []
    h.push(observe(1.1, {}))
    assert h.near(10.0, 1.0)  # out of sight


def test_who_was_seen_on_both_sides_of_a_place() -> None:
    h = history(interval=0.1)
    follow(h, range(4))  # middles 1, 3, 5
    assert h.passed(1.0) == h.passed(4.9) == [track_of(h)]
    assert h.passed(0.9) == h.passed(5.0) == []
    h.push(observe(0.4, {"new": (9.0, 0.0, 0.0, 1.0)}))
    assert h.passed(9.0) == []


def scene(*cars: tuple[float, float, float, float], ego_heading: float = 0.1) -> Scene:
    n = len(cars)
    return Scene(
        time=4.0,
        ego=CartesianState(300.0, -8.75, ego_heading, 25.0),
        ego_size=(5.0, 1.8),
        ids=tuple(f"c{i}" for i in range(n)),
        states=np.array(cars, dtype=float).reshape(-1, 4),
        sizes=np.column_stack((4.0 + np.arange(n), np.full(n, 2.0))),
    )


def test_what_is_in_range_and_not_hidden_is_seen_in_the_roads_frame(highway: Road) -> None:
    seen = scene(
        (340.0, -8.75, 0.0, 20.0),
        (330.0, -8.75 + 40.0, 0.0, 20.0),  # 50 m away, slantwise: just in range
        (330.01, -8.75 + 40.0, 0.0, 20.0),
        (310.0, -5.25, pi - 0.1, 10.0),
        (290.0, -1.75, 0.2, 30.0),
    )
    sensor = Sensor(50.0, hidden={"c3"}, special={"c4"})
    found = sensor.survey(seen, highway, not_followed={"c1"}).seen_by("ego")
    assert found.ids == ("c0", "c1", "c4")
    assert found.voter == (True, False, False)
    assert found.ego == pytest.approx((300.0, 0.0, 0.1, 25.0))
    assert (found.time, found.ego_size) == (4.0, (5.0, 1.8))
    expected = [(340.0, 0.0, 0.0, 20.0), (330.0, 40.0, 0.0, 20.0), (290.0, 7.0, 0.2, 30.0)]
    assert found.states == pytest.approx(np.array(expected))
    assert found.sizes[:, 0].tolist() == [4.0, 5.0, 8.0]
    assert found.curvature.tolist() == [0.0, 0.0, 0.0]
    alone = Sensor(50.0).survey(scene(), highway).seen_by("ego")
    assert alone.states.shape == (0, 4)


def test_headings_are_relative_to_the_road_and_wrapped(curve: Road) -> None:
    # A quarter of the way round the left curve, whose circle has its centre at (0, 500).
    angle = 0.5
    there = (505.25 * np.sin(angle), 500.0 - 505.25 * np.cos(angle))
    world = Scene(
        time=0.0,
        ego=CartesianState(*there, angle - 2.0 * pi + 0.2, 20.0),
        ego_size=(5.0, 1.8),
        ids=("a",),
        states=np.array([[*there, angle + pi + 0.3, 20.0]]),
        sizes=np.array([[5.0, 1.8]]),
    )
    found = Sensor(50.0).survey(world, curve).seen_by("ego")
    assert found.ego.heading == pytest.approx(0.2, abs=0.01)
    assert found.states[0, 2] == pytest.approx(0.3 - pi, abs=0.01)
    assert found.curvature[0] == pytest.approx(1 / 505.25, rel=0.05)


def test_nobody_sees_itself_nor_beyond_its_reach(highway: Road) -> None:
    seen = scene(
        (330.0, -8.75 + 40.0, 0.0, 20.0),
        (251.0, -8.75, 0.0, 20.0),
        (249.0, -8.75, 0.0, 20.0),
    )
    overview = Sensor(50.0, special={"c0"}).survey(seen, highway)
    found = overview.seen_by("ego")
    assert found.ids == ("c0", "c1")
    assert found.voter == (False, True)
    assert found.states[0] == pytest.approx([330.0, 40.0, 0.0, 20.0])
    assert found.sizes.tolist() == [[4.0, 2.0], [5.0, 2.0]]
    assert found.curvature.tolist() == [0.0, 0.0]
    other = overview.seen_by("c1")
    assert other.ids == ("c2", "ego")
    assert other.ego == pytest.approx((251.0, 0.0, 0.0, 20.0))
    assert (other.time, other.ego_size) == (4.0, (5.0, 2.0))
    assert Sensor(2.0).survey(seen, highway).seen_by("c2").ids == ("c1",)
