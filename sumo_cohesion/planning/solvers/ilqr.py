"""The fast solver: control-limited iterative LQR over CasADi expressions.

Per iteration one backward pass (a quadratic model of the cost-to-go, stage by stage, Riccati) and
forward passes (roll the policy out, with shorter steps until the cost falls). The steps come from
the exact Hessian where it is convex enough, else from a Gauss-Newton one, which always descends.
Bounds on the controls and on their change are part of every stage's quadratic problem in two
unknowns, which is solved exactly.

Sources: W. Li and E. Todorov 2004 (iterative LQR); Y. Tassa, N. Mansard and E. Todorov 2014
(control-limited DDP, the line search and the regularisation).

Both passes are CasADi Functions without loops or branches. They run in CasADi's virtual machine,
and several times faster compiled (planning.solvers.compiled).
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from math import isfinite
from typing import Any

import casadi as ca
import numpy as np

from sumo_cohesion.planning.problem import Instance, Solution
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.compiled import BoundCall, Numbers, compiled
from sumo_cohesion.planning.stage import (
    CONTROL_SCALE,
    N_STATES,
    SCALES,
    Stage,
    StageParameters,
    control_limits,
    limited_stage,
    make_stage,
)
from sumo_cohesion.state import FloatArray

TOLERANCE = 1e-7
"""Relative decrease of the cost at which an iteration is the last one."""
_ROUNDING = 1e-4
"""Relative decrease that may be promised in vain at the end."""
_LEAST_CURVATURE = 1e-8
_AT_LIMIT = 1e-12
"""Distance from a limit at which a scaled control is held by it."""
_SHORTEST_STEP = 0.01
_SHORTEN = 0.4
_SUFFICIENT = 1e-4
"""Share of the decrease promised by the model that a step must give."""
_REGULARISATION = (1e-9, 1e-4, 1e12)
"""Least, first one that acts, and largest value added to the controls' Hessian."""
_GOOD_SHARE = 0.25
"""Share of the promised decrease that must come true for the regularisation to be lowered."""


