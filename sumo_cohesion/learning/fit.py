"""Find theta: maximum likelihood, trimmed, with what cannot be told from the data kept as it was.

Only ratios of weights matter to a planner, and one of them, the anchor, says what one is. The
common scale of all is the inverse of a temperature: the same driving, more or less exactly optimal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from sumo_cohesion.learning.likelihood import Quadratics, Score, score
from sumo_cohesion.state import BoolArray, FloatArray

ROUNDS = 6
"""Of fitting and trimming, at most."""
UNCERTAIN = 1.0
"""Standard error of a weight's logarithm above which the data do not tell it."""
ROUNDING = 1e-14
"""Error of a scaled control from rounding: without any, exact optima would have no temperature."""
ASKED, UNKNOWN = "as asked for", "the demonstrations do not tell it"
SMALLER = "the demonstrations tell only that it is smaller"
"""Why a weight was not learned."""
_CLEARLY = 3.0
"""Log-likelihood (nats) that is lost where driving speaks against a weight."""
_FURTHEST = 18.0
"""How far (natural logarithm) a weight may fall from where it starts: 8 powers of ten."""
_FAINT, _GAIN = 1e-6, 1e-2
"""Share of all curvature below which a term is hardly there, and what likelihood (nats) it must
promise to be tried again with that share."""
_BEGINNINGS = 3
"""Of the search, at most."""
_STRIDE = 4.0
"""How far it may go at once: what a model promises farther away, exponentials do not keep."""


