"""What no plan may do for any reward: come too close to a visible car, or leave the road.

An exact penalty: beyond the limit it costs in proportion to how far (not to its square), and the
more the more cohesion could win by it. So a plan keeps to the limit where it can within its
horizon, and where it cannot, as when it starts beyond, the problem still has a solution. What needs
more warning than the horizon, such as stopping behind a standing car, is the last resort's
(planning.safety).
Bounds on the controls and on their change are no penalties: solvers keep to them exactly
(stage.control_limits).
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from sumo_cohesion.planning.reward import StageInputs

CORNERS = 2.0**0.125
"""Size of the superellipse of eighth order that holds a box, relative to the box."""
_SMOOTH = 0.05
"""Metres over which the penalty's slope grows from zero, so that it has a gradient everywhere."""


def violations(state: Any, inputs: StageInputs, ego_width: Any) -> Any:
    """How far (m) a state is beyond every limit, a column; negative where it keeps to it.

    One per car: its surroundings are a superellipse around the two boxes put together, metres are
    measured across the car. And the ego's sides beyond the right and the left edge of the road.
    """
    right, left = inputs.right + ego_width / 2 - state[1], state[1] + ego_width / 2 - inputs.left
    return ca.vertcat(_too_near(inputs), right, left)


def _too_near(inputs: StageInputs) -> Any:
    # Three square roots are faster than a power of 1/8.
    distance = ca.sqrt(ca.sqrt(ca.sqrt(inputs.along**8 + inputs.across**8 + 1e-12)))
    return (CORNERS - distance) * inputs.half_widths


def penalties(violation: Any) -> Any:
    """Cost of each violation (m) for a weight of one per metre."""
    beyond = ca.fmax(violation, 0.0)
    return ca.if_else(beyond < _SMOOTH, 0.5 * beyond**2 / _SMOOTH, beyond - 0.5 * _SMOOTH)


def penalty_weights(violation: Any) -> Any:
    """Weights w with which a sum of squares w·violation² has the penalties' gradient."""
    return (violation > 0.0) / ca.fmax(violation, _SMOOTH)
