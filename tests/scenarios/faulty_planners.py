"""Users' planners that go wrong in every way there is, after ten steps of driving well."""

from __future__ import annotations

import ctypes
import os
import time
from pathlib import Path

import numpy as np

from sumo_cohesion.perception.history import History
from sumo_cohesion.road import Road
from sumo_cohesion.state import Control, Observation, Plan
from tests.waiting import Gate


class Good:
    """Keeps its course."""

    def reset(self, road: Road) -> None:
        self.steps = 0

    def plan(self, observation: Observation, history: History) -> Plan:
        self.steps += 1
        if self.steps > 10:
            self.fail()
        return Plan((Control(0.0, 0.5),), np.array([observation.ego]), "solved")

    def fail(self) -> None:
        """Do not fail."""


class Learned(Good):
    """Accelerates by a gain, given or from a file."""

    def __init__(self, gain: float = 0.0, file: str = "") -> None:
        self.gain = float(Path(file).read_text()) if file else gain

    def plan(self, observation: Observation, history: History) -> Plan:
        return Plan((Control(0.0, self.gain),), np.array([observation.ego]), "solved")


class Forgetful(Learned):
    """Forgets to forget the last run."""

    def reset(self, road: Road) -> None:
        pass

    def plan(self, observation: Observation, history: History) -> Plan:
        self.gain += 0.1
        return super().plan(observation, history)


class SegmentationFault(Good):
    def fail(self) -> None:
        ctypes.string_at(0)


class Endless(Good):
    def fail(self) -> None:
        while True:
            time.sleep(0.01)


class Held(Good):
    """Waits in the middle of its run at a gate, a folder, until a test lets it pass."""

    def __init__(self, gate: str) -> None:
        self.gate = Gate(Path(gate))

    def fail(self) -> None:
        if self.steps == 11:
            self.gate.wait_here()


class EatsMemory(Good):
    def fail(self) -> None:
        self.eaten = getattr(self, "eaten", [])
        self.eaten.append(np.empty(20_000_000))  # 160 MB that count, though nothing is in them


class Raises(Good):
    def fail(self) -> None:
        raise ValueError("no idea where to go")


class RaisesAtOnce(Good):
    def reset(self, road: Road) -> None:
        raise ValueError("no such road")


class RaisesNonsense(Good):
    def reset(self, road: Road) -> None:
        raise ValueError("bad file \udc80")


class CannotBeMade(Good):
    def __init__(self) -> None:
        raise ValueError("no")


class Exits(Good):
    def fail(self) -> None:
        os._exit(3)


class Prints(Good):
    def plan(self, observation: Observation, history: History) -> Plan:
        print("thinking")
        return super().plan(observation, history)


class Tells(Good):
    """Writes down its process once it drives, and then takes for ever."""

    def __init__(self, file: str) -> None:
        self.file = Path(file)

    def fail(self) -> None:
        new = self.file.with_suffix(".new")
        new.write_text(str(os.getpid()))
        new.rename(self.file)
        while True:
            time.sleep(0.01)