class Ilqr:
    """Solver for problems of one shape; its functions are built once."""

    name = "ilqr"

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        self._settings = settings
        stage = make_stage(settings, StageParameters(settings, n_lanes))
        functions, self.how = compiled(
            [
                _backward_pass(stage, settings, exact=True),
                _backward_pass(stage, settings, exact=False),
                _forward_pass(stage, settings),
                _rollout(stage, settings),
            ]
        )
        self._functions = functions
        self._allocate()

    def _allocate(self) -> None:
        """Make the arrays that the functions read and write in place.

        There are two trajectories: a forward pass reads the present one and writes the other, which
        `_accept` makes the present one.
        """
        t, f = self._settings.horizon, np.zeros
        self._x, self._u = [f((t + 1, N_STATES)) for _ in range(2)], [f((t, 2)) for _ in range(2)]
        self._parts = self._settings.reward.parts
        self._terms = [f(len(self._parts)) for _ in range(2)]
        self._present = 0
        self._guess, self._step, self._gain = f((t, 2)), f((t, 2)), f((t, N_STATES, 2))
        # Python's arrays: their items are Python's numbers, which are faster than NumPy's.
        self._mu, self._length, self._cost, self._change, self._convexity = (
            array("d", [0.0]) for _ in range(5)
        )
        self._bound: Instance | None = None

    def _bind(self, instance: Instance) -> None:
        """Let the functions read an instance where it is: the transcription's is always the same.

        A C-ordered (T, n) array is a CasADi matrix of T columns.
        """
        exact, gauss_newton, forward, rollout = self._functions
        start, *given = instance
        policy: list[Numbers] = [self._step, self._gain]
        found = [*policy, self._change, self._convexity]
        self._exact: list[BoundCall] = []
        self._gauss_newton: list[BoundCall] = []
        self._forward: list[BoundCall] = []
        self._rollout: list[BoundCall] = []
        for present, other in ((0, 1), (1, 0)):
            read = [self._x[present], self._u[present], *given]
            new: list[Numbers] = [self._x[other], self._u[other], self._cost, self._terms[other]]
            self._exact.append(BoundCall(exact, [*read, self._mu], found))
            self._gauss_newton.append(BoundCall(gauss_newton, [*read, self._mu], found))
            self._forward.append(BoundCall(forward, [*read, *policy, self._length], new))
            self._rollout.append(BoundCall(rollout, [start, self._guess, *given], new))
        self._bound = instance

    def solve(self, instance: Instance, guess: FloatArray) -> Solution:
        """Solve from guessed controls, (T, 2)."""
        start = time.perf_counter()
        if instance is not self._bound:
            self._bind(instance)
        self._guess[:] = guess
        self._rollout[self._present]()
        cost = self._cost[0]
        if not isfinite(cost):
            return self._result("cost is not finite", 0, start, solved=False)
        self._accept()
        exact, mu = True, _REGULARISATION[0]
        for iteration in range(1, self._settings.max_iterations + 1):
            self._mu[0] = mu
            (self._exact if exact else self._gauss_newton)[self._present]()
            if exact and not self._convexity[0] > _LEAST_CURVATURE:
                exact = False
                continue
            promised = -self._change[0]
            if promised < TOLERANCE * (1.0 + abs(cost)):
                return self._result("solved", iteration, start, solved=True)
            new_cost = self._search(cost, promised)
            if new_cost is not None:
                self._accept()
                gained = cost - new_cost
                small = gained < TOLERANCE * (1.0 + abs(cost))
                if gained > _GOOD_SHARE * promised:
                    mu = max(0.1 * mu, _REGULARISATION[0])
                cost, exact = new_cost, True
                if small:
                    return self._result("solved", iteration, start, solved=True)
            elif exact:
                exact = False
            else:
                mu = max(100.0 * mu, _REGULARISATION[1])
                if mu > _REGULARISATION[2]:
                    # As good as it gets in this arithmetic, unless much was promised.
                    good = promised < _ROUNDING * (1.0 + abs(cost))
                    status = "solved" if good else "no step lowers the cost"
                    return self._result(status, iteration, start, solved=good)
        return self._result(
            "too many iterations", self._settings.max_iterations, start, solved=False
        )

    def _search(self, cost: float, promised: float) -> float | None:
        """Shorten the step until it lowers the cost enough; None if no length does."""
        length = 1.0
        while length > _SHORTEST_STEP:
            self._length[0] = length
            self._forward[self._present]()
            if self._cost[0] < cost - _SUFFICIENT * length * promised:
                return self._cost[0]
            length *= _SHORTEN
        return None

    def _accept(self) -> None:
        """Take what was rolled out last."""
        self._present = 1 - self._present

    def _result(self, status: str, iterations: int, start: float, *, solved: bool) -> Solution:
        if not solved:
            return Solution(
                np.zeros((0, 0)),
                np.zeros((0, 0)),
                False,
                f"{self.name} returned {status}",
                iterations,
                time.perf_counter() - start,
                {},
            )
        return Solution(
            states=self._x[self._present][:, :4].copy(),
            controls=self._u[self._present] * CONTROL_SCALE,
            solved=True,
            status=status,
            iterations=iterations,
            wall_time=time.perf_counter() - start,
            reward=dict(zip(self._parts, self._terms[self._present].tolist(), strict=True)),
        )


def _backward_pass(stage: Stage, settings: PlannerSettings, *, exact: bool) -> Any:
    """(x, u, p, low, high, most, mu) -> (steps, gains, change of cost, least curvature).

    ``most`` bounds how much a control may differ from the one before.
    """
    one = _riccati_step(stage, settings, exact=exact)
    t, n = settings.horizon, N_STATES
    x, u, p, *bounds = _trajectory(stage, t)
    mu = ca.MX.sym("mu")
    gradient, hessian, change = ca.MX.zeros(n), ca.MX.zeros(n, n), ca.MX(0)
    steps, gains, curvatures = [ca.MX()] * t, [ca.MX()] * t, []
    for i in reversed(range(t)):
        gradient, hessian, steps[i], gains[i], gain, curvature = one(
            gradient, hessian, x[:, i], u[:, i], p[:, i], *[b[:, i] for b in bounds], mu
        )
        change += gain
        curvatures.append(curvature)
    outputs = [ca.horzcat(*steps), ca.horzcat(*gains), change, ca.mmin(ca.vertcat(*curvatures))]
    name = "backward_exact" if exact else "backward_gauss_newton"
    return ca.Function(name, [x, u, p, *bounds, mu], outputs)


def _trajectory(stage: Stage, t: int) -> list[Any]:
    """Symbols x, u, p and low, high, most: one column per stage."""
    sizes = (N_STATES, 2, stage.parameters.shape[0], 2, 2, 2)
    columns = (t + 1, t, t, t, t, t)
    names = ("x", "u", "p", "low", "high", "most")
    return [ca.MX.sym(*shape) for shape in zip(names, sizes, columns, strict=True)]


