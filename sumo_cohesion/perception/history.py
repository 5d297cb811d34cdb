"""What the ego has seen of others: transitions, in bounded memory.

Plain Python numbers: the ego has a handful of cars around it, and for so few, loops cost less
than arrays. Memory and time depend on how many cars were met within the memory, never on how long
the simulation has run.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Collection, Iterable
from itertools import compress
from math import atan2
from operator import not_

from sumo_cohesion.perception.habit import Features, Habit
from sumo_cohesion.state import Observation

State = tuple[float, float, float, float]
"""s, d (m), heading (rad, of the displacement), speed (m/s), in the road frame."""
Describe = Callable[[State, State, float, float], Features]
"""Features of a transition: (before, after, seconds between, road curvature)."""


class Track:
    """One car's transitions (x_t, x_t+1), oldest first.

    Attributes
    ----------
    state : where the car was seen last.
    step : when it was seen last, in steps.
    steps, middle_s, middle_d, features, habits : of each remembered transition: the step it
        ended in, its middle (m), its features, and the variance of the same features in this
        car's own past (see Habit).
    """

    __slots__ = (
        "_habit",
        "_lag",
        "_recent",
        "features",
        "habits",
        "middle_d",
        "middle_s",
        "state",
        "step",
        "steps",
    )

    def __init__(self, lag: int, habit: Habit) -> None:
        self.step = -2
        self.state: State = (0.0, 0.0, 0.0, 0.0)
        self.steps: list[int] = []
        self.middle_s = array("d")  # side by side in memory: searched at every step
        self.middle_d = array("d")
        self.features: list[Features] = []
        self.habits: list[Features] = []
        self._habit = habit
        self._lag = lag
        self._recent: deque[State] = deque(maxlen=lag + 1)

    def see(
        self,
        step: int,
        state: State,
        curvature: float,
        least_move: float,
        interval: float,
        describe: Describe,
    ) -> None:
        """Add what was seen in this step."""
        s, d, heading, speed = state
        if self.step != step - 1:
            self._recent.clear()  # lost from sight: no transition spans the gap
        elif self._recent:
            # Heading of the displacement, as the ego's own; SUMO's angle lags behind it. A car
            # that is new or stands still keeps the reported heading.
            before = self._recent[-1]
            along = (s - before[0]) * (1.0 - curvature * d)
            if along > least_move:
                heading = atan2(d - before[1], along)
        self.step = step
        self.state = state = (s, d, heading, speed)
        self._recent.append(state)
        if len(self._recent) == self._recent.maxlen:
            start = self._recent[0]
            self.steps.append(step)
            self.middle_s.append(0.5 * (start[0] + s))
            self.middle_d.append(0.5 * (start[1] + d))
            self.features.append(describe(start, state, interval, curvature))
            if step % self._lag == 0:  # transitions that do not overlap
                self._habit.see(self.features[-1])
            self.habits.append(self._habit.variance)

    def newest(self) -> Features | None:
        """Features of the transition that ended when the car was seen last."""
        if self.steps and self.steps[-1] == self.step:
            return self.features[-1]
        return None

    def d_at(self, s: float) -> float | None:
        """Where across the road (m) the car was when it passed s (m); None if that is not known."""
        middle_s, middle_d = self.middle_s, self.middle_d
        after = bisect_right(middle_s, s)
        if not 0 < after < len(middle_s):
            return None
        s0, d0 = middle_s[after - 1], middle_d[after - 1]
        return d0 + (middle_d[after] - d0) * (s - s0) / (middle_s[after] - s0)

    def habit_at(self, s: float) -> Features:
        """Variance of the car's features in its own past when it passed s."""
        return self.habits[min(bisect_right(self.middle_s, s), len(self.habits) - 1)]

    def forget(self, before: int) -> None:
        """Drop transitions that ended before a step."""
        if self.steps and self.steps[0] < before:
            old = bisect_left(self.steps, before)
            for series in (
                self.steps,
                self.middle_s,
                self.middle_d,
                self.features,
                self.habits,
            ):
                del series[:old]


