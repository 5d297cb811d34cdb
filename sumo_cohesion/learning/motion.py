"""Controls from positions: smoothing, and the planner's dynamics solved for what drove them."""

from __future__ import annotations

from math import pi, sin
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded

from sumo_cohesion.planning.dynamics import stretch
from sumo_cohesion.state import FloatArray

_ORDER = 3
"""Differences that are penalised: constant acceleration passes as it is."""


class Motion(NamedTuple):
    """A track in the road's frame.

    ``states`` (n, 4) s, d (m), heading (rad), speed (m/s); the first has no heading and speed of
    its own and takes the second's. ``bends`` (n,) curvature (1/m) of the reference line there.
    """

    states: FloatArray
    bends: FloatArray


def smoothed(values: FloatArray, interval: float, period: float) -> FloatArray:
    """Smooth the columns of (n, m) by penalised third differences (Whittaker, Eilers).

    Parameters
    ----------
    interval : seconds between two rows.
    period : seconds; an oscillation of this period is halved, slower ones pass. 0 changes nothing.
    """
    n = len(values)
    if period <= 0.0 or n <= _ORDER:
        return values
    weight = (2.0 * sin(pi * min(interval / period, 0.5))) ** (-2 * _ORDER)
    stencil = np.array([-1.0, 3.0, -3.0, 1.0])
    # D'D of the difference matrix D, upper diagonals: the banded form that LAPACK solves.
    bands = np.zeros((_ORDER + 1, n))
    for lag in range(_ORDER + 1):
        product = stencil[: _ORDER + 1 - lag] * stencil[lag:]
        for first in range(len(product)):
            # Row k of D covers columns k to k + 3: entry (k + first, k + first + lag).
            columns = np.arange(n - _ORDER) + first + lag
            np.add.at(bands[_ORDER - lag], columns, weight * product[first])
    bands[_ORDER] += 1.0
    # Around its mean, so that a place far along the road loses no digits.
    middle = values.mean(axis=0)
    return np.asarray(middle + solveh_banded(bands, values - middle))


def motion(places: FloatArray, bends: FloatArray, interval: float) -> Motion:
    """Heading and speed of a track from its places alone.

    The planner's step is semi-implicit (planning.dynamics): speed and heading after a step are
    those of the way that was driven in it.

    Parameters
    ----------
    places : (n, 2) s and d (m), ``interval`` seconds apart.
    bends : (n,) curvature (1/m) of the reference line at each.
    """
    way = np.diff(places, axis=0)
    along = way[:, 0] * stretch(bends[:-1], places[:-1, 1])
    heading, speed = np.arctan2(way[:, 1], along), np.hypot(along, way[:, 1]) / interval
    states = np.column_stack((places, np.append(heading[:1], heading), np.append(speed[:1], speed)))
    return Motion(states, bends)


def controls(states: FloatArray, bends: FloatArray, interval: float, friction: float) -> FloatArray:
    """Return the controls that lead from each state to the next.

    Inverts planning.dynamics.step. Where the car stands its curvature is not a number.

    Parameters
    ----------
    states : (..., T + 1, 4) s, d (m), heading (rad), speed (m/s).
    bends : (..., T) curvature (1/m) of the reference line in each step.

    Returns
    -------
    (..., T, 2) curvature (1/m), acceleration (m/s², before friction).
    """
    before, after = states[..., :-1, :], states[..., 1:, :]
    turned = np.diff(states[..., 2], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        curvature = turned / (interval * after[..., 3])
    curvature = curvature + bends * np.cos(before[..., 2]) / stretch(bends, before[..., 1])
    acceleration = np.diff(states[..., 3], axis=-1) / interval + friction * before[..., 3]
    return np.stack((curvature, acceleration), axis=-1)
