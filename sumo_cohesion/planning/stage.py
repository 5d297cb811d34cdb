"""One stage of the horizon as CasADi expressions: the one objective that every solver maximises.

A stage goes from one state to the next. Its reward is the ego's own, at the state it leads to
(paper, eq. 1), plus its cohesion (eq. 2).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sumo_cohesion.planning import constraints, dynamics, reward
from sumo_cohesion.planning.reward import Point
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.social.features import FEATURES, social_features
from sumo_cohesion.state import STEP

SCALES = (0.01, 5.0)
"""Curvature (1/m) and acceleration (m/s²) that solvers see as one."""
CONTROL_SCALE = np.array(SCALES)
N_STATES = 6
UNLIMITED = 1e6
"""Change of a scaled control that no bound stands against."""


class Stage(NamedTuple):
    """Expressions of one stage in ``state`` (6), ``control`` (2, scaled) and ``parameters``.

    The state is the road state and the scaled control of the stage before. ``next_state`` is where
    the control leads. The terms are written in two symbols, in which derivatives are cheap, and
    dear in what leads there: ``landing`` (4) stands for the road state there, and ``relative``
    (2 N) for its place in the other cars' frames, which is ``relative_there`` of the landing.

    ``residuals`` r and ``residual_weights`` w say the same cost as a weighted sum of squares, in
    the sense that its gradient is J'(w r) and J' diag(w) J is positive semidefinite: what a
    Gauss-Newton step needs.
    """

    state: Any
    control: Any
    parameters: Any
    next_state: Any
    landing: Any
    relative: Any
    relative_there: Any
    terms: dict[str, Any]
    residuals: Any
    residual_weights: Any

    @property
    def cost(self) -> Any:
        """Minus the sum of all terms."""
        return -sum(self.terms.values())

    def landed(self, *expressions: Any) -> list[Any]:
        """Put where the control leads in the place of ``relative`` and ``landing``."""
        near = ca.substitute(list(expressions), [self.relative], [self.relative_there])
        return list(ca.substitute(near, [self.landing], [self.next_state[:4]]))

    def inputs(self) -> list[Any]:
        """State, control and parameters, of which everything is a function."""
        return [self.state, self.control, self.parameters]


class StageParameters:
    """The parts of a stage's parameter vector, in order, and their sizes."""

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        k, self.n_cars, self.n_lanes = len(FEATURES), settings.cars, n_lanes
        self.sizes = {
            "ego_width": 1,
            "theta": len(settings.reward.in_use),
            "road_curvature": 1,
            "lanes": n_lanes,
            "lane_widths": n_lanes,
            "right": 1,
            "left": 1,
            "speed_limit": 1,
            "cars": 6 * self.n_cars,
            "cohesion_weight": k,
            "cohesion_target": k,
            "place_weight": 1,
            "place_target": 1,
            "constraint_weight": 1,
        }
        self.size = sum(self.sizes.values())

    def columns(self, name: str) -> slice:
        """Where a part lies."""
        before = list(self.sizes)[: list(self.sizes).index(name)]
        start = sum(self.sizes[other] for other in before)
        return slice(start, start + self.sizes[name])

    def symbols(self) -> dict[str, Any]:
        """Return one symbol per part."""
        return {name: ca.SX.sym(name, size) for name, size in self.sizes.items()}


