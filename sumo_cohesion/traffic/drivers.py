"""What a scenario may ask of human drivers, where SUMO's models have no such rule.

Orders say where to go, never how: SUMO carries them out with its own lane-change and
car-following models, safe gaps included. Every human draws its own numbers from the seed and its
name, so that all planners of a seed meet the same humans.

Lane orders: https://sumo.dlr.de/docs/TraCI/Change_Vehicle_State.html#change_lane_0x13
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Annotated, Protocol
from zlib import crc32

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]

_TRIGGERS = ("at", "near", "every")
_ORDERS = ("lane", "sublane", "speed_factor", "keep_lane")


class Event(BaseModel):
    """One trigger and one order.

    Attributes
    ----------
    at : trigger, s after the ego's departure.
    near, distance : trigger, when that vehicle is within so many metres of the ego.
    every : trigger, [low, high] s: each human again and again, after a time drawn anew.
    reaction, reaction_std : s, mean and standard deviation of each human's delay.
    who : ids that are ordered; empty: all humans.
    lane : order, change to this lane (0 = rightmost) when it is safe, trying for ``patience`` s.
    sublane : order, [low, high] m: move aside by so much, to a side drawn anew.
    speed_factor : order, [low, high]: a new desired speed, as a share of the limit.
    keep_lane : order, never change lane.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    at: NonNegative | None = None
    near: str | None = None
    distance: Positive = 140.0
    every: tuple[Positive, Positive] | None = None
    reaction: NonNegative = 0.0
    reaction_std: NonNegative = 0.0
    who: tuple[str, ...] = ()
    lane: Annotated[int, Field(ge=0)] | None = None
    patience: Positive = 30.0
    sublane: tuple[Positive, Positive] | None = None
    speed_factor: tuple[Positive, Positive] | None = None
    keep_lane: bool | None = None

    @model_validator(mode="after")
    def _one_of_each(self) -> Event:
        for names in (_TRIGGERS, _ORDERS):
            given = [name for name in names if getattr(self, name) is not None]
            if len(given) != 1:
                raise ValueError(f"give exactly one of {', '.join(names)}, not {given or 'none'}")
        for name in ("every", "sublane", "speed_factor"):
            pair = getattr(self, name)
            if pair is not None and pair[0] > pair[1]:
                raise ValueError(f"{name} must be [low, high] with low <= high, not {list(pair)}")
        return self


class Commands(Protocol):
    """What orders need of a simulation."""

    def vehicles(self) -> Sequence[str]:
        """Ids of all vehicles on the road, the ego's excluded."""

    def distance_to_ego(self, vehicle: str) -> float:
        """Metres between a vehicle and the ego; infinite if it is not there."""

    def order_lane(self, vehicle: str, lane: int, seconds: float) -> None:
        """Change to a lane when it is safe."""

    def order_sublane(self, vehicle: str, metres: float) -> None:
        """Move aside within the road; left is positive."""

    def order_speed_factor(self, vehicle: str, factor: float) -> None:
        """Desire another share of the limit."""

    def order_keep_lane(self, vehicle: str) -> None:
        """Never change lane of one's own accord."""


class Drivers:
    """Carries out a scenario's events.

    Parameters
    ----------
    events : in the order of the scenario.
    special : vehicles that are no humans; only events that name them order them.
    seed : of the run.
    start : s, SUMO's time at the ego's departure.
    """

    def __init__(
        self, events: Sequence[Event], special: Collection[str], seed: int, start: float
    ) -> None:
        self._events = events
        self._special = special
        self._seed = seed
        self._start = start
        self._rng: dict[tuple[int, str], np.random.Generator] = {}
        self._due: dict[tuple[int, str], float] = {}
        self.triggered: dict[int, float] = {}
        """SUMO's time (s) at which each event was first triggered, by its number."""

    def act(self, time: float, sumo: Commands, planned: Collection[str] = ()) -> None:
        """Give the orders that are due; call it once per step, before the step.

        ``planned`` are vehicles that planners drive: no human is there to be told. If a human
        takes over again, it hears then what is still to be done.
        """
        if not self._events:
            return
        vehicles = [name for name in sumo.vehicles() if name not in planned]
        for number, event in enumerate(self._events):
            if number not in self.triggered and self._is_triggered(event, time, sumo):
                self.triggered[number] = time
            if number not in self.triggered:
                continue
            for name in vehicles:
                addressed = name in event.who if event.who else name not in self._special
                if addressed:
                    self._order(number, event, name, time, sumo)

    def _is_triggered(self, event: Event, time: float, sumo: Commands) -> bool:
        if event.at is not None:
            return time >= self._start + event.at
        if event.near is not None:
            return sumo.distance_to_ego(event.near) <= event.distance
        return True

    def _order(self, number: int, event: Event, name: str, time: float, sumo: Commands) -> None:
        key = number, name
        if key not in self._due:
            self._rng[key] = np.random.default_rng([self._seed, number, crc32(name.encode())])
            delay = self._rng[key].normal(event.reaction, event.reaction_std)
            if event.every is not None:
                delay += self._rng[key].uniform(0.0, event.every[1])
            self._due[key] = time + max(float(delay), 0.0)
        if time < self._due[key]:
            return
        # Who is told once needs no more numbers: a day's flow has many cars.
        rng = self._rng[key] if event.every else self._rng.pop(key)
        self._due[key] = time + float(rng.uniform(*event.every)) if event.every else np.inf
        if event.lane is not None:
            sumo.order_lane(name, event.lane, event.patience)
        elif event.sublane is not None:
            sumo.order_sublane(name, float(rng.choice((-1.0, 1.0)) * rng.uniform(*event.sublane)))
        elif event.speed_factor is not None:
            sumo.order_speed_factor(name, float(rng.uniform(*event.speed_factor)))
        else:
            sumo.order_keep_lane(name)