def _riccati_step(stage: Stage, settings: PlannerSettings, *, exact: bool) -> Any:
    """One stage of the backward pass: the cost-to-go before it, from the one after it."""
    n = N_STATES
    gradient, hessian = ca.SX.sym("gradient", n), ca.SX.sym("hessian", n, n)
    low, high, most = (ca.SX.sym(name, 2) for name in ("low", "high", "most"))
    mu = ca.SX.sym("mu")
    slope, model = _quadratic(stage, gradient, _symmetric(hessian), exact=exact)
    xx, ux, uu = model[:n, :n], model[n:, :n], model[n:, n:]
    x_slope, u_slope = slope[:n], slope[n:]

    damped = uu + mu * ca.SX.eye(2)
    limits = control_limits(stage.state, low, high, most, settings)
    below, above = (limit - stage.control for limit in limits)
    step, free = _box_step(damped, u_slope, below, above)
    # What is held at a limit moves with it: the limits depend on the state.
    slopes = [ca.jacobian(limit, stage.state) for limit in limits]
    at_lowest = [step[i] <= below[i] + _AT_LIMIT for i in range(2)]
    held = [ca.if_else(at_lowest[i], slopes[0][i, :], slopes[1][i, :]) for i in range(2)]
    gain = _gain(damped, ux, free, held)
    gradient_before = x_slope + gain.T @ (uu @ step + u_slope) + ux.T @ step
    hessian_before = xx + gain.T @ (uu @ gain + ux) + ux.T @ gain
    change = ca.dot(step, u_slope) + 0.5 * ca.dot(step, uu @ step)
    return ca.Function(
        "riccati_exact" if exact else "riccati_gauss_newton",
        [gradient, hessian, *stage.inputs(), low, high, most, mu],
        [
            gradient_before,
            _symmetric(hessian_before),
            step,
            gain,
            change,
            _least_eigenvalue(damped),
        ],
        {"cse": True},
    )


def _quadratic(stage: Stage, gradient: Any, hessian: Any, *, exact: bool) -> tuple[Any, Any]:
    """Gradient and Hessian, in (state, control), of a stage's cost and the cost-to-go after it.

    The cost is a function of w = (landing, road state, control) and of the place relative to every
    car, of few of which each part of it depends; the chain rule does the rest. The control before
    is part of w if the cost depends on it. Exact: the dynamics' own curvature, weighted by all that
    depends on where they lead, belongs to it (DDP).
    """
    z = ca.vertcat(stage.state, stage.control)
    changes = ca.depends_on(stage.cost, stage.state[4:])
    here = z if changes else ca.vertcat(stage.state[:4], stage.control)
    w = ca.vertcat(stage.landing, here)
    move, pick = ca.jacobian(stage.next_state, z), ca.jacobian(here, z)
    v = ca.vertcat(w, stage.relative)
    of_v = ca.jacobian(ca.vertcat(w, stage.relative_there), w)  # linear
    if exact:
        curvature, by_v = ca.hessian(stage.cost, v)
    else:
        by_v, rows = ca.gradient(stage.cost, v), ca.jacobian(stage.residuals, v)
        curvature = rows.T @ (ca.repmat(stage.residual_weights, 1, v.shape[0]) * rows)
    by_w, curvature = stage.landed(of_v.T @ by_v, _symmetric(of_v.T @ curvature @ of_v))
    # What it costs to land there adds to the cost-to-go from there.
    gradient = gradient + ca.vertcat(by_w[:4], ca.SX(2, 1))
    hessian = hessian + ca.diagcat(curvature[:4, :4], ca.SX(2, 2))
    slope = move.T @ gradient + pick.T @ by_w[4:]
    both = move[:4, :].T @ curvature[:4, 4:] @ pick
    model = move.T @ hessian @ move + both + both.T + pick.T @ curvature[4:, 4:] @ pick
    if exact:
        price = ca.SX.sym("price", 4)
        bend, _ = ca.hessian(ca.dot(price, stage.next_state[:4]), z)
        model += ca.substitute(bend, price, gradient[:4])
    return slope, _symmetric(model)


def _symmetric(matrix: Any) -> Any:
    """Return the same symmetric matrix, of which only one half is worked out."""
    return ca.triu2symm(ca.triu(matrix))


