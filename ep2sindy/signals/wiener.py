"""Samples of a twice integrated Wiener process in white noise: likelihood, signal and slope.

The third derivative of the signal is white noise of density `ratio`, in units in which the
measurement noise has variance one and steps are of order one. The start is diffuse: of the samples
only the third differences count, which no parabola has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline
from scipy.linalg.lapack import dgbtrf, dgbtrs, dpbtrf, dtbtrs

# Variance of the rounding errors of values scaled to unit range; less noise cannot be detected.
ROUNDING = np.finfo(np.float64).eps ** 2

# Steps shorter than this share of a unit count as that long; divided differences of samples that
# are closer together lose their digits.
CLOSEST = 1e-6

# Least ratio, times the sixth power of the shortest step, for likelihoods by D D' + ratio Q as it
# is: about the inverse of its condition. There logarithms of likelihoods err by 0.01 at most.
WELL_CONDITIONED = 5e-11

WIDTH = 5  # of the band on either side of the diagonal


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
    def at(steps: Float[np.ndarray, " steps"]) -> WienerProcess:
        steps = np.maximum(steps, CLOSEST)
        weights, by_process = third_differences(steps), _covariance(steps)
        n, norms = weights.shape[1], np.sqrt(np.square(weights).sum(axis=0))
        weights /= norms
        by_noise = np.zeros_like(by_process)
        for k in range(min(4, n)):
            by_process[k, : n - k] /= norms[k:] * norms[: n - k]
            by_noise[k, : n - k] = (weights[k:, : n - k] * weights[: 4 - k, k:]).sum(axis=0)
        return WienerProcess(steps, weights, by_noise, by_process)

    def likelihood(
        self, values: Float[np.ndarray, "samples columns"], ratio: float
    ) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, " columns"]]:
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
            _, squares, logs = self._solve(values, ratio)
        n = self.differences.shape[1]
        noise = np.maximum(squares / n, ROUNDING)
        return -0.5 * (n * np.log(noise) + logs), noise

    def signal(
        self, values: Float[np.ndarray, "samples columns"], ratio: float
    ) -> Float[np.ndarray, "samples columns"]:
        """The signal given all samples: the quintic smoothing spline."""
        return values - self._solve(values, ratio)[0]

    def slope(
        self, signal: Float[np.ndarray, "samples columns"]
    ) -> Float[np.ndarray, "samples columns"]:
        """Slope of a signal given all samples, whose third and fourth derivative end at zero."""
        nothing, t = np.zeros(signal.shape[1]), np.append(0.0, np.cumsum(self.steps))
        ends = [(3, nothing), (4, nothing)]
        return make_interp_spline(t, signal, k=5, bc_type=(ends, ends)).derivative()(t)

    def _solve(
        self, values: Float[np.ndarray, "samples columns"], ratio: float
    ) -> tuple[Float[np.ndarray, "samples columns"], Float[np.ndarray, " columns"], float]:
        """Noise of the samples, sum of weighted squares, and log-determinant of D D' + ratio Q."""
        n, (n_samples, n_columns), root = self.differences.shape[1], values.shape, np.sqrt(ratio)
        # bands[i, j, 2 * WIDTH + k] is the entry of unknown (i, j) in the equation k further down;
        # three unknowns beyond the last difference are zero.
        bands, sides = np.zeros((n_samples, 2, 3 * WIDTH + 1)), np.zeros((n_samples, 2, n_columns))
        bands[:, 0, 2 * WIDTH] = bands[n:, 1, 2 * WIDTH] = 1.0
        for k, weight in enumerate(self.differences / root):
            bands[k : k + n, 0, 2 * WIDTH + 1 - 2 * k] = weight
            bands[:n, 1, 2 * WIDTH - 1 + 2 * k] = -weight
        for k, shared in enumerate(self.by_process[: min(3, n)]):
            bands[: n - k, 1, 2 * WIDTH + 2 * k] = shared[: n - k]
            bands[k:n, 1, 2 * WIDTH - 2 * k] = shared[: n - k]
        sides[:n, 1] = self._differences_of(values) / root
        matrix = bands.reshape(2 * n_samples, -1).T
        factor, pivots, info = dgbtrf(matrix, WIDTH, WIDTH, overwrite_ab=True)
        assert info == 0
        flat = sides.reshape(2 * n_samples, n_columns)
        solution = dgbtrs(factor, WIDTH, WIDTH, flat, pivots)[0].reshape(sides.shape)
        squares = (sides[:, 1] * solution[:, 1]).sum(axis=0)
        logs = np.log(np.abs(factor[2 * WIDTH])).sum() + n * np.log(ratio)
        return solution[:, 0], squares, float(logs)

    def _differences_of(
        self, values: Float[np.ndarray, "samples columns"]
    ) -> Float[np.ndarray, "differences columns"]:
        n = self.differences.shape[1]
        pairs = enumerate(self.differences)
        return sum(weight[:, None] * values[k : k + n] for k, weight in pairs)


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


def _covariance(steps: Float[np.ndarray, " steps"]) -> Float[np.ndarray, "four differences"]:
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
    covariance = np.zeros((4, len(one)), order="F")  # as LAPACK takes it
    for k in range(min(3, len(one))):  # difference i + k begins where step k of i does
        n = len(one) - k
        products = splines[k:, :n] * splines[: 3 - k, k:] * weights[k:, :n]
        covariance[k, :n] = products.sum(axis=(0, 2))
    return covariance
