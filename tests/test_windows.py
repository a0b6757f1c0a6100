import numpy as np
import pytest

from ep2sindy.regression.windows import (
    EDGE,
    Boxes,
    Bumps,
    WindowFunctions,
    Windows,
    bump_power,
    spectral_half_width,
)

T = np.linspace(0.0, 2.0, 401)  # steps of 5 ms


def uneven_times(n: int = 200) -> np.ndarray:
    return np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, size=n))


def windows_of(
    functions: WindowFunctions, t: np.ndarray = T, x: np.ndarray | None = None
) -> Windows:
    x = np.sin(9.0 * t) if x is None else x
    return functions.windows(t, x, rng=np.random.default_rng(1))


def half_widths(windows: Windows) -> np.ndarray:
    return (windows.last - windows.first) // 2


def test_boxes_of_two_points_are_difference_quotients_and_means_of_two() -> None:
    t = uneven_times()
    x = np.random.default_rng(2).normal(size=len(t))
    windows = windows_of(Boxes(n_windows=80, n_points=2), t)
    k = windows.first
    assert np.array_equal(windows.last, k + 1)
    assert windows.slope @ x == pytest.approx((x[k + 1] - x[k]) / (t[k + 1] - t[k]), rel=1e-12)
    assert windows.mean @ x == pytest.approx(0.5 * (x[k + 1] + x[k]), rel=1e-12)


@pytest.mark.parametrize("n_points", [2, 3, 50, 200])
def test_boxes_integrate_straight_lines_exactly_on_unequal_steps(n_points: int) -> None:
    t = uneven_times()
    windows = windows_of(Boxes(n_windows=30, n_points=n_points), t)
    middle = 0.5 * (t[windows.first] + t[windows.last])
    assert windows.mean @ (3.0 - 2.0 * t) == pytest.approx(3.0 - 2.0 * middle, rel=1e-12)
    assert windows.slope @ (3.0 - 2.0 * t) == pytest.approx(-2.0, rel=1e-12)


def test_boxes_lie_anywhere_and_in_order() -> None:
    windows = windows_of(Boxes(n_windows=3000, n_points=100))
    assert windows.mean.shape == (3000, len(T))
    assert set(windows.first) == set(range(len(T) - 99))
    assert np.all(np.diff(windows.first) >= 0)


# What is cut off at the edge: 1e-10 of the bump, but its slope there amounts to 6e-9 of the
# bump's sum at 8 samples a side, and to 1e-9 at 15 and more.
@pytest.mark.parametrize("degree", range(6))
@pytest.mark.parametrize(("half_width_s", "tolerance"), [(None, 1e-9), (0.04, 1e-8), (0.5, 1e-9)])
def test_bumps_integrate_derivatives_by_parts(
    half_width_s: float | None, tolerance: float, degree: int
) -> None:
    windows = windows_of(Bumps(half_width_s=half_width_s))
    slope = degree * T ** max(degree - 1, 0)
    largest = max(slope.max(), 1.0)
    assert windows.slope @ (T**degree) == pytest.approx(
        windows.mean @ slope, abs=tolerance * largest
    )


@pytest.mark.parametrize(
    "functions", [Bumps(), Bumps(half_width_s=0.05), Boxes(20, 2), Boxes(20, 60)], ids=repr
)
def test_constants_have_themselves_for_mean_and_no_slope(functions: WindowFunctions) -> None:
    windows = windows_of(functions)
    constant = np.full(len(T), 7.5e18)
    assert windows.mean @ constant == pytest.approx(7.5e18, rel=1e-13)
    largest = abs(windows.slope).max() * 7.5e18
    assert np.abs(windows.slope @ constant).max() < 1e-12 * largest


def test_first_and_last_are_the_samples_that_a_window_touches() -> None:
    windows = windows_of(Bumps(half_width_s=0.1))
    for k, row in enumerate(windows.mean.toarray()):
        inside = np.zeros(len(T), dtype=bool)
        inside[windows.first[k] : windows.last[k] + 1] = True
        assert not row[~inside].any()
        assert row[inside][1:-1].all()


def test_the_half_width_is_given_in_seconds_and_overlap_sets_the_stride() -> None:
    for dt_s, width in ((5e-3, 20), (1e-2, 10)):
        windows = windows_of(Bumps(half_width_s=0.1, overlap=5), np.arange(0.0, 2.0, dt_s))
        assert set(half_widths(windows)) == {width}
        assert set(np.diff(windows.first)) == {width // 5}


def test_bumps_fall_to_the_edge_one_sample_inside() -> None:
    for width in (2, 5, 17, 200):
        power = float(bump_power(width))
        value = (1.0 - (1.0 - 1.0 / width) ** 2) ** power
        assert value <= EDGE
        assert value > EDGE * (1.0 - (1.0 - 1.0 / width) ** 2)  # one power less would not do


def tones(n_samples: int, noise: float, seed: int = 0) -> np.ndarray:
    """Tones in bins 7 and 19, whatever the rate, and white noise."""
    s = np.arange(n_samples) / n_samples
    white = np.random.default_rng(seed).standard_normal(n_samples)
    return np.sin(14 * np.pi * s) + 0.7 * np.cos(38 * np.pi * s) + noise * white


@pytest.mark.parametrize("seed", range(3))
def test_twice_the_samples_make_the_automatic_width_twice_as_many(seed: int) -> None:
    slow, fast = (spectral_half_width(tones(n, 0.01, seed), tau_hat=0.7) for n in (1000, 2000))
    # The power falls with the width, and with it the spectrum's: somewhat less than twice.
    assert 1.6 < fast / slow <= 2.0


@pytest.mark.parametrize("seed", range(3))
def test_more_noise_makes_no_narrower_windows(seed: int) -> None:
    t = np.linspace(0.0, 20.0, 2000)
    ring = np.exp(-0.1 * t) * np.cos(6.0 * t) ** 3
    noise = np.random.default_rng(seed).standard_normal(len(t))
    widths = [
        spectral_half_width(ring + level * noise, tau_hat=0.7) for level in (0.001, 0.01, 0.1, 0.3)
    ]
    assert widths == sorted(widths)
    assert widths[-1] > widths[0]


def test_a_stricter_tail_makes_wider_windows() -> None:
    x = tones(1000, 0.01)
    widths = [spectral_half_width(x, tau_hat=tau_hat) for tau_hat in (0.5, 1.0, 2.0)]
    assert widths == sorted(set(widths))


def test_the_automatic_width_takes_no_unit() -> None:
    x = tones(1000, 0.01)
    assert spectral_half_width(1e18 * x + 5e18, tau_hat=0.7) == spectral_half_width(x, tau_hat=0.7)


@pytest.mark.parametrize("n_samples", [5, 8, 20])
def test_the_automatic_width_fits_short_records(n_samples: int) -> None:
    t = np.arange(float(n_samples))
    windows = windows_of(Bumps(), t, np.sin(t))
    assert len(windows.first) >= 1
    assert windows.last.max() < n_samples


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Bumps(half_width_s=0.0), "half_width_s must be positive, got 0.0"),
        (lambda: Boxes(n_points=1), "n_points must be a whole number, two or more, got 1"),
    ],
)
def test_impossible_settings_are_refused(build: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()  # type: ignore[operator]


@pytest.mark.parametrize(
    ("functions", "message"),
    [
        (Bumps(half_width_s=1.1), "441 samples were asked of 401; lower half_width_s"),
        (Boxes(n_points=402), "402 samples were asked of 401; lower n_points or use more data"),
    ],
)
def test_windows_that_do_not_fit_are_refused(functions: WindowFunctions, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        windows_of(functions)
