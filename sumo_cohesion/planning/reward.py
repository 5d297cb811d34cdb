"""The reward terms phi of one planned state and control (paper, section II-B).

Each is a function of CasADi symbols; `terms` names them, and their weights theta carry the same
names in RewardWeights.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

LANE_SIGMA = 0.25
"""Standard deviation of a lane's Gaussian, as a share of the lane's width."""
EDGE_MARGIN = 0.3
"""Metres between the ego's side and the road's edge below which the edge costs."""
CAR_SIGMA_LATERAL = 0.55
"""Standard deviation across a car's Gaussian, as a share of the two cars' mean width."""


class StageInputs(NamedTuple):
    """What the road and the other cars are at one planned stage; symbols.

    Attributes
    ----------
    lanes, lane_widths : (L, 1) m; a lane that does not exist has a centre far away.
    right, left : m, the road's edges.
    speed_limit : m/s.
    along, across : (N, 1) place relative to every car, in its own frame, in half_lengths and
        half_widths (`in_frames`).
    half_widths : (N, 1) m, half widths of both cars added.
    """

    lanes: Any
    lane_widths: Any
    right: Any
    left: Any
    speed_limit: Any
    along: Any
    across: Any
    half_widths: Any


def in_frames(s: Any, d: Any, cars: Any) -> tuple[Any, Any]:
    """Place (s, d) (m) in every car's own frame, in half sizes: along and across, (N, 1) each.

    ``cars`` is (6, N): s, d (m), cos and sin of the heading, half lengths and half widths of both
    cars added (m).
    """
    ds, dd = s - cars[0, :], d - cars[1, :]
    cos, sin, half_length, half_width = cars[2, :], cars[3, :], cars[4, :], cars[5, :]
    return ((ds * cos + dd * sin) / half_length).T, ((dd * cos - ds * sin) / half_width).T


def terms(state: Any, control: Any, inputs: StageInputs, ego_width: Any) -> dict[str, Any]:
    """Reward terms by name, unweighted; costs are negative."""
    right, left = _beyond_edges(state[1], inputs, ego_width)
    return {
        # One Gaussian per lane. It saturates: far from every centre nothing pulls, so that the
        # car may cross a line when it has a reason to.
        "lane": ca.sum1(ca.exp(-0.5 * _lanes(state[1], inputs) ** 2)),
        # Square of how far the ego's side is beyond the margin to either edge.
        "edge": -(ca.fmax(right, 0) ** 2 + ca.fmax(left, 0) ** 2),
        "speed": -((state[3] - inputs.speed_limit) ** 2),
        # One oriented Gaussian per car, as long and as wide as the two cars together.
        "car": -ca.sum1(ca.exp(-0.5 * _cars(inputs))),
        "curvature": -(control[0] ** 2),
        "acceleration": -(control[1] ** 2),
    }


def squares(
    state: Any, control: Any, inputs: StageInputs, ego_width: Any
) -> dict[str, list[tuple[Any, Any]]]:
    """Return the same terms as pairs of residual r and weight w >= 0, both columns.

    The gradient of a term's cost is J'(w r), J the residuals' Jacobian; J'diag(w)J stands for its
    Hessian and is never negative, as the Hessian of a Gaussian is far from its centre.
    """
    right, left = _beyond_edges(state[1], inputs, ego_width)
    lanes = _lanes(state[1], inputs)
    near = ca.exp(-0.25 * _cars(inputs))
    return {
        "lane": [(lanes, ca.exp(-0.5 * lanes**2))],
        "edge": [(right, 2.0 * (right > 0)), (left, 2.0 * (left > 0))],
        "speed": [(state[3] - inputs.speed_limit, 2.0)],
        "car": [(near, 2.0 * ca.DM.ones(near.shape[0]))],
        "curvature": [(control[0], 2.0)],
        "acceleration": [(control[1], 2.0)],
    }


def _lanes(d: Any, inputs: StageInputs) -> Any:
    """Distance to every lane's centre, in standard deviations of its Gaussian."""
    return (d - inputs.lanes) / (LANE_SIGMA * inputs.lane_widths)


def _beyond_edges(d: Any, inputs: StageInputs, ego_width: Any) -> tuple[Any, Any]:
    """Metres that the ego's side is beyond the margin to the right and to the left edge."""
    reach = ego_width / 2 + EDGE_MARGIN
    return inputs.right + reach - d, d + reach - inputs.left


def _cars(inputs: StageInputs) -> Any:
    """Squared distance to every car, in its half length along and CAR_SIGMA_LATERAL across."""
    return inputs.along**2 + (inputs.across / CAR_SIGMA_LATERAL) ** 2
