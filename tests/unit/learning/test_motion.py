"""Controls from positions: the planner's dynamics inverted, and what smoothing lets pass."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sumo_cohesion.learning.motion import controls, motion, smoothed
from sumo_cohesion.planning import dynamics
from sumo_cohesion.state import STEP

FRICTION = 0.1


def track(seed: int, bend: float, n: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (n + 1, 4) and the random controls (n, 2) that lead to them; bends (n + 1,)."""
    rng = np.random.default_rng(seed)
    chosen = np.column_stack((bend + rng.normal(size=n) * 0.005, 1.5 + rng.normal(size=n) * 2.0))
    bends = bend * (1.0 + 0.3 * np.sin(0.2 * np.arange(n + 1)))
    states = [(20.0, 1.0, 0.05, 15.0)]
    for t in range(n):
        states.append(dynamics.step(states[-1], chosen[t], STEP, FRICTION, bends[t]))
    return np.array(states), chosen, bends


@given(st.integers(0, 1000), st.sampled_from([0.0, 0.01, -0.02]))
def test_controls_are_those_that_were_driven(seed: int, bend: float) -> None:
    states, chosen, bends = track(seed, bend)
    found = controls(states, bends[:-1], STEP, FRICTION)
    assert found == pytest.approx(chosen, abs=1e-9)
    several = controls(np.stack((states, states)), np.stack((bends, bends))[:, :-1], STEP, FRICTION)
    assert several == pytest.approx(np.stack((chosen, chosen)), abs=1e-9)


@given(st.integers(0, 1000), st.sampled_from([0.0, 0.01, -0.02]))
def test_places_alone_tell_heading_speed_and_controls(seed: int, bend: float) -> None:
    states, chosen, bends = track(seed, bend)
    moved = motion(states[:, :2], bends, STEP)
    assert moved.states[1:] == pytest.approx(states[1:], abs=1e-9)
    assert moved.states[0, 2:] == pytest.approx(states[1, 2:], abs=1e-9)
    found = controls(moved.states, bends[:-1], STEP, FRICTION)
    # The first state's heading and speed are made up, and with them the first control.
    assert found[1:] == pytest.approx(chosen[1:], abs=1e-6)


def test_where_a_car_stands_there_is_no_curvature() -> None:
    states = np.array([[10.0, 0.0, 0.0, 0.0], [10.0, 0.0, 0.0, 0.0]])
    found = controls(states, np.zeros(1), STEP, FRICTION)
    assert np.isnan(found[0, 0])
    assert found[0, 1] == 0.0


@pytest.mark.parametrize(("interval", "period"), [(0.1, 1.0), (0.1, 2.0), (0.04, 1.0), (0.2, 3.0)])
def test_an_oscillation_of_the_period_is_halved(interval: float, period: float) -> None:
    n = 40 * round(period / interval) + 1
    wave = np.sin(2.0 * np.pi * interval * np.arange(n) / period)
    middle = slice(n // 4, -n // 4)  # away from the ends
    assert smoothed(wave[:, None], interval, period)[middle, 0] == pytest.approx(
        0.5 * wave[middle], abs=1e-6
    )
    slow = np.sin(2.0 * np.pi * interval * np.arange(n) / (10.0 * period))
    assert smoothed(slow[:, None], interval, period)[middle, 0] == pytest.approx(
        slow[middle], abs=1e-4
    )


def test_parabolas_pass_as_they_are_however_far_along_the_road() -> None:
    t = 0.1 * np.arange(60)
    values = np.column_stack((9000.0 + 25.0 * t + 0.7 * t**2, 3.0 - t))
    assert smoothed(values, 0.1, 2.0) == pytest.approx(values, abs=1e-8)


@pytest.mark.parametrize("n", [1, 3, 50])
def test_no_period_changes_nothing_nor_are_a_few_places_smoothed(n: int) -> None:
    values = np.random.default_rng(0).normal(size=(n, 2))
    assert np.array_equal(smoothed(values, 0.1, 0.0), values)
    if n <= 3:
        assert np.array_equal(smoothed(values, 0.1, 2.0), values)
