"""The reward terms phi of one planned state and control (paper, section II-B).

Each is a function of CasADi symbols, declared with its weight theta in RewardWeights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import casadi as ca
from pydantic import BaseModel, ConfigDict, Field

from sumo_cohesion.state import STEP

NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]

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


class Point(NamedTuple):
    """One planned stage: where it leads, what controls it, and what is around; symbols.

    Attributes
    ----------
    state : s, d (m), heading (rad), speed (m/s) in the road's frame.
    control, before : curvature (1/m), acceleration (m/s²); and those of the stage before.
    inputs, ego_width : see StageInputs; m.
    friction : linear friction (1/s), a number below 1 / STEP.
    """

    state: Any
    control: Any
    before: Any
    inputs: StageInputs
    ego_width: Any
    friction: float


@dataclass(frozen=True)
class Term:
    """How one reward term phi is worked out.

    Attributes
    ----------
    value : the term; a cost is negative.
    squares : the same as pairs of residual r and weight w >= 0, both columns. The gradient of the
        term's cost is J'(w r), J the residuals' Jacobian; J'diag(w)J stands for its Hessian and is
        never negative, as the Hessian of a Gaussian is far from its centre.
    of_change : it is about the control before: where there is none it has no weight.
    """

    value: Callable[[Point], Any]
    squares: Callable[[Point], list[tuple[Any, Any]]]
    of_change: bool = False


def _lane(at: Point) -> Any:
    """One Gaussian per lane.

    It saturates: far from every centre nothing pulls, so that the car may cross a line when it has
    a reason to.
    """
    return ca.sum1(ca.exp(-0.5 * _lanes(at) ** 2))


def _lane_squares(at: Point) -> list[tuple[Any, Any]]:
    lanes = _lanes(at)
    return [(lanes, ca.exp(-0.5 * lanes**2))]


def _edge(at: Point) -> Any:
    """Square of how far the ego's side is beyond the margin to either edge."""
    right, left = _beyond_edges(at)
    return -(ca.fmax(right, 0) ** 2 + ca.fmax(left, 0) ** 2)


def _edge_squares(at: Point) -> list[tuple[Any, Any]]:
    right, left = _beyond_edges(at)
    return [(right, 2.0 * (right > 0)), (left, 2.0 * (left > 0))]


def _speed(at: Point) -> Any:
    return -((at.state[3] - at.inputs.speed_limit) ** 2)


def _speed_squares(at: Point) -> list[tuple[Any, Any]]:
    return [(at.state[3] - at.inputs.speed_limit, 2.0)]


def _car(at: Point) -> Any:
    """One oriented Gaussian per car, as long and as wide as the two cars together."""
    return -ca.sum1(ca.exp(-0.5 * _cars(at)))


def _car_squares(at: Point) -> list[tuple[Any, Any]]:
    near = ca.exp(-0.25 * _cars(at))
    return [(near, 2.0 * ca.DM.ones(near.shape[0]))]


def _square_of(i: int) -> Term:
    """Cost of a control: its square."""
    return Term(lambda at: -(at.control[i] ** 2), lambda at: [(at.control[i], 2.0)])


def _square_of_change(i: int) -> Term:
    """Cost of how fast a control changes: the square of its change per second."""

    def rate(at: Point) -> Any:
        return (at.control[i] - at.before[i]) / STEP

    return Term(lambda at: -(rate(at) ** 2), lambda at: [(rate(at), 2.0)], of_change=True)


def _net_acceleration(at: Point) -> Any:
    return -(_net(at) ** 2)


def _net_acceleration_squares(at: Point) -> list[tuple[Any, Any]]:
    return [(_net(at), 2.0)]


