"""One stage of the horizon as CasADi expressions: the one objective that every solver maximises.

A stage goes from one state to the next. Its reward is the ego's own, at the state it leads to
(paper, eq. 1), plus its cohesion (eq. 2).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sumo_cohesion.planning import constraints, dynamics, reward
from sumo_cohesion.planning.dynamics import DT
from sumo_cohesion.planning.problem import Instance, Problem
from sumo_cohesion.planning.settings import PlannerSettings, RewardWeights
from sumo_cohesion.social.features import FEATURES, social_features
from sumo_cohesion.state import FloatArray

SCALES = (0.01, 5.0)
"""Curvature (1/m) and acceleration (m/s²) that solvers see as one."""
CONTROL_SCALE = np.array(SCALES)
N_STATES = 6
UNLIMITED = 1e6
"""Change of a scaled control that no bound stands against."""
TERMS = (*RewardWeights.model_fields, "cohesion", "constraints")
"""Names of the parts of a stage's reward."""


class Stage(NamedTuple):
    """Expressions of one stage in ``state`` (6), ``control`` (2, scaled) and ``parameters``.

    The state is the road state and the scaled control of the stage before. ``next_state`` is where
    the control leads. The terms are written in a symbol ``landing`` (4) that stands for the road
    state there: their derivatives are cheap in it, and dear in what leads there.

    ``residuals`` r and ``residual_weights`` w say the same cost as a weighted sum of squares, in
    the sense that its gradient is J'(w r) and J' diag(w) J is positive semidefinite: what a
    Gauss-Newton step needs.
    """

    state: Any
    control: Any
    parameters: Any
    next_state: Any
    landing: Any
    terms: dict[str, Any]
    residuals: Any
    residual_weights: Any

    @property
    def cost(self) -> Any:
        """Minus the sum of all terms."""
        return -sum(self.terms.values())

    def landed(self, *expressions: Any) -> list[Any]:
        """Put the road state where the control leads in the place of ``landing``."""
        where = [self.next_state[:4]]
        return list(ca.substitute(list(expressions), [self.landing], where))

    def inputs(self) -> list[Any]:
        """State, control and parameters, of which everything is a function."""
        return [self.state, self.control, self.parameters]


_PER_STAGE = (
    "road_curvature",
    "lanes",
    "lane_widths",
    "right",
    "left",
    "speed_limit",
    "cohesion_weight",
    "cohesion_target",
    "place_weight",
    "place_target",
)


class StageParameters:
    """Where each part of a Problem lies in a stage's parameter vector."""

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        k, self.n_cars = len(FEATURES), settings.cars
        self.sizes = {
            "ego_width": 1,
            "theta": len(RewardWeights.model_fields),
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
        ends = np.cumsum(list(self.sizes.values())).tolist()
        starts = [0, *ends[:-1]]
        self._places = dict(zip(self.sizes, map(slice, starts, ends), strict=True))

    def symbols(self) -> dict[str, Any]:
        """Return one symbol per part."""
        return {name: ca.SX.sym(name, size) for name, size in self.sizes.items()}

    def fill(self, problem: Problem, out: FloatArray) -> None:
        """Write a problem's parameters: ``out`` is (T, size), one row per stage."""
        columns, places = out.T, self._places
        for name in ("ego_width", "theta", "constraint_weight"):  # the same at all stages
            columns[places[name]] = getattr(problem, name)[:, None]
        for name in _PER_STAGE:
            columns[places[name]] = getattr(problem, name)
        cars = problem.cars.transpose(1, 0, 2)
        columns[places["cars"]] = cars.reshape(self.sizes["cars"], -1)


def make_stage(settings: PlannerSettings, parameters: StageParameters) -> Stage:
    """Write down one stage."""
    state, control = ca.SX.sym("state", N_STATES), ca.SX.sym("control", 2)
    p = parameters.symbols()
    physical = [control[i] * SCALES[i] for i in range(2)]
    before = ca.vertsplit(state)[:4]
    reached = dynamics.step(before, physical, DT, settings.friction, p["road_curvature"])
    landing = ca.SX.sym("landing", 4)
    after = ca.vertsplit(landing)
    inputs = reward.StageInputs(
        lanes=p["lanes"],
        lane_widths=p["lane_widths"],
        right=p["right"],
        left=p["left"],
        speed_limit=p["speed_limit"],
        cars=ca.reshape(p["cars"], 6, parameters.n_cars),
    )
    # Original reward, eq. 1.
    own = reward.terms(after, physical, inputs, p["ego_width"])
    theta = dict(zip(RewardWeights.model_fields, ca.vertsplit(p["theta"]), strict=True))
    terms = {name: theta[name] * own[name] for name in RewardWeights.model_fields}
    # Cohesion, eq. 2: distance of the ego's social features from the groups' means.
    psi = ca.vertcat(*social_features(before, after, DT, p["road_curvature"]))
    missed, aside = psi - p["cohesion_target"], after[1] - p["place_target"]
    terms["cohesion"] = -ca.dot(p["cohesion_weight"], missed**2) - p["place_weight"] * aside**2
    violation = constraints.violations(after, inputs, p["ego_width"])
    terms["constraints"] = -p["constraint_weight"] * ca.sum1(constraints.penalties(violation))
    rows = reward.squares(after, physical, inputs, p["ego_width"])
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
        terms,
        ca.vertcat(*residuals),
        ca.vertcat(*weights),
    )


