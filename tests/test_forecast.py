"""Forecasts: starts from the past alone, bands that hold what they say, and baselines."""

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.numbers import quantiles
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.likelihood import linearise
from ep2sindy.forecasting.forecast import _width, calibrate
from ep2sindy.forecasting.state_estimation import tune_estimator
from ep2sindy.model.draws import draw_coef, draw_normal, draw_runs
from tests.models import model_of

LINEAR = ep.polynomial(["x", "v"], degree=1)
SPRING = ep.SparseModel(LINEAR, ["x", "v"], ep.model.coef_matrix(LINEAR, [{"v": 1.0}, {"x": -1.0}]))
LORENZ = ep.lorenz()
DRIVEN = model_of({"x": {"v": 1.0}, "v": {"x": -1.0, "v": -0.3, "u": 1.0}}, ["u"])


@cache
def spring(noise: float, *, process_noise: float = 0.0, n: int = 1200, seed: int = 0) -> Trajectory:
    """The exact spring, at steps of 0.1 s, with process noise of the speed at every step."""
    rng, h = np.random.default_rng(seed), 0.1
    turn = np.array([[np.cos(h), np.sin(h)], [-np.sin(h), np.cos(h)]])
    states = [np.array([1.0, 0.0])]
    for _ in range(n - 1):
        states.append(turn @ states[-1] + [0.0, process_noise * rng.standard_normal()])
    samples = np.array(states) + noise * rng.standard_normal((n, 2))
    return Trajectory(h * np.arange(n), samples, ("x", "v"))


@pytest.fixture
def few_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bands are calibrated by few forecasts, for tests that look at none."""
    monkeypatch.setattr(sys.modules[calibrate.__module__], "N_STARTS", 10)


@pytest.mark.parametrize(("noise", "process_noise"), [(0.1, 0.0), (0.05, 0.02)])
def test_noise_and_process_noise_are_those_of_the_record(noise, process_noise) -> None:
    estimator = tune_estimator(SPRING, spring(noise, process_noise=process_noise, n=3000))
    # The standard error of either is a hundredth or two of it.
    assert estimator.noise.samples == pytest.approx([noise, noise], rel=0.1)
    if process_noise:
        assert estimator.noise.process[1] == pytest.approx(process_noise, rel=0.15)
    else:
        assert estimator.noise.process.max() < 0.1 * noise


def test_a_start_is_the_kalman_filter_of_the_window() -> None:
    """For a linear model the fitted state is the least-squares fit of the window's samples."""
    run = spring(0.1)
    estimator = tune_estimator(SPRING, run)
    end = estimator.filter(run.window(0, 800))
    n = estimator.memory
    age = run.t[799] - run.t[800 - n : 800]
    rows = np.stack(
        [np.column_stack([np.cos(age), -np.sin(age)]), np.column_stack([np.sin(age), np.cos(age)])]
    ).reshape(2 * n, 2)
    fit = np.linalg.lstsq(rows, run.states[800 - n : 800].T.ravel(), rcond=None)[0]
    assert end.mean == pytest.approx(fit, abs=2e-3)  # the process noise is small, not zero
    expected = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))) * estimator.noise.samples
    assert np.sqrt(np.diag(end.covariance)) == pytest.approx(expected, rel=0.1)


@pytest.mark.usefixtures("few_starts")
def test_nothing_but_the_past_enters() -> None:
    run = LORENZ.trajectory(noise=0.05, rng=0).window(0, 900)
    changed = run.states.copy()
    changed[600:] = changed[600:][::-1]
    other = replace(run, states=changed)
    ours, theirs = (
        ep.forecast(LORENZ.model, each.window(0, 600), 0.5, n_draws=20) for each in (run, other)
    )
    np.testing.assert_array_equal(ours.draws, theirs.draws)
    skills = [
        ep.model.forecast_skill(LORENZ.model, each, n_fitted=600, starts=1, horizon_s=0.2)
        for each in (run, other)
    ]
    np.testing.assert_array_equal(skills[0].example.states, skills[1].example.states)


@pytest.mark.slow
@pytest.mark.parametrize(("system", "noise"), [(ep.lorenz(), 0.05), (ep.lotka_volterra(), 0.2)])
def test_bands_hold_what_they_say(system, noise) -> None:
    run = system.trajectory(noise=noise, rng=1)
    n = round(0.75 * run.n_samples)
    skill = ep.model.forecast_skill(system.model, run, n_fitted=n, starts=20)
    assert 0.85 <= skill.coverage_90 <= 0.95
    assert (skill.nrmse["model"] < skill.nrmse["autoregression"]).mean() > 0.9
    furthest = skill.horizons_s[-1] / skill.period_s
    assert skill.better_periods == pytest.approx((0.0, furthest), rel=1e-9)
    assert skill.summary()["horizons_periods"][-1] == pytest.approx(furthest, rel=1e-9)
    assert skill.text.startswith("better than an autoregression up to ")