def make_stage(settings: PlannerSettings, parameters: StageParameters) -> Stage:
    """Write down one stage."""
    state, control = ca.SX.sym("state", N_STATES), ca.SX.sym("control", 2)
    p = parameters.symbols()
    physical = [control[i] * SCALES[i] for i in range(2)]
    before = ca.vertsplit(state)[:4]
    reached = dynamics.step(before, physical, STEP, settings.friction, p["road_curvature"])
    landing = ca.SX.sym("landing", 4)
    after = ca.vertsplit(landing)
    cars = ca.reshape(p["cars"], 6, parameters.n_cars)
    relative = ca.SX.sym("relative", 2 * parameters.n_cars)
    along, across = ca.vertsplit(relative, parameters.n_cars)
    inputs = reward.StageInputs(
        lanes=p["lanes"],
        lane_widths=p["lane_widths"],
        right=p["right"],
        left=p["left"],
        speed_limit=p["speed_limit"],
        along=along,
        across=across,
        half_widths=cars[5, :].T,
    )
    # Original reward, eq. 1.
    last = [state[4 + i] * SCALES[i] for i in range(2)]
    at = Point(after, physical, last, inputs, p["ego_width"], settings.friction)
    names = settings.reward.in_use
    theta = dict(zip(names, ca.vertsplit(p["theta"]), strict=True))
    terms = {name: theta[name] * value for name, value in reward.terms(at, names).items()}
    # Cohesion, eq. 2: distance of the ego's social features from the groups' means.
    psi = ca.vertcat(*social_features(before, after, STEP, p["road_curvature"]))
    missed, aside = psi - p["cohesion_target"], after[1] - p["place_target"]
    terms["cohesion"] = -ca.dot(p["cohesion_weight"], missed**2) - p["place_weight"] * aside**2
    violation = constraints.violations(after, inputs, p["ego_width"])
    terms["constraints"] = -p["constraint_weight"] * ca.sum1(constraints.penalties(violation))
    rows = reward.squares(at, names)
    pairs = [(r, theta[name] * w) for name in rows for r, w in rows[name]]
    pairs.append((violation, p["constraint_weight"] * constraints.penalty_weights(violation)))
    pairs += [(missed, 2.0 * p["cohesion_weight"]), (aside, 2.0 * p["place_weight"])]
    residuals, weights = zip(*pairs, strict=True)
    return Stage(
        state,
        control,
        ca.vertcat(*p.values()),
        ca.vertcat(*reached, control),
        landing,
        relative,
        ca.vertcat(*reward.in_frames(after[0], after[1], cars)),
        terms,
        ca.vertcat(*residuals),
        ca.vertcat(*weights),
    )


def standstill(state: Any, settings: PlannerSettings) -> Any:
    """Scaled acceleration that ends a stage at standstill: no car reverses."""
    return (settings.friction - 1.0 / STEP) * state[3] / SCALES[1]


def control_limits(
    state: Any, low: Any, high: Any, change: Any, settings: PlannerSettings
) -> tuple[Any, Any]:
    """Lowest and highest scaled control of a stage that starts in a state; symbols, two each.

    The stage's own bounds come before those of the change, and standing still before both: who
    has stopped no longer brakes.
    """
    last, stop = state[4:], standstill(state, settings)
    lowest = ca.fmin(ca.fmax(low, last - change), high)
    highest = ca.fmax(ca.fmin(high, last + change), low)
    return (
        ca.vertcat(lowest[0], ca.fmax(lowest[1], stop)),
        ca.vertcat(highest[0], ca.fmax(highest[1], stop)),
    )


def rate_excess(state: Any, control: Any, change: Any, settings: PlannerSettings) -> Any:
    """How much more than it may a control differs from the one before; (4,), none positive.

    The limits of control_limits, for solvers that take them as constraints: but where a stage's
    bounds leave no such control, the problem has no solution.
    """
    last, stop = state[4:], standstill(state, settings)
    highest = ca.vertcat(last[0] + change[0], ca.fmax(last[1] + change[1], stop))
    return ca.vertcat(last - change - control, control - highest)


def limited_stage(stage: Stage, settings: PlannerSettings) -> Any:
    """(state, control, parameters, low, high, change) -> (next state, control as driven, terms).

    The control is kept within its limits.
    """
    low, high, change = ca.SX.sym("low", 2), ca.SX.sym("high", 2), ca.SX.sym("change", 2)
    lowest, highest = control_limits(stage.state, low, high, change, settings)
    control = ca.fmin(ca.fmax(stage.control, lowest), highest)
    (terms,) = stage.landed(ca.vertcat(*[stage.terms[name] for name in settings.reward.parts]))
    after = ca.substitute([stage.next_state, terms], [stage.control], [control])
    return ca.Function(
        "stage",
        [*stage.inputs(), low, high, change],
        [after[0], control, after[1]],
        {"cse": True},
    )