def make_instance(problem: Problem, stages: FloatArray, settings: PlannerSettings) -> Instance:
    """Put a problem into the solvers' numbers; ``stages`` are its filled parameters."""
    low, high = control_bounds(settings, float(problem.ego[3]))
    start, change = np.zeros(N_STATES), _largest_change(settings)
    start[:4] = problem.ego
    if problem.driven is None:
        change = change.copy()
        change[0] = UNLIMITED
        return Instance(start, stages, low, high, change)
    # What was driven under other bounds, at another speed, must not leave nothing to choose.
    bounds = zip(problem.driven, SCALES, low[0].tolist(), high[0].tolist(), strict=True)
    start[4:] = [min(max(value / scale, least), most) for value, scale, least, most in bounds]
    return Instance(start, stages, low, high, change)


@lru_cache(maxsize=32)
def _largest_change(settings: PlannerSettings) -> FloatArray:
    per_step = (DT * settings.max_curvature_rate / SCALES[0], DT * settings.max_jerk / SCALES[1])
    change = np.tile(per_step, (settings.horizon, 1))
    change.setflags(write=False)  # everybody's
    return change


def control_bounds(settings: PlannerSettings, speed: float) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest scaled controls of every stage, (T, 2) each, from a speed (m/s).

    Braking and acceleration are bounded as what they do to the speed, friction included. Curvature
    is bounded so that the lateral acceleration keeps to its bound however fast the ego may be by
    then.
    """
    gain, drag, horizon = (
        DT * settings.max_acceleration,
        settings.friction * speed,
        settings.horizon,
    )
    low, high = np.empty((horizon, 2)), np.empty((horizon, 2))
    if settings.sharpest(speed + gain * horizon) == settings.max_curvature:
        high[:, 0] = settings.max_curvature / SCALES[0]
    else:
        high[:, 0] = [
            settings.sharpest(speed + gain * t) / SCALES[0] for t in range(1, horizon + 1)
        ]
    low[:, 0] = -high[:, 0]
    low[:, 1] = (drag - settings.max_braking) / SCALES[1]
    high[:, 1] = (drag + settings.max_acceleration) / SCALES[1]
    return low, high


def standstill(state: Any, settings: PlannerSettings) -> Any:
    """Scaled acceleration that ends a stage at standstill: no car reverses."""
    return (settings.friction - 1.0 / DT) * state[3] / SCALES[1]


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
    (terms,) = stage.landed(ca.vertcat(*[stage.terms[name] for name in TERMS]))
    after = ca.substitute([stage.next_state, terms], [stage.control], [control])
    return ca.Function(
        "stage",
        [*stage.inputs(), low, high, change],
        [after[0], control, after[1]],
        {"cse": True},
    )
