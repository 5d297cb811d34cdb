"""Tuning: the beta at which a cohesive ego follows as much as wanted, whatever its reward weights.

Only the ratio of beta to the reward weights matters, so other weights need another beta.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from math import exp, isfinite, log
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import brentq

from sumo_cohesion.batches.comparison import Progress, compare
from sumo_cohesion.batches.weights_file import WeightsFile
from sumo_cohesion.errors import UserError
from sumo_cohesion.planning.registry import BUILT_IN, WITHOUT_COHESION
from sumo_cohesion.simulation.overrides import read_files
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.tables.intervals import median_interval
from sumo_cohesion.tables.metrics import METRICS
from sumo_cohesion.user_input import closest, parse_seeds

LEAST, MOST = 1e-4, 1e4
"""Between which beta is looked for."""
TOLERANCE = 0.02
"""Difference to the target that is near enough, in the metric's unit."""
_NARROW = 1.05
"""Ratio of two betas with the target between them that are near enough to each other."""
_STRIDE = 4.0
"""Ratio of one beta to the next, until the target lies between them."""
_BETA, _REWARD = "cohesion.beta", "planner.reward"


class NotReachedError(UserError):
    """No beta brings the metric to its target."""


@dataclass(frozen=True, repr=False)
class Tuning:
    """What was found.

    Attributes
    ----------
    beta : of those that were tried, the one whose value is nearest to the target.
    tried : one row per beta that was tried, ascending: ``beta``; ``value``, the metric's median
        over the seeds, with its 95 % bootstrap interval ``low`` to ``high``; ``n``, the runs in
        which the metric is defined; ``successes`` of the scenario.
    reached : the value is the target, within TOLERANCE; else it jumps over it.
    said : one line that says of which runs this is true.
    """

    beta: float
    tried: pd.DataFrame
    reached: bool
    said: str

    def __repr__(self) -> str:
        return f"<Tuning beta {self.beta:g}: {self.said}>"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>{self.tried.to_html(index=False)}"


