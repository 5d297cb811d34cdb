"""How: the cohesive model predictive controller (paper, eqs. 1 and 2), built once, solved often.

The problem is written down once (planning.stage); which solver solves it is a setting.
"""

from __future__ import annotations

import threading
from functools import lru_cache
from importlib import import_module
from typing import Protocol

import numpy as np

from sumo_cohesion.planning.problem import Instance, Problem, Solution
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers import SOLVERS
from sumo_cohesion.planning.solvers.compiled import BUILDING
from sumo_cohesion.planning.solvers.transcription import Transcription
from sumo_cohesion.state import RESCUED, FloatArray


class Solver(Protocol):
    """What a solver must offer; ``how`` says whether its functions are compiled."""

    name: str
    how: str

    def solve(self, instance: Instance, guess: FloatArray) -> Solution:
        """Solve one instance from guessed controls, (T, 2); a failure is not ``solved``."""


class _Built(threading.local):
    """What one thread has built: solvers work in arrays of their own, which no two may share."""

    def __init__(self) -> None:
        self.solver = lru_cache(maxsize=32)(_build_solver)
        self.transcription = lru_cache(maxsize=32)(_build_transcription)


def _build_solver(name: str, settings: PlannerSettings, n_lanes: int) -> Solver:
    module, _, maker = SOLVERS[name].partition(":")
    with BUILDING:
        make = getattr(import_module(f"{__package__}.{module}"), maker)
        solver: Solver = make(settings, n_lanes)
    return solver


def _build_transcription(settings: PlannerSettings, n_lanes: int) -> Transcription:
    with BUILDING:
        return Transcription(settings, n_lanes)


_BUILT = _Built()


def shared_solver(name: str, settings: PlannerSettings, n_lanes: int) -> Solver:
    """Return a solver, built once per thread: it remembers nothing between two solves.

    The reward weights are part of the problem: they need no solver of their own, but which optional
    terms there are does.
    """
    return _BUILT.solver(name, _shape(settings), n_lanes)


def _shape(settings: PlannerSettings) -> PlannerSettings:
    return settings.model_copy(update={"reward": settings.reward.shape})


class _Tools(threading.local):
    """What a controller works with; each thread that uses it gets its own."""

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        self.solver = shared_solver(settings.solver, settings, n_lanes)
        self.transcription = _BUILT.transcription(_shape(settings), n_lanes)


class Mpc:
    """The controller for roads of up to ``n_lanes`` lanes.

    The first solve starts from a rollout that holds speed and lane; later ones from the last
    solution shifted by one step, unless ``reset`` is called. What the chosen solver cannot solve is
    tried once more with IPOPT. No solver is believed: one that raises, or returns what cannot be a
    solution, has failed.
    """

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        self.settings = settings
        self.n_lanes = n_lanes
        self._tools = _Tools(settings, n_lanes)
        self._last: Solution | None = None
        self._warm = False
        self._age = 0

    @property
    def solver(self) -> Solver:
        """The chosen solver, of this thread."""
        return self._tools.solver

    @property
    def how(self) -> str:
        """Which solver, and whether it is compiled."""
        return f"{self.solver.name}, {self.solver.how}"

    @property
    def rest(self) -> tuple[FloatArray, FloatArray] | None:
        """What is left of the last solution after a failure, while that is more than half of it.

        States and controls.
        """
        last, age = self._last, self._age
        if last is None or 2 * (self.settings.horizon - age) <= self.settings.horizon:
            return None
        return last.states[age:], last.controls[age:]

    def drop_rest(self) -> None:
        """Forget what is left of the last solution: the ego has not driven along it."""
        self._age = self.settings.horizon

    def reset(self) -> None:
        """Forget the last solution."""
        self._last, self._warm = None, False

    def solve(self, problem: Problem) -> Solution:
        """Solve one instance; never raises for a solver's failure, see ``solved``."""
        self._age += 1
        instance = self._tools.transcription.write(problem)
        if instance is None:
            # Some solvers never return from a problem that is not a number.
            return _failed("input is not finite")
        last = self._last if self._warm else None
        guess = self.hold(problem) if last is None else shifted(last.controls)
        solution = self._attempt(self.solver, instance, guess)
        if not solution.solved:
            solution = self._rescued(instance, self.hold(problem), solution)
        if solution.solved:
            self._last, self._age = solution, 0
        self._warm = solution.solved
        return solution

    def _attempt(self, solver: Solver, instance: Instance, guess: FloatArray) -> Solution:
        """Let a solver try; whatever goes wrong in it is a solution that is not ``solved``."""
        try:
            solution = solver.solve(instance, guess)
        except MemoryError:
            raise  # nothing else would work either
        except Exception as error:
            return _failed(f"{solver.name} raised {type(error).__name__}: {error}")
        if solution.solved and not self._tools.transcription.is_solution(solution):
            return _failed(f"{solver.name} returned garbage", solution)
        return solution

    def _rescued(self, instance: Instance, guess: FloatArray, failed: Solution) -> Solution:
        """Try IPOPT, slower and sturdier."""
        ipopt = shared_solver("ipopt", self.settings, self.n_lanes)
        second = self._attempt(ipopt, instance, guess)
        return second._replace(
            status=RESCUED if second.solved else f"{failed.status}; {second.status}",
            iterations=failed.iterations + second.iterations,
            wall_time=failed.wall_time + second.wall_time,
        )

    def hold(self, problem: Problem) -> FloatArray:
        """Return controls that keep speed and heading along the road, (T, 2)."""
        controls = np.empty((self.settings.horizon, 2))
        controls[:, 0] = problem.road.rows[:-1, -1]
        controls[:, 1] = self.settings.friction * problem.ego.speed
        return controls


def shifted(controls: FloatArray) -> FloatArray:
    """Shift controls, (T, 2), by one step in time; the last is held."""
    return np.concatenate((controls[1:], controls[-1:]))


def _failed(status: str, what: Solution | None = None) -> Solution:
    """Make the solution that is none; ``what`` was offered as one."""
    empty = np.zeros((0, 0))
    iterations, wall_time = (what.iterations, what.wall_time) if what else (0, 0.0)
    return Solution(empty, empty, False, status, iterations, wall_time, {})
