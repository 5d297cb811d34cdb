"""Find theta: maximum likelihood, trimmed, with what cannot be told from the data kept as it was.

Only ratios of weights matter to a planner, and one of them, the anchor, says what one is. The
common scale of all is the inverse of a temperature: the same driving, more or less exactly optimal.
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
"""How far (natural logarithm) a weight may fall from where it starts: 8 powers of ten."""
_LONGEST_STEP = 3.0
"""Of the search, in natural logarithms: no number overflows."""
ASKED, UNKNOWN = "as asked for", "the demonstrations do not tell it"
"""Why a weight was not learned."""


@dataclass(frozen=True)
class Fit:
    """What was found.

    Attributes
    ----------
    names : (K,) of the reward terms, in the order of the data.
    theta : (K,) of the greatest likelihood.
    error : (K,) standard errors of theta's logarithms (Fisher information); inf where unknown.
    kept_default : why a weight was not learned, by name.
    anchor : the weight that says what one is: it is its default, all others are relative to it.
    defaults : (K,) weights where nothing is learned.
    kept : (N,) segments that the fit is made of; each : (N,) log-likelihood; misfit : (N,) q / f.
    share : (K,) of the curvature that a term has, in the mean.
    """

    names: tuple[str, ...]
    theta: FloatArray
    error: FloatArray
    kept_default: Mapping[str, str]
    anchor: str
    defaults: FloatArray
    kept: BoolArray
    each: FloatArray
    misfit: FloatArray
    share: FloatArray

    @property
    def scale(self) -> float:
        """Of all weights: the inverse of the temperature."""
        at = self.names.index(self.anchor)
        return float(self.theta[at] / self.defaults[at])

    @property
    def weights(self) -> FloatArray:
        """(K,) what was learned, relative to the anchor, and the defaults of what was not."""
        known = [self.kept_default.get(name, ASKED) == ASKED for name in self.names]
        return np.where(known, self.theta / self.scale, self.defaults)

    def without(self, why: Mapping[str, str]) -> Fit:
        """Return the same with weights that are not believed, by name with the reason.

        If the anchor is one of them, the one that is known best takes its place.
        """
        doubted = {**self.kept_default, **why}
        anchor = self.anchor
        if anchor in why:
            known = [
                i
                for i, name in enumerate(self.names)
                if name not in doubted and self.defaults[i] > 0.0
            ]
            if known:
                anchor = self.names[min(known, key=lambda i: self.error[i])]
        return replace(self, kept_default=doubted, anchor=anchor)


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
    fixed : weights that are not learned, by name, relative to the lane's (the first that is on).
    keep : share of the segments that the fit is made of: those it fits worst are trimmed, because
        driving that is no optimum of anything would decide everything.

    A weight of which the data say nothing goes to zero, which is not "learned zero": its default is
    what is reported.
    """
    n, counted = len(data.gradient), np.ones(len(data.gradient))
    free = [i for i, name in enumerate(names) if name not in fixed]
    reference = next((i for i in free if defaults[i] > 0.0), 0)
    held = {names.index(name): value for name, value in fixed.items()}
    theta = _start(data, defaults)
    kept = np.ones(n, dtype=bool)
    for _ in range(ROUNDS):
        theta, error = maximise(data, kept.astype(float), held, reference, defaults, theta)
        found = score(data, theta, counted)
        misfit = found.misfit / np.maximum(data.free, 1.0)
        again = np.zeros(n, dtype=bool)
        again[np.argsort(misfit, kind="stable")[: max(round(keep * n), 1)]] = True
        if (again == kept).all():
            break
        kept = again
    strength = np.einsum("k,nkii->nk", theta, data.curvature[kept])
    share = (strength / np.maximum(strength.sum(axis=1, keepdims=True), 1e-300)).mean(axis=0)
    result = Fit(
        names,
        theta,
        error,
        dict.fromkeys(fixed, ASKED),
        names[reference],
        defaults,
        kept,
        found.each,
        misfit,
        share,
    )
    return result.without({names[i]: UNKNOWN for i in free if not error[i] <= UNCERTAIN})


