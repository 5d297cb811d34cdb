"""Likelihoods against SciPy's normal distribution, derivatives against finite differences."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import sumo_cohesion.learning.likelihood as likelihood
from sumo_cohesion.learning.likelihood import Quadratics, quadratics, score
from sumo_cohesion.learning.segments import make_segments
from sumo_cohesion.planning import reward
from sumo_cohesion.planning.reward import Point, RewardWeights, StageInputs
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.stage import CONTROL_SCALE
from sumo_cohesion.state import Control, FloatArray, RoadState
from tests.unit.learning.making import LIMIT, driven, example, noisy_optima, straight

ALL = dict.fromkeys(RewardWeights.model_fields, 1.0)
THETA = np.array([0.5, 2.0, 7.0])


def of_terms(horizon: int, names: tuple[str, ...] = tuple(ALL)) -> PlannerSettings:
    weights = {
        name: 1.0 for name in ALL if name in names or RewardWeights.model_fields[name].default
    }
    return PlannerSettings(horizon=horizon, cars=2, reward=RewardWeights(**weights))


def test_a_reward_of_squares_has_the_likelihood_of_a_normal_distribution() -> None:
    data = noisy_optima(THETA, n=5, size=4)
    a = np.einsum("k,nkij->nij", THETA, data.curvature)
    offset = np.linalg.solve(a, np.einsum("k,nki->ni", THETA, data.gradient)[..., None])[..., 0]
    # The optimum is where the gradient leads: u* = u + A^-1 g.
    expected = [
        multivariate_normal.logpdf(-o, cov=np.linalg.inv(c)) for o, c in zip(offset, a, strict=True)
    ]
    assert score(data, THETA, np.ones(5)).each == pytest.approx(expected, rel=1e-10)


def test_controls_that_only_cost_are_normal_around_zero() -> None:
    controls = np.array([[0.002, 1.0], [-0.003, 2.5], [0.001, -0.5]])
    data = quadratics(make_segments([example(controls)], of_terms(3, ())), of_terms(3, ()))
    names = of_terms(3, ()).reward.in_use
    theta = np.array([{"curvature": 3e5, "acceleration": 0.2}.get(n, 0.0) for n in names])
    sigma = 1.0 / np.sqrt(2.0 * np.array([3e5, 0.2])) / CONTROL_SCALE
    scaled = (controls / CONTROL_SCALE).ravel()
    expected = multivariate_normal.logpdf(scaled, cov=np.diag(np.tile(sigma**2, 3)))
    assert score(data, theta, np.ones(1)).each == pytest.approx([expected], rel=1e-9)


def test_directions_without_a_choice_count_for_nothing() -> None:
    data = noisy_optima(THETA, n=3, size=4)
    wider = np.zeros((3, 3, 6, 6))
    wider[:, :, :4, :4] = data.curvature
    gradient = np.concatenate((data.gradient, np.zeros((3, 3, 2))), axis=2)
    fixed = np.tile([False] * 4 + [True] * 2, (3, 1))
    held = Quadratics(gradient, wider, fixed, data.penalty)
    one, other = (score(d, THETA, np.ones(3), with_hessian=True) for d in (data, held))
    assert held.free.tolist() == [4.0] * 3
    for name in ("each", "misfit", "gradient", "hessian"):
        assert getattr(other, name) == pytest.approx(getattr(one, name), rel=1e-10)


def test_slope_and_bend_of_the_likelihood_are_those_of_finite_differences() -> None:
    data, counts = noisy_optima(THETA, n=6, size=4), np.arange(6.0)

    def total(theta: FloatArray) -> float:
        return float(counts @ score(data, theta, counts).each)

    found = score(data, THETA, counts, with_hessian=True)
    assert found.hessian is not None
    steps = 1e-6 * np.diag(THETA)
    slope = [(total(THETA + h) - total(THETA - h)) / (2 * h.sum()) for h in steps]
    bend = [
        (score(data, THETA + h, counts).gradient - score(data, THETA - h, counts).gradient)
        / (2 * h.sum())
        for h in steps
    ]
    assert found.gradient == pytest.approx(np.array(slope), rel=1e-6)
    assert found.hessian == pytest.approx(np.array(bend), rel=1e-6)


def test_many_segments_are_worked_out_in_parts_that_add_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data, counts = noisy_optima(THETA, n=7, size=4), np.arange(7.0)
    whole = score(data, THETA, counts, with_hessian=True)
    controls = np.array([[0.002, 1.0], [-0.003, 2.5]])
    segments = make_segments([example(c * controls) for c in (1.0, 0.5, 0.2)], of_terms(2))
    at_once = quadratics(segments, of_terms(2))
    monkeypatch.setattr(likelihood, "_NUMBERS_AT_ONCE", 2 * data.curvature[0].size)
    monkeypatch.setattr(likelihood, "_STAGES_AT_ONCE", 4)
    parts = score(data, THETA, counts, with_hessian=True)
    for one, other in zip(whole, parts, strict=True):
        assert other == pytest.approx(one, rel=1e-12)
    for one, other in zip(at_once, quadratics(segments, of_terms(2)), strict=True):
        assert np.array_equal(one, other)


CARS = np.array(
    [
        [58.0, 3.5, 0.02, 17.0, 4.5, 1.7, 0.0],
        [45.0, -1.5, -0.1, 21.0, 9.0, 2.4, 0.0],
    ]
)


def cost_of(
    name: str, controls: FloatArray, ego: RoadState, before: Control | None, bend: float
) -> float:
    """Minus a term, summed along driven controls, written down anew with plain numbers."""
    states = driven(ego, controls, bend)
    total, last = 0.0, before
    for t, (state, control) in enumerate(zip(states, controls, strict=True)):
        s, d, _, speed = state
        along, across = [], []
        for car in CARS:
            ahead = 0.1 * (t + 1)
            metres = car[3] * np.cos(car[2]) / (1.0 - car[6] * car[1])
            ds = s - (car[0] + ahead * metres)
            dd = d - (car[1] + ahead * car[3] * np.sin(car[2]))
            cos, sin = np.cos(car[2]), np.sin(car[2])
            along.append((ds * cos + dd * sin) / ((5.0 + car[4]) / 2))
            across.append((dd * cos - ds * sin) / ((1.8 + car[5]) / 2))
        rate = np.zeros(2) if last is None else (control - np.array(last)) / 0.1
        value = {
            "lane": -sum(np.exp(-0.5 * ((d - c) / (0.25 * 3.5)) ** 2) for c in (1.75, 5.25)),
            "edge": max(0.0 + 1.2 - d, 0.0) ** 2 + max(d + 1.2 - 7.0, 0.0) ** 2,
            "speed": (speed - LIMIT) ** 2,
            "car": sum(
                np.exp(-0.5 * (a**2 + (c / 0.55) ** 2)) for a, c in zip(along, across, strict=True)
            ),
            "curvature": control[0] ** 2,
            "acceleration": control[1] ** 2,
            "curvature_change": rate[0] ** 2,
            "acceleration_change": rate[1] ** 2,
            "net_acceleration": ((control[1] - 0.1 * speed) / (1.0 - 0.1 * 0.1)) ** 2,
        }[name]
        total, last = total + value, Control(*control)
    return float(total)


@pytest.mark.parametrize("bend", [0.0, 0.004])
@pytest.mark.parametrize("before", [None, Control(0.001, 1.5)])
@pytest.mark.parametrize("name", list(ALL))
def test_a_terms_gradient_is_that_of_what_driving_costs(
    name: str, before: Control | None, bend: float
) -> None:
    ego = RoadState(50.0, 1.0, 0.01, 18.0)  # nearer to the edge than its margin
    rng = np.random.default_rng(3)
    controls = np.array([bend, 1.8]) + rng.normal(size=(4, 2)) * [0.003, 0.5]
    road = straight(bend=bend)
    settings = of_terms(4)
    segments = make_segments([example(controls, ego, road, CARS, before)], settings)
    data = quadratics(segments, settings)
    assert (segments.dropped == "").all()
    assert segments.controls[0] == pytest.approx(controls / CONTROL_SCALE, abs=1e-10)
    k = settings.reward.in_use.index(name)

    def cost(u: FloatArray) -> float:
        return cost_of(name, u.reshape(4, 2) * CONTROL_SCALE, ego, before, bend)

    u = (controls / CONTROL_SCALE).ravel()
    h = 1e-5 * np.eye(8)
    slope = np.array([(cost(u + e) - cost(u - e)) / 2e-5 for e in h])
    assert np.abs(slope).max() > 0.0
    assert -data.gradient[0, k] == pytest.approx(slope, rel=1e-6, abs=1e-7 * np.abs(slope).max())
    curvature = data.curvature[0, k]
    assert curvature == pytest.approx(curvature.T, rel=1e-12, abs=1e-12)
    assert np.linalg.eigvalsh(curvature).min() >= -1e-9 * np.abs(curvature).max()


QUADRATIC = ("curvature", "acceleration", "curvature_change", "acceleration_change")


@pytest.mark.parametrize("name", [*QUADRATIC, "speed", "net_acceleration"])
def test_the_curvature_of_a_square_of_the_controls_is_its_hessian(name: str) -> None:
    """Speed is linear in the accelerations: its square, too, has no other curvature."""
    ego, before = RoadState(50.0, 2.0, 0.0, 18.0), Control(0.001, 1.5)
    controls = np.array([[0.002, 1.0], [-0.003, 2.5], [0.001, 1.2]])
    settings = of_terms(3)
    data = quadratics(make_segments([example(controls, ego, None, CARS)], settings), settings)
    u, h = (controls / CONTROL_SCALE).ravel(), 0.01 * np.eye(6)

    def cost(v: FloatArray) -> float:
        return cost_of(name, v.reshape(3, 2) * CONTROL_SCALE, ego, before, 0.0)

    hessian = np.array(
        [
            [
                (cost(u + a + b) - cost(u + a - b) - cost(u - a + b) + cost(u - a - b)) / 4e-4
                for a in h
            ]
            for b in h
        ]
    )
    curvature = data.curvature[0, settings.reward.in_use.index(name)]
    assert curvature == pytest.approx(hessian, rel=1e-4, abs=1e-5 * np.abs(hessian).max())


@pytest.mark.parametrize("name", ["lane", "edge", "car"])
def test_other_curvatures_are_those_of_weighted_squares(name: str) -> None:
    """J'WJ of the residuals along the drive, J by finite differences."""
    import casadi as ca

    ego = RoadState(50.0, 1.0, 0.01, 18.0)
    controls = np.array([[0.002, 1.0], [-0.003, 2.5], [0.001, 1.2]])
    settings = of_terms(3)
    segments = make_segments([example(controls, ego, None, CARS)], settings)
    data = quadratics(segments, settings)

    def squares(v: FloatArray) -> tuple[FloatArray, FloatArray]:
        controls = v.reshape(3, 2) * CONTROL_SCALE
        r, w = [], []
        for t, state in enumerate(driven(ego, controls)):
            cars = np.array(CARS)
            at = 0.1 * (t + 1)
            cars[:, 0] += at * cars[:, 3] * np.cos(cars[:, 2])
            cars[:, 1] += at * cars[:, 3] * np.sin(cars[:, 2])
            half = (np.array([[5.0, 1.8]]) + cars[:, 4:6]) / 2
            rows = np.column_stack((cars[:, :2], np.cos(cars[:, 2]), np.sin(cars[:, 2]), half)).T
            along, across = reward.in_frames(state[0], state[1], ca.DM(rows))
            dm = ca.DM
            inputs = StageInputs(
                dm([1.75, 5.25]),
                dm([3.5, 3.5]),
                dm(0.0),
                dm(7.0),
                dm(LIMIT),
                along,
                across,
                dm(half[:, 1]),
            )
            point = Point([dm(v) for v in state], [], [], inputs, dm(1.8), 0.1)
            for residual, weight in reward.squares(point, [name])[name]:
                r.append(np.asarray(ca.DM(residual).full()).ravel())
                w.append(np.asarray(ca.DM(weight).full()).ravel() * np.ones(len(r[-1])))
        return np.concatenate(r), np.concatenate(w)

    u, h = (controls / CONTROL_SCALE).ravel(), 1e-5 * np.eye(6)
    jacobian = np.array([(squares(u + e)[0] - squares(u - e)[0]) / 2e-5 for e in h]).T
    expected = jacobian.T @ (squares(u)[1][:, None] * jacobian)
    curvature = data.curvature[0, settings.reward.in_use.index(name)]
    assert curvature == pytest.approx(expected, rel=1e-5, abs=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize(("horizon", "n_lanes"), [(2, 1), (40, 1), (5, 3)])
def test_any_length_and_number_of_lanes_has_dense_shapes(horizon: int, n_lanes: int) -> None:
    settings = of_terms(horizon)
    controls = np.tile([0.0, 1.9], (horizon, 1))
    road = straight(n_lanes)
    both = [example(controls, road=road), example(controls * 1.1, road=straight(1))]
    data = quadratics(make_segments(both, settings), settings)
    k = len(ALL)
    assert data.gradient.shape == (2, k, 2 * horizon)
    assert data.curvature.shape == (2, k, 2 * horizon, 2 * horizon)
    assert np.isfinite(data.curvature).all()
    assert np.isfinite(score(data, np.ones(k), np.ones(2)).each).all()


@pytest.mark.slow
def test_threads_that_learn_at_once_do_not_disturb_one_another() -> None:
    controls = np.array([[0.002, 1.0], [-0.003, 2.5], [0.001, 1.2]])
    both = [example(f * controls) for f in (1.0, 0.5)]
    alone = quadratics(make_segments(both, of_terms(3)), of_terms(3))

    def again(_: int) -> Quadratics:
        return quadratics(make_segments(both, of_terms(3)), of_terms(3))

    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(again, range(12)):
            for one, other in zip(alone, found, strict=True):
                assert np.array_equal(one, other)