def tune(
    weights: str | Path | None = None,
    *,
    scenario: str | Path = "speeding",
    metric: str = "speed_gap_closed",
    target: float = 0.6,
    planner: str = "cohesive",
    seeds: str | Sequence[int] = "1000:1010",
    overrides: Mapping[str, Any] | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Tuning:
    """Find the beta at which the median of a metric over the seeds meets a target.

    Every beta drives the same seeds, so the same traffic. Figures on these seeds are no evidence:
    beta was chosen on them.

    Parameters
    ----------
    weights : TOML file with the reward weights to tune for, in [planner.reward]; beta is written
        into it, in [cohesion]. Default: the weights of ``overrides``, and nothing is written.
    scenario, overrides, workers : as for compare().
    metric, target : a metric that grows with beta, and its wanted median. Default: six tenths of
        the gap to the humans' speed are closed.
    planner : "cohesive" or "paper".
    seeds : a list, a range, or "1000:1010" (half-open): none that are reported later.
    progress : called after each run, with the runs of the betas tried so far as the total.

    Raises
    ------
    UserError
        If the input is wrong, the file has a beta that is not of tune, or no beta between 1e-4
        and 1e4 brings the metric to its target.
    SimulationError
        If a run failed.
    """
    _check(metric, target, planner)
    numbers = parse_seeds(seeds, "seeds")
    where = f"{Path(scenario).name}, seeds {_range(numbers)}"
    file = None if weights is None else _file(Path(weights))
    settings = _settings(overrides or {}, weights)
    tried: list[dict[str, float]] = []

    def measure(beta: float) -> float:
        before = len(tried) * len(numbers)
        runs = compare(
            scenario,
            planner,
            numbers,
            overrides={**settings, _BETA: beta},
            workers=workers,
            progress=progress and (lambda done, total: progress(before + done, before + total)),
        ).runs
        values = runs[metric].dropna()
        if values.empty:
            raise UserError(
                f"{metric} is not defined in any run of {where}; choose another metric or scenario"
            )
        value, low, high = median_interval(values.to_list())
        row = {"beta": beta, "value": value, "low": low, "high": high}
        tried.append({**row, "n": len(values), "successes": int(runs["success"].sum())})
        return value

    try:
        beta = find_beta(measure, target, CohesionSettings().beta)
    except NotReachedError as error:
        raise NotReachedError(f"{where}: {metric} {error}") from None
    table = pd.DataFrame(tried).sort_values("beta", ignore_index=True)
    value = float(table["value"][table["beta"] == beta].iloc[0])
    given = "".join(f", {name}={value}" for name, value in (overrides or {}).items())
    said = f"{metric} {value:.3f} for {target:g} with {planner} in {where}{given}"
    if file is not None:
        file.write_beta(beta, said)
    return Tuning(beta, table, abs(value - target) <= TOLERANCE, said)


def find_beta(measure: Callable[[float], float], target: float, start: float) -> float:
    """Find the beta at which a measure that grows with beta meets its target.

    In strides from ``start`` until the target lies between two betas, then by Brent's method, both
    in the logarithm of beta. Betas have three digits, and none is measured twice.

    Returns
    -------
    Of all that were measured, the beta whose measure is nearest to the target: within TOLERANCE,
    or, if the measure jumps over the target, at one side of the jump.

    Raises
    ------
    NotReachedError
        If the target is beyond what LEAST or MOST give.
    """
    measured: dict[float, float] = {}

    def missing(log_beta: float) -> float:
        beta = float(f"{exp(log_beta):.3g}")
        if beta not in measured:
            measured[beta] = measure(beta)
        gap = measured[beta] - target
        return 0.0 if abs(gap) <= TOLERANCE else gap  # near enough is a root

    here = there = log(start)
    side = np.sign(missing(here))
    while side and np.sign(missing(there)) == side:
        end = log(MOST if side < 0 else LEAST)
        if there == end:
            beta, value = min(measured.items(), key=lambda tried: abs(tried[1] - target))
            raise NotReachedError(
                f"does not come to {target:g} with any beta from {LEAST:g} to {MOST:g}; nearest is "
                f"{value:.3f}, with {beta:g}"
            )
        here, there = there, there - side * log(_STRIDE)
        there = min(there, end) if side < 0 else max(there, end)
    if side and missing(there):
        brentq(missing, here, there, xtol=log(_NARROW))
    return min(measured, key=lambda beta: (abs(measured[beta] - target), beta))


def _check(metric: str, target: float, planner: str) -> None:
    numeric = [column.name for column in METRICS if column.dtype in ("float64", "int64")]
    if metric not in numeric:
        known = metric in [column.name for column in METRICS]
        why = f"{metric!r} is no number" if known else f"there is no metric {metric!r}"
        raise UserError(f"{why}{closest(metric, numeric) or '; docs/tables.md lists them'}")
    if not isfinite(target):
        raise UserError(f"target {target} is no finite number")
    with_beta = [name for name in BUILT_IN if name not in WITHOUT_COHESION]
    if planner not in with_beta:
        raise UserError(f"planner {planner!r} has no beta; tune {' or '.join(with_beta)}")


def _file(path: Path) -> WeightsFile:
    if path.suffix != ".toml" and not path.exists():
        raise UserError(f"{path}: no such file of weights; a scenario is named by --scenario")
    return WeightsFile.read(path)


def _settings(overrides: Mapping[str, Any], weights: str | Path | None) -> dict[str, Any]:
    """Return the settings of all runs but for beta."""
    if _BETA in overrides:
        raise UserError(f"{_BETA} is what is looked for; leave it out")
    if weights is None:
        return read_files(overrides)
    if _REWARD in overrides:
        raise UserError(f"{_REWARD} comes from {weights}; leave one of them out")
    return read_files({_REWARD: f"@{weights}", **overrides})


def _range(seeds: Sequence[int]) -> str:
    """Write seeds as they are given on the command line."""
    if seeds and list(seeds) == list(range(seeds[0], seeds[0] + len(seeds))):
        return f"{seeds[0]}:{seeds[-1] + 1}"
    return ",".join(map(str, seeds))
