import numpy as np
import pytest
from scipy.signal import periodogram

from ep2sindy.signals import smoothers
from ep2sindy.signals.smoothers import NoSmoothing, SavitzkyGolay, difference
from ep2sindy.signals.spectrum import dominant_frequency, power_spectrum

EQUAL = np.linspace(0.0, 2.0, 41)
UNEQUAL = EQUAL + 0.02 * np.sin(9.0 * EQUAL)


@pytest.mark.parametrize("t", [EQUAL, UNEQUAL], ids=["equal", "unequal"])
def test_differences_are_exact_for_parabolas(t: np.ndarray) -> None:
    values = (3.0 * t**2 - t + 1.0)[:, None]
    assert np.allclose(difference(t, values)[:, 0], 6.0 * t - 1.0, atol=1e-12)


@pytest.mark.parametrize("n", [3, 7, 8, 9, 15, 41])
def test_blocks_of_a_long_record_have_the_differences_of_the_whole(
    n: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    values, t = np.random.default_rng(0).normal(size=(n, 2)), UNEQUAL[:n]
    monkeypatch.setattr(smoothers, "BLOCK", 7)
    whole = np.gradient(values, t, axis=0, edge_order=2)
    np.testing.assert_allclose(difference(t, values), whole, rtol=1e-12)


@pytest.mark.parametrize("t", [EQUAL, UNEQUAL], ids=["equal", "unequal"])
def test_smoothing_keeps_polynomials_of_its_order(t: np.ndarray) -> None:
    values = np.stack([t**3 - t, 2.0 - t**2], axis=1)
    assert np.allclose(SavitzkyGolay(window=11, order=3).smooth(t, values), values, atol=1e-11)


def test_unequal_steps_reduce_to_the_equal_ones() -> None:
    noise = np.random.default_rng(0).normal(size=(41, 2))
    smoother = SavitzkyGolay()
    assert np.allclose(
        smoother._smooth_unequal(EQUAL, noise), smoother.smooth(EQUAL, noise), atol=1e-12
    )


def test_edges_do_not_wrap() -> None:
    values = np.zeros((41, 1))
    values[-1] = 1.0
    assert np.array_equal(SavitzkyGolay().smooth(EQUAL, values)[:20], np.zeros((20, 1)))


def test_derivative_converges_at_second_order() -> None:
    steps = np.array([50, 100, 200, 400])
    errors = []
    for n in steps:
        t = np.linspace(0.0, 1.0, n + 1)
        slope = NoSmoothing().derivative(t, np.sin(5.0 * t)[:, None])[:, 0]
        errors.append(np.abs(slope - 5.0 * np.cos(5.0 * t)).max())
    assert -np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(("window", "order"), [(10, 3), (5, -1)])
def test_impossible_windows_are_refused(window: int, order: int) -> None:
    with pytest.raises(ValueError, match=f"odd and longer .* window={window}, order={order}"):
        SavitzkyGolay(window=window, order=order)


@pytest.mark.parametrize("stretch", [0.0, 1e-4], ids=["equal", "unequal"])
def test_dominant_frequency_is_found_between_bins(stretch: float) -> None:
    t = np.arange(4000) * 1.5e-6
    t = t + stretch * t.max() * np.sin(3e3 * t)
    tone = 2.0 + np.sin(2 * np.pi * 14.3e3 * t) + 0.3 * np.sin(2 * np.pi * 120e3 * t)
    bin_Hz = 1.0 / t[-1]
    assert dominant_frequency(t, tone) == pytest.approx(14.3e3, abs=0.02 * bin_Hz)


def test_a_constant_has_no_frequency() -> None:
    assert dominant_frequency(EQUAL, np.full(41, 3.0)) == 0.0


def test_spectrum_integrates_to_the_variance() -> None:
    t = np.arange(2000) * 1e-3
    frequency, power = power_spectrum(t, 3.0 * np.sin(2 * np.pi * 50.0 * t))
    assert np.sum(power) * frequency[1] == pytest.approx(4.5, rel=1e-3)


@pytest.mark.parametrize("n", [4, 501, 2000])
def test_a_spectrum_is_that_of_scipy(n: int) -> None:
    t = 1e-3 * np.arange(n)
    x = 7.0 + np.random.default_rng(n).standard_normal(n)
    theirs = periodogram(x, 1e3, window="hann", detrend="constant")
    for ours, other in zip(power_spectrum(t, x), theirs, strict=True):
        np.testing.assert_allclose(ours, other, rtol=1e-10, atol=1e-20)
