"""Smoothers that smooth sampled states and differentiate them; that of Kalman tells their noise.

Its signal is a twice integrated Wiener process in white noise: its third derivative is white noise
of density `ratio`, in units in which the measurement noise has variance one and steps are of order
one. The start is diffuse: of the samples only the third differences count, which no parabola has.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import make_interp_spline
from scipy.linalg.lapack import dgbtrf, dgbtrs, dpbtrf, dtbtrs

from ep2sindy.data.numbers import least_beside_grid, zero_to_one
from ep2sindy.data.trajectory import check_time
from ep2sindy.runtime.values import Columns, Samples, check_positive, read_only
from ep2sindy.signals.spectrum import is_uniform

# The range extends from a memory of about 200 samples to interpolation.
LOG10_RATIO_MIN, LOG10_RATIO_MAX = -14.0, 4.0

# Finer than data can determine: over 1000 samples the most likely ratio scatters by 0.03 or more.
LOG10_RATIO_TOLERANCE = 0.01

# Three samples determine a parabola; at least two more are needed to tell noise from signal.
MIN_SAMPLES = 5

# Variance of the rounding errors of values scaled to unit range; less noise cannot be detected.
ROUNDING = np.finfo(np.float64).eps ** 2

# Steps shorter than this fraction of a unit count as that long; divided differences of samples that
# are closer together lose their digits.
CLOSEST = 1e-6

# Least ratio, times the sixth power of the shortest step, for likelihoods by D D' + ratio Q as it
# is: about the inverse of its condition. There logarithms of likelihoods err by 0.01 at most.
WELL_CONDITIONED = 5e-11

WIDTH = 5  # of the band on either side of the diagonal

BLOCK = 262_144  # samples that are differentiated at once

ByColumn = Float[np.ndarray, " columns"]


@runtime_checkable
class Smoother(Protocol):
    """Interface of the smoothers: smoothed samples, and their time derivative."""

    def smooth(self, t: Samples, values: Columns) -> Columns: ...

    def derivative(self, t: Samples, values: Columns) -> Columns: ...


def difference(t: Samples, values: Columns) -> Columns:
    """Second-order finite differences, exact for parabolas, also at unequal steps and the ends."""
    if len(t) < 3:
        raise ValueError(f"second-order differences need three samples or more, got {len(t)}")
    found = np.empty(values.shape)
    for start in range(0, len(t), BLOCK):  # differences hold several copies
        first = max(start - 2, 0)
        some, own = slice(first, start + BLOCK + 1), slice(start, start + BLOCK)
        part = np.gradient(values[some], t[some], axis=0, edge_order=2)
        found[own] = part[start - first :][:BLOCK]
    return found


@dataclass(frozen=True)
class NoSmoothing:
    """Use the samples unchanged, for data without noise."""

    def smooth(self, t: Samples, values: Columns) -> Columns:
        return values

    def derivative(self, t: Samples, values: Columns) -> Columns:
        return difference(t, values)


@dataclass(frozen=True)
class SavitzkyGolay:
    """Fit a least-squares polynomial over a window of samples around every sample.

    The derivative is the second-order difference of the smoothed samples (the thesis's
    "smoothed finite difference"). Near the ends the first and the last full window are used. With
    unequal steps the polynomial is fitted to the actual times.

    Parameters
    ----------
    window : int, default 11
        Number of samples in a window, odd.
    order : int, default 3
        Degree of the polynomial, below the window.

    Raises
    ------
    ValueError
        Unless window is odd and above order.

    Notes
    -----
    At each sample i, the polynomial p of degree `order` minimises

        sum over k in the window about i: (values_k - p(t_k))^2

    Source: Savitzky & Golay 1964, doi:10.1021/ac60214a047.
    """

    window: int = 11
    order: int = 3

    def __post_init__(self) -> None:
        if self.window % 2 == 0 or not 0 <= self.order < self.window:
            raise ValueError(
                "a Savitzky-Golay window must be odd and longer than its order, got "
                f"window={self.window}, order={self.order}"
            )

    def smooth(self, t: Samples, values: Columns) -> Columns:
        """Raises ValueError when the trajectory is shorter than the window."""
        if len(t) < self.window:
            raise ValueError(
                f"smoothing needs at least {self.window} samples (its window), got {len(t)}; "
                "shorten the window or join more data"
            )
        if is_uniform(t):
            return self._smooth_equal(values)
        return self._smooth_unequal(t, values)

    def derivative(self, t: Samples, values: Columns) -> Columns:
        return difference(t, self.smooth(t, values))

    def _smooth_equal(self, values: np.ndarray) -> np.ndarray:
        """Weighted sums over windows: each sample takes its own, those at the ends the nearest."""
        half, weights = self.window // 2, self._weights
        smoothed = np.empty(values.shape)
        for column, target in zip(values.T, smoothed.T, strict=True):
            target[half : len(values) - half] = np.correlate(column, weights[half])
        smoothed[:half] = weights[:half] @ values[: self.window]
        smoothed[len(values) - half :] = weights[half + 1 :] @ values[len(values) - self.window :]
        return smoothed

    @cached_property
    def _weights(self) -> Float[np.ndarray, "window window"]:
        """Weights of a window's samples; row k gives the polynomial at sample k."""
        powers = np.linspace(-1.0, 1.0, self.window)[:, None] ** np.arange(self.order + 1)
        return powers @ np.linalg.pinv(powers)

    def _smooth_unequal(self, t: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Fit the window around each sample in scaled time; the nearest full one at the ends."""
        first = np.clip(np.arange(len(t)) - self.window // 2, 0, len(t) - self.window)
        window_t = sliding_window_view(t, self.window)[first] - t[:, None]
        window_t = window_t / np.abs(window_t).max(axis=1, keepdims=True)
        powers = window_t[:, :, None] ** np.arange(self.order + 1)
        # Row 0 of the pseudo-inverse gives the constant: the polynomial at the sample itself.
        weights = np.linalg.pinv(powers)[:, 0]
        windows = sliding_window_view(values, self.window, axis=0)[first]
        return np.einsum("sw,scw->sc", weights, windows)


@dataclass(frozen=True, eq=False)
class WienerProcess:
    """Third differences D of samples at given times, and their covariance D D' + ratio Q.

    differences: (4, n - 3), weights of samples i to i + 3 in difference i, of unit norm. by_noise,
    by_process: (4, n - 3), D D' and Q, of difference i + k with difference i.

    The noise e that the samples x hold solves e = D' c, (D D' + ratio Q) c = D x. The matrix in
    brackets has lost half of the digits, which is too much for smooth signals and crowded samples.
    Then both are solved at once, for e and s c with s = sqrt(ratio): e - D'/s (s c) = 0 and
    D/s e + Q (s c) = D x / s. With e and c in turn this is a band.
    Source: Wahba 1978, doi:10.1111/j.2517-6161.1978.tb01050.x; Green & Silverman 1994,
    Nonparametric Regression and Generalized Linear Models, section 2.3, for D and Q.
    """

    steps: Float[np.ndarray, " steps"]
    differences: Float[np.ndarray, "four differences"]
    by_noise: Float[np.ndarray, "four differences"]
    by_process: Float[np.ndarray, "four differences"]

    @staticmethod
    def at(steps: Float[np.ndarray, " steps"], *, lumped: bool = False) -> WienerProcess:
        """The process at samples with these steps between them.

        lumped: whether Q is replaced by the diagonal matrix of its row sums, so that the inverse of
        Q is the roughness, the integral of the squared third derivative.
        """
        steps = np.maximum(steps, CLOSEST)
        weights, by_process = _third_differences(steps), _covariance(steps)
        if lumped:
            by_process[0], by_process[1:] = 3.0 / (steps[:-2] + steps[1:-1] + steps[2:]), 0.0
        n, norms = weights.shape[1], np.sqrt(np.square(weights).sum(axis=0))
        weights /= norms
        by_noise = np.zeros_like(by_process)
        for k in range(min(4, n)):
            by_process[k, : n - k] /= norms[k:] * norms[: n - k]
            by_noise[k, : n - k] = (weights[k:, : n - k] * weights[: 4 - k, k:]).sum(axis=0)
        return WienerProcess(steps, weights, by_noise, by_process)

    def likelihood(self, values: Columns, ratio: float) -> tuple[ByColumn, ByColumn]:
        """Log-likelihood of each column's third differences, and the variance of its noise.

        The variance of the measurement noise is profiled out: its most likely value is returned. A
        constant that depends on neither the values nor the ratio is left out.
        """
        if ratio * self.steps.min() ** 6 > WELL_CONDITIONED:
            band = self.by_noise + ratio * self.by_process
            factor, info = dpbtrf(band, lower=True, overwrite_ab=True)
            assert info == 0
            white = dtbtrs(factor, self._differences_of(values), uplo="L")[0]
            squares, logs = np.square(white).sum(axis=0), 2.0 * np.log(factor[0]).sum()
        else:
            _, squares, logs = self.solve(values, ratio)
        n = self.differences.shape[1]
        noise = np.maximum(squares / n, ROUNDING)
        return -0.5 * (n * np.log(noise) + logs), noise

    def signal(self, values: Columns, ratio: float) -> Columns:
        """The signal given all samples: the quintic smoothing spline."""
        return values - self.solve(values, ratio)[0]

    def roughness(self, signal: Samples) -> float:
        """Squares of a signal's third differences over their variances, for a lumped Q."""
        third = self._differences_of(signal[:, None])[:, 0]
        return float((np.square(third) / self.by_process[0]).sum())

    def slope(self, signal: Columns) -> Columns:
        """Slope of a signal given all samples, whose third and fourth derivative end at zero."""
        nothing, t = np.zeros(signal.shape[1]), np.append(0.0, np.cumsum(self.steps))
        ends = [(3, nothing), (4, nothing)]
        return make_interp_spline(t, signal, k=5, bc_type=(ends, ends)).derivative()(t)

    def solve(
        self,
        values: Columns,
        ratio: float,
        *,
        weights: Samples | float = 1.0,
        pull: Columns | float = 0.0,
    ) -> tuple[Columns, ByColumn, float]:
        """Noise of the samples, sum of weighted squares, and log-determinant of D D' + ratio Q.

        weights: W of the squares of the noise. pull: p in W e - D' c = -p, half the gradient that
        the squares have next to that of W e.
        """
        n, (n_samples, n_columns), root = self.differences.shape[1], values.shape, np.sqrt(ratio)
        # bands[i, j, 2 * WIDTH + k] is the entry of unknown (i, j) in the equation k further down;
        # three unknowns beyond the last difference are zero.
        bands, sides = np.zeros((n_samples, 2, 3 * WIDTH + 1)), np.zeros((n_samples, 2, n_columns))
        bands[:, 0, 2 * WIDTH], bands[n:, 1, 2 * WIDTH] = weights, 1.0
        for k, weight in enumerate(self.differences / root):
            bands[k : k + n, 0, 2 * WIDTH + 1 - 2 * k] = weight
            bands[:n, 1, 2 * WIDTH - 1 + 2 * k] = -weight
        for k, shared in enumerate(self.by_process[: min(3, n)]):
            bands[: n - k, 1, 2 * WIDTH + 2 * k] = shared[: n - k]
            bands[k:n, 1, 2 * WIDTH - 2 * k] = shared[: n - k]
        sides[:, 0], sides[:n, 1] = -np.asarray(pull), self._differences_of(values) / root
        matrix = bands.reshape(2 * n_samples, -1).T
        factor, pivots, info = dgbtrf(matrix, WIDTH, WIDTH, overwrite_ab=True)
        assert info == 0
        flat = sides.reshape(2 * n_samples, n_columns)
        solution = dgbtrs(factor, WIDTH, WIDTH, flat, pivots)[0].reshape(sides.shape)
        squares = (sides[:, 1] * solution[:, 1]).sum(axis=0)
        logs = np.log(np.abs(factor[2 * WIDTH])).sum() + n * np.log(ratio)
        return solution[:, 0], squares, float(logs)

    def _differences_of(self, values: Columns) -> Float[np.ndarray, "differences columns"]:
        n = self.differences.shape[1]
        pairs = enumerate(self.differences)
        return sum(weight[:, None] * values[k : k + n] for k, weight in pairs)


