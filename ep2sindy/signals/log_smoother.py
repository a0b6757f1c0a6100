"""Smoother for positive signals: the logarithm is smooth, and the noise is additive."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.interpolate import make_interp_spline

from ep2sindy.data.numbers import least_beside_grid
from ep2sindy.runtime.values import Samples, read_only
from ep2sindy.signals.smoothers import WienerProcess, check_memory_bounds, ratio_bounds, scale_steps

# Range of log10 of the ratio of process to measurement noise, with the mean step as the unit of
# time and the mean as the unit of the signal: from a memory of about 30 samples to interpolation.
LOG10_RATIO_MIN, LOG10_RATIO_MAX = -9.0, 8.0

LOG10_RATIO_TOLERANCE = 0.05  # finer than data can determine

MIN_SAMPLES = 8

MAX_ITER, TOLERANCE = 50, 1e-9

ROUNDING = 1e-24  # squared rounding error of samples of order one; less noise is not detectable

FLOOR = 1e-3  # lower bound, in means of the signal, on samples whose logarithm starts the search


@dataclass(frozen=True, eq=False)
class LogEstimate:
    """Smoothed logarithm and growth rate of a positive signal, with its noise.

    log: natural logarithm of the smoothed signal in its unit. rate: time derivative of `log`, in
    1/s. noise_std: standard deviation of the white noise in the samples, in their unit.
    log10_ratio: log10 of the ratio of process to measurement noise.
    """

    log: Samples
    rate: Samples
    noise_std: float
    log10_ratio: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "log", read_only(self.log))
        object.__setattr__(self, "rate", read_only(self.rate))

    @property
    def smoothed(self) -> Samples:
        return np.exp(self.log)


@dataclass(frozen=True)
class LogSmoother:
    """Smoother for a positive signal with additive white noise and a smooth logarithm.

    A sample in a trough no higher than the noise says little about the logarithm there and has
    little weight; it may be zero or negative.

    Parameters
    ----------
    finest_s : float, optional
        Shortest memory of the process in s, where the signal is at its mean, as for
        `KalmanSmoother`. None leaves it to the data.
    coarsest_s : float, optional
        Longest memory in s.

    Raises
    ------
    ValueError
        If the bounds are not positive times.

    Notes
    -----
    Over logarithms f,

        minimise sum_i (x_i - exp f(t_i))^2 + (1 / ratio) integral (d^3 f / dt^3)^2 dt

    The logarithm is a twice integrated Wiener process, as in `KalmanSmoother`; the samples are its
    exponential plus noise of constant standard deviation. The mode of the posterior is found by the
    Gauss-Newton method, each step of which solves for a `WienerProcess` with weights; the ratio of
    process to measurement noise is the most likely one (Laplace's approximation).

    Source: Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, section 3.4.

    Examples
    --------
    >>> t = np.linspace(0.0, 6.0, 301)
    >>> noisy = np.exp(np.sin(t)) + 0.05 * np.random.default_rng(0).normal(size=301)
    >>> found = ep.signals.LogSmoother().estimate(t, noisy)
    >>> bool(np.abs(found.log - np.sin(t)).max() < 0.1)
    True
    """

    finest_s: float | None = None
    coarsest_s: float | None = None

    def __post_init__(self) -> None:
        check_memory_bounds(self.finest_s, self.coarsest_s)

    def estimate(self, t: Samples, x: Samples) -> LogEstimate:
        """Smooth samples of a signal that is positive apart from noise; steps may be unequal.

        Parameters
        ----------
        t : (samples,) array
            Times in s.
        x : (samples,) array
            Samples of the signal.

        Returns
        -------
        LogEstimate
            The logarithm and its derivative at the samples.

        Raises
        ------
        ValueError
            If there are fewer than eight samples, or the mean is not positive.
        """
        steps, step_s = scale_steps(t, x, MIN_SAMPLES)
        mean = float(x.mean())
        if not mean > 0.0:
            raise ValueError(
                f"a signal must be positive for its logarithm to be taken: its mean is {mean:.3g}; "
                'take its derivative instead, ep.embed(run, "derivative")'
            )
        y, process = x / mean, WienerProcess.at(steps, lumped=True)
        limits = (LOG10_RATIO_MIN, LOG10_RATIO_MAX)
        ratio, (_, log, squares) = _find_likeliest_mode(
            y, process, *ratio_bounds(self.finest_s, self.coarsest_s, step_s, limits)
        )
        log = log + np.log(mean)
        return LogEstimate(
            log=log,
            rate=make_interp_spline(t, log, k=5).derivative()(t),
            noise_std=mean * float(np.sqrt(squares / (len(y) - 3))),
            log10_ratio=ratio,
        )


# Mode of the posterior for one ratio: -2 log likelihood, the logarithm at every sample, and the sum
# of squared residuals and roughness penalty.
_Mode = tuple[float, np.ndarray, float]


def _find_likeliest_mode(
    y: np.ndarray, process: WienerProcess, lowest: float, highest: float
) -> tuple[float, _Mode]:
    """Ratio of greatest likelihood, and the mode of the posterior for it.

    y: in units of its mean. The decades go down from the highest ratio, and each search for a mode
    starts from the previous mode.
    """
    decades = np.append(np.arange(highest, lowest, -1.0), lowest)
    modes, log = [], np.log(np.maximum(y, FLOOR))
    for decade in decades:
        modes.append(_find_mode(y, process, decade, log))
        log = modes[-1][1]
    costs = np.array([cost for cost, *_ in modes])
    start = modes[int(costs.argmin())][1]
    ratio = least_beside_grid(
        lambda ratio: _find_mode(y, process, ratio, start)[0],
        decades,
        costs,
        tolerance=LOG10_RATIO_TOLERANCE,
    )
    return ratio, _find_mode(y, process, ratio, start)


def _find_mode(y: np.ndarray, process: WienerProcess, log10_ratio: float, log: np.ndarray) -> _Mode:
    """Most likely logarithm for one ratio, by damped Gauss-Newton steps."""
    n, ratio = len(y) - 3, 10.0**log10_ratio
    squares_at = partial(_sum_squares, y, process, ratio)
    squares = squares_at(log)
    for _ in range(MAX_ITER):
        value = np.exp(log)
        pull = value * (y - value)
        step = -process.solve(log[:, None], ratio, weights=value**2, pull=pull[:, None])[0][:, 0]
        fraction = min(1.0, 2.0 / max(np.abs(step).max(), 1e-300))
        while (tried := squares_at(log + fraction * step)) > squares and fraction > 1e-6:
            fraction *= 0.5
        if tried > squares:
            break
        log, gained, squares = log + fraction * step, squares - tried, tried
        if gained <= TOLERANCE * squares:
            break
    _, _, logs = process.solve(log[:, None], ratio, weights=np.exp(2.0 * log))
    squares = max(squares, n * ROUNDING)
    return float(n * np.log(squares) + logs), log, squares


def _sum_squares(y: np.ndarray, process: WienerProcess, ratio: float, log: np.ndarray) -> float:
    with np.errstate(over="ignore"):  # a step that is too long overflows, and is then halved
        return float(np.square(y - np.exp(log)).sum() + process.roughness(log) / ratio)