def _start(data: Quadratics, defaults: FloatArray) -> FloatArray:
    """Weights to begin with: the defaults; what is off by default begins as strong as the rest."""
    strength = np.einsum("nkii->k", data.curvature)
    known = (defaults > 0.0) & (strength > 0.0)
    usual = float(np.median((defaults * strength)[known])) if known.any() else 1.0
    equal = usual / np.maximum(strength, 1e-300)
    return np.where(defaults > 0.0, defaults, np.where(strength > 0.0, equal, 1.0))


def maximise(
    data: Quadratics,
    counted: FloatArray,
    held: Mapping[int, float],
    reference: int,
    defaults: FloatArray,
    start: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Find theta of the greatest likelihood, and the standard errors of its logarithms.

    Unknown are the logarithms of all weights that are not held; those that are held are so relative
    to the reference.
    """
    used = counted > 0.0
    some, counts = data.where(used), counted[used]
    total = float(counts @ some.free)
    free = [i for i in range(len(defaults)) if i not in held]
    # Theta is linear in the exponentials of the unknowns: one column for each.
    columns = np.zeros((len(defaults), len(free)))
    columns[free, np.arange(len(free))] = 1.0
    if reference in free:
        for i, value in held.items():
            columns[i, free.index(reference)] = value / defaults[reference]

    def loss(x: FloatArray) -> tuple[float, FloatArray]:
        chain = columns * np.exp(x)
        found = score(some, chain.sum(axis=1), counts)
        return -float(counts @ found.each) / total, np.asarray(-(found.gradient @ chain) / total)

    def bend(x: FloatArray) -> FloatArray:
        chain = columns * np.exp(x)
        found = score(some, chain.sum(axis=1), counts, with_hessian=True)
        assert found.hessian is not None
        curvature = chain.T @ found.hessian @ chain + np.diag(found.gradient @ chain)
        return np.asarray(-curvature / total)

    x0 = np.log(np.maximum(start[free], 1e-300))
    # The best common scale has a closed form: q and log|A| are simple in it.
    misfit = float(counts @ score(some, (columns * np.exp(x0)).sum(axis=1), counts).misfit)
    x0 += np.log(total / misfit) if misfit > 0.0 else 0.0
    options = {"maxiter": 200, "gtol": 1e-7, "max_trust_radius": _LONGEST_STEP}
    x = minimize(loss, x0, jac=True, hess=bend, method="trust-exact", options=options).x
    error = np.zeros(len(defaults))
    error[free] = np.where(x - x0 < -_FURTHEST, np.inf, _errors(total * bend(x)))
    return (columns * np.exp(x)).sum(axis=1), error


def _errors(curvature: FloatArray) -> FloatArray:
    """Square roots of the diagonal of a curvature's inverse; inf where it is not positive."""
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    share = vectors**2
    known = values > 0.0
    variance = (share[:, known] / values[known]).sum(axis=1)
    lost = (share[:, ~known] > 1e-9).any(axis=1)
    return np.where(lost, np.inf, np.sqrt(variance))


def bootstrap(
    data: Quadratics,
    groups: FloatArray,
    found: Fit,
    fixed: Mapping[str, float],
    draws: int,
    progress: Callable[[int, int], None] | None = None,
) -> FloatArray:
    """Weights of as many draws of whole runs, with replacement: (draws, K).

    Segments of one run are alike: drawing segments would make intervals half as wide as they are.
    """
    rng = np.random.default_rng(0)
    labels, member = np.unique(groups.astype(str), return_inverse=True)
    names, at = found.names, found.names.index(found.anchor)
    free = [i for i, name in enumerate(names) if name not in fixed]
    reference = next((i for i in free if found.defaults[i] > 0.0), 0)
    held = {names.index(name): value for name, value in fixed.items()}
    samples = np.zeros((draws, len(names)))
    for draw in range(draws):
        drawn = rng.integers(len(labels), size=len(labels))
        times = np.bincount(drawn, minlength=len(labels))[member] * found.kept.astype(float)
        if times.any():
            theta, _ = maximise(data, times, held, reference, found.defaults, found.theta)
        else:
            theta = found.theta
        samples[draw] = theta * (found.defaults[at] / theta[at])
        if progress is not None:
            progress(draw + 1, draws)
    return samples
