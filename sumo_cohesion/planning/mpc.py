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
from sumo_cohesion.planning.stage import CONTROL_SCALE, StageParameters, make_instance
from sumo_cohesion.state import RESCUED


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


_HAIR = 1e-3
"""How far a solution may be from what it should be, in scaled controls and in SI units."""


@lru_cache(maxsize=32)
def shared_solver(name: str, settings: PlannerSettings, n_lanes: int) -> Solver:
    """Return a solver, built once per process: it remembers nothing between two solves."""
    return SOLVERS[name](settings, n_lanes)


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
        self.solver = shared_solver(settings.solver, settings, n_lanes)
        self._parameters = StageParameters(settings, n_lanes)
        self._stages = np.zeros((settings.horizon, self._parameters.size))
        self._warm: Guess | None = None
        self._rest: Guess | None = None

    @property
    def how(self) -> str:
        """Which solver, and whether it is compiled."""
        return f"{self.solver.name}, {self.solver.how}"

    @property
    def rest(self) -> Guess | None:
        """What is left of the last solution after a failure, while that is more than half of it."""
        return self._rest

    def drop_rest(self) -> None:
        """Forget what is left of the last solution: the ego has not driven along it."""
        self._rest = None

    def reset(self) -> None:
        """Forget the last solution."""
        self._warm = self._rest = None

    def solve(self, problem: Problem) -> Solution:
        """Solve one instance; never raises for a solver's failure, see ``solved``."""
        self._keep_rest()
        self._parameters.fill(problem, self._stages)
        if not isfinite(self._stages.sum() + problem.ego.sum()):
            # Some solvers never return from a problem that is not a number.
            return _failed("input is not finite")
        instance = make_instance(problem, self._stages, self.settings)
        guess = self._warm or self._hold(problem)
        solution = self._attempt(self.solver, problem, instance, guess)
        if not solution.solved:
            solution = self._rescued(problem, instance, self._hold(problem), solution)
        if solution.solved:
            self._rest = Guess(solution.states, solution.controls)
            self._warm = self._shifted(solution, float(problem.road_curvature[-1]))
        else:
            self._warm = None
        return solution

    def _keep_rest(self) -> None:
        """Drop from the last solution the step that has been driven since."""
        rest = self._rest
        enough = rest is not None and 2 * (len(rest.controls) - 1) > self.settings.horizon
        self._rest = Guess(rest.states[1:], rest.controls[1:]) if rest and enough else None

    def _attempt(
        self, solver: Solver, problem: Problem, instance: Instance, guess: Guess
    ) -> Solution:
        """Let a solver try; whatever goes wrong in it is a solution that is not ``solved``."""
        try:
            solution = solver.solve(instance, guess)
        except MemoryError:
            raise  # nothing else would work either
        except Exception as error:
            return _failed(f"{solver.name} raised {type(error).__name__}: {error}")
        if solution.solved and not self._is_solution(solution, problem, instance):
            return _failed(f"{solver.name} returned garbage", solution)
        return solution

    def _is_solution(self, solution: Solution, problem: Problem, instance: Instance) -> bool:
        """Tell if all is finite and within bounds, and the first control leads where it says."""
        states, controls = solution.states, solution.controls
        horizon, friction = self.settings.horizon, self.settings.friction
        if states.shape != (horizon + 1, 4) or controls.shape != (horizon, 2):
            return False
        if not isfinite(states.sum() + controls.sum()):
            return False
        scaled = controls / CONTROL_SCALE
        if (np.minimum(scaled - instance.low, instance.high - scaled) < -_HAIR).any():
            return False
        start, bend = problem.ego.tolist(), float(problem.road_curvature[0])
        reached = dynamics.step(start, controls[0].tolist(), DT, friction, bend)
        claimed = states[:2].ravel().tolist()
        return all(abs(a - b) < _HAIR for a, b in zip((*start, *reached), claimed, strict=True))

    def _rescued(
        self, problem: Problem, instance: Instance, guess: Guess, failed: Solution
    ) -> Solution:
        """Try IPOPT, slower and sturdier."""
        ipopt = shared_solver("ipopt", self.settings, self.n_lanes)
        second = self._attempt(ipopt, problem, instance, guess)
        return replace(
            second,
            status=RESCUED if second.solved else f"{failed.status}; {second.status}",
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

    def _shifted(self, solution: Solution, road_curvature: float) -> Guess:
        """Shift a solution by one step in time: the last control is held."""
        states, controls = solution.states, solution.controls
        final, held = states[-1].tolist(), controls[-1].tolist()
        last = dynamics.step(final, held, DT, self.settings.friction, road_curvature)
        return Guess(
            np.concatenate((states[1:], np.array(last)[None])),
            np.concatenate((controls[1:], controls[-1:])),
        )


def _failed(status: str, what: Solution | None = None) -> Solution:
    """Make the solution that is none; ``what`` was offered as one."""
    empty = np.zeros((0, 0))
    iterations, wall_time = (what.iterations, what.wall_time) if what else (0, 0.0)
    return Solution(empty, empty, False, status, iterations, wall_time, {})
