"""Reference: the paper's own method, L-BFGS on the controls alone (section IV), by SciPy.

It takes bounds and no constraints: of the controls' rates it keeps that of the first one, the only
one that is driven.
"""

from __future__ import annotations

import time

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from sumo_cohesion.planning.problem import Instance, Solution
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.compiled import BoundCall, compiled
from sumo_cohesion.planning.stage import (
    CONTROL_SCALE,
    N_STATES,
    UNLIMITED,
    StageParameters,
    limited_stage,
    make_stage,
)
from sumo_cohesion.state import FloatArray


class Lbfgs:
    """Solver for problems of one shape; built once."""

    name = "lbfgs"

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        self._settings = settings
        parameters = StageParameters(settings, n_lanes)
        one = limited_stage(make_stage(settings, parameters), settings)
        t, self._parts = settings.horizon, settings.reward.parts
        start, u = ca.MX.sym("start", N_STATES), ca.MX.sym("u", 2, t)
        p = ca.MX.sym("p", parameters.size, t)
        state, total, states, driven = start, ca.MX.zeros(len(self._parts)), [start], []
        for i in range(t):
            state, control, gained = one(state, u[:, i], p[:, i], -ca.inf, ca.inf, UNLIMITED)
            states.append(state)
            driven.append(control)
            total += gained
        cost = -ca.sum1(total)
        function = ca.Function(
            "cost",
            [start, u, p],
            [cost, ca.gradient(cost, u), ca.horzcat(*states), ca.horzcat(*driven), total],
        )
        (function,), self.how = compiled([function])
        self._start, self._p = np.zeros(N_STATES), np.zeros((t, p.shape[0]))
        self._u = np.zeros((t, 2))
        self._cost, self._gradient = np.zeros(1), np.zeros((t, 2))
        self._states, self._driven = np.zeros((t + 1, N_STATES)), np.zeros((t, 2))
        self._terms = np.zeros(len(self._parts))
        outputs = [self._cost, self._gradient, self._states, self._driven, self._terms]
        self._run = BoundCall(function, [self._start, self._u, self._p], outputs)

    def solve(self, instance: Instance, guess: FloatArray) -> Solution:
        """Solve from guessed controls, (T, 2)."""
        start = time.perf_counter()
        self._p[:], self._start[:] = instance.stages, instance.start
        low, high = instance.low.copy(), instance.high.copy()
        last, most = instance.start[4:], instance.change[0]
        low[0] = np.minimum(np.maximum(low[0], last - most), high[0])
        high[0] = np.maximum(np.minimum(high[0], last + most), low[0])
        first = np.clip(guess / CONTROL_SCALE, low, high)
        result = minimize(
            self._cost_and_gradient,
            first.ravel(),
            method="L-BFGS-B",
            jac=True,
            bounds=list(zip(low.ravel().tolist(), high.ravel().tolist(), strict=True)),
            options={"maxiter": 10 * self._settings.max_iterations},
        )
        self._cost_and_gradient(result.x)
        # A line search that ends at the limits of the arithmetic is no failure.
        solved = bool(np.isfinite(result.fun)) and result.status in (0, 2)
        return Solution(
            states=self._states[:, :4].copy(),
            controls=self._driven * CONTROL_SCALE,
            solved=solved,
            status="solved" if solved else f"{self.name} returned {result.message}",
            iterations=int(result.nit),
            wall_time=time.perf_counter() - start,
            reward=dict(zip(self._parts, self._terms.tolist(), strict=True)),
        )

    def _cost_and_gradient(self, u: FloatArray) -> tuple[float, FloatArray]:
        self._u[:] = u.reshape(self._u.shape)
        self._run()
        return float(self._cost[0]), self._gradient.ravel().copy()
