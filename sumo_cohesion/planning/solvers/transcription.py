"""From a problem to the solvers' numbers, and from a solution back: checked.

What is known in a step is little; what solvers read are thousands of numbers: the cars predicted,
the road and all weights for every stage, the bounds. Two CasADi functions write and check them,
because as many small array operations would take longer than the solver.
"""

from __future__ import annotations

from math import isfinite
from typing import Any

import casadi as ca
import numpy as np

from sumo_cohesion.planning import dynamics, reward
from sumo_cohesion.planning.problem import FAR_AWAY, Instance, Problem, Solution
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.compiled import BoundCall, compiled
from sumo_cohesion.planning.stage import N_STATES, SCALES, UNLIMITED, StageParameters
from sumo_cohesion.social.features import FEATURES
from sumo_cohesion.state import STEP, Control

_NOW = {
    "ego": 4,
    "ego_size": 2,
    "driven": 2,
    "is_driven": 1,
    "transitions": 1,
    "constraint_weight": 1,
    "cohesion_weight": len(FEATURES),
    "cohesion_target": len(FEATURES),
}
"""Parts of a problem that are the same at all stages, and their sizes."""
_LIMITS = (
    "max_curvature",
    "max_lateral_acceleration",
    "max_curvature_rate",
    "max_braking",
    "max_acceleration",
    "max_jerk",
)
"""Settings that bound the controls."""
_NO_CAR = (FAR_AWAY, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0)
_NOT_DRIVEN = Control(0.0, 0.0)
_HAIR = 1e-3
"""How far a solution may be from what it should be, in scaled controls and in SI units."""


class Transcription:
    """Writes the instances of problems of one shape, and checks their solutions.

    Roads have up to ``n_lanes`` lanes. One plan after the other: writing, solving and checking
    must not be interleaved; mpc has one per thread.
    """

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        self._settings = settings
        layout = StageParameters(settings, n_lanes)
        functions, _ = compiled([_write(settings, layout), _check(settings, layout)])
        self._allocate(layout, *functions)

    def _allocate(self, layout: StageParameters, write: Any, check: Any) -> None:
        t, f = self._settings.horizon, np.zeros
        self._now, self._cars = f(sum(_NOW.values())), f((self._settings.cars, len(_NO_CAR)))
        self._road, self._edges = f((t + 1, 2 * layout.n_lanes + 2)), f((t + 1, 2))
        self._place, self._sum = f((2, t)), f(1)
        self._instance = Instance(f(N_STATES), f((t, layout.size)), f((t, 2)), f((t, 2)), f((t, 2)))
        settings = self._settings
        limits = np.array([getattr(settings, name) for name in _LIMITS])
        self._theta = f(layout.sizes["theta"])
        # A C-ordered (T, n) array is a CasADi matrix of T columns.
        given = [self._now, self._cars, self._road, self._edges, self._place, self._theta, limits]
        written = self._instance
        self._write = BoundCall(
            write,
            given,
            [written.start, written.stages, written.low, written.high, written.change, self._sum],
        )
        self._states, self._controls = f((t + 1, 4)), f((t, 2))
        self._off, self._total = f(1), f(1)
        bounds = [written.start, written.low, written.high, self._road]
        claimed = [self._states, self._controls]
        self._check = BoundCall(check, [*claimed, *bounds], [self._off, self._total])

    def write(self, problem: Problem) -> Instance | None:
        """Write a problem's instance, valid until the next one; None if it is not finite."""
        driven = problem.driven
        self._now[:] = (
            *problem.ego,
            *problem.ego_size,
            *(_NOT_DRIVEN if driven is None else driven),
            driven is not None,
            problem.transitions,
            problem.constraint_weight,
            *problem.cohesion_weight,
            *problem.cohesion_target,
        )
        cars = problem.cars[: len(self._cars)]
        self._cars[: len(cars)], self._cars[len(cars) :] = cars, _NO_CAR
        self._road[:], self._edges[:] = problem.road
        self._place[0], self._place[1] = problem.place_weight, problem.place_target
        self._theta[:] = problem.theta
        self._write()
        return self._instance if isfinite(self._sum[0]) else None

    def is_solution(self, solution: Solution) -> bool:
        """Tell if what is said to solve the instance written last can be its solution.

        All is finite and within bounds, and the first control leads where it says.
        """
        states, controls = solution.states, solution.controls
        if states.shape != self._states.shape or controls.shape != self._controls.shape:
            return False
        self._states[:], self._controls[:] = states, controls
        self._check()
        return isfinite(self._total[0]) and bool(self._off[0] < _HAIR)


