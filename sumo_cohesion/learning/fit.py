"""Find theta: maximum likelihood, trimmed, with what cannot be told from the data kept as it was.

Weights w are relative to one that is kept, the anchor; the common scale of all is apart. A scale is
the inverse of a temperature: the same driving, more or less exactly optimal.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from sumo_cohesion.learning.likelihood import Quadratics, score
from sumo_cohesion.state import BoolArray, FloatArray

ROUNDS = 6
"""Of fitting and trimming, at most."""
UNCERTAIN = 1.0
"""Standard error of a weight's logarithm above which the data do not tell it."""
_FURTHEST = 18.0
"""How far (natural logarithm) a weight may go from where it starts: 8 powers of ten."""
_STRIDE = 4.0
"""How far it may go at once: what a model promises farther away, exponentials do not keep."""
_LEAST_NOISE = 1e-24
"""Temperature of driving that is exactly optimal: with none its likelihood has no maximum."""


@dataclass(frozen=True)
class Fit:
    """What was found.

    Attributes
    ----------
    names : (K,) of the reward terms, in the order of the data.
    weights : (K,) with the anchor at its default.
    scale : of all weights; the temperature is its inverse.
    anchor : the weight that says what one is.
    error : (K,) standard error of the weights' logarithms (Fisher information); inf where unknown,
        zero where a weight was kept.
    kept_default : why a weight was not learned, by name.
    kept : (N,) segments that the fit is made of; each : (N,) log-likelihood; misfit : (N,) q / f.
    share : (K,) of the curvature that a term has, in the mean.
    """

    names: tuple[str, ...]
    weights: FloatArray
    scale: float
    anchor: str
    error: FloatArray
    kept_default: Mapping[str, str]
    kept: BoolArray
    each: FloatArray
    misfit: FloatArray
    share: FloatArray

    @property
    def theta(self) -> FloatArray:
        """(K,) the weights with their scale."""
        return self.scale * self.weights

    def weights_of(self, names: Iterable[str]) -> dict[str, float]:
        """Return some weights by name."""
        return {name: float(self.weights[self.names.index(name)]) for name in names}


class Maximum(NamedTuple):
    """Weights (K,) and their scale of the greatest likelihood; standard errors of logarithms."""

    weights: FloatArray
    scale: float
    error: FloatArray
    scale_error: float


def fit(
    data: Quadratics,
    names: tuple[str, ...],
    defaults: FloatArray,
    fixed: Mapping[str, float],
    keep: float,
) -> Fit:
    """Learn the weights of the terms that the data tell something of.

    Parameters
    ----------
    defaults : (K,) weights that are kept where nothing is learned; 0 is off.
    fixed : weights that are not learned, by name.
    keep : share of the segments that the fit is made of: those it fits worst are trimmed, because
        driving that is no optimum of anything would decide everything.

    A weight of which the data say nothing would go to zero, which is not "learned zero": it keeps
    its default.
    """
    usual = dict(zip(names, defaults.tolist(), strict=True))
    why, held = dict.fromkeys(fixed, "as asked for"), dict(fixed)
    weights = _start(data, defaults)
    while True:
        anchor = _anchor({**usual, **fixed}, [name for name in held if name not in fixed])
        unit = held.get(anchor, usual[anchor])
        found, scale_error = _trimmed(data, names, {**held, anchor: unit}, anchor, weights, keep)
        error = dict(zip(names, found.error, strict=True))
        unknown = [n for n in names if n not in held and not error[n] <= UNCERTAIN]
        if anchor not in held and not scale_error <= UNCERTAIN:
            # Relative to what is not known nothing is.
            name = anchor
        elif unknown:
            name = max(unknown, key=error.__getitem__)
        else:
            return replace(found, kept_default=why)
        held[name] = usual[name]
        why[name] = "the demonstrations do not tell it"
        weights = found.weights


def _start(data: Quadratics, defaults: FloatArray) -> FloatArray:
    """Weights to begin with: the defaults; what is off by default begins as strong as the rest."""
    strength = np.einsum("nkii->k", data.curvature)
    known = (defaults > 0.0) & (strength > 0.0)
    usual = np.median((defaults * strength)[known]) if known.any() else 1.0
    equal = usual / np.where(strength > 0.0, strength, usual)
    return np.where(defaults > 0.0, defaults, equal)


def _anchor(weights: Mapping[str, float], unknown: Collection[str]) -> str:
    """Return the weight that all others are relative to: the first that is on and can be known.

    In the order of planning.reward, where the lane comes first.
    """
    on = [name for name, weight in weights.items() if weight > 0.0]
    return next((name for name in [*on, *weights] if name not in unknown), next(iter(weights)))


