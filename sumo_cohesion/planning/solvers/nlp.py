"""Cross-check: CasADi's interior point methods on the same problem, by multiple shooting.

The states and controls of the horizon are the unknowns, the dynamics are equality constraints.
fatrop uses the structure of the horizon; IPOPT is general, slower and sturdier.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import casadi as ca
import numpy as np

from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.problem import Instance, Solution
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.stage import (
    CONTROL_SCALE,
    N_STATES,
    SCALES,
    StageParameters,
    make_stage,
    rate_excess,
)
from sumo_cohesion.state import STEP, FloatArray

_ONE_AT_A_TIME = threading.Lock()
"""IPOPT's linear solver, MUMPS, keeps numbers that all threads share."""


def fatrop(settings: PlannerSettings, n_lanes: int) -> InteriorPoint:
    """Make the solver that uses the structure of the horizon."""
    return InteriorPoint(settings, n_lanes, "fatrop")


def ipopt(settings: PlannerSettings, n_lanes: int) -> InteriorPoint:
    """Make the general one, slower and sturdier."""
    return InteriorPoint(settings, n_lanes, "ipopt")


class InteriorPoint:
    """Solver for problems of one shape; built once."""

    how = "CasADi's virtual machine"

    def __init__(self, settings: PlannerSettings, n_lanes: int, name: str) -> None:
        self.name = name
        self._settings = settings
        layout = StageParameters(settings, n_lanes)
        self._bends = layout.columns("road_curvature")
        horizon, self._parts = settings.horizon, settings.reward.parts
        stage = make_stage(settings, layout)
        terms = stage.landed(ca.vertcat(*[stage.terms[term] for term in self._parts]))
        one = ca.Function("stage", stage.inputs(), [stage.next_state, *terms])
        start, p = ca.SX.sym("start", N_STATES), ca.SX.sym("p", layout.size, horizon)
        change = ca.SX.sym("change", 2, horizon)
        states = [ca.SX.sym(f"x{t}", N_STATES) for t in range(horizon + 1)]
        controls = [ca.SX.sym(f"u{t}", 2) for t in range(horizon)]
        unknowns, constraints, total = [], [], ca.SX.zeros(len(self._parts))
        equality: list[bool] = []
        for t in range(horizon):
            stepped, gained = one(states[t], controls[t], p[:, t])
            unknowns += [states[t], controls[t]]
            constraints.append(states[t + 1] - stepped)
            equality += [True] * N_STATES
            if t == 0:
                constraints.append(states[0] - start)
                equality += [True] * N_STATES
            constraints.append(rate_excess(states[t], controls[t], change[:, t], settings))
            equality += [False] * 4
            total += gained
        unknowns.append(states[horizon])
        z, g = ca.vertcat(*unknowns), ca.vertcat(*constraints)
        parameters = ca.vertcat(start, ca.vec(p), ca.vec(change))
        nlp = {"x": z, "p": parameters, "f": -ca.sum1(total), "g": g}
        self._solver = ca.nlpsol(name, name, nlp, self._options(equality))
        self._lowest = np.where(equality, 0.0, -np.inf)
        self._terms = ca.Function("terms", [z, parameters], [total])

    def _options(self, equality: list[bool]) -> dict[str, Any]:
        common: dict[str, Any] = {"print_time": False, "error_on_fail": False}
        iterations = self._settings.max_iterations
        if self.name == "fatrop":
            return common | {
                "structure_detection": "auto",
                "equality": equality,
                "fatrop.print_level": 0,
                "fatrop.max_iter": iterations,
            }
        return common | {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": iterations}

    def solve(self, instance: Instance, guess: FloatArray) -> Solution:
        """Solve from guessed controls, (T, 2); never raises for the solver's failure."""
        start = time.perf_counter()
        parameters = np.concatenate(
            (instance.start, instance.stages.ravel(), instance.change.ravel())
        )
        lower, upper = self._bounds(instance)
        x0 = self._pack(instance, guess)
        with _ONE_AT_A_TIME:
            result = self._solver(
                x0=x0, p=parameters, lbx=lower, ubx=upper, lbg=self._lowest, ubg=0.0
            )
            stats = self._solver.stats()
        z = np.asarray(result["x"]).ravel()
        solved = bool(stats["success"]) and bool(np.isfinite(z.sum()))
        states, controls = self._unpack(z)
        # Interior point methods are allowed to be a hair outside.
        low, high = instance.low * CONTROL_SCALE, instance.high * CONTROL_SCALE
        controls = np.clip(controls, low, high)
        values = np.asarray(self._terms(z, parameters)).ravel().tolist() if solved else []
        return Solution(
            states=states,
            controls=controls,
            solved=solved,
            status="solved" if solved else f"{self.name} returned {stats['return_status']}",
            iterations=int(stats["iter_count"]),
            wall_time=time.perf_counter() - start,
            reward=dict(zip(self._parts, values, strict=True)) if solved else {},
        )

    def _bounds(self, instance: Instance) -> tuple[FloatArray, FloatArray]:
        """Bounds on the unknowns: those of the controls, and no reversing."""
        horizon, free = self._settings.horizon, np.full(N_STATES, np.inf)
        forwards = -free
        forwards[3] = 0.0
        rows = np.hstack((np.tile(forwards, (horizon, 1)), instance.low))
        lower = np.concatenate((rows.ravel(), forwards))
        # The present state is given: a bound that it lies on would leave no interior.
        lower[:N_STATES] = -np.inf
        rows = np.hstack((np.tile(free, (horizon, 1)), instance.high))
        return lower, np.concatenate((rows.ravel(), free))

    def _pack(self, instance: Instance, guess: FloatArray) -> FloatArray:
        states = roll_out(instance, guess, self._bends, self._settings.friction)
        rows = np.hstack((states[:-1], guess / CONTROL_SCALE))
        return np.concatenate((rows.ravel(), states[-1]))

    def _unpack(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = z[:-N_STATES].reshape(self._settings.horizon, N_STATES + 2)
        states = np.vstack((rows[:, :N_STATES], z[-N_STATES:]))
        return states[:, :4], rows[:, N_STATES:] * CONTROL_SCALE


def roll_out(instance: Instance, controls: FloatArray, bends: slice, friction: float) -> FloatArray:
    """Whole states, (T + 1, 6), that controls, (T, 2), lead to; ``bends`` as in the stages."""
    state, rows = instance.start[:4].tolist(), [instance.start]
    for control, bend in zip(controls.tolist(), instance.stages[:, bends].ravel(), strict=True):
        state = dynamics.step(state, control, STEP, friction, float(bend))
        rows.append(np.array((*state, control[0] / SCALES[0], control[1] / SCALES[1])))
    return np.array(rows)
