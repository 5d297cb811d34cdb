"""Find theta: maximum likelihood, trimmed, with what cannot be told from the data kept as it was.

Weights w are relative to one that is kept, the anchor; the common scale of all is apart. A scale is
the inverse of a temperature: the same driving, more or less exactly optimal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from sumo_cohesion.learning.likelihood import Quadratics, score
from sumo_cohesion.state import BoolArray, FloatArray

ROUNDS = 6
"""Of fitting and trimming, at most."""
UNCERTAIN = 1.0
"""Standard error of a weight's logarithm above which the data do not tell it."""
_FURTHEST = 18.0
"""How far (natural logarithm) the fit may go from where it starts: 8 powers of ten."""


@dataclass(frozen=True)
class Fit:
    """What was found.

    Attributes
    ----------
    names : (K,) of the reward terms, in the order of the data.
    weights : (K,) with the anchor at its default.
    scale : of all weights; the temperature is its inverse.
    anchor : the weight that says what one is.
    error : (K,) standard error of the weights' logarithms (Fisher information); inf where unknown.
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
    why = dict.fromkeys(fixed, "as asked for")
    held = {name: value for name, value in zip(names, defaults, strict=True) if name in fixed}
    held |= fixed
    chosen = _start(data, defaults)
    while True:
        free = [name for name in names if name not in held]
        anchor = _anchor(free, names, defaults, why)
        found = _trimmed(data, names, held, anchor, chosen, defaults, keep)
        unknown = {
            name: found.error[names.index(name)]
            for name in free
            if name != anchor and not found.error[names.index(name)] <= UNCERTAIN
        }
        if not unknown:
            return replace(found, kept_default=why)
        name = max(unknown, key=lambda n: unknown[n])
        held[name] = float(defaults[names.index(name)])
        why[name] = "the demonstrations do not tell it"
        chosen = found.theta


def _start(data: Quadratics, defaults: FloatArray) -> FloatArray:
    """Weights to begin with: the defaults; what is off by default begins as strong as the rest."""
    strength = np.einsum("nkii->k", data.curvature)
    known = defaults > 0.0
    usual = np.median((defaults * strength)[known & (strength > 0.0)]) if known.any() else 1.0
    with np.errstate(divide="ignore"):
        equal = np.where(strength > 0.0, usual / strength, 1.0)
    return np.where(known, defaults, equal)


def _anchor(
    free: list[str], names: tuple[str, ...], defaults: FloatArray, why: Mapping[str, str]
) -> str:
    """Return the weight that all others are relative to: the first that can be learned.

    In the order of planning.reward, where the lane comes first.
    """
    on = [name for name in names if defaults[names.index(name)] > 0.0]
    return next((name for name in on if name in free), next(iter(why), names[0]))


def _trimmed(
    data: Quadratics,
    names: tuple[str, ...],
    held: Mapping[str, float],
    anchor: str,
    start: FloatArray,
    defaults: FloatArray,
    keep: float,
) -> Fit:
    """Fit, leave out the segments that fit worst, and fit again until these stay the same."""
    n = len(data.gradient)
    kept = np.ones(n, dtype=bool)
    theta = start
    for _ in range(ROUNDS):
        theta, error = maximise(data, kept.astype(float), names, held, anchor, theta, defaults)
        found = score(data, theta, np.ones(n))
        misfit = found.misfit / np.maximum(data.free, 1.0)
        order = np.argsort(misfit, kind="stable")
        again = np.zeros(n, dtype=bool)
        again[order[: max(round(keep * n), 1)]] = True
        if (again == kept).all():
            break
        kept = again
    unit = defaults[names.index(anchor)] if defaults[names.index(anchor)] > 0.0 else 1.0
    scale = float(theta[names.index(anchor)] / unit)
    strength = np.einsum("k,nkii->nk", theta, data.curvature[kept])
    share = (strength / np.maximum(strength.sum(axis=1, keepdims=True), 1e-300)).mean(axis=0)
    return Fit(names, theta / scale, scale, anchor, error, {}, kept, found.each, misfit, share)


def maximise(
    data: Quadratics,
    counted: FloatArray,
    names: tuple[str, ...],
    held: Mapping[str, float],
    anchor: str,
    start: FloatArray,
    defaults: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Find theta of the greatest likelihood, and the standard errors of the weights' logarithms.

    Unknown are the logarithms of the scale and of every weight relative to the anchor; weights that
    are held have no unknown, but they, too, are multiplied by the scale.
    """
    used = counted > 0.0
    some, counts = data.where(used), counted[used]
    free = [i for i, name in enumerate(names) if name not in held and name != anchor]
    at = names.index(anchor)
    unit = defaults[at] if defaults[at] > 0.0 else 1.0
    weights = np.array([held.get(name, 0.0) for name in names])
    weights[at] = held.get(anchor, unit)
    scale = max(start[at] / weights[at], 1e-300) if weights[at] > 0.0 else 1.0

    def theta_of(x: FloatArray) -> FloatArray:
        w = weights.copy()
        w[free] = np.exp(x[1:])
        return np.asarray(np.exp(x[0]) * w)

    def chain(theta: FloatArray) -> FloatArray:
        """Slope of theta in x: (K, 1 + number of free weights)."""
        columns = np.zeros((len(names), 1 + len(free)))
        columns[:, 0] = theta
        columns[free, np.arange(1, 1 + len(free))] = theta[free]
        return columns

    total = float(counts @ some.free)

    def loss(x: FloatArray) -> tuple[float, FloatArray]:
        theta = theta_of(x)
        found = score(some, theta, counts)
        value = -float(counts @ found.each) / total
        return value, np.asarray(-(found.gradient @ chain(theta)) / total)

    def bend(x: FloatArray) -> FloatArray:
        theta = theta_of(x)
        found, columns = score(some, theta, counts, with_hessian=True), chain(theta)
        assert found.hessian is not None
        curvature = -columns.T @ found.hessian @ columns
        # d² theta / dx²: a logarithm's own, and those of scale and weight together.
        slope = found.gradient * theta
        curvature[0, 0] -= slope.sum()
        for column, k in enumerate(free, start=1):
            for entry in ((0, column), (column, 0), (column, column)):
                curvature[entry] -= slope[k]
        return np.asarray(curvature / total)

    # The best scale for given weights has a closed form: q and log|A| are simple in it.
    relative = np.maximum(start, 1e-300) / scale
    x0 = np.concatenate(([np.log(scale)], np.log(relative[free])))
    misfit = counts @ score(some, theta_of(x0), counts).misfit
    x0[0] += np.log(total / misfit) if misfit > 0.0 else 0.0
    result = minimize(
        loss,
        x0,
        jac=True,
        hess=bend,
        method="trust-exact",
        options={"maxiter": 200, "gtol": 1e-7},
    )
    theta = theta_of(result.x)
    curvature = total * bend(result.x)
    error = np.full(len(names), np.inf)
    error[free] = _errors(curvature)[1:]
    error[at] = 0.0
    for name in held:
        error[names.index(name)] = 0.0
    stuck = np.abs(result.x - x0) > _FURTHEST
    error[np.array(free, dtype=int)[stuck[1:]]] = np.inf
    return theta, error