def _trimmed(
    data: Quadratics,
    names: tuple[str, ...],
    held: Mapping[str, float],
    anchor: str,
    start: FloatArray,
    keep: float,
) -> tuple[Fit, float]:
    """Fit, leave out the segments that fit worst, and fit again until these stay the same.

    Returns the fit and the standard error of the scale's logarithm.
    """
    n = len(data.gradient)
    kept, again = np.zeros(n, dtype=bool), np.ones(n, dtype=bool)
    for _ in range(ROUNDS):
        if (again == kept).all():
            break
        kept = again
        start, scale, error, scale_error = maximise(data, kept.astype(float), names, held, start)
        found = score(data, scale * start, np.ones(n))
        misfit = found.misfit / np.maximum(data.free, 1.0)
        again = np.zeros(n, dtype=bool)
        again[np.argsort(misfit, kind="stable")[: max(round(keep * n), 1)]] = True
    strength = np.einsum("k,nkii->nk", start, data.curvature[kept])
    share = (strength / np.maximum(strength.sum(axis=1, keepdims=True), 1e-300)).mean(axis=0)
    fitted = Fit(names, start, scale, anchor, error, {}, kept, found.each, misfit, share)
    return fitted, scale_error


def maximise(
    data: Quadratics,
    counted: FloatArray,
    names: tuple[str, ...],
    held: Mapping[str, float],
    start: FloatArray,
) -> Maximum:
    """Find the weights and the scale of the greatest likelihood of segments, each counted so often.

    Unknown are the logarithms of the scale and of every weight that is not held; those that are
    held, one at least, are multiplied by the scale, too. ``start`` are weights (K,) to begin with.
    """
    used = counted > 0.0
    some, counts = data.where(used), counted[used]
    free = [i for i, name in enumerate(names) if name not in held]
    weights = np.array([held.get(name, 0.0) for name in names])
    first = np.log(np.maximum(start[free], 1e-300))
    total = float(counts @ some.free)

    def weights_of(x: FloatArray) -> FloatArray:
        w = weights.copy()
        w[free] = np.exp(np.clip(x[1:], first - _FURTHEST, first + _FURTHEST))
        return w

    def chain(x: FloatArray, theta: FloatArray) -> FloatArray:
        """Slope of theta in x: (K, 1 + number of free weights)."""
        columns = np.zeros((len(names), 1 + len(free)))
        columns[:, 0] = theta
        within = np.abs(x[1:] - first) < _FURTHEST
        columns[free, np.arange(1, 1 + len(free))] = theta[free] * within
        return columns

    def loss(x: FloatArray) -> tuple[float, FloatArray]:
        theta = np.exp(x[0]) * weights_of(x)
        found = score(some, theta, counts)
        exact = 0.5 * _LEAST_NOISE * np.exp(x[0])
        slope = -(found.gradient @ chain(x, theta)) / total
        slope[0] += exact
        return exact - float(counts @ found.each) / total, slope

    def bend(x: FloatArray) -> FloatArray:
        theta = np.exp(x[0]) * weights_of(x)
        found, columns = score(some, theta, counts, with_hessian=True), chain(x, theta)
        assert found.hessian is not None
        curvature = -columns.T @ found.hessian @ columns
        # d² theta / dx²: a logarithm's own, and those of scale and weight together.
        slope = found.gradient @ columns
        curvature[0, 1:] -= slope[1:]
        curvature[1:, 0] -= slope[1:]
        curvature[np.diag_indices(len(slope))] -= slope
        curvature[0, 0] += 0.5 * _LEAST_NOISE * np.exp(x[0]) * total
        return np.asarray(curvature / total)

    # The best scale for given weights has a closed form: q and log|A| are simple in it.
    x0 = np.concatenate(([0.0], first))
    misfit = float(counts @ score(some, weights_of(x0), counts).misfit)
    x0[0] = -np.log(misfit / total + _LEAST_NOISE)
    options = {"maxiter": 200, "gtol": 1e-7, "max_trust_radius": _STRIDE}
    x = minimize(loss, x0, jac=True, hess=bend, method="trust-exact", options=options).x
    errors = _errors(total * bend(x))
    error = np.zeros(len(names))
    error[free] = np.where(np.abs(x[1:] - first) < _FURTHEST, errors[1:], np.inf)
    return Maximum(weights_of(x), float(np.exp(x[0])), error, float(errors[0]))


def _errors(curvature: FloatArray) -> FloatArray:
    """Square roots of the diagonal of a curvature's inverse; inf where it is not positive."""
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    known, share = values > 0.0, vectors**2
    variance = share[:, known] @ (1.0 / values[known])
    unknown = (share[:, ~known] > 1e-12).any(axis=1)
    return np.where(unknown, np.inf, np.sqrt(variance))


def bootstrap(
    data: Quadratics,
    runs: NDArray[np.object_],
    found: Fit,
    draws: int,
    progress: Callable[[int, int], None] | None = None,
) -> FloatArray:
    """Weights of as many draws of whole runs, with replacement: (draws, K).

    Of the segments that were kept. Those of one run are alike: drawing segments would make
    intervals half as wide as they are.
    """
    rng = np.random.default_rng(0)
    some = data.where(found.kept)
    labels, member = np.unique(runs[found.kept].astype(str), return_inverse=True)
    held = found.weights_of([*found.kept_default, found.anchor])
    samples = np.zeros((draws, len(found.names)))
    for draw in range(draws):
        times = np.bincount(rng.integers(len(labels), size=len(labels)), minlength=len(labels))
        counted = times[member].astype(float)
        samples[draw] = maximise(some, counted, found.names, held, found.weights).weights
        if progress is not None:
            progress(draw + 1, draws)
    return samples
