"""Periods, waveforms and their comparison: exact on signals whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import fftconvolve

import ep2sindy as ep
from ep2sindy.signals.attractor import (
    _fourier_columns,
    _moving_average,
    best_shift,
    find_cycle,
    waveform_errors,
    white_variance,
)
from ep2sindy.signals.spectrum import power_spectrum
from ep2sindy.systems.systems import lorenz

F_HZ, DT_S = 12.345, 1.5e-3


def spiky(t: np.ndarray, *, shift: float = 0.0, f_Hz: float = F_HZ) -> np.ndarray:
    """Two states of six harmonics each, mean 3 and -1."""
    phase = 2.0 * np.pi * f_Hz * t + shift
    x = 3.0 + sum(np.cos(k * phase + k**2) / k for k in range(1, 7))
    y = -1.0 + 5.0 * sum(np.sin(k * phase) / k**2 for k in range(1, 7))
    return np.column_stack([x, y])


def times(n_periods: float) -> np.ndarray:
    return DT_S * np.arange(round(n_periods / (F_HZ * DT_S)) + 1)


@pytest.mark.parametrize("n", [7, 64])
def test_averages_under_a_window_are_those_of_scipy(n: int) -> None:
    x = np.exp(1j * np.arange(301) ** 1.5)
    window = np.hanning(n)
    np.testing.assert_allclose(
        _moving_average(x, window), fftconvolve(x, window, "same"), atol=1e-12
    )


@pytest.mark.parametrize("n_periods", [6.3, 20.0, 81.7])
def test_a_waveform_of_few_harmonics_comes_back(n_periods):
    t = times(n_periods)
    cycle = find_cycle(t, spiky(t))
    assert cycle.frequency_Hz == pytest.approx(F_HZ, rel=1e-5)
    assert cycle.n_periods == pytest.approx(F_HZ * t[-1], rel=1e-2)
    orders = np.arange(1.0, 7.0)
    exact = np.array(
        [np.sqrt(0.5 * (1 / orders**2).sum()), 5 * np.sqrt(0.5 * (1 / orders**4).sum())]
    )
    np.testing.assert_allclose(cycle.std, exact, rtol=1e-4)
    np.testing.assert_allclose(cycle.mean, [3.0, -1.0], atol=1e-3)
    assert cycle.fraction == pytest.approx(1.0, abs=1e-3)
    phase = cycle.phase[::7]
    np.testing.assert_allclose(cycle.waveform(phase), spiky(t)[::7], atol=1e-2)


def test_white_noise_averages_out():
    t = times(60.0)
    rng = np.random.default_rng(0)
    clean = find_cycle(t, spiky(t))
    std = spiky(t).std(axis=0)
    noisy = find_cycle(t, spiky(t) + rng.normal(size=(len(t), 2)) * std)  # as much as signal
    assert noisy.fraction > 0.95
    assert noisy.frequency_Hz == pytest.approx(F_HZ, rel=1e-3)
    # 13 coefficients of 3240 samples: sqrt(13/3240) = 6 % of the noise.
    assert np.all(waveform_errors(clean, noisy) < 0.13)
    np.testing.assert_allclose(noisy.std, clean.std, rtol=0.06)


def test_white_variance_is_that_of_the_noise():
    t = times(60.0)
    noise = np.random.default_rng(1).normal(size=len(t))
    assert white_variance(*power_spectrum(t, 0.3 * noise)) == pytest.approx(0.09, rel=0.1)
    assert white_variance(*power_spectrum(t, spiky(t)[:, 1] + 0.3 * noise)) == pytest.approx(
        0.09, rel=0.1
    )


def test_units_and_unequal_steps_change_nothing():
    t = times(30.0)
    t = t + 0.2 * DT_S * np.random.default_rng(2).uniform(-1.0, 1.0, len(t))
    plain = find_cycle(t, spiky(t))
    scaled = find_cycle(1e-6 * t, 1e18 * spiky(t))
    assert scaled.frequency_Hz == pytest.approx(1e6 * plain.frequency_Hz, rel=1e-9)
    np.testing.assert_allclose(scaled.std, 1e18 * plain.std, rtol=1e-9)
    assert plain.frequency_Hz == pytest.approx(F_HZ, rel=1e-4)


def test_what_does_not_repeat_has_no_cycle():
    rng = np.random.default_rng(3)
    t = times(30.0)
    chaos = replace(lorenz(), duration_s=40.0).trajectory()
    decaying = np.exp(-0.4 * F_HZ * t)[:, None] * (spiky(t) - [3.0, -1.0])
    for name, (t_s, x) in {
        "chaos": (chaos.t, chaos.states),
        "noise": (t, rng.normal(size=(len(t), 1))),
        "a walk": (t, rng.normal(size=(len(t), 1)).cumsum(axis=0)),
        "a decay": (t, decaying),
        "rest": (t, np.ones((len(t), 2))),
        "rest but for rounding": (t, 1e18 * (1.0 + 1e-16 * rng.normal(size=(len(t), 1)))),
        "two periods": (t[: len(t) // 15], spiky(t)[: len(t) // 15]),
    }.items():
        assert find_cycle(t_s, x) is None, name


def test_waveforms_are_compared_at_their_best_shift():
    t = times(30.0)
    data, other = find_cycle(t, spiky(t)), find_cycle(t, spiky(t, shift=1.0))
    np.testing.assert_allclose(waveform_errors(data, other), 0.0, atol=5e-3)
    on_data = other.waveform(data.phase + best_shift(data, other))
    np.testing.assert_allclose(on_data, data.waveform(data.phase), atol=0.05)
    off = spiky(t)
    off[:, 0] += 0.5 * data.std[0]  # a mean that is off counts
    np.testing.assert_allclose(waveform_errors(data, find_cycle(t, off)), [0.5, 0.0], atol=5e-3)
    lag = np.column_stack([spiky(t)[:, 0], spiky(t, shift=0.3)[:, 1]])  # a lag between states too
    assert np.max(waveform_errors(data, find_cycle(t, lag))) > 0.1


def noisy_wave(fraction: float, *, n_periods: int = 50) -> tuple[ep.Trajectory, np.ndarray]:
    """A wave with one overtone in white noise, given in its standard deviations; and the wave."""
    t = np.linspace(0.0, float(n_periods), 40 * n_periods + 1)
    wave = 3.0 + np.cos(2.0 * np.pi * t) + 0.5 * np.sin(4.0 * np.pi * t)
    noise = fraction * wave.std() * np.random.default_rng(0).normal(size=len(t))
    inputs = np.arange(len(t), dtype=np.float64)[:, None]
    return ep.Trajectory(t, (wave + noise)[:, None], ["x"], inputs, ["u"], label="wave"), wave


def test_the_mean_cycle_is_as_certain_as_its_harmonics() -> None:
    run, wave = noisy_wave(2.0)
    found = ep.signals.mean_cycle(run)
    # Five coefficients and the frequency from n samples: the noise falls by sqrt(6 / n).
    off = (found.states[:, 0] - wave).std() / wave.std()
    assert off < 1.5 * 2.0 * np.sqrt(6.0 / run.n_samples)
    assert np.array_equal(found.inputs, run.inputs)
    assert (found.label, found.units) == ("wave", run.units)


@pytest.mark.parametrize("wander", [0.0, 1.5])
def test_a_phase_is_followed_where_it_wanders_and_not_where_noise_does(wander: float) -> None:
    t = np.linspace(0.0, 80.0, 3201)
    true = 2.0 * np.pi * t + wander * np.sin(2.0 * np.pi * t / 40.0)
    noise = np.random.default_rng(3).normal(size=len(t))
    found = find_cycle(t, (np.cos(true) + 0.7 * noise)[:, None])
    straight = np.polynomial.Polynomial.fit(t, found.phase, 1)(t)
    if not wander:
        np.testing.assert_allclose(found.phase, straight, atol=1e-9)
    off = found.phase - true
    # Noise and what eight periods smooth are left of a phase that is followed; else 1 rad would be.
    assert (off - off.mean()).std() < (0.3 if wander else 0.02)


def test_what_does_not_repeat_has_no_mean_cycle() -> None:
    run, _ = noisy_wave(1.0, n_periods=2)
    with pytest.raises(ValueError, match="repeats itself, three periods or more: wave does not"):
        ep.signals.mean_cycle(run)


@pytest.mark.parametrize("reach", [40.0, 3.0])  # in rad: over periods, and over half of one
def test_triangles_are_those_of_reflections_also_where_samples_cluster(reach: float) -> None:
    columns, triangle = _fourier_columns(np.linspace(0.0, reach, 400), 4)
    plain = np.linalg.qr(columns, mode="r")
    signs = np.sign(np.diagonal(plain) * np.diagonal(triangle))
    np.testing.assert_allclose(triangle, signs[:, None] * plain, rtol=1e-11, atol=1e-11)
