"""Samples of a twice integrated Wiener process in white noise: likelihood, signal and slope.

The third derivative of the signal is white noise of density `ratio`, in units in which the
measurement noise has variance one and steps are of order one. The start is diffuse: of the samples
only the third differences count, which no parabola has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline
from scipy.linalg.lapack import dgbtrf, dgbtrs
from scipy.optimize import minimize_scalar

# Variance of the rounding errors of values scaled to unit range; less noise cannot be detected.
ROUNDING = np.finfo(np.float64).eps ** 2

# Steps shorter than this share of a unit count as that long; divided differences of samples that
# are closer together lose their digits.
CLOSEST = 1e-6

WIDTH = 5  # of the band on either side of the diagonal

NATURAL = [(3, 0.0), (4, 0.0)]  # derivatives of the spline at its ends


@dataclass(frozen=True, eq=False)
class WienerProcess:
    """Third differences of samples at given times, and their covariance by the process.

    differences: (4, n - 3), weights of samples i to i + 3 in difference i, of unit norm.
    covariance: (3, n - 3), of difference i + k with difference i, at a ratio of one.

    With differences D and covariance Q, the noise e that the samples x hold solves
    e = D' c, (D D' + ratio Q) c = D x. The matrix in brackets would lose half of the digits, so
    both are solved at once, for e and c / s with s = sqrt(ratio):
    e - D'/s c = 0, D/s e + Q c = D x / s. With e and c in turn this is a band.
    Source: Wahba 1978, doi:10.1111/j.2517-6161.1978.tb01050.x; Green & Silverman 1994,
    Nonparametric Regression and Generalized Linear Models, section 2.3, for D and Q.
    """

    steps: Float[np.ndarray, " steps"]
    differences: Float[np.ndarray, "four differences"]
    covariance: Float[np.ndarray, "three differences"]

    @staticmethod
    def at(steps: Float[np.ndarray, " steps"]) -> WienerProcess:
        steps = np.maximum(steps, CLOSEST)
        weights, covariance = third_differences(steps), _covariance(steps)
        norms = np.sqrt(np.square(weights).sum(axis=0))
        for k in range(3):
            covariance[k, : len(norms) - k] /= norms[k:] * norms[: len(norms) - k]
        return WienerProcess(steps, weights / norms, covariance)

    def likelihood(
        self, values: Float[np.ndarray, "samples columns"], ratio: float
    ) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, " columns"]]:
        """Log-likelihood of each column's third differences, and the variance of its noise.

        The variance of the measurement noise is profiled out: its most likely value is returned. A
        constant that depends on neither the values nor the ratio is left out.
        """
        _, squares, log_determinant = self._solve(values, ratio)
        n = self.differences.shape[1]
        noise = np.maximum(squares / n, ROUNDING)
        return -0.5 * (n * np.log(noise) + log_determinant), noise

    def smooth(
        self, values: Float[np.ndarray, "samples columns"], ratio: float
    ) -> tuple[Float[np.ndarray, "samples columns"], Float[np.ndarray, "samples columns"]]:
        """Signal and slope given all samples; the signal is the quintic smoothing spline."""
        signal = values - self._solve(values, ratio)[0]
        ends = [(order, np.full(values.shape[1], value)) for order, value in NATURAL]
        t = np.append(0.0, np.cumsum(self.steps))
        return signal, make_interp_spline(t, signal, k=5, bc_type=(ends, ends)).derivative()(t)

    def _solve(
        self, values: Float[np.ndarray, "samples columns"], ratio: float
    ) -> tuple[Float[np.ndarray, "samples columns"], Float[np.ndarray, " columns"], float]:
        """Noise of the samples, sum of weighted squares, and log-determinant of D D' + ratio Q."""
        n, (n_samples, n_columns) = self.differences.shape[1], values.shape
        weights = self.differences / np.sqrt(ratio)
        # bands[i, j, 2 * WIDTH + k] is the entry of unknown (i, j) in the equation k further down;
        # three unknowns beyond the last difference are zero.
        bands = np.zeros((n_samples, 2, 3 * WIDTH + 1))
        bands[:, 0, 2 * WIDTH] = bands[n:, 1, 2 * WIDTH] = 1.0
        sides = np.zeros((n_samples, 2, n_columns))
        for k, weight in enumerate(weights):
            bands[k : k + n, 0, 2 * WIDTH + 1 - 2 * k] = weight
            bands[:n, 1, 2 * WIDTH - 1 + 2 * k] = -weight
            sides[:n, 1] += weight[:, None] * values[k : k + n]
        for k, shared in enumerate(self.covariance):
            bands[: n - k, 1, 2 * WIDTH + 2 * k] = shared[: n - k]
            bands[k:n, 1, 2 * WIDTH - 2 * k] = shared[: n - k]
        matrix = bands.reshape(2 * n_samples, -1).T
        factor, pivots, info = dgbtrf(matrix, WIDTH, WIDTH, overwrite_ab=True)
        assert info == 0
        flat = sides.reshape(2 * n_samples, n_columns)
        solution = dgbtrs(factor, WIDTH, WIDTH, flat, pivots)[0].reshape(sides.shape)
        squares = (sides[:, 1] * solution[:, 1]).sum(axis=0)
        logs = np.log(np.abs(factor[2 * WIDTH])).sum() + n * np.log(ratio)
        return solution[:, 0], squares, float(logs)


def third_differences(steps: Float[np.ndarray, " steps"]) -> Float[np.ndarray, "four differences"]:
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


def _covariance(steps: Float[np.ndarray, " steps"]) -> Float[np.ndarray, "three differences"]:
    """Covariance of the third differences of a process whose third derivative is white.

    A difference is the mean of the third derivative under a quadratic B-spline over its three
    steps. Products of two are of degree four, so three Gauss nodes a step integrate them.
    """
    nodes, shares = np.polynomial.legendre.leggauss(3)
    x, y = 0.5 * (1.0 + nodes), 0.5 * (1.0 - nodes)
    one, two, three = steps[:-2, None], steps[1:-1, None], steps[2:, None]
    before, after, whole = one + two, two + three, one + two + three
    middle = (one + two * x) * y / before + (three + two * y) * x / after
    splines = np.stack([one * x**2 / before, middle, three * y**2 / after]) * 3.0 / whole
    weights = 0.5 * shares * np.stack([one, two, three])
    covariance = np.zeros((3, len(one)))
    for k in range(3):  # difference i + k begins where step k of difference i does
        n = len(one) - k
        products = splines[k:, :n] * splines[: 3 - k, k:] * weights[k:, :n]
        covariance[k, :n] = products.sum(axis=(0, 2))
    return covariance


def most_likely(
    misfit: Callable[[float], float],
    decades: Float[np.ndarray, " decades"],
    on_grid: Float[np.ndarray, " decades"],
    *,
    tolerance: float,
) -> float:
    """log10 of the noise ratio of least misfit, which may be flat or have several minima.

    A grid of decades, over which the misfits are given, finds the lowest one, and a bounded search
    between its neighbours refines it.
    """
    best = int(on_grid.argmin())
    search = minimize_scalar(
        misfit,
        bounds=sorted(decades[[max(best - 1, 0), min(best + 1, len(decades) - 1)]]),
        method="bounded",
        options={"xatol": tolerance},
    )
    # The bounded search never tries the bounds themselves, so the grid point may be better.
    return float(search.x if search.fun < on_grid[best] else decades[best])