def _symbols(sizes: dict[str, int]) -> dict[str, Any]:
    return {name: ca.SX.sym(name, size) for name, size in sizes.items()}


def _write(settings: PlannerSettings, layout: StageParameters) -> Any:
    """(now, cars, road, edges, place, theta, limits) -> instance, and the sum of its numbers."""
    t = settings.horizon
    now = ca.MX.sym("now", sum(_NOW.values()))
    cars = ca.MX.sym("cars", len(_NO_CAR), settings.cars)
    road, edges = ca.MX.sym("road", 2 * layout.n_lanes + 2, t + 1), ca.MX.sym("edges", 2, t + 1)
    place = ca.MX.sym("place", t, 2)
    theta, limits = ca.MX.sym("theta", layout.sizes["theta"]), ca.MX.sym("limits", len(_LIMITS))
    moving = _moving(settings)(now, cars)
    one = _stage_numbers(settings, layout)
    columns = [
        one(now, moving, road[:, i], road[:, i + 1], edges[:, i + 1], place[i, :], theta, limits, i)
        for i in range(t)
    ]
    stages, low, high, change = (ca.horzcat(*column) for column in zip(*columns, strict=True))
    start = _start()(now, low[:, 0], high[:, 0])
    total = ca.sum1(ca.sum2(stages)) + ca.sum1(start)
    inputs = [now, cars, road, edges, place, theta, limits]
    return ca.Function("write", inputs, [start, stages, low, high, change, total])


def _moving(settings: PlannerSettings) -> Any:
    """(now, cars) -> columns as in reward.in_frames, and how fast s and d grow (m/s)."""
    parts = _symbols(_NOW)
    cars = ca.SX.sym("cars", len(_NO_CAR), settings.cars)
    s, d, heading, speed, length, width, curvature = ca.vertsplit(cars)
    along, across = ca.cos(heading), ca.sin(heading)
    half_length, half_width = (
        0.5 * (own + other)
        for own, other in zip(ca.vertsplit(parts["ego_size"]), (length, width), strict=True)
    )
    velocity = speed * along / dynamics.stretch(curvature, d), speed * across
    rows = ca.vertcat(s, d, along, across, half_length, half_width, *velocity)
    return ca.Function("moving", [ca.vertcat(*parts.values()), cars], [rows])


