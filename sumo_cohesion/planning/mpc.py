"""How: the cohesive model predictive controller (paper, eqs. 1 and 2), built once, solved often.

The problem is written down once (planning.stage); which solver solves it is a setting.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from math import isfinite
from typing import Protocol

import numpy as np

from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.dynamics import DT
from sumo_cohesion.planning.ilqr import Ilqr
from sumo_cohesion.planning.lbfgs import Lbfgs
from sumo_cohesion.planning.nlp import InteriorPoint
from sumo_cohesion.planning.problem import Guess, Instance, Problem, Solution
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.stage import StageParameters, make_instance
from sumo_cohesion.state import FloatArray


class Solver(Protocol):
    """What a solver must offer; ``how`` says whether its functions are compiled."""

    name: str
    how: str

    def solve(self, instance: Instance, guess: Guess) -> Solution:
        """Solve one instance; a failure is a solution that is not ``solved``."""


SOLVERS: dict[str, Callable[[PlannerSettings, int], Solver]] = {
    "ilqr": Ilqr,
    "fatrop": partial(InteriorPoint, name="fatrop"),
    "ipopt": partial(InteriorPoint, name="ipopt"),
    "lbfgs": Lbfgs,
}


@lru_cache(maxsize=32)
def shared_solver(name: str, settings: PlannerSettings, n_lanes: int) -> Solver:
    """Return a solver, built once per process: it remembers nothing between two solves."""
    return SOLVERS[name](settings, n_lanes)


class Mpc:
    """The controller for roads of up to ``n_lanes`` lanes.

    The first solve starts from a rollout that holds speed and lane; later ones from the last
    solution shifted by one step, unless ``reset`` is called. What the chosen solver cannot solve is
    tried once more with IPOPT.
    """

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        self.settings = settings
        self.n_lanes = n_lanes
        self.solver = shared_solver(settings.solver, settings, n_lanes)
        self._parameters = StageParameters(settings, n_lanes)
        self._stages = np.zeros((settings.horizon, self._parameters.size))
        self._warm: Guess | None = None

    @property
    def how(self) -> str:
        """Which solver, and whether it is compiled."""
        return f"{self.solver.name}, {self.solver.how}"

    @property
    def expected_lateral(self) -> FloatArray | None:
        """Where across the road (m) the last solution is from now on, (T + 1,)."""
        return None if self._warm is None else self._warm.states[:, 1]

    def reset(self) -> None:
        """Forget the last solution."""
        self._warm = None

    def solve(self, problem: Problem) -> Solution:
        """Solve one instance; never raises for a solver's failure, see ``solved``."""
        self._parameters.fill(problem, self._stages)
        if not isfinite(self._stages.sum() + problem.ego.sum()):
            # Some solvers never return from a problem that is not a number.
            empty = np.zeros((0, 0))
            return Solution(empty, empty, False, "input is not finite", 0, 0.0, {})
        instance = make_instance(problem, self._stages, self.settings)
        solution = self.solver.solve(instance, self._warm or self._hold(problem))
        if not solution.solved:
            solution = self._rescued(instance, self._hold(problem), solution)
        self._warm = self._shifted(solution) if solution.solved else None
        return solution

    def _rescued(self, instance: Instance, guess: Guess, failed: Solution) -> Solution:
        """Try IPOPT, slower and sturdier."""
        second = shared_solver("ipopt", self.settings, self.n_lanes).solve(instance, guess)
        return replace(
            second,
            status="rescued by ipopt" if second.solved else f"{failed.status}; {second.status}",
            iterations=failed.iterations + second.iterations,
            wall_time=failed.wall_time + second.wall_time,
        )

    def _hold(self, problem: Problem) -> Guess:
        """Guess that keeps speed and heading along the road."""
        state = tuple(float(v) for v in problem.ego)
        states, controls = [state], []
        for t in range(self.settings.horizon):
            curvature = float(problem.road_curvature[t])
            control = (curvature, self.settings.friction * state[3])
            state = dynamics.step(state, control, DT, self.settings.friction, curvature)
            states.append(state)
            controls.append(control)
        return Guess(np.array(states), np.array(controls))

    def _shifted(self, solution: Solution) -> Guess:
        """Shift a solution by one step in time: the last control is held."""
        states, controls = solution.states, solution.controls
        final, held = states[-1].tolist(), controls[-1].tolist()
        last = dynamics.step(final, held, DT, self.settings.friction)
        return Guess(
            np.concatenate((states[1:], np.array(last)[None])),
            np.concatenate((controls[1:], controls[-1:])),
        )