class RewardWeights(BaseModel):
    """Weights theta of the reward terms phi (paper, eq. 1); each term says its own unit.

    A term is one field: its name, how it is worked out, and its weight. One whose default is 0 is
    optional: unless it is given a weight it is no part of the problem.

    Attributes
    ----------
    lane : per lane, reward at its centre.
    edge : per m², cost beyond the margin at the road's edges.
    speed : per (m/s)², cost of missing the speed limit.
    car : cost at the centre of another car.
    curvature, acceleration : per (1/m)² and (m/s²)², cost of control.
    curvature_change, acceleration_change : per (1/m/s)² and (m/s³)², cost of changing it; optional.
    net_acceleration : per (m/s²)², cost of the acceleration that friction leaves; optional. In the
        place of ``acceleration``, which charges what holding a speed against friction takes:
        whoever sets one sets the other to 0.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    lane: Annotated[NonNegative, Term(_lane, _lane_squares)] = 1.0
    edge: Annotated[NonNegative, Term(_edge, _edge_squares)] = 500.0
    speed: Annotated[NonNegative, Term(_speed, _speed_squares)] = 0.037
    car: Annotated[NonNegative, Term(_car, _car_squares)] = 100.0
    curvature: Annotated[NonNegative, _square_of(0)] = 80.0
    acceleration: Annotated[NonNegative, _square_of(1)] = 1.2e-4
    curvature_change: Annotated[NonNegative, _square_of_change(0)] = 0.0
    acceleration_change: Annotated[NonNegative, _square_of_change(1)] = 0.0
    net_acceleration: Annotated[NonNegative, Term(_net_acceleration, _net_acceleration_squares)] = (
        0.0
    )

    @property
    def in_use(self) -> tuple[str, ...]:
        """Names of the terms that are part of the problem, in the order of the fields."""
        fields = type(self).model_fields.items()
        return tuple([n for n, field in fields if field.default > 0.0 or getattr(self, n) > 0.0])

    @property
    def theta(self) -> tuple[float, ...]:
        """The weights of the terms in use, as a vector."""
        return tuple([getattr(self, name) for name in self.in_use])

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts of a stage's reward: the terms in use, and what is no term of it."""
        return (*self.in_use, "cohesion", "constraints")

    @property
    def shape(self) -> RewardWeights:
        """The same for all weights of the same terms."""
        return RewardWeights(**dict.fromkeys(self.in_use, 1.0))


_TERMS = {
    name: next(part for part in field.metadata if isinstance(part, Term))
    for name, field in RewardWeights.model_fields.items()
}


def terms(at: Point, names: Sequence[str]) -> dict[str, Any]:
    """Reward terms by name, unweighted; costs are negative."""
    return {name: _TERMS[name].value(at) for name in names}


def squares(at: Point, names: Sequence[str]) -> dict[str, list[tuple[Any, Any]]]:
    """Return the same terms as weighted squares, see Term."""
    return {name: _TERMS[name].squares(at) for name in names}


def of_change(names: Sequence[str]) -> list[bool]:
    """Tell of each term whether it is about the control before, see Term."""
    return [_TERMS[name].of_change for name in names]


def _lanes(at: Point) -> Any:
    """Distance to every lane's centre, in standard deviations of its Gaussian."""
    return (at.state[1] - at.inputs.lanes) / (LANE_SIGMA * at.inputs.lane_widths)


def _beyond_edges(at: Point) -> tuple[Any, Any]:
    """Metres that the ego's side is beyond the margin to the right and to the left edge."""
    reach, d = at.ego_width / 2 + EDGE_MARGIN, at.state[1]
    return at.inputs.right + reach - d, d + reach - at.inputs.left


def _cars(at: Point) -> Any:
    """Squared distance to every car, in its half length along and CAR_SIGMA_LATERAL across."""
    return at.inputs.along**2 + (at.inputs.across / CAR_SIGMA_LATERAL) ** 2


def _net(at: Point) -> Any:
    """Acceleration that friction leaves, (v' - v) / STEP, of the speed v' where the stage leads."""
    drag = at.friction * at.state[3]
    return (at.control[1] - drag) / (1.0 - at.friction * STEP)