class Path:
    """Where across the road the ego drove, by place; bounded."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._s: list[float] = []
        self._d: list[float] = []

    def add(self, s: float, d: float) -> None:
        """Add the present place, if it is a new one."""
        if self._s and s <= self._s[-1]:
            return
        self._s.append(s)
        self._d.append(d)
        if len(self._s) > 2 * self._length:  # seldom, so that dropping the old half is cheap
            del self._s[: self._length], self._d[: self._length]

    @property
    def first(self) -> float:
        """Farthest place back (m) that is known."""
        return self._s[0]

    def at(self, s: float) -> float:
        """Where across the road (m) the ego was at the known place nearest ahead of s."""
        return self._d[min(bisect_left(self._s, s), len(self._d) - 1)]


class History:
    """The transitions of all voters seen within the last ``memory`` seconds.

    Parameters
    ----------
    step : seconds between observations.
    interval : seconds that one transition spans (a multiple of step).
    memory : seconds to remember.
    describe : what to remember of a transition; the runner gives the social features.
    habit : makes what is known of a driver before anything is known of it.
    """

    def __init__(
        self,
        step: float,
        interval: float,
        memory: float,
        describe: Describe,
        habit: Callable[[], Habit],
    ) -> None:
        self._step_length = step
        self._lag = max(round(interval / step), 1)
        self._interval = self._lag * step
        self._memory = round(memory / step)
        self._describe = describe
        self._habit = habit
        self._now = -1
        self._tracks: dict[str, Track] = {}
        self._in_sight: list[Track] = []
        self.ego_path = Path(self._memory)

    def push(self, observation: Observation) -> None:
        """Remember one observation, of those to follow; call it once per step."""
        self._now = now = self._now + 1
        self._forget()
        self.ego_path.add(observation.ego.s, observation.ego.d)
        voter, tracks = observation.voter, self._tracks
        rows: Iterable[State] = observation.states.tolist()
        names, curvatures = observation.ids, observation.curvature.tolist()
        if not all(voter):
            for name in compress(names, map(not_, voter)):
                tracks.pop(name, None)  # it may have been one
            names, rows = tuple(compress(names, voter)), compress(rows, voter)
            curvatures = compress(curvatures, voter)
        least_move, interval, describe = 0.1 * self._step_length, self._interval, self._describe
        self._in_sight = in_sight = []
        for name, state, curvature in zip(names, rows, curvatures, strict=True):
            track = tracks.get(name)
            if track is None:
                track = tracks[name] = Track(self._lag, self._habit())
            in_sight.append(track)
            track.see(now, state, curvature, least_move, interval, describe)

    def _forget(self) -> None:
        before = self._now - self._memory
        for name, track in list(self._tracks.items()):
            track.forget(before)
            if not track.steps and track.step < before:
                del self._tracks[name]

    def in_sight(self) -> Collection[Track]:
        """Tracks of the voters in the latest observation."""
        return self._in_sight

    def near(self, s: float, reach: float) -> list[tuple[Track, range]]:
        """Tracks, in sight or not, with transitions whose middle is within ``reach`` (m) of s.

        And which of their transitions: cars do not reverse.
        """
        low, high, found = s - reach, s + reach, []
        for track in self._tracks.values():
            middle_s = track.middle_s
            if middle_s and middle_s[-1] >= low and middle_s[0] <= high:
                first = bisect_left(middle_s, low)
                found.append((track, range(first, bisect_right(middle_s, high, first))))
        return found

    def passed(self, s: float) -> list[Track]:
        """Tracks, in sight or not, of cars that were seen on both sides of s."""
        return [
            track
            for track in self._tracks.values()
            if (middle_s := track.middle_s) and middle_s[0] <= s < middle_s[-1]
        ]