@dataclass(frozen=True)
class Fit:
    """What was found.

    Attributes
    ----------
    names : (K,) of the reward terms, in the order of the data.
    theta : (K,) of the greatest likelihood.
    error : (K,) standard errors of theta's logarithms (Fisher information); inf where unknown,
        zero where a weight was fixed.
    defaults : (K,) weights where nothing is learned; fixed : weights that were asked for, by name.
    anchor : the weight that says what one is: it is as it was, all others are relative to it.
    kept_default : why a weight was not learned, by name.
    kept : (N,) segments that the fit is made of; each : (N,) log-likelihood; misfit : (N,) q / f.
    share : (K,) of the curvature that a term has, in the mean.
    """

    names: tuple[str, ...]
    theta: FloatArray
    error: FloatArray
    defaults: FloatArray
    fixed: Mapping[str, float]
    anchor: str
    kept_default: Mapping[str, str]
    kept: BoolArray
    each: FloatArray
    misfit: FloatArray
    share: FloatArray

    @property
    def scale(self) -> float:
        """Of all weights: the inverse of the temperature."""
        at = self.names.index(self.anchor)
        return float(self.theta[at] / self.fixed.get(self.anchor, self.defaults[at]))

    @property
    def weights(self) -> FloatArray:
        """(K,) what was learned, relative to the anchor, and the defaults of what was not."""
        weights = np.where(self._known, self.theta / self.scale, self.defaults)
        for name, value in self.fixed.items():
            weights[self.names.index(name)] = value
        return weights

    @property
    def _known(self) -> BoolArray:
        return np.array([name not in self.kept_default for name in self.names])

    def without(self, why: Mapping[str, str]) -> Fit:
        """Return the same with weights that are not believed, by name with the reason.

        If the anchor is one of them, the one that is known best takes its place.
        """
        doubted = {**self.kept_default, **why}
        left = [n for n in self.names if n not in doubted and self._default(n) > 0.0]
        if self.anchor not in why or not left:
            return replace(self, kept_default=doubted)
        best = min(left, key=lambda n: self.error[self.names.index(n)])
        return replace(self, kept_default=doubted, anchor=best)

    def _default(self, name: str) -> float:
        return float(self.defaults[self.names.index(name)])


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
    fixed : weights that are not learned, by name, relative to the lane's (to the first that is on).
    keep : share of the segments that the fit is made of: those it fits worst are trimmed, because
        driving that is no optimum of anything would decide everything.

    A weight of which the data say nothing goes to zero, which is not "learned zero": its default is
    what is reported.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the fixed weights leave controls that cost nothing.
    """
    n = len(data.gradient)
    units = _units(names, defaults, fixed)
    theta = _start(data, defaults)
    kept, again = np.zeros(n, dtype=bool), np.ones(n, dtype=bool)
    for _ in range(ROUNDS):
        if (again == kept).all():
            break
        kept = again
        theta, error = maximise(data, kept.astype(float), units, theta)
        found = score(data, theta, np.ones(n))
        misfit = found.misfit / np.maximum(data.free, 1.0)
        again = np.zeros(n, dtype=bool)
        again[np.argsort(misfit, kind="stable")[: max(round(keep * n), 1)]] = True
    strength = np.einsum("k,nkii->nk", theta, data.curvature[kept])
    share = (strength / np.maximum(strength.sum(axis=1, keepdims=True), 1e-300)).mean(axis=0)
    for name in fixed:
        error[names.index(name)] = 0.0
    result = Fit(
        names=names,
        theta=theta,
        error=error,
        defaults=defaults,
        fixed=dict(fixed),
        anchor=names[next(iter(units))],
        kept_default=dict.fromkeys(fixed, ASKED),
        kept=kept,
        each=found.each,
        misfit=misfit,
        share=share,
    )
    unknown = [name for name, e in zip(names, error, strict=True) if not e <= UNCERTAIN]
    result = result.without(dict.fromkeys(unknown, UNKNOWN))
    return result.without({name: SMALLER for name in unknown if _is_too_much(data, result, name)})


def _is_too_much(data: Quadratics, found: Fit, name: str) -> bool:
    """Tell if the default of a weight that is near zero makes the driving much less likely."""
    at, theta = found.names.index(name), found.theta.copy()
    theta[at] = found.scale * found.defaults[at]
    if theta[at] <= found.theta[at]:
        return False
    there = score(data, theta, np.ones(len(data.free))).each
    return float((found.each - there)[found.kept].sum()) > _CLEARLY


def _units(
    names: tuple[str, ...], defaults: FloatArray, fixed: Mapping[str, float]
) -> dict[int, float]:
    """Return the weights that have one scale in common, by index: the anchor's, and those fixed.

    The anchor comes first: in the order of planning.reward the first that is on, the lane.
    """
    values = [fixed.get(name, default) for name, default in zip(names, defaults, strict=True)]
    anchor = next((i for i, value in enumerate(values) if value > 0.0), 0)
    return {anchor: values[anchor]} | {names.index(n): value for n, value in fixed.items()}


def _start(data: Quadratics, defaults: FloatArray) -> FloatArray:
    """Weights to begin with: the defaults; what is off by default begins as strong as the rest."""
    strength = np.einsum("nkii->k", data.curvature)
    known = (defaults > 0.0) & (strength > 0.0)
    usual = float(np.median((defaults * strength)[known])) if known.any() else 1.0
    equal = usual / np.where(strength > 0.0, strength, usual)
    return np.where(defaults > 0.0, defaults, equal)


def maximise(
    data: Quadratics, counted: FloatArray, units: Mapping[int, float], start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Find theta (K,) of the greatest likelihood, and the standard errors of its logarithms.

    Unknown are the logarithms of a scale that ``units`` have in common, and of every other weight.

    Parameters
    ----------
    counted : (N,) how often each segment counts.
    units : weights that are relative to each other, by index; the first is positive.
    start : (K,) to begin with, but for the scale.
    """
    used = counted > 0.0
    some, counts = data.where(used), counted[used]
    total = float(counts @ some.free)
    free = [i for i in range(len(start)) if i not in units]
    # Theta is linear in the exponentials of the unknowns: a column for each.
    columns = np.zeros((len(start), 1 + len(free)))
    columns[list(units), 0] = list(units.values())
    columns[free, np.arange(1, 1 + len(free))] = 1.0
    rounded = ROUNDING**2 * counts @ np.einsum("nkii->nk", some.curvature)

    @lru_cache(maxsize=1)  # value and Hessian are asked for one after the other
    def score_at(x: tuple[float, ...]) -> Score:
        return score(some, (columns * np.exp(x)).sum(axis=1), counts, with_hessian=True)

    def loss(x: FloatArray) -> tuple[float, FloatArray]:
        chain, found = columns * np.exp(x), score_at(tuple(x))
        value = 0.5 * float(rounded @ chain.sum(axis=1)) - float(counts @ found.each)
        return value / total, np.asarray((0.5 * rounded - found.gradient) @ chain / total)

    def bend(x: FloatArray) -> FloatArray:
        chain, found = columns * np.exp(x), score_at(tuple(x))
        assert found.hessian is not None
        slope = (0.5 * rounded - found.gradient) @ chain
        return np.asarray((np.diag(slope) - chain.T @ found.hessian @ chain) / total)

    first = next(iter(units))
    if units[first] <= 0.0:
        raise np.linalg.LinAlgError("no weight is positive")
    x0 = np.log(np.append(start[first] / units[first], np.maximum(start[free], 1e-300)))
    # The best common scale has a closed form: q and log|A| are simple in it.
    theta = (columns * np.exp(x0)).sum(axis=1)
    misfit = float(counts @ score(some, theta, counts).misfit + rounded @ theta)
    x0 += np.log(total / misfit) if misfit > 0.0 else 0.0
    options = {"maxiter": 200, "gtol": 1e-7, "max_trust_radius": _STRIDE}
    x, begin = x0, x0
    for _ in range(_BEGINNINGS):
        x = minimize(loss, begin, jac=True, hess=bend, method="trust-exact", options=options).x
        lifted = _lifted(x, columns, some, counts)
        if lifted is None:
            break
        begin = lifted
    errors = _errors(total * bend(x))
    # What only rounding bounds is not known.
    told = np.abs(some.gradient).max(initial=0.0) > 0.0
    errors[(x - x0 < -_FURTHEST) | (not told)] = np.inf
    error = np.zeros(len(start))
    error[free], error[first] = errors[1:], errors[0]
    return (columns * np.exp(x)).sum(axis=1), error