@dataclass(frozen=True, eq=False)
class KalmanEstimate:
    """Result of the Kalman smoother for samples in u, column by column.

    smoothed: in u; derivative: in u/s.
    noise_std: standard deviation of the white noise in the samples, in u.
    log10_ratio: log10 of the ratio of process to measurement noise, with the mean step as the
    unit of time.
    """

    smoothed: Columns
    derivative: Columns
    noise_std: ByColumn
    log10_ratio: ByColumn

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, read_only(getattr(self, field.name)))


@dataclass(frozen=True)
class KalmanSmoother:
    """Smoother for a twice integrated Wiener process with white noise; steps may be unequal.

    Each column has its own ratio of process to measurement noise.

    Parameters
    ----------
    log10_ratio : float, optional
        Logarithm of the ratio for all columns. None takes the most likely ratio of each column.
    finest_s : float, optional
        Shortest memory of the process in s, for the most likely ratio. Faster components count as
        noise. None sets no bound.
    coarsest_s : float, optional
        Longest memory in s. On pulses, or with few samples to a period, the likelihood has a second
        maximum where the whole signal counts as noise; this bound keeps the search away from it.
        None sets no bound.

    Raises
    ------
    ValueError
        If log10_ratio lies outside [-14, 4], or the bounds are not positive times.

    Notes
    -----
    Over signals f,

        minimise sum_i (values_i - f(t_i))^2 + (1 / ratio) integral (d^3 f / dt^3)^2 dt

    so that f, the mean of the process given all samples, is the quintic smoothing spline. The
    initial state is diffuse, so a parabola passes unchanged.

    Source: Wahba 1978, doi:10.1111/j.2517-6161.1978.tb01050.x; Durbin & Koopman 2012,
    doi:10.1093/acprof:oso/9780199641178.001.0001.

    Examples
    --------
    >>> t = np.linspace(0.0, 6.0, 301)
    >>> noisy = np.sin(t) + 0.1 * np.random.default_rng(0).normal(size=301)
    >>> found = ep.signals.KalmanSmoother().estimate(t, noisy[:, None])
    >>> bool(np.abs(found.derivative[:, 0] - np.cos(t)).max() < 0.2)
    True
    """

    log10_ratio: float | None = None
    finest_s: float | None = None
    coarsest_s: float | None = None

    def __post_init__(self) -> None:
        if not LOG10_RATIO_MIN <= (self.log10_ratio or 0.0) <= LOG10_RATIO_MAX:
            raise ValueError(
                f"log10_ratio must lie in [{LOG10_RATIO_MIN:g}, {LOG10_RATIO_MAX:g}], got "
                f"{self.log10_ratio:g}; leave it out to have the most likely one found"
            )
        check_memory_bounds(self.finest_s, self.coarsest_s)

    def estimate(self, t: Samples, values: Columns) -> KalmanEstimate:
        """Smooth every column and estimate its derivative and noise.

        `smooth` and `derivative` return parts of this result, each at the full cost.

        Parameters
        ----------
        t : (samples,) array
            Times in s.
        values : (samples, columns) array
            Samples. A constant column is returned unchanged: its noise and derivative are zero, and
            its ratio is the smoothest one unless log10_ratio is set.

        Returns
        -------
        KalmanEstimate
            The smooth signal, its derivative and the noise, by column.

        Raises
        ------
        ValueError
            If there are fewer than five samples.
        """
        steps, step_s = scale_steps(t, values, MIN_SAMPLES)
        process, spread = WienerProcess.at(steps), values.max(axis=0) - values.min(axis=0)
        columns = (values - values[0]) / zero_to_one(spread)
        signal, noise_std = np.empty(values.shape), np.empty(len(spread))
        if self.log10_ratio is None:
            limits = (LOG10_RATIO_MIN, LOG10_RATIO_MAX)
            bounds = ratio_bounds(self.finest_s, self.coarsest_s, step_s, limits)
            ratios = most_likely_ratios(process, columns, *bounds)
        else:
            ratios = np.full(len(spread), self.log10_ratio)
        for j in range(len(spread)):
            column = columns[:, [j]]
            signal[:, [j]] = process.signal(column, 10.0 ** ratios[j])
            noise_std[j] = np.sqrt(process.likelihood(column, 10.0 ** ratios[j])[1][0])
        return KalmanEstimate(
            smoothed=values[0] + spread * signal,
            derivative=spread * process.slope(signal) / step_s,
            noise_std=spread * noise_std,
            log10_ratio=ratios,
        )

    def smooth(self, t: Samples, values: Columns) -> Columns:
        """Raises ValueError for fewer than five samples."""
        return self.estimate(t, values).smoothed

    def derivative(self, t: Samples, values: Columns) -> Columns:
        """Raises ValueError for fewer than five samples."""
        return self.estimate(t, values).derivative


