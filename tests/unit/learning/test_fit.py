"""Weights are found again in driving that was made up, and only what it tells is learned."""

from __future__ import annotations

import numpy as np
import pytest

from sumo_cohesion.learning.fit import bootstrap, fit, maximise
from sumo_cohesion.learning.likelihood import Quadratics, score
from sumo_cohesion.state import FloatArray
from tests.unit.learning.making import joined, noisy_optima

NAMES = ("lane", "speed", "car")
DEFAULTS = np.array([1.0, 0.04, 50.0])
TRUE = np.array([1.0, 0.1, 20.0])
"""Relative to lane."""
SCALE = 40.0


def data_of(theta: FloatArray = SCALE * TRUE, n: int = 300, seed: int = 0) -> Quadratics:
    return noisy_optima(theta, n=n, size=4, seed=seed)


def without(data: Quadratics, term: int) -> Quadratics:
    """Return the same with a term that nothing depends on."""
    gradient, curvature = data.gradient.copy(), data.curvature.copy()
    gradient[:, term], curvature[:, term] = 0.0, 0.0
    return data._replace(gradient=gradient, curvature=curvature)


def test_weights_and_temperature_are_found_again() -> None:
    data = data_of()
    found = fit(data, NAMES, DEFAULTS, {}, 1.0)
    assert found.anchor == "lane"
    assert found.weights[0] == 1.0
    assert np.abs(np.log(found.weights / TRUE)[1:]).max() < 3.0 * found.error.max() < 0.3
    assert found.scale == pytest.approx(SCALE, rel=0.15)
    assert np.median(found.misfit) == pytest.approx(1.0, abs=0.2)
    assert not found.kept_default
    assert found.kept.all()
    # It is a maximum: nothing is left to climb.
    assert score(data, found.theta, np.ones(300)).gradient * found.theta == pytest.approx(
        np.zeros(3), abs=1e-3
    )


@pytest.mark.slow
def test_the_standard_error_is_how_far_off_fits_are() -> None:
    fits = [fit(data_of(n=60, seed=s), NAMES, DEFAULTS, {}, 1.0) for s in range(40)]
    off = np.array([np.log(f.theta / (SCALE * TRUE)) for f in fits])
    said = np.array([f.error for f in fits])
    assert np.sqrt((off**2).mean(axis=0)) / said.mean(axis=0) == pytest.approx(1.0, abs=0.35)


def test_a_tenth_of_garbage_does_no_harm() -> None:
    rng = np.random.default_rng(1)
    sound, garbage = data_of(n=270), data_of(n=30, seed=9)
    garbage = garbage._replace(gradient=garbage.gradient + 1e3 * rng.normal(size=(30, 3, 4)))
    found = fit(joined(sound, garbage), NAMES, DEFAULTS, {}, 0.85)
    assert np.log(found.weights / TRUE) == pytest.approx(np.zeros(3), abs=0.3)
    assert not found.kept[270:].any()
    assert found.kept.sum() == round(0.85 * 300)
    astray = fit(joined(sound, garbage), NAMES, DEFAULTS, {}, 1.0)
    assert np.abs(np.log(astray.weights / TRUE)).max() > 0.5


def test_what_is_kept_is_what_the_fit_is_made_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """However early trimming is given up."""
    data = joined(data_of(n=50), data_of(theta=0.2 * SCALE * TRUE[::-1], n=40, seed=3))
    for rounds in (1, 2, 3):
        monkeypatch.setattr("sumo_cohesion.learning.fit.ROUNDS", rounds)
        found = fit(data, NAMES, DEFAULTS, {}, 0.6)
        again, _ = maximise(data, found.kept.astype(float), {0: 1.0}, found.theta)
        assert found.theta == pytest.approx(again, rel=1e-4)


@pytest.mark.parametrize("term", [1, 2])
def test_what_the_data_do_not_tell_keeps_its_default(term: int) -> None:
    theta = SCALE * TRUE
    theta[term] = 0.0
    found = fit(without(data_of(theta), term), NAMES, DEFAULTS, {}, 1.0)
    assert found.kept_default == {NAMES[term]: "the demonstrations do not tell it"}
    assert found.weights[term] == DEFAULTS[term]
    other = 3 - term
    assert found.weights[other] == pytest.approx(TRUE[other], rel=0.3)