def _lifted(
    x: FloatArray, columns: FloatArray, data: Quadratics, counts: FloatArray
) -> FloatArray | None:
    """Return a better beginning, if weights are near zero only because the search began there.

    The likelihood is concave in theta, but flat in the logarithm of a weight that is near zero.
    """
    chain = columns * np.exp(x)
    theta = chain.sum(axis=1)
    strength = (counts @ np.einsum("nkii->nk", data.curvature)) @ chain
    wanted = _FAINT * strength.sum()
    faint = (strength > 0.0) & (strength < 0.5 * wanted)
    gain = score(data, theta, counts).gradient @ chain
    rise = np.log(wanted) - np.log(np.where(faint, strength, wanted))
    grows = faint & (gain * np.exp(np.minimum(rise, 600.0)) > _GAIN)
    return x + np.where(grows, rise, 0.0) if grows.any() else None


def _errors(curvature: FloatArray) -> FloatArray:
    """Square roots of the diagonal of a curvature's inverse; inf where it is not positive."""
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    known, share = values > 0.0, vectors**2
    variance = share[:, known] @ (1.0 / values[known])
    unknown = (share[:, ~known] > 1e-9).any(axis=1)
    return np.where(unknown, np.inf, np.sqrt(variance))


def bootstrap(
    data: Quadratics,
    runs: NDArray[np.object_],
    found: Fit,
    draws: int,
    progress: Callable[[int, int], None] | None = None,
) -> FloatArray:
    """Weights of as many draws of whole runs, with replacement, relative to the anchor: (draws, K).

    Of the segments that were kept. Those of one run are alike: drawing segments would make
    intervals half as wide as they are.
    """
    rng = np.random.default_rng(0)
    some = data.where(found.kept)
    labels, member = np.unique(runs[found.kept].astype(str), return_inverse=True)
    units = _units(found.names, found.defaults, found.fixed)
    at = found.names.index(found.anchor)
    samples = np.zeros((draws, len(found.names)))
    for draw in range(draws):
        times = np.bincount(rng.integers(len(labels), size=len(labels)), minlength=len(labels))
        theta, _ = maximise(some, times[member].astype(float), units, found.theta)
        samples[draw] = theta / theta[at] * found.weights[at]
        if progress is not None:
            progress(draw + 1, draws)
    return samples