def _errors(curvature: FloatArray) -> FloatArray:
    """Square roots of the diagonal of a curvature's inverse; inf where it is not positive."""
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    with np.errstate(divide="ignore"):
        inverse = np.where(values > 0.0, 1.0 / np.maximum(values, 1e-300), np.inf)
    share = vectors**2
    variance = np.where(share > 1e-12, share * inverse, 0.0).sum(axis=1)
    return np.asarray(np.sqrt(variance))


def bootstrap(
    data: Quadratics,
    groups: FloatArray,
    found: Fit,
    held: Mapping[str, float],
    defaults: FloatArray,
    draws: int,
    progress: Callable[[int, int], None] | None = None,
) -> FloatArray:
    """Weights of as many draws of whole runs, with replacement: (draws, K).

    Segments of one run are alike: drawing segments would make intervals half as wide as they are.
    """
    rng = np.random.default_rng(0)
    labels, member = np.unique(groups.astype(str), return_inverse=True)
    at = found.names.index(found.anchor)
    samples = np.zeros((draws, len(found.names)))
    for draw in range(draws):
        times = np.bincount(rng.integers(len(labels), size=len(labels)), minlength=len(labels))
        counted = times[member] * found.kept.astype(float)
        theta, _ = maximise(data, counted, found.names, held, found.anchor, found.theta, defaults)
        samples[draw] = theta * (found.weights[at] / theta[at])
        if progress is not None:
            progress(draw + 1, draws)
    return samples
