"""Smoother for positive signals: the logarithm is smooth, and the noise is additive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline
from scipy.linalg import cholesky_banded, solveh_banded

from ep2sindy.data.numbers import least_beside_grid
from ep2sindy.data.trajectory import check_time
from ep2sindy.runtime.values import read_only
from ep2sindy.signals.kalman import check_memory_bounds, ratio_bounds
from ep2sindy.signals.wiener import third_differences

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

    log: Float[np.ndarray, " samples"]
    rate: Float[np.ndarray, " samples"]
    noise_std: float
    log10_ratio: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "log", read_only(self.log))
        object.__setattr__(self, "rate", read_only(self.rate))

    @property
    def smoothed(self) -> Float[np.ndarray, " samples"]:
        return np.exp(self.log)


@dataclass(frozen=True)
class LogSmoother:
    """Smoother for a positive signal with additive white noise and a smooth logarithm.

    The logarithm is a twice integrated Wiener process, as in `KalmanSmoother`; the samples are
    its exponential plus noise of constant standard deviation. A sample in a trough no higher than
    the noise says little about the logarithm there and has little weight; it may be zero or
    negative. The mode of the posterior is found by the Gauss-Newton method; the ratio of process
    to measurement noise is the most likely one (Laplace's approximation).
    finest_s, coarsest_s: bounds on the memory of the process, in s, where the signal is at its
    mean, as for `KalmanSmoother`. None leaves it to the data.
    Source: Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, section 3.4.
    """

    finest_s: float | None = None
    coarsest_s: float | None = None

    def __post_init__(self) -> None:
        check_memory_bounds(self.finest_s, self.coarsest_s)

    def estimate(
        self, t: Float[np.ndarray, " samples"], x: Float[np.ndarray, " samples"]
    ) -> LogEstimate:
        """Smooth samples of a signal that is positive apart from noise; steps may be unequal.

        Raises ValueError for fewer than eight samples, or a mean that is not positive.
        """
        _check(t, x)
        step_s = (t[-1] - t[0]) / (len(t) - 1)
        mean = float(x.mean())
        y, penalty = x / mean, _roughness(np.diff(t) / step_s)
        limits = (LOG10_RATIO_MIN, LOG10_RATIO_MAX)
        ratio, found = _best_mode(
            y, penalty, *ratio_bounds(self.finest_s, self.coarsest_s, step_s, limits)
        )
        log = found.log + np.log(mean)
        return LogEstimate(
            log=log,
            rate=make_interp_spline(t, log, k=5).derivative()(t),
            noise_std=mean * float(np.sqrt(found.squares / (len(y) - 3))),
            log10_ratio=ratio,
        )


@dataclass(frozen=True, eq=False)
class _Mode:
    """Mode of the posterior for one ratio.

    log: (samples,). squares: residual sum of squares plus roughness penalty. misfit: -2 log
    likelihood.
    """

    log: np.ndarray
    squares: float
    misfit: float


def _best_mode(
    y: np.ndarray, penalty: np.ndarray, lowest: float, highest: float
) -> tuple[float, _Mode]:
    """Ratio of greatest likelihood, and the mode of the posterior for it.

    y: in units of its mean. The decades go down from the highest ratio, and each search for a mode
    starts from the previous mode.
    """
    decades = np.append(np.arange(highest, lowest, -1.0), lowest)
    modes, log = [], np.log(np.maximum(y, FLOOR))
    for decade in decades:
        modes.append(_mode(y, penalty, decade, log))
        log = modes[-1].log
    misfits = np.array([mode.misfit for mode in modes])
    start = modes[int(misfits.argmin())].log
    ratio = least_beside_grid(
        lambda ratio: _mode(y, penalty, ratio, start).misfit,
        decades,
        misfits,
        tolerance=LOG10_RATIO_TOLERANCE,
    )
    return ratio, _mode(y, penalty, ratio, start)


def _mode(y: np.ndarray, penalty: np.ndarray, log10_ratio: float, log: np.ndarray) -> _Mode:
    """Most likely logarithm for one ratio, by damped Gauss-Newton steps."""
    prior = penalty * 10.0**-log10_ratio
    squares = _squares(y, prior, log)
    for _ in range(MAX_ITER):
        value = np.exp(log)
        curvature = _with_weights(prior, np.square(value))
        step = solveh_banded(curvature, value * (y - value) - _times(prior, log), lower=True)
        share = min(1.0, 2.0 / max(np.abs(step).max(), 1e-300))
        while (tried := _squares(y, prior, log + share * step)) > squares and share > 1e-6:
            share *= 0.5
        if tried > squares:
            break
        log, gained, squares = log + share * step, squares - tried, tried
        if gained <= TOLERANCE * squares:
            break
    factor = cholesky_banded(_with_weights(prior, np.exp(2.0 * log)), lower=True)
    n = len(y) - 3
    squares = max(squares, n * ROUNDING)
    misfit = n * np.log(squares) + 2.0 * np.log(factor[0]).sum() + n * np.log(10.0) * log10_ratio
    return _Mode(log, squares, float(misfit))


def _squares(y: np.ndarray, prior: np.ndarray, log: np.ndarray) -> float:
    with np.errstate(over="ignore"):  # a step that is too long overflows, and is then halved
        return float(np.square(y - np.exp(log)).sum() + log @ _times(prior, log))


def _roughness(steps: np.ndarray) -> np.ndarray:
    """Lower diagonals of the matrix of the integral of the squared third derivative.

    The matrix is a quadratic form of the samples. It is built from third divided differences, each
    weighted by a third of the span of its four samples.

    steps: (samples - 1,) in mean steps. Returns (4, samples).
    """
    n = len(steps) - 2
    weights = third_differences(steps) * np.sqrt((steps[:-2] + steps[1:-1] + steps[2:]) / 3.0)
    diagonals = np.zeros((4, n + 3))
    for lower in range(4):
        for k in range(4 - lower):
            diagonals[lower, k : k + n] += weights[k] * weights[k + lower]
    return diagonals


def _with_weights(diagonals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Banded matrix with weights added to its main diagonal."""
    found = diagonals.copy()
    found[0] += weights
    return found


def _times(diagonals: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Product of a symmetric banded matrix and a vector."""
    product = diagonals[0] * x
    for k in range(1, len(diagonals)):
        product[k:] += diagonals[k, :-k] * x[:-k]
        product[:-k] += diagonals[k, :-k] * x[k:]
    return product


def _check(t: np.ndarray, x: np.ndarray) -> None:
    if len(t) < MIN_SAMPLES or len(x) != len(t):
        raise ValueError(
            f"smoothing needs {MIN_SAMPLES} samples or more, one per time: {len(x)} came with "
            f"{len(t)} times; join more data"
        )
    check_time(t)
    if not x.mean() > 0.0:
        raise ValueError(
            f"a signal must be positive for its logarithm to be taken: its mean is {x.mean():.3g}; "
            "take its derivative instead (ep.signals.Rate)"
        )