def _box_step(h: Any, g: Any, low: Any, high: Any) -> tuple[Any, list[Any]]:
    """Minimise u'hu/2 + g'u over a box, u of two entries; and which entries are free.

    The minimum is the unconstrained one, or lies on one of the four sides.
    """

    def value(u: Any) -> Any:
        return 0.5 * ca.dot(u, h @ u) + ca.dot(g, u)

    def clip(v: Any, i: int) -> Any:
        return ca.fmin(ca.fmax(v, low[i]), high[i])

    best = _solve_2x2(h, -g)
    inside = ca.logic_and(ca.logic_and(best[0] >= low[0], best[0] <= high[0]), best[1] >= low[1])
    inside = ca.logic_and(inside, best[1] <= high[1])
    sides = [ca.vertcat(e, clip(-(g[1] + h[0, 1] * e) / h[1, 1], 1)) for e in (low[0], high[0])]
    sides += [ca.vertcat(clip(-(g[0] + h[0, 1] * e) / h[0, 0], 0), e) for e in (low[1], high[1])]
    side, cost = sides[0], value(sides[0])
    for other in sides[1:]:
        lower = value(other) < cost
        side, cost = ca.if_else(lower, other, side), ca.if_else(lower, value(other), cost)
    step = ca.if_else(inside, best, side)
    free = [
        ca.logic_and(step[i] > low[i] + _AT_LIMIT, step[i] < high[i] - _AT_LIMIT) for i in range(2)
    ]
    return step, free


def _gain(h: Any, ux: Any, free: list[Any], held: list[Any]) -> Any:
    """Feedback of the controls on the state, (2, n): free ones as is best, held ones as given.

    A free one answers to what the held one does.
    """
    both, coupled = ca.logic_and(*free), _solve_2x2(h, -ux)
    rows = []
    for i in range(2):
        alone = -(ux[i, :] + h[0, 1] * held[1 - i]) / h[i, i]
        rows.append(ca.if_else(both, coupled[i, :], ca.if_else(free[i], alone, held[i])))
    return ca.vertcat(*rows)


def _solve_2x2(h: Any, b: Any) -> Any:
    determinant = h[0, 0] * h[1, 1] - h[0, 1] * h[0, 1]
    first = (h[1, 1] * b[0, :] - h[0, 1] * b[1, :]) / determinant
    second = (h[0, 0] * b[1, :] - h[0, 1] * b[0, :]) / determinant
    return ca.vertcat(first, second)


def _least_eigenvalue(h: Any) -> Any:
    mean, half = 0.5 * (h[0, 0] + h[1, 1]), 0.5 * (h[0, 0] - h[1, 1])
    return mean - ca.sqrt(half**2 + h[0, 1] ** 2)


def _rollout(stage: Stage, settings: PlannerSettings) -> Any:
    """(start, guess in SI units, p, low, high, most) -> (x, u within limits, cost, terms)."""
    start = ca.MX.sym("start", N_STATES)
    _, guess, p, *bounds = _trajectory(stage, settings.horizon)
    u = guess / ca.repmat(ca.DM(SCALES), 1, settings.horizon)
    driven = _driven(stage, settings, start, lambda i, _: u[:, i], [p, *bounds])
    return ca.Function("rollout", [start, guess, p, *bounds], driven)


def _forward_pass(stage: Stage, settings: PlannerSettings) -> Any:
    """(x, u, p, low, high, most, steps, gains, length) -> (new x, new u, cost, terms)."""
    t, n = settings.horizon, N_STATES
    x, u, p, *bounds = _trajectory(stage, t)
    steps, gains, length = ca.MX.sym("steps", 2, t), ca.MX.sym("gains", 2, n * t), ca.MX.sym("a")

    def policy(i: int, state: Any) -> Any:
        feedback = gains[:, n * i : n * i + n] @ (state - x[:, i])
        return u[:, i] + length * steps[:, i] + feedback

    driven = _driven(stage, settings, x[:, 0], policy, [p, *bounds])
    return ca.Function("forward", [x, u, p, *bounds, steps, gains, length], driven)


def _driven(
    stage: Stage,
    settings: PlannerSettings,
    start: Any,
    policy: Callable[[int, Any], Any],
    given: list[Any],
) -> list[Any]:
    """Expressions of states, controls, cost and terms, from a start and (stage, state) -> control.

    ``given`` are parameters and bounds, a column per stage.
    """
    one = limited_stage(stage, settings)
    states, controls, total = [start], [], ca.MX.zeros(len(settings.reward.parts))
    for i in range(settings.horizon):
        wanted = policy(i, states[-1])
        state, control, terms = one(states[-1], wanted, *[column[:, i] for column in given])
        states.append(state)
        controls.append(control)
        total += terms
    return [ca.horzcat(*states), ca.horzcat(*controls), -ca.sum1(total), total]
