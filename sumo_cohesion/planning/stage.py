"""One stage of the horizon as CasADi expressions: the one objective that every solver maximises.

A stage goes from one state to the next. Its reward is the ego's own, at the state it leads to
(paper, eq. 1), plus its cohesion (eq. 2).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sumo_cohesion.planning import constraints, dynamics, reward
from sumo_cohesion.planning.dynamics import DT
from sumo_cohesion.planning.problem import Problem
from sumo_cohesion.planning.settings import PlannerSettings, RewardWeights
from sumo_cohesion.social.features import FEATURES, social_features
from sumo_cohesion.state import FloatArray

CONTROL_SCALE = np.array([0.01, 5.0])
"""Curvature (1/m) and acceleration (m/s²) that solvers see as one."""
TERMS = (*RewardWeights.model_fields, "cohesion", "constraints")
"""Names of the parts of a stage's reward."""


class Stage(NamedTuple):
    """Expressions of one stage in ``state`` (4), ``control`` (2, scaled) and ``parameters``.

    ``residuals`` r and ``residual_weights`` w say the same cost as a weighted sum of squares, in
    the sense that its gradient is J'(w r) and J' diag(w) J is positive semidefinite: what a
    Gauss-Newton step needs.
    """

    state: Any
    control: Any
    parameters: Any
    next_state: Any
    terms: dict[str, Any]
    residuals: Any
    residual_weights: Any

    @property
    def cost(self) -> Any:
        """Minus the sum of all terms."""
        return -sum(self.terms.values())


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

    def symbols(self) -> dict[str, Any]:
        """Return one symbol per part."""
        return {name: ca.SX.sym(name, size) for name, size in self.sizes.items()}

    def fill(self, problem: Problem, out: FloatArray) -> None:
        """Write a problem's parameters: ``out`` is (T, size), one row per stage."""
        columns = out.T
        columns[0] = problem.ego_width[0]
        start = 1 + self.sizes["theta"]
        columns[1:start] = problem.theta[:, None]
        for name in list(self.sizes)[2:]:
            end = start + self.sizes[name]
            part = getattr(problem, name)
            if name == "cars":
                part = part.transpose(1, 0, 2).reshape(self.sizes[name], -1)
            columns[start:end] = part
            start = end


def make_stage(settings: PlannerSettings, parameters: StageParameters) -> Stage:
    """Write down one stage."""
    state, control = ca.SX.sym("state", 4), ca.SX.sym("control", 2)
    p = parameters.symbols()
    physical = [control[i] * float(CONTROL_SCALE[i]) for i in range(2)]
    before = ca.vertsplit(state)
    after = dynamics.step(before, physical, DT, settings.friction, p["road_curvature"])
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
    violation = constraints.violations(after, inputs)
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
        ca.vertcat(*after),
        terms,
        ca.vertcat(*residuals),
        ca.vertcat(*weights),
    )


def control_bounds(settings: PlannerSettings, speed: float) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest scaled controls of every stage, (T, 2) each, at a speed (m/s).

    Braking and acceleration are bounded as what they do to the speed, friction included.
    """
    drag, bend = settings.friction * speed, settings.max_curvature
    low = np.tile((-bend, drag - settings.max_braking), (settings.horizon, 1))
    high = np.tile((bend, drag + settings.max_acceleration), (settings.horizon, 1))
    return low / CONTROL_SCALE, high / CONTROL_SCALE


def standstill(state: Any, settings: PlannerSettings) -> Any:
    """Scaled acceleration that ends a stage at standstill: no car reverses."""
    return (settings.friction - 1.0 / DT) * state[3] / float(CONTROL_SCALE[1])


def stopping_stage(stage: Stage, settings: PlannerSettings) -> Any:
    """(state, control, parameters, low, high) -> (next state, control as driven, terms).

    The control is kept within its bounds, and no car reverses.
    """
    low, high = ca.SX.sym("low", 2), ca.SX.sym("high", 2)
    lowest = ca.vertcat(low[0], ca.fmax(low[1], standstill(stage.state, settings)))
    control = ca.fmin(ca.fmax(stage.control, lowest), high)
    terms = ca.vertcat(*[stage.terms[name] for name in TERMS])
    after = ca.substitute([stage.next_state, terms], [stage.control], [control])
    return ca.Function(
        "stage",
        [stage.state, stage.control, stage.parameters, low, high],
        [after[0], control, after[1]],
        {"cse": True},
    )
