"""How likely a demonstration is under a reward (Levine and Koltun 2012, section 4).

Around a locally optimal example the reward is a quadratic in the controls, and the Boltzmann
distribution over them a normal one. With the reward's gradient g and A, minus its Hessian, of f
free controls,

    log p(u | theta) = -1/2 g' A^-1 g + 1/2 log|A| - f/2 log 2 pi.

The reward is theta' phi, so that g and A are sums of each term's own: they are worked out once,
and the fit needs no reward any more. A is of Gauss-Newton's kind, from the terms as weighted
squares (planning.reward): positive for every theta > 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sumo_cohesion.learning.segments import Segments, free_directions
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.compiled import BUILDING
from sumo_cohesion.planning.stage import N_STATES, StageParameters, make_stage
from sumo_cohesion.state import BoolArray, FloatArray

_LANDING = 4
"""Numbers of a road state, where a stage leads."""
_STAGES_AT_ONCE, _NUMBERS_AT_ONCE = 20_000, 8_000_000
"""Of many segments so much is worked out at once: less would be slower, more fills the memory."""


class Quadratics(NamedTuple):
    """Reward terms around N segments, as quadratics in their 2 T scaled controls.

    gradient : (N, K, 2 T) of every term. curvature : (N, K, 2 T, 2 T) minus its Hessian.
    fixed : (N, 2 T) directions that active bounds leave no choice in; both are zero there.
    penalty : (N,) cost of the exact penalties for a weight of one: not a quadratic where positive.
    """

    gradient: FloatArray
    curvature: FloatArray
    fixed: BoolArray
    penalty: FloatArray

    @property
    def free(self) -> FloatArray:
        """Free dimensions of every segment."""
        return np.asarray((~self.fixed).sum(axis=1), dtype=float)

    def where(self, chosen: BoolArray | slice) -> Quadratics:
        """Return those of some segments."""
        return Quadratics(
            self.gradient[chosen], self.curvature[chosen], self.fixed[chosen], self.penalty[chosen]
        )


class Score(NamedTuple):
    """Log-likelihood of N segments under K weights, and its derivatives, weighted and summed.

    each : (N,) of every segment. misfit : (N,) q = g' A^-1 g; about ``free`` where it fits.
    gradient : (K,). hessian : (K, K), or None if it was not asked for.
    """

    each: FloatArray
    misfit: FloatArray
    gradient: FloatArray
    hessian: FloatArray | None


def quadratics(segments: Segments, settings: PlannerSettings) -> Quadratics:
    """Work out gradient and curvature of every reward term in use, around one segment or more."""
    functions = _stage_functions(settings, _lanes_of(segments, settings))
    at_once = max(_STAGES_AT_ONCE // settings.horizon, 1)
    parts = [
        _quadratics(segments.where(slice(first, first + at_once)), *functions)
        for first in range(0, len(segments), at_once)
    ]
    return Quadratics(*[np.concatenate(part) for part in zip(*parts, strict=True)])


def _quadratics(segments: Segments, terms_of: Any, moved_by: Any) -> Quadratics:
    n, steps, _ = segments.controls.shape
    before = np.concatenate((segments.start[:, None, :4], segments.states[:, :-1]), axis=1)
    driven = np.concatenate((segments.start[:, None, 4:], segments.controls[:, :-1]), axis=1)
    rows = (np.concatenate((before, driven), axis=2), segments.controls, segments.stages)
    columns = [part.reshape(n * steps, -1).T for part in rows]
    landing = segments.states.reshape(n * steps, -1).T
    slopes, squares, penalty = _mapped(terms_of, [landing, *columns])
    (moves,) = _mapped(moved_by, columns)
    width = _LANDING + 2 + 2
    k = terms_of.size2_out(0)
    # A CasADi matrix of several blocks is a NumPy one with the blocks' columns in a row.
    slope = slopes.reshape(n, steps, k, width)
    square = squares.reshape(n, steps, k, width, width)
    move = moves.reshape(n, steps, N_STATES + 2, N_STATES).swapaxes(2, 3)
    gradient, curvature = _chained(slope, square, move)
    basis, free = free_directions(segments)
    held = ~free.all(axis=1)
    z = (basis * free[:, None])[held]
    gradient[held] = gradient[held] @ z
    curvature[held] = z.swapaxes(1, 2)[:, None] @ curvature[held] @ z[:, None]
    return Quadratics(gradient, curvature, ~free, penalty.reshape(n, steps).sum(axis=1))


def _lanes_of(segments: Segments, settings: PlannerSettings) -> int:
    """Return the number of lanes that the segments' parameters were written for."""
    return int(segments.stages.shape[2] - StageParameters(settings, 0).size) // 2


