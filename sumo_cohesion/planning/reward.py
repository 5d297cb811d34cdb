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
    cars : (6, N) s, d (m), cos and sin of the heading, half lengths and half widths of both
        cars added (m).
    """

    lanes: Any
    lane_widths: Any
    right: Any
    left: Any
    speed_limit: Any
    cars: Any


def terms(state: Any, control: Any, inputs: StageInputs, ego_width: Any) -> dict[str, Any]:
    """Reward terms by name, unweighted; costs are negative."""
    return {
        "lane": _lane(state[1], inputs),
        "edge": -_edge(state[1], inputs, ego_width),
        "speed": -((state[3] - inputs.speed_limit) ** 2),
        "car": -_cars(state, inputs.cars),
        "curvature": -(control[0] ** 2),
        "acceleration": -(control[1] ** 2),
    }


def _lane(d: Any, inputs: StageInputs) -> Any:
    """One Gaussian per lane.

    It saturates: far from every centre nothing pulls, so that the car may cross a line when it
    has a reason to.
    """
    z = (d - inputs.lanes) / (LANE_SIGMA * inputs.lane_widths)
    return ca.sum1(ca.exp(-0.5 * z**2))


def _edge(d: Any, inputs: StageInputs, ego_width: Any) -> Any:
    """Square of how far (m) the ego's side is beyond the margin to either edge."""
    reach = ego_width / 2 + EDGE_MARGIN
    return ca.fmax(inputs.right + reach - d, 0) ** 2 + ca.fmax(d + reach - inputs.left, 0) ** 2


def _cars(state: Any, cars: Any) -> Any:
    """One oriented Gaussian per car, as long and as wide as the two cars together."""
    ds, dd = state[0] - cars[0, :], state[1] - cars[1, :]
    cos, sin, half_length, half_width = cars[2, :], cars[3, :], cars[4, :], cars[5, :]
    along = (ds * cos + dd * sin) / half_length
    across = (dd * cos - ds * sin) / (CAR_SIGMA_LATERAL * half_width)
    return ca.sum2(ca.exp(-0.5 * (along**2 + across**2)))
