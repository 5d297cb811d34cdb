"""What: the social features psi of a transition (paper, section III-B and figure 3).

The function runs on floats, NumPy arrays and CasADi symbols alike, so that what is measured of
the humans and what the planner makes the ego match is one definition.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

_STANDSTILL = 0.05
"""Metres per transition; a car that hardly moves has no direction, and this fades it to zero."""


class Feature(NamedTuple):
    """One social feature: declared in this one place.

    Attributes
    ----------
    name : as in tables.
    steers : whether it steers; the others only set the speed.
    scale : largest value expected of SUMO's drivers. The paper normalises each feature by its
        maximum difference expected, so that a variance in radians can be compared with one in
        metres.
    formula : of ``across``, ``along`` and ``distance`` (m), ``turn`` (rad), ``interval`` (s) and
        ``scale``; for numbers, arrays and symbols.
    """

    name: str
    steers: bool
    scale: float
    formula: str


DECLARED = (
    Feature("lateral", True, 1.5, "across / (interval * scale)"),  # m/s
    Feature("longitudinal", False, 10.0, "along / (interval * scale)"),  # m/s
    Feature("heading", True, 0.15, "turn / (interval * scale)"),  # rad/s
    Feature("distance", False, 10.0, "distance / (interval * scale)"),  # m/s
    Feature("direction", True, 0.06, "across / (distance * scale)"),  # sine of the direction
)
FEATURES = tuple(feature.name for feature in DECLARED)
LATERAL = tuple(feature.steers for feature in DECLARED)
"""Which features steer."""


def _all_in_one() -> Callable[..., tuple[Any, ...]]:
    """Make one function of all formulas: every car in every step needs it, and a call costs."""
    formulas = [f.formula.replace("scale", repr(f.scale)) for f in DECLARED]
    arguments = "across, along, distance, turn, interval"
    made: Callable[..., tuple[Any, ...]] = eval(f"lambda {arguments}: ({', '.join(formulas)},)")
    return made


_values = _all_in_one()


def social_features(
    before: Any, after: Any, interval: Any, curvature: Any = 0.0
) -> tuple[Any, ...]:
    """Social features psi of the transition from one state to the next, normalised.

    Parameters
    ----------
    before, after : four entries s, d (m), heading (rad), speed (m/s) in the road frame, each a
        number, an array of any common shape, or a symbol.
    interval : seconds between them; features are per second, so that transitions of different
        length can be compared.
    curvature : of the reference line (1/m): beside it, a metre of s is 1 - curvature · d long.

    Returns
    -------
    The features named in FEATURES, without unit.

    >>> [round(f, 3) for f in social_features((0, 0, 0, 20), (10, 0.5, 0.06, 20), 0.5)]
    [0.667, 2.0, 0.8, 2.003, 0.832]
    """
    across = after[1] - before[1]
    along = (after[0] - before[0]) * (1.0 - curvature * 0.5 * (before[1] + after[1]))
    distance = (across * across + along * along + _STANDSTILL**2) ** 0.5
    return _values(across, along, distance, after[2] - before[2], interval)