def _stage_functions(settings: PlannerSettings, n_lanes: int) -> tuple[Any, Any]:
    """Write down the derivatives of one stage.

    (landing, state, control, parameters) -> every term's gradient in (landing, control before,
    control), (8, K); its Gauss-Newton block, (8, 8 K); the penalties.
    (state, control, parameters) -> Jacobian of the next state in (state, control), (6, 8).
    """
    with BUILDING:
        layout = StageParameters(settings, n_lanes)
        stage = make_stage(settings, layout)
        near = [stage.residuals, stage.residual_weights, stage.terms["constraints"]]
        residuals, weights, penalty = ca.substitute(near, [stage.relative], [stage.relative_there])
        y = ca.vertcat(stage.landing, stage.state[4:], stage.control)
        jacobian = ca.jacobian(residuals, y)
        # The weights of the squares are linear in theta: what each term has of them. Times theta,
        # which is one, or zero where a stage has no control before it to differ from.
        theta = layout.columns("theta")
        shares = ca.jacobian(weights, stage.parameters)[:, theta]
        shares = shares * ca.repmat(stage.parameters[theta].T, shares.shape[0], 1)
        slopes, squares = [], []
        for k in range(layout.sizes["theta"]):
            share = shares[:, k]
            slopes.append(-jacobian.T @ (share * residuals))
            squares.append(jacobian.T @ (ca.repmat(share, 1, y.shape[0]) * jacobian))
        inputs = [stage.landing, *stage.inputs()]
        outputs = [ca.horzcat(*slopes), ca.horzcat(*squares), -penalty]
        dense = [ca.densify(output) for output in outputs]
        terms_of = ca.Function("terms", inputs, dense, {"cse": True})
        z = ca.vertcat(stage.state, stage.control)
        moved = ca.densify(ca.jacobian(stage.next_state, z))
        return terms_of, ca.Function("moves", stage.inputs(), [moved], {"cse": True})


def _mapped(function: Any, columns: list[FloatArray]) -> list[FloatArray]:
    """Call a function for every column; (columns, entries) of each of its outputs."""
    n = columns[0].shape[1]
    with BUILDING:
        mapped = function.map(n)
    # Blocks of columns, each column-major: its transpose is row-major.
    return [np.asarray(result.full()).T.reshape(n, -1) for result in mapped.call(columns)]


def _chained(
    slope: FloatArray, square: FloatArray, move: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gradient and curvature in all controls, from those of every stage.

    ``slope`` (N, T, K, 8), ``square`` (N, T, K, 8, 8), ``move`` (N, T, 6, 8).
    """
    n, steps, k, _ = slope.shape
    size = 2 * steps
    gradient, curvature = np.zeros((n, k, size)), np.zeros((n, k, size, size))
    reach = np.zeros((n, N_STATES, size))  # how the state before depends on all controls
    for t in range(steps):
        upto = 2 * t + 2
        chosen = np.zeros((n, 2, size))
        chosen[:, 0, 2 * t] = chosen[:, 1, 2 * t + 1] = 1.0
        before = reach
        reach = move[:, t, :, :N_STATES] @ before + move[:, t, :, N_STATES:] @ chosen
        y = np.concatenate((reach[:, :_LANDING], before[:, _LANDING:], chosen), axis=1)
        y = y[:, None, :, :upto]
        gradient[:, :, :upto] += (slope[:, t, :, None] @ y)[:, :, 0]
        curvature[:, :, :upto, :upto] += y.swapaxes(2, 3) @ (square[:, t] @ y)
    return gradient, curvature


def score(
    data: Quadratics, theta: FloatArray, weights: FloatArray, *, with_hessian: bool = False
) -> Score:
    """Log-likelihood of segments under theta (K,), each counted by its weight (N,)."""
    n, at_once = len(data.gradient), max(_NUMBERS_AT_ONCE // data.curvature[0].size, 1)
    each, misfit, gradient, hessian = zip(
        *[
            _score(data.where(part), theta, weights[part], with_hessian)
            for part in [slice(first, first + at_once) for first in range(0, n, at_once)]
        ],
        strict=True,
    )
    return Score(
        np.concatenate(each),
        np.concatenate(misfit),
        np.sum(gradient, axis=0),
        np.sum(hessian, axis=0) if with_hessian else None,
    )


def _score(data: Quadratics, theta: FloatArray, weights: FloatArray, with_hessian: bool) -> Score:
    n, k, size, _ = data.curvature.shape
    flat = data.curvature.reshape(n, k, size * size)
    curvature = (theta @ flat).reshape(n, size, size)
    # Where no choice is left the curvature is one: neither determinant nor inverse notices.
    curvature[:, np.arange(size), np.arange(size)] += data.fixed
    inverse = np.linalg.inv(curvature)
    _, log_determinant = np.linalg.slogdet(curvature)
    v = (inverse @ (theta @ data.gradient)[:, :, None])[:, :, 0]
    misfit = ((theta @ data.gradient) * v).sum(axis=1)
    each = 0.5 * (log_determinant - misfit - data.free * np.log(2.0 * np.pi))
    # d/dk: -G_k' v + 1/2 v' A_k v + 1/2 tr(A^-1 A_k)
    pushed = (data.curvature @ v[:, None, :, None])[:, :, :, 0]
    volume = (flat @ inverse.reshape(n, size * size, 1))[:, :, 0]
    slopes = ((0.5 * pushed - data.gradient) @ v[:, :, None])[:, :, 0] + 0.5 * volume
    hessian = None
    if with_hessian:
        # -(G_k - A_k v)' A^-1 (G_l - A_l v) - 1/2 tr(A^-1 A_k A^-1 A_l)
        apart = data.gradient - pushed
        each_way = apart @ inverse @ apart.swapaxes(1, 2)
        relative = inverse[:, None] @ data.curvature
        twisted = relative.swapaxes(2, 3).reshape(n, k, size * size)
        each_way += 0.5 * relative.reshape(n, k, size * size) @ twisted.swapaxes(1, 2)
        hessian = -np.tensordot(weights, each_way, 1)
    return Score(each, misfit, weights @ slopes, hessian)