def _stage_numbers(settings: PlannerSettings, layout: StageParameters) -> Any:
    """(now, moving, road before, road, edges, place, theta, limits, i) -> numbers of stage i.

    Those are a column of stage.StageParameters, and lowest, highest and largest change of the
    controls. Cars are predicted at constant velocity.
    """
    parts, n_lanes = _symbols(_NOW), layout.n_lanes
    moving = ca.SX.sym("moving", 8, settings.cars)
    before, road = (ca.SX.sym(name, 2 * n_lanes + 2) for name in ("before", "road"))
    edges, place = ca.SX.sym("edges", 2), ca.SX.sym("place", 1, 2)
    theta, limits = ca.SX.sym("theta", layout.sizes["theta"]), ca.SX.sym("limits", len(_LIMITS))
    i = ca.SX.sym("i")
    ahead = STEP * (i + 1)
    free = ca.logic_and(i < 1, parts["is_driven"] < 1)
    of_change = reward.of_change(settings.reward.in_use)
    weights = [
        ca.if_else(free, 0.0, weight) if changes else weight
        for weight, changes in zip(ca.vertsplit(theta), of_change, strict=True)
    ]
    numbers = {
        "ego_width": parts["ego_size"][1],
        "theta": ca.vertcat(*weights),
        "road_curvature": before[-1],
        "lanes": ca.fmin(road[:n_lanes], FAR_AWAY),
        "lane_widths": road[n_lanes : 2 * n_lanes],
        "right": edges[0],
        "left": edges[1],
        "speed_limit": road[-2],
        "cars": ca.vec(ca.vertcat(moving[:2, :] + moving[6:, :] * ahead, moving[2:6, :])),
        "cohesion_weight": parts["cohesion_weight"] * (i < parts["transitions"]),
        "cohesion_target": parts["cohesion_target"],
        "place_weight": place[0],
        "place_target": place[1],
        "constraint_weight": parts["constraint_weight"],
    }
    named = dict(zip(_LIMITS, ca.vertsplit(limits), strict=True))
    low, high = control_bounds(named, settings.friction, parts["ego"][3], i)
    most = ca.vertcat(
        STEP * named["max_curvature_rate"] / SCALES[0], STEP * named["max_jerk"] / SCALES[1]
    )
    return ca.Function(
        "stage_numbers",
        [ca.vertcat(*parts.values()), moving, before, road, edges, place, theta, limits, i],
        [
            ca.vertcat(*[numbers[name] for name in layout.sizes]),
            low,
            high,
            ca.if_else(free, ca.SX([UNLIMITED, UNLIMITED]), most),
        ],
    )


def control_bounds(limits: dict[str, Any], friction: float, speed: Any, i: Any) -> tuple[Any, Any]:
    """Lowest and highest scaled control of stage i, two each, from the present speed (m/s).

    Braking and acceleration are bounded as what they do to the speed, friction included. Curvature
    is bounded so that the lateral acceleration keeps to its bound however fast the ego may be by
    then: as in PlannerSettings.sharpest, which is for numbers.
    """
    drag = friction * speed
    fastest = ca.fmax(speed + STEP * limits["max_acceleration"] * (i + 1), 1e-3)
    sharpest = ca.fmin(limits["max_curvature"], limits["max_lateral_acceleration"] / fastest**2)
    low = ca.vertcat(-sharpest / SCALES[0], (drag - limits["max_braking"]) / SCALES[1])
    high = ca.vertcat(sharpest / SCALES[0], (drag + limits["max_acceleration"]) / SCALES[1])
    return low, high


def _start() -> Any:
    """(now, low, high) -> state in which the first stage starts."""
    parts = _symbols(_NOW)
    low, high = ca.SX.sym("low", 2), ca.SX.sym("high", 2)
    # What was driven under other bounds, at another speed, must not leave nothing to choose.
    last = ca.fmin(ca.fmax(parts["driven"] / ca.SX(SCALES), low), high)
    start = ca.vertcat(parts["ego"], parts["is_driven"] * last)
    return ca.Function("start", [ca.vertcat(*parts.values()), low, high], [start])


def _check(settings: PlannerSettings, layout: StageParameters) -> Any:
    """(states, controls, start, low, high, road) -> how far off, and the sum of all."""
    t = settings.horizon
    states, controls = ca.SX.sym("states", 4, t + 1), ca.SX.sym("controls", 2, t)
    start, road = ca.SX.sym("start", N_STATES), ca.SX.sym("road", 2 * layout.n_lanes + 2, t + 1)
    low, high = ca.SX.sym("low", 2, t), ca.SX.sym("high", 2, t)
    scaled = controls / ca.repmat(ca.SX(SCALES), 1, t)
    outside = ca.fmax(ca.mmax(low - scaled), ca.mmax(scaled - high))
    first = ca.vertsplit(start)[:4], ca.vertsplit(controls[:, 0])
    reached = ca.vertcat(start[:4], *dynamics.step(*first, STEP, settings.friction, road[-1, 0]))
    claimed = ca.vertcat(states[:, 0], states[:, 1])
    off = ca.fmax(outside, ca.mmax(ca.fabs(reached - claimed)))
    total = ca.sum1(ca.sum2(states)) + ca.sum1(ca.sum2(controls))
    return ca.Function("check", [states, controls, start, low, high, road], [off, total])
