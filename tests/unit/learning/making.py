"""Driving that is made up, of which everything is known."""

from __future__ import annotations

import numpy as np

from sumo_cohesion.learning.example import Example
from sumo_cohesion.learning.likelihood import Quadratics
from sumo_cohesion.planning import dynamics
from sumo_cohesion.road import Road
from sumo_cohesion.state import STEP, Control, FloatArray, RoadState

LIMIT = 20.0
EGO_STATE, BEFORE = RoadState(50.0, 2.0, 0.01, 18.0), Control(0.001, 1.5)


def straight(n_lanes: int = 2, bend: float = 0.0, length: float = 400.0) -> Road:
    """Road of 3.5 m wide lanes, straight or along a circle."""
    s = np.arange(-100.0, length + 101.0)
    angle = bend * s
    if bend:
        x, y = np.sin(angle) / bend, (1.0 - np.cos(angle)) / bend
    else:
        x, y = s, np.zeros_like(s)
    n = len(s)
    return Road(
        x=x,
        y=y,
        tangent_x=np.cos(angle),
        tangent_y=np.sin(angle),
        curvature=np.full(n, bend),
        s0=-100.0,
        length=length,
        lane_centre=np.tile(3.5 * np.arange(n_lanes) + 1.75, (n, 1)),
        lane_width=np.full((n, n_lanes), 3.5),
        speed_limit=np.full(n, LIMIT),
        n_route_lanes=n_lanes,
    )


def driven(ego: RoadState, controls: FloatArray, bend: float = 0.0) -> FloatArray:
    """States (T, 4) that controls (T, 2) lead to."""
    states, state = [], ego
    for control in controls:
        state = RoadState(*dynamics.step(state, control, STEP, 0.1, bend))
        states.append(state)
    return np.array(states, dtype=float)


def example(
    controls: FloatArray,
    ego: RoadState = EGO_STATE,
    road: Road | None = None,
    cars: FloatArray | None = None,
    before: Control | None = BEFORE,
    *,
    run: str = "a",
    bounded: bool = False,
    unusable: str = "",
) -> Example:
    road = straight() if road is None else road
    return Example(
        run=run,
        vehicle="ego",
        time=0.0,
        road=road,
        ego=ego,
        ego_size=(5.0, 1.8),
        cars=np.empty((0, 7)) if cars is None else cars,
        driven=before,
        states=driven(ego, controls, float(road.curvature[0])),
        bounded=bounded,
        unusable=unusable,
    )


def noisy_optima(
    theta: FloatArray, n: int, size: int, seed: int = 0, noise: float = 1.0
) -> Quadratics:
    """Segments of a reward of squares, around its optimum with Boltzmann noise.

    The reward is -theta_k / 2 |r_k + J_k u|²; u is drawn from exp(reward), exactly.
    """
    rng = np.random.default_rng(seed)
    k = len(theta)
    jacobian = rng.normal(size=(n, k, size, size))
    residual = rng.normal(size=(n, k, size))
    curvature = jacobian.swapaxes(2, 3) @ jacobian
    pull = (jacobian.swapaxes(2, 3) @ residual[..., None])[..., 0]
    a = np.einsum("k,nkij->nij", theta, curvature)
    optimum = -np.linalg.solve(a, np.einsum("k,nki->ni", theta, pull)[..., None])[..., 0]
    root = np.linalg.inv(np.linalg.cholesky(a)).swapaxes(1, 2)
    u = optimum + noise * (root @ rng.normal(size=(n, size, 1)))[..., 0]
    gradient = -pull - (curvature @ u[:, None, :, None])[..., 0]
    return Quadratics(gradient, curvature, np.zeros((n, size), dtype=bool), np.zeros(n))


def joined(*parts: Quadratics) -> Quadratics:
    return Quadratics(*[np.concatenate(part) for part in zip(*parts, strict=True)])
