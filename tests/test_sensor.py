"""What sensors do to records: limits in place of values, delayed channels, noise that is not
as assumed, states and samples that come twice."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.stats import norm

import ep2sindy as ep
from benchmarks.spoilt import spoilt
from ep2sindy.data.coerce import check_repeats
from ep2sindy.data.sensor import bounds_of
from ep2sindy.estimation.likelihood import TrajectoryFit, between, gram, observe
from ep2sindy.estimation.observation import (
    best_delays,
    delayed_gram,
    shift_channels,
    without_delays,
)
from ep2sindy.estimation.problem import EstimationProblem, scale_problem
from ep2sindy.systems.systems import System

LIMITS = [(-np.inf, 0.3), (0.3, np.inf), (-1.0, 0.5), (2.0, 2.5), (-9.0, -8.0), (30.0, np.inf)]


# Limits


def test_a_record_that_repeats_no_value_is_not_copied() -> None:
    values = np.random.default_rng(0).normal(size=(20_000, 6))
    tracemalloc.start()
    try:
        assert bounds_of(values, list("abcdef")) is None
        assert tracemalloc.get_traced_memory()[1] < 0.5 * values.nbytes
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("lower", "upper"), LIMITS)
def test_what_limits_say_is_the_normal_distribution_between_them(
    lower: float, upper: float
) -> None:
    mean, tells, squares = (float(v[0]) for v in between(np.array([lower]), np.array([upper])))
    # Next to its highest density there, so that far tails do not vanish.
    top = min(max(0.0, lower), upper)
    start, end = max(lower, top - 12.0), min(upper, top + 12.0)
    peak = norm.logpdf(top)
    moments = [
        quad(lambda z, k=k: z**k * np.exp(norm.logpdf(z) - peak), start, end, epsabs=0.0)[0]
        for k in range(3)
    ]
    expected = moments[1] / moments[0]
    assert mean == pytest.approx(expected, rel=1e-7)
    assert tells == pytest.approx(1.0 - (moments[2] / moments[0] - expected**2), abs=1e-6)
    assert squares == pytest.approx(-2.0 * (np.log(moments[0]) + peak), rel=1e-9)


def test_far_beyond_a_limit_it_is_as_good_as_a_value() -> None:
    mean, tells, squares = between(np.array([2e4]), np.array([np.inf]))
    assert mean[0] == pytest.approx(2e4, rel=1e-6)
    assert tells[0] == 1.0
    assert squares[0] == pytest.approx(4e8, rel=1e-6)


def clipped_problem() -> tuple[EstimationProblem, System]:
    system, run = spoilt("lorenz", "clip 80", 0, 0.02)
    return scale_problem([run], system.model.library), system


def test_residuals_next_to_limits_are_the_slope_of_what_is_least() -> None:
    problem, _ = clipped_problem()
    (record,) = problem.records
    rng = np.random.default_rng(0)
    path = record.samples + 0.4 * rng.standard_normal(record.samples.shape)
    variance, small = np.full(path.shape, 0.01), 1e-6
    here = observe(record, path, variance)
    up, down = (observe(record, path + sign * small, variance).squares for sign in (1.0, -1.0))
    slope = np.nan_to_num(-2.0 * here.residuals / here.variance)
    known = np.isfinite(here.residuals)
    assert 0 < (known & record.limits.at).sum() < record.limits.at.sum()
    np.testing.assert_allclose(
        slope[known], ((up - down) / (2 * small))[known], rtol=1e-4, atol=1e-5
    )


def test_a_clipped_top_is_found_and_values_next_to_it_stay() -> None:
    rng = np.random.default_rng(0)
    x = np.sin(np.linspace(0.0, 40.0, 500)) + 0.01 * rng.standard_normal(500)
    cut = np.column_stack([np.minimum(x, 0.9), x])
    found = bounds_of(cut, ["u", "w"])
    assert found is not None
    at = cut[:, 0] == 0.9
    assert found.words == (f"u is clipped, {at.sum()} samples at 0.9",)
    assert (found.upper[at, 0] == np.inf).all()
    np.testing.assert_array_equal(found.lower, cut)
    np.testing.assert_array_equal(found.upper[~at, 0], cut[~at, 0])
    np.testing.assert_array_equal(found.upper[:, 1], x)


def test_what_comes_to_rest_is_not_clipped() -> None:
    t = np.linspace(0.0, 100.0, 1000)
    settled = np.maximum(np.exp(-t), 1e-12)  # stays at its lowest value to the end
    switched = np.where(t < 10.0, 0.0, 1.0 - np.exp(10.0 - t))
    assert bounds_of(np.column_stack([settled, switched]), ["a", "b"]) is None


def test_in_noise_one_stretch_at_the_start_is_clipped_as_well() -> None:
    t = np.linspace(0.0, 20.0, 1000)
    x = np.exp(-0.1 * t) * np.cos(t) + 0.01 * np.random.default_rng(0).standard_normal(1000)
    found = bounds_of(np.minimum(x, 0.85)[:, None], ["x"])
    assert found is not None
    assert found.words == (f"x is clipped, {(x >= 0.85).sum()} samples at 0.85",)


@pytest.mark.parametrize("bits", [8, 12])
def test_turning_points_of_a_rounded_sine_are_not_clipped(bits: int) -> None:
    step = 2.0 / 2**bits
    t = np.linspace(0.0, 50.0, 2001)
    x = step * np.round(np.sin(t) / step)
    found = bounds_of(x[:, None], ["x"])
    assert found is None or found.words == (f"x is rounded to steps of {step:.3g}",)


def test_rounding_counts_where_it_is_coarser_than_the_noise() -> None:
    rng = np.random.default_rng(0)
    x = np.sin(np.linspace(0.0, 40.0, 1000))
    noisy = x + 0.1 * rng.standard_normal(1000)
    coarse, fine = 0.2 * np.round(x / 0.2), 0.1 * np.round(noisy / 0.1)
    found = bounds_of(np.column_stack([coarse, fine]), ["c", "f"])
    assert found is not None
    assert found.words == ("c is rounded to steps of 0.2",)
    np.testing.assert_allclose(found.upper[:, 0] - found.lower[:, 0], 0.2)
    assert ((found.lower[:, 0] - 1e-9 <= x) & (x <= found.upper[:, 0] + 1e-9)).all()


@pytest.mark.parametrize("kind", ["clip 80", "4 bits"])
def test_samples_at_their_limits_do_not_lead_astray(kind: str) -> None:
    system, run = spoilt("van_der_pol", kind, 0, 0.02)
    found = ep.discover(run, system.model.library)
    np.testing.assert_array_equal(found.model.coef != 0.0, system.model.coef != 0.0)
    assert not found.lack_of_fit
    assert any("read as limits, not as values" in each for each in found.data_warnings)
    std = np.sqrt(np.diag(found.model.covariance))  # type: ignore[arg-type]
    used = system.model.coef.T != 0.0
    off = (found.model.coef - system.model.coef).T[used] / std
    assert np.abs(off).max() < 3.5


# Delays


def late_record(delays: tuple[float, ...]) -> tuple[EstimationProblem, System]:
    """Lorenz without noise, every channel read so many steps late."""
    system = ep.lorenz()
    t = np.arange(300) / 100.0
    found = solve_ivp(
        lambda _, x: system.model.derivative(x, np.empty(0)), (0.0, 4.0), system.initial, "DOP853",
        rtol=1e-11, atol=1e-11, dense_output=True,
    )  # fmt: skip
    states = [found.sol(t + 0.5 - each / 100.0)[k] for k, each in enumerate(delays)]
    run = ep.Trajectory(t, np.stack(states, axis=1), ["x", "y", "z"])
    return scale_problem([run], system.model.library), system


def fit_of_samples(problem: EstimationProblem, system: System) -> TrajectoryFit:
    free = system.model.coef[problem.column, problem.equation] / problem.to_SI
    path = problem.all_records.samples
    return TrajectoryFit(
        problem, np.full(path.shape, 1e-2), 1e-2, path, free, free != 0.0, n_substeps=2
    )


def test_delays_are_found_to_second_order_next_to_the_true_equations() -> None:
    errors = []
    for size in (0.2, 0.1):
        delays = (0.0, size, -0.5 * size)
        problem, system = late_record(delays)
        fit = fit_of_samples(problem, system)
        fit = replace(fit, n_substeps=4)
        late = np.array([False, True, True])
        found, std = best_delays(delayed_gram(fit), fit.support, late)
        errors.append(np.abs(found - delays).max())
        assert ((std > 0.0) == late).all()
    assert errors[0] < 0.01
    assert errors[1] < 0.4 * errors[0]


def test_without_delays_the_gram_pair_is_the_plain_one() -> None:
    problem, system = late_record((0.0, 0.3, 0.0))
    fit = fit_of_samples(problem, system)
    plain, delayed = gram(fit), without_delays(delayed_gram(fit), len(fit.free))
    np.testing.assert_allclose(delayed.quadratic, plain.quadratic, rtol=1e-9)
    np.testing.assert_allclose(delayed.linear, plain.linear, rtol=1e-9, atol=1e-9)
    assert delayed.offset == pytest.approx(plain.offset)


def test_moved_samples_are_those_of_the_time_they_belong_to() -> None:
    late, _ = late_record((0.0, 1.5, -2.25))
    right, _ = late_record((0.0, 0.0, 0.0))
    (found,) = shift_channels(
        late, [r.samples for r in late.records], np.array([0.0, 1.5, -2.25])
    ).records
    assert len(found.samples) == 300 - 3 - 2  # 2.25 steps at the start, 1.5 at the end
    expected = right.records[0].samples[3:-2] * right.scale
    np.testing.assert_allclose(found.samples * late.scale, expected, atol=2e-3)


def test_a_delayed_channel_is_reported_and_brought_forward_on_request() -> None:
    system, run = spoilt("lotka_volterra", "lag 2", 0, 0.02)
    run = run.window(0, 500)
    found = ep.discover(run, system.model.library)
    assert found.lack_of_fit.startswith("y lags ")
    assert found.model.covariance is None
    aligned = ep.discover(run, system.model.library, ep.TrajectorySearch(align=True))
    np.testing.assert_array_equal(aligned.model.coef != 0.0, system.model.coef != 0.0)
    assert not aligned.lack_of_fit
    assert aligned.estimate is not None
    assert aligned.estimate.delays_s[1] == pytest.approx(2.0 * run.dt_s, rel=0.05)
    assert "brought together with the others" in aligned.data_warnings[0]


def test_the_first_channel_may_be_the_late_one() -> None:
    system, run = spoilt("lorenz", "none", 1, 0.02)
    states = np.column_stack([run.states[:-2, 0], run.states[2:, 1:]])
    late = ep.Trajectory(run.t[2:], states, run.state_names).window(0, 500)
    found = ep.estimate([late], system.model.library, align=True)
    np.testing.assert_allclose(found.delays_s / run.dt_s, [2.0, 0.0, 0.0], atol=0.1)
    np.testing.assert_array_equal(found.model.coef != 0.0, system.model.coef != 0.0)


# Noise that is not as assumed


@pytest.mark.parametrize(
    ("kind", "word"),
    [("outliers", "outliers beyond five"), ("multiplicative", "grows with"), ("AR 0.95", "lasts")],
)
def test_noise_that_is_not_as_assumed_is_reported(kind: str, word: str) -> None:
    system, run = spoilt("lotka_volterra", kind, 0, 0.02)
    found = ep.discover(run, system.model.library)
    assert any(word in each for each in found.data_warnings)


@pytest.mark.parametrize("name", ["lorenz", "van_der_pol", "lotka_volterra"])
def test_white_and_normal_noise_is_not_spoken_of(name: str) -> None:
    system, run = spoilt(name, "none", 0, 0.05)
    found = ep.discover(run, system.model.library)
    assert found.data_warnings == ()
    assert found.estimate is not None
    np.testing.assert_allclose(found.estimate.kurtosis, 3.0, atol=0.6)
    assert not found.estimate.delays_s.any()


# What came twice


def test_a_state_that_is_another_one_is_refused() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    x, y = run.states.T
    for third, words in ((x, "z is 1 x at"), (1.0 - 2.0 * y, r"z is -2 y \+1 at")):
        twice = ep.Trajectory(run.t, np.column_stack([x, y, third]), ["x", "y", "z"])
        with pytest.raises(ValueError, match=f"states must differ: {words}.*leave z out"):
            ep.discover(twice)
    nearly = ep.Trajectory(run.t, np.column_stack([x, y, x + 1e-4 * y]), ["x", "y", "z"])
    check_repeats([nearly])


def test_states_that_hang_together_but_for_their_noise_are_named() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0).window(0, 250)
    rng = np.random.default_rng(1)
    second = run.states[:, 0] + 0.02 * rng.standard_normal(run.n_samples)
    both = ep.Trajectory(run.t, np.column_stack([run.states, second]), ["x", "y", "z"])
    found = ep.discover(both, ep.polynomial(["x", "y", "z"], degree=1))
    assert any("x and z hang together: 1 x -" in each for each in found.data_warnings)


def test_samples_that_two_runs_share_are_refused() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    with pytest.raises(ValueError, match="1000 samples in a row stand in .* leave one run out"):
        ep.discover([run, run])
    with pytest.raises(ValueError, match="200 samples in a row"):
        check_repeats([run.window(0, 600), run.window(400, 900)])
    with pytest.raises(ValueError, match="100 samples in a row"):
        check_repeats([run.window(0, 600), run.window(100, 200)])
    check_repeats([run.window(0, 500), run.window(500, 1000)])