def test_driving_that_speaks_against_a_default_says_so() -> None:
    found = fit(data_of(SCALE * TRUE * [1.0, 1.0, 0.0]), NAMES, DEFAULTS, {}, 1.0)
    assert found.kept_default == {"car": "the demonstrations tell only that it is smaller"}
    assert found.weights[2] == DEFAULTS[2]


def test_a_lane_of_which_nothing_is_known_is_no_anchor() -> None:
    theta = SCALE * TRUE * [0.0, 1.0, 1.0]
    found = fit(without(data_of(theta), 0), NAMES, DEFAULTS, {}, 1.0)
    at = NAMES.index(found.anchor)  # the one that is known best
    assert at == found.error.argmin() > 0
    assert found.kept_default == {"lane": "the demonstrations do not tell it"}
    assert found.weights[[0, at]] == pytest.approx(DEFAULTS[[0, at]])
    assert found.weights[2] / found.weights[1] == pytest.approx(TRUE[2] / TRUE[1], rel=0.3)


def test_data_that_tell_nothing_leave_all_defaults() -> None:
    data = data_of()
    data = data._replace(
        gradient=np.tile(data.gradient[:, :1], (1, 3, 1)),
        curvature=np.tile(data.curvature[:, :1], (1, 3, 1, 1)),
    )
    found = fit(data, NAMES, DEFAULTS, {}, 1.0)
    assert found.weights == pytest.approx(DEFAULTS)
    assert len(found.kept_default) >= 2


def test_a_weight_that_is_fixed_stays() -> None:
    found = fit(data_of(), NAMES, DEFAULTS, {"car": 33.0}, 1.0)
    assert found.weights[2] == 33.0
    assert found.kept_default == {"car": "as asked for"}
    assert found.anchor == "lane"
    assert found.weights[0] == 1.0


def test_a_fixed_lane_is_the_anchor_and_all_others_are_learned() -> None:
    free, same = (fit(data_of(), NAMES, DEFAULTS, fixed, 1.0) for fixed in ({}, {"lane": 1.0}))
    assert same.kept_default == {"lane": "as asked for"}
    assert same.anchor == "lane"
    assert same.weights == pytest.approx(free.weights, rel=1e-5)
    double = fit(data_of(), NAMES, DEFAULTS, {"lane": 2.0}, 1.0)
    assert double.weights == pytest.approx(2.0 * free.weights, rel=1e-4)
    assert double.scale == pytest.approx(0.5 * free.scale, rel=1e-4)


def test_a_lane_fixed_at_nothing_leaves_the_next_for_an_anchor() -> None:
    theta = SCALE * TRUE * [0.0, 1.0, 1.0]
    found = fit(data_of(theta), NAMES, DEFAULTS, {"lane": 0.0}, 1.0)
    assert found.anchor == "speed"
    assert found.weights[:2].tolist() == [0.0, DEFAULTS[1]]
    assert found.weights[2] / found.weights[1] == pytest.approx(TRUE[2] / TRUE[1], rel=0.3)


@pytest.mark.parametrize("fixed", [{"lane": 1.0, "car": 20.0}, dict(zip(NAMES, TRUE, strict=True))])
def test_with_one_weight_free_or_none_the_temperature_is_found(fixed: dict[str, float]) -> None:
    found = fit(data_of(), NAMES, DEFAULTS, fixed, 1.0)
    assert found.scale == pytest.approx(SCALE, rel=0.15)
    assert found.weights == pytest.approx(TRUE, rel=0.2)


def test_a_term_that_is_off_by_default_is_learned_or_off() -> None:
    defaults = DEFAULTS * [1.0, 1.0, 0.0]
    found = fit(data_of(), NAMES, defaults, {}, 1.0)
    assert found.weights == pytest.approx(TRUE, rel=0.3)
    theta = SCALE * TRUE * [1.0, 1.0, 0.0]
    nothing = fit(without(data_of(theta), 2), NAMES, defaults, {}, 1.0)
    assert nothing.weights[2] == 0.0
    assert nothing.kept_default == {"car": "the demonstrations do not tell it"}