@pytest.mark.slow
def test_bands_grow_where_the_record_is_moved_by_process_noise() -> None:
    run = spring(0.02, process_noise=0.05)
    low, high = ep.forecast(SPRING, run, 30.0).band()
    width = (high - low)[:, 0]
    assert width[-20:].mean() > 3.0 * width[:5].mean()
    # Pushes that make the second record grow throughout, by chance, cost it its band.
    runs = (spring(0.02, process_noise=0.05, seed=seed) for seed in (0, 2, 3))
    held = [
        ep.model.forecast_skill(SPRING, run, n_fitted=900, starts=30).coverage_90 for run in runs
    ]
    assert 0.82 <= np.mean(held) <= 0.97  # 300 samples are few where process noise lasts


def driven_spring(n: int = 1200) -> Trajectory:
    """A damped spring under random perturbations by an input which nobody could foresee."""
    rng, t = np.random.default_rng(3), 0.1 * np.arange(n)
    u = np.repeat(rng.standard_normal(n // 20), 20)
    run = DRIVEN.simulate(t, [1.0, 0.0], inputs={"u": u})
    noisy = run.states + 0.05 * rng.standard_normal((n, 2))
    return Trajectory(t, noisy, ("x", "v"), u[:, None], ("u",))


@pytest.mark.slow
def test_inputs_are_known_ahead_to_model_and_autoregression() -> None:
    run = driven_spring()
    skill = ep.model.forecast_skill(DRIVEN, run, n_fitted=900, starts=20)
    assert skill.better is not None
    assert skill.nrmse["model"].max() < 0.15
    assert skill.nrmse["autoregression"][-1] < 0.5 * skill.nrmse["neighbours"][-1]
    assert 0.8 <= skill.coverage_90 <= 0.97
    own = ep.forecast(DRIVEN, run.window(0, 900), 5.0, inputs={"u": run.inputs[899:950, 0]})
    assert np.abs(own.states - run.states[900:950]).max() < 0.4
    with pytest.raises(ValueError, match="this model is driven by"):
        ep.forecast(DRIVEN, run.window(0, 900), 5.0)


def test_bands_are_as_wide_as_forecasts_of_the_past_were_off() -> None:
    """A model whose spring is too stiff is off by its phase, which its own draws do not show."""
    stiff = replace(SPRING, coef=SPRING.coef * np.where(SPRING.coef < 0.0, 1.1, 1.0))
    run = spring(0.05)
    fitted = run.window(0, 900)
    bare = tune_estimator(stiff, fitted)
    quiet = replace(bare, noise=replace(bare.noise, process=1e-3 * bare.noise.process))
    skills = [
        ep.model.forecast_skill(stiff, run, n_fitted=900, starts=20, estimator=estimator)
        for estimator in (quiet, calibrate(quiet, fitted))
    ]
    assert skills[0].coverage_90 < 0.6
    assert 0.82 <= skills[1].coverage_90 <= 0.96
    assert skills[1].example.width[-1, 0] > 3.0


@pytest.mark.slow
def test_widths_are_the_same_however_often_and_in_what_unit_they_are_asked_for() -> None:
    run = spring(0.05, process_noise=0.02).window(0, 400)
    once, again = (calibrate(tune_estimator(SPRING, run), run).widths for _ in range(2))
    np.testing.assert_array_equal(once.widths, again.widths)
    scaled = replace(run, states=1e-3 * run.states)
    other = calibrate(tune_estimator(SPRING, scaled), scaled).widths
    np.testing.assert_allclose(other.widths, once.widths, rtol=0.05)


@pytest.mark.parametrize("n_groups", [5, 40])
def test_a_width_is_that_of_a_normal_variable_estimated_from_few(n_groups) -> None:
    """Of groups of starts that share one distance, it holds as many others as it should."""
    rng, held = np.random.default_rng(n_groups), []
    for _ in range(400):
        off = np.repeat(np.abs(rng.standard_normal(n_groups)), 40 // n_groups)
        held.append(np.abs(rng.standard_normal(2000)) <= _width(off[:, None] * np.ones(4)))
    assert np.mean(held) == pytest.approx(0.9, abs=0.03)


def test_no_band_is_shown_where_none_can_be_estimated() -> None:
    few = spring(0.05).window(0, 9)
    ahead = ep.forecast(SPRING, few, 1.0)
    assert np.isnan(ahead.band()).all()
    assert np.isfinite(ahead.states).all()
    skill = ep.model.forecast_skill(SPRING, spring(0.05).window(0, 20), n_fitted=9)
    assert np.isnan(skill.coverage_90)
    damped = model_of({"x": {"v": 1.0}, "v": {"x": -1.0, "v": -0.05}})
    t = 0.1 * np.arange(600)
    noise = 0.01 * np.random.default_rng(0).standard_normal((600, 2))
    run = Trajectory(t, damped.simulate(t, [1.0, 0.0]).states + noise, ("x", "v"))
    # Of what decays, later errors are not those of the past.
    assert np.isnan(ep.model.forecast_skill(damped, run, n_fitted=450).coverage_90)


def test_a_state_that_was_not_measured_is_fitted_by_the_model() -> None:
    run = spring(0.05)
    nothing = 0.3 + 1e-3 * np.sin(run.t)
    blind = replace(run, states=np.column_stack([run.states[:, 0], nothing]))
    estimator = tune_estimator(SPRING, blind, measured=["x"])
    assert np.isnan(estimator.noise.samples[1])
    truth = [np.cos(run.t[-1]), -np.sin(run.t[-1])]
    assert estimator.filter(blind).mean == pytest.approx(truth, abs=0.05)


def test_draws_have_the_covariance_that_was_asked_for() -> None:
    rng = np.random.default_rng(0)
    covariance = np.array([[4e20, 1e10], [1e10, 1.0]])
    draws = draw_normal(np.array([1e12, 0.0]), covariance, 20_000, rng)
    np.testing.assert_allclose(np.cov(draws.T) / covariance, 1.0, atol=0.05)
    model = replace(SPRING, covariance=np.diag([0.01, 0.04]))
    coef = draw_coef(model, model.covariance, 5000, rng)
    assert coef[:, LINEAR.index("v"), 0].std() == pytest.approx(0.1, rel=0.05)
    assert coef[:, LINEAR.index("x"), 1].std() == pytest.approx(0.2, rel=0.05)
    assert np.count_nonzero(coef[0]) == 2


def test_draws_move_no_more_than_their_covariance() -> None:
    """Of equal correlations the eigenvectors are any that rounding makes of them, as by a unit."""
    covariance = np.full((5, 5), 0.3) + 0.7 * np.eye(5)
    rounding = 1e-12 * np.random.default_rng(0).standard_normal((5, 5))
    here, there = (
        draw_normal(np.zeros(5), each, 3, np.random.default_rng(1))
        for each in (covariance, covariance + rounding + rounding.T)
    )
    np.testing.assert_allclose(there, here, atol=1e-10)


def test_drawn_runs_are_those_of_the_solver() -> None:
    t = np.linspace(0.0, 2.0, 41)
    start = np.array([1.0, 2.0, 20.0])
    coef = draw_coef(LORENZ.model, None, 2, np.random.default_rng(0))
    runs = draw_runs(LORENZ.model, t, np.stack([start, start]), coef, reach=start)
    exact = LORENZ.model.simulate(t, start).states
    np.testing.assert_allclose(runs[0], exact, atol=2e-2)
    np.testing.assert_array_equal(runs[0], runs[1])


def test_a_simulation_shows_what_the_coefficients_leave_open() -> None:
    """x'' = -k x with k known to a part: the phase after a time t is off by t / 2 of it."""
    model = replace(SPRING, covariance=np.diag([0.0, 0.01**2]))
    t = np.linspace(0.0, 20.0, 401)
    run = model.simulate(t, [1.0, 0.0], draws=4000)
    low, high = run.band(0.95)
    zero = int(np.argmin(np.abs(t - 4.5 * np.pi)))  # where x falls through zero
    expected = 2.0 * 1.96 * 0.5 * 0.01 * t[zero]
    assert (high - low)[zero, 0] == pytest.approx(expected, rel=0.05)
    np.testing.assert_array_equal(run.states, model.simulate(t, [1.0, 0.0]).states)


def test_a_run_that_diverges_is_not_a_number_and_counts_as_such() -> None:
    library = ep.polynomial(["x"], degree=2)
    model = ep.SparseModel(library, ["x"], ep.model.coef_matrix(library, [{"x^2": 1.0}]))
    coef = draw_coef(model, None, 2, np.random.default_rng(0))
    runs = draw_runs(
        model, np.linspace(0.0, 2.0, 21), np.array([[1.0], [0.1]]), coef, reach=np.ones(1)
    )
    assert np.isnan(runs[0, -1]).all()
    assert runs[1, -1, 0] == pytest.approx(0.125, rel=1e-4)
    assert quantiles(runs, [0.5])[0, -1, 0] == pytest.approx(0.125, rel=1e-4)


def test_a_gap_is_no_obstacle() -> None:
    run = spring(0.05)
    kept = np.delete(np.arange(1200), slice(500, 560))
    gappy = Trajectory(run.t[kept], run.states[kept], run.state_names)
    skill = ep.model.forecast_skill(SPRING, gappy, n_fitted=800, starts=10)
    assert set(skill.nrmse) >= {"model", "autoregression", "neighbours"}
    assert 0.8 <= skill.coverage_90 <= 1.0


@pytest.mark.usefixtures("few_starts")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ep.forecast(SPRING, spring(0.05), [5.0, 6.0]), "after the history's end at 119.9"),
        (lambda: ep.model.forecast_skill(SPRING, spring(0.05), n_fitted=1200), "and leave four"),
        (
            lambda: ep.model.forecast_skill(SPRING, spring(0.05), n_fitted=900, horizon_s=40.0),
            "the horizon must leave room for starts, got 40 s, and 30 s are held out",
        ),
    ],
)
def test_what_cannot_be_forecast_is_refused(call, message) -> None:
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.usefixtures("few_starts")
def test_a_model_that_runs_away_forecasts_without_breaking() -> None:
    wild = replace(LORENZ.model, coef=1e6 * LORENZ.model.coef)
    run = LORENZ.trajectory(noise=0.05, rng=0).window(0, 300)
    end = tune_estimator(wild, run).filter(run)
    assert np.isfinite(end.mean).all()
    assert np.isfinite(end.covariance).all()
    with pytest.raises(ValueError, match="all 10 runs of the model diverge within 0.0033"):
        ep.forecast(wild, run, 0.05, n_draws=10)


