"""What: the social features psi of a transition (paper, section III-B and figure 3).

The function runs on floats, NumPy arrays and CasADi symbols alike, so that what is measured of
the humans and what the planner makes the ego match is one definition.
"""

from __future__ import annotations

from typing import Any

FEATURES = ("lateral", "longitudinal", "heading", "distance", "direction")
"""Change of lateral and longitudinal position, of heading, length and direction of the move."""

LATERAL = (True, False, True, False, True)
"""Which features steer; the others only set the speed."""

SCALES = (1.5, 10.0, 0.15, 10.0, 0.06)
"""Largest value expected of SUMO's drivers: m/s, m/s, rad/s, m/s, 1 (sine of the direction).

The paper normalises each feature by its maximum difference expected, so that a variance in
radians can be compared with one in metres.
"""

_STANDSTILL = 0.05
"""Metres per transition; a car that hardly moves has no direction, and this fades it to zero."""


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
    turn = after[2] - before[2]
    lateral, longitudinal, heading, length, direction = SCALES
    return (
        across / (interval * lateral),
        along / (interval * longitudinal),
        turn / (interval * heading),
        distance / (interval * length),
        across / (distance * direction),
    )