@pytest.mark.parametrize("noise", [0.0, 1e-9])
def test_exact_optima_have_weights_and_hardly_a_temperature(noise: float) -> None:
    data = noisy_optima(TRUE, n=50, size=4, noise=noise)
    found = fit(data, NAMES, DEFAULTS, {}, 1.0)
    assert found.weights == pytest.approx(TRUE, rel=1e-4)
    assert 0.0 < 1.0 / found.scale < 1e-10


def test_driving_without_any_gradient_says_nothing_and_breaks_nothing() -> None:
    data = data_of(n=20)
    found = fit(data._replace(gradient=0.0 * data.gradient), NAMES, DEFAULTS, {}, 1.0)
    assert np.isfinite(found.theta).all()
    assert set(found.kept_default) == set(NAMES)
    assert found.weights == pytest.approx(DEFAULTS)


def test_segments_that_are_all_the_same() -> None:
    one = data_of(n=1)
    found = fit(joined(*[one] * 40), NAMES, DEFAULTS, {}, 0.85)
    assert np.isfinite(found.theta).all()
    assert found.kept.sum() == 34
    alone = fit(one, NAMES, DEFAULTS, {}, 0.85)
    assert alone.kept.tolist() == [True]


def test_weights_that_leave_a_choice_without_cost_are_no_fit() -> None:
    fixed = dict.fromkeys(NAMES, 0.0)
    with pytest.raises(np.linalg.LinAlgError):
        fit(data_of(n=5), NAMES, DEFAULTS, fixed, 1.0)


def test_fits_from_other_beginnings_agree() -> None:
    data = data_of()
    first = fit(data, NAMES, DEFAULTS, {}, 1.0)
    for factor in (1e-4, 1e4):
        other, _ = maximise(data, np.ones(300), {0: 1.0}, DEFAULTS * [1, factor, 1 / factor])
        assert other == pytest.approx(first.theta, rel=1e-4)


def of_two_opinions() -> tuple[Quadratics, np.ndarray]:
    """Four runs that differ, each of three segments that come again and again."""
    runs = [
        data_of(SCALE * TRUE * [1.0, 1.0, f], n=3, seed=i) for i, f in enumerate((0.5, 1, 2, 4))
    ]
    data = joined(*[part for part in runs for _ in range(25)])
    return data, np.repeat([f"run {i}" for i in range(4)], 75).astype(object)


@pytest.mark.slow
def test_the_bootstrap_draws_whole_runs() -> None:
    data, runs = of_two_opinions()
    found = fit(data, NAMES, DEFAULTS, {}, 1.0)
    by_run = bootstrap(data, runs, found, 40)
    by_segment = bootstrap(data, np.arange(300).astype(object), found, 40)
    assert by_run.shape == (40, 3)
    assert (by_run[:, 0] == 1.0).all()
    spread, narrow = (np.log(s[:, 2]).std() for s in (by_run, by_segment))
    assert spread > 3.0 * narrow
    # Of 4 runs there are but 35 draws whose order does not matter.
    assert len(np.unique(by_run[:, 2].round(6))) <= 35
    assert np.array_equal(by_run, bootstrap(data, runs, found, 40))


def test_runs_of_which_nothing_was_kept_are_not_drawn() -> None:
    """Drawn alone, they would leave nothing to fit."""
    sound, garbage = data_of(n=40), data_of(n=10, seed=5)
    garbage = garbage._replace(gradient=1e4 + garbage.gradient)
    data, runs = joined(sound, garbage), np.array(["a"] * 40 + ["b"] * 10, dtype=object)
    found = fit(data, NAMES, DEFAULTS, {}, 0.8)
    assert not found.kept[40:].any()
    samples = bootstrap(data, runs, found, 20)
    assert samples == pytest.approx(np.tile(found.weights, (20, 1)), rel=1e-4)


def test_what_was_kept_or_fixed_stays_in_every_draw() -> None:
    data, runs = of_two_opinions()
    found = fit(data, NAMES, DEFAULTS, {"speed": 0.2}, 1.0)
    samples = bootstrap(data, runs, found, 5)
    assert samples[:, :2] == pytest.approx(np.tile([1.0, 0.2], (5, 1)))
    assert samples[:, 2].std() > 0.0