@pytest.mark.usefixtures("few_starts")
@pytest.mark.parametrize("n", [60, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_history_of_pulses_forecasts_what_follows_however_long_it_is(n: int) -> None:
    """The square of Lorenz' x, a laser's intensity, nine samples a pulse: pulses are no noise."""
    laws = {
        "u": {"p": 20.0, "u": -20.0},  # p = x y, q = y^2
        "p": {"q": 10.0, "p": -11.0, "u": 28.0, "u*z": -1.0},
        "q": {"p": 56.0, "p*z": -2.0, "q": -2.0},
        "z": {"p": 1.0, "z": -8.0 / 3.0},
    }
    model = model_of(laws)
    full = model.simulate(0.08 * np.arange(1010), [1.0, 2.0, 4.0, 20.0]).states
    scale = full.std(axis=0)
    u = full[:1000, :1] + 0.01 * scale[0] * np.random.default_rng(0).standard_normal((1000, 1))
    end = Trajectory(0.08 * np.arange(1000 - n, 1000), u[-n:], ["u"])
    ahead = ep.forecast(model, end, 0.48, n_draws=20)
    assert np.abs((ahead.states - full[1000:1006]) / scale).max() < 0.02


@pytest.mark.slow
def test_rounded_samples_are_compared_as_they_are() -> None:
    run = spring(0.0)
    step = 0.2 * run.states.std()
    rounded = Trajectory(run.t, step * np.round(run.states / step), run.state_names)
    estimator = tune_estimator(SPRING, rounded)
    (record,) = estimator.problem.records
    assert record.limits.at.any()
    fit = estimator.fit_path(record, record.samples)
    residuals = linearise(fit).residuals
    np.testing.assert_allclose(residuals, record.samples - fit.path, rtol=1e-12)
    skill = ep.model.forecast_skill(SPRING, rounded, n_fitted=900, starts=10)
    assert np.mean(skill.nrmse["model"]) < 0.1


@pytest.mark.usefixtures("few_starts")
def test_a_history_whose_end_is_at_rest_is_forecast() -> None:
    t = np.arange(0.0, 60.0, 0.05)
    states = np.stack([np.exp(-t) * np.cos(t), -np.exp(-t) * (np.cos(t) + np.sin(t))], axis=1)
    states[400:] = 0.0
    damped = model_of({"x": {"v": 1.0}, "v": {"x": -2.0, "v": -2.0}})
    run = Trajectory(t, states, ["x", "v"])
    ahead = ep.forecast(damped, run, 1.0, fitted_to=run.window(0, 400))
    assert np.abs(ahead.states).max() < 1e-2


@pytest.mark.usefixtures("few_starts")
def test_the_noise_of_three_samples_is_not_estimated() -> None:
    few = spring(0.05).window(0, 3)
    with pytest.raises(
        ValueError, match="5 samples or more to tell its noise: got 3; pass the rec"
    ):
        ep.forecast(SPRING, few, 1.0)
    assert np.isfinite(ep.forecast(SPRING, few, 1.0, fitted_to=spring(0.05)).states).all()
