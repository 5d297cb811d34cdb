"""What the ego has seen of others: transitions, in bounded memory.

A ring of the last steps holds every car's state. Its size depends on the memory and on the
number of cars met within it, never on how long the simulation has run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sumo_cohesion.state import BoolArray, FloatArray, IntArray, Observation


@dataclass(frozen=True, slots=True)
class Transitions:
    """Pairs of states (x_t, x_t+1) of other cars, in the road frame.

    Attributes
    ----------
    car : (m,) number of the car that made each transition.
    before, after : (m, 4) s, d (m), heading (rad, of the displacement), speed (m/s).
    curvature : (m,) of the reference line (1/m).
    interval : seconds between before and after.
    """

    car: IntArray
    before: FloatArray
    after: FloatArray
    curvature: FloatArray
    interval: float


class History:
    """The transitions of all cars seen within the last ``memory`` seconds.

    Parameters
    ----------
    step : seconds between observations.
    interval : seconds that one transition spans (a multiple of step).
    memory : seconds to remember.
    """

    def __init__(self, step: float, interval: float, memory: float) -> None:
        self.step = step
        self.interval = interval
        self._lag = max(round(interval / step), 1)
        self._rows = round(memory / step) + self._lag + 1
        self._now = -1
        self._slots: dict[str, int] = {}
        self._last_seen: dict[str, int] = {}
        self._present = np.zeros(0, dtype=np.intp)
        self._voter: BoolArray = np.zeros(0, dtype=bool)
        self._free: list[int] = []
        self._allocate(8)

    def _allocate(self, width: int) -> None:
        """Give every row room for ``width`` cars; cells nobody has filled are NaN."""
        old = self._voter.size
        self._voter = np.concatenate((self._voter, np.zeros(width - old, dtype=bool)))
        for name, depth in (("_states", 4), ("_middle", 2), ("_curvature", 1)):
            fresh = np.full((self._rows, width, depth), np.nan)
            if old:
                fresh[:, :old] = getattr(self, name)
            setattr(self, name, fresh)
        self._free.extend(range(width - 1, old - 1, -1))

    _states: FloatArray
    _middle: FloatArray
    _curvature: FloatArray

    def push(self, observation: Observation) -> None:
        """Remember one observation; call it once per step."""
        self._now += 1
        row = self._now % self._rows
        self._states[row] = np.nan
        self._middle[row] = np.nan
        # The row just taken was the start of the transitions that end one interval after it.
        self._middle[(row + self._lag) % self._rows] = np.nan
        slots = np.array([self._slot(name) for name in observation.ids], dtype=np.intp)
        self._present = slots
        if slots.size == 0:
            return
        states = observation.states.copy()
        previous = self._states[(row - 1) % self._rows, slots]
        # Heading of the displacement, as the ego's own; SUMO's angle lags behind it. A car
        # that is new or stands still keeps the reported heading.
        stretch = 1.0 - observation.curvature * states[:, 1]
        along = (states[:, 0] - previous[:, 0]) * stretch
        moved = along > 0.1 * self.step
        heading = np.arctan2(states[:, 1] - previous[:, 1], along)
        states[:, 2] = np.where(moved, heading, states[:, 2])
        self._states[row, slots] = states
        self._curvature[row, slots, 0] = observation.curvature
        self._voter[slots] = observation.voter
        before = self._states[(row - self._lag) % self._rows, slots]
        self._middle[row, slots] = 0.5 * (before[:, :2] + states[:, :2])

    def _slot(self, name: str) -> int:
        slot = self._slots.get(name)
        if slot is None:
            if not self._free:
                self._make_room()
            slot = self._slots[name] = self._free.pop()
            self._states[:, slot] = np.nan
            self._middle[:, slot] = np.nan
        self._last_seen[name] = self._now
        return slot

    def _make_room(self) -> None:
        """Forget cars that no remembered transition is of; if there are none, take more memory."""
        gone = [name for name, step in self._last_seen.items() if self._now - step > self._rows]
        for name in gone:
            del self._last_seen[name]
            self._free.append(self._slots.pop(name))
        if not gone:
            self._allocate(2 * self._voter.size)

    def newest(self) -> Transitions:
        """Return the latest transition of every voting car in sight."""
        row = self._now % self._rows
        known = ~np.isnan(self._middle[row, self._present, 0]) & self._voter[self._present]
        return self._transitions(np.full(int(known.sum()), row), self._present[known])

    def near(self, s: float, d: float, half_length: float, half_width: float) -> Transitions:
        """Return all remembered transitions of voting cars whose middle lies in a box.

        The box is centred on (s, d) of the road frame; lengths in metres.
        """
        offset = np.abs(self._middle - (s, d))
        inside = (offset[:, :, 0] <= half_length) & (offset[:, :, 1] <= half_width) & self._voter
        rows, cars = np.nonzero(inside)
        return self._transitions(rows, cars)

    def _transitions(self, rows: IntArray, cars: IntArray) -> Transitions:
        return Transitions(
            car=cars,
            before=self._states[(rows - self._lag) % self._rows, cars],
            after=self._states[rows, cars],
            curvature=self._curvature[rows, cars, 0],
            interval=self.interval,
        )