def ratio_bounds(
    finest_s: float | None, coarsest_s: float | None, step_s: float, limits: tuple[float, float]
) -> tuple[float, float]:
    """Least and largest log10_ratio at which the memory of the process lies within its bounds.

    If the bounds contradict each other, the signal is followed: `coarsest_s` holds.
    """
    lowest, highest = limits
    if coarsest_s is not None:
        lowest = float(np.clip(6.0 * np.log10(step_s / coarsest_s), *limits))
    if finest_s is not None:
        highest = float(np.clip(6.0 * np.log10(step_s / finest_s), *limits))
    return lowest, max(lowest, highest)


def most_likely_ratios(
    process: WienerProcess,
    columns: Columns,
    lowest: float = LOG10_RATIO_MIN,
    highest: float = LOG10_RATIO_MAX,
) -> ByColumn:
    """log10 of the noise ratio of greatest likelihood for each column, within bounds."""
    if not columns.shape[1]:
        return np.empty(0)  # LAPACK takes no empty right-hand sides

    def cost(j: int, log10_ratio: float) -> float:
        return -float(process.likelihood(columns[:, [j]], 10.0**log10_ratio)[0][0])

    decades = np.append(np.arange(lowest, highest, 1.0), highest)
    # One factorisation of a decade serves all columns.
    on_grid = np.array([-process.likelihood(columns, 10.0**decade)[0] for decade in decades])
    beside = partial(least_beside_grid, tolerance=LOG10_RATIO_TOLERANCE)
    return np.array([beside(partial(cost, j), decades, own) for j, own in enumerate(on_grid.T)])


