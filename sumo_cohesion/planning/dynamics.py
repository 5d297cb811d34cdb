"""Point-mass dynamics (paper, eq. 3), for floats, NumPy arrays and CasADi symbols alike."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

_LEAST_STRETCH = 0.1
"""Towards the centre of a bend a metre of s becomes ever shorter, and beyond it the frame has no
meaning; nothing is taken as nearer to the centre than this share of the bend's radius."""


def step(
    state: Any, control: Any, dt: float, friction: float, road_curvature: Any = 0.0
) -> tuple[Any, Any, Any, Any]:
    """Advance a state by one step.

    (x', y', heading', speed') = (speed cos heading, speed sin heading, speed · curvature,
    acceleration - friction · speed), paper eq. 3, in the road's frame: with road_curvature
    zero (s, d) are Cartesian coordinates and this is the paper's equation.

    The step is semi-implicit: speed, then heading, then position. With an explicit Euler step
    the first transition's position does not depend on the first control, and cohesion on it
    would have no gradient in speed or distance.

    Parameters
    ----------
    state : s, d (m), heading (rad), speed (m/s).
    control : curvature (1/m), acceleration (m/s²).
    dt : seconds.
    friction : linear friction (1/s).
    road_curvature : curvature (1/m) of the reference line at s.

    >>> [float(v) for v in step((0.0, 0.0, 0.0, 20.0), (0.0, 2.0), 0.1, 0.1)]
    [2.0, 0.0, 0.0, 20.0]
    """
    s, d, heading, speed = state
    curvature, acceleration = control
    speed = speed + dt * (acceleration - friction * speed)
    # Metres of s per metre driven along the road: more on the inside of a bend.
    along = 1.0 / stretch(road_curvature, d)
    heading_next = heading + dt * speed * (curvature - road_curvature * _cos(heading) * along)
    s = s + dt * speed * _cos(heading_next) * along
    d = d + dt * speed * _sin(heading_next)
    return s, d, heading_next, speed


def stretch(road_curvature: Any, d: Any) -> Any:
    """Metres driven along the road at d (m) per metre of s.

    >>> stretch(0.01, 5.0), stretch(0.12, 8.4)
    (0.95, 0.1)
    """
    metres = 1.0 - road_curvature * d
    if isinstance(metres, float):
        return max(metres, _LEAST_STRETCH)
    return (
        metres.fmax(_LEAST_STRETCH)
        if hasattr(metres, "fmax")
        else np.maximum(metres, _LEAST_STRETCH)
    )


def _cos(angle: Any) -> Any:
    """Cosine of a number, an array or a symbol, whatever CasADi makes of NumPy's functions."""
    if isinstance(angle, float):
        return math.cos(angle)
    return angle.cos() if hasattr(angle, "cos") else np.cos(angle)


def _sin(angle: Any) -> Any:
    if isinstance(angle, float):
        return math.sin(angle)
    return angle.sin() if hasattr(angle, "sin") else np.sin(angle)