def check_memory_bounds(finest_s: float | None, coarsest_s: float | None) -> None:
    """Raise ValueError for bounds on a smoother's memory that are no positive times."""
    for name, value in {"finest_s": finest_s, "coarsest_s": coarsest_s}.items():
        if value is not None:
            check_positive(name, value)


def scale_steps(
    t: Samples, values: Float[np.ndarray, "samples ..."], least: int
) -> tuple[Float[np.ndarray, " steps"], float]:
    """Time steps in units of their mean, and that mean in s.

    Raises ValueError for fewer than the least number of samples, or not one row of values per time.
    """
    if len(t) < least or len(values) != len(t):
        raise ValueError(
            f"smoothing needs at least {least} samples, one row of values per time, got "
            f"{len(values)} rows with {len(t)} times; join more data"
        )
    check_time(t)
    step_s = float(t[-1] - t[0]) / (len(t) - 1)
    return np.diff(t) / step_s, step_s


def _third_differences(steps: Float[np.ndarray, " steps"]) -> Float[np.ndarray, "four differences"]:
    """Weights of four successive samples in their third derivative, by divided differences."""
    one, two, three = steps[:-2], steps[1:-1], steps[2:]
    before, after, whole = one + two, two + three, one + two + three
    return 6.0 * np.stack(
        [
            -1.0 / (one * before * whole),
            1.0 / (one * two * after),
            -1.0 / (before * two * three),
            1.0 / (whole * after * three),
        ]
    )


def _covariance(steps: Float[np.ndarray, " steps"]) -> Float[np.ndarray, "four differences"]:
    """Covariance of the third differences of a process whose third derivative is white.

    A difference is the mean of the third derivative under a quadratic B-spline over its three
    steps. Products of two are of degree four, so three Gauss nodes a step integrate them.
    """
    nodes, gauss = np.polynomial.legendre.leggauss(3)
    x, y = 0.5 * (1.0 + nodes), 0.5 * (1.0 - nodes)
    one, two, three = steps[:-2, None], steps[1:-1, None], steps[2:, None]
    before, after, whole = one + two, two + three, one + two + three
    middle = (one + two * x) * y / before + (three + two * y) * x / after
    splines = np.stack([one * x**2 / before, middle, three * y**2 / after]) * 3.0 / whole
    weights = 0.5 * gauss * np.stack([one, two, three])
    covariance = np.zeros((4, len(one)), order="F")  # as LAPACK takes it
    for k in range(min(3, len(one))):  # difference i + k begins where step k of i does
        n = len(one) - k
        products = splines[k:, :n] * splines[: 3 - k, k:] * weights[k:, :n]
        covariance[k, :n] = products.sum(axis=(0, 2))
    return covariance
