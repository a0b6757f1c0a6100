"""Compiled covariance of weak rows, whose windows are short stretches of neighbouring samples.

The windows of row i are mean[starts[i]:starts[i + 1]] and slope in the same places, over samples
from first[i] on. Loops run over slices: with sums of indices in them they would stay scalar.
"""

import numpy as np

from ep2sindy.runtime.compilation import INNER_REORDERED, REORDERED, compiled


@compiled(**INNER_REORDERED)
def _both_products(a, b, c, d):
    """Sum of the scalar products of a with b and of c with d."""
    total = 0.0
    for s in range(len(a)):
        total += a[s] * b[s] + c[s] * d[s]
    return total


def banded_covariance(starts, first, mean, slope, of_mean, of_both, of_slope, band):
    """Write the covariance of the rows to band[i, k], of row i + k with row i.

    A unit of a sample's noise moves the row by mean times some factor, of the terms, minus slope
    times another, of the target; of_mean, of_both and of_slope (samples,) are the sums over all
    variables of the products of these factors.
    """
    by_mean, by_slope = np.empty((2, np.diff(starts).max(initial=0)))
    _banded_covariance(
        starts, first, mean, slope, of_mean, of_both, of_slope, by_mean, by_slope, band
    )


@compiled(**REORDERED)
def _banded_covariance(
    starts, first, mean, slope, of_mean, of_both, of_slope, by_mean, by_slope, band
):
    n_rows = len(first)
    for i in range(n_rows):
        m, w = mean[starts[i] : starts[i + 1]], slope[starts[i] : starts[i + 1]]
        here = slice(first[i], first[i] + len(m))
        mm, mw, ww = of_mean[here], of_both[here], of_slope[here]
        for s in range(len(m)):
            by_mean[s] = m[s] * mm[s] - w[s] * mw[s]
            by_slope[s] = w[s] * ww[s] - m[s] * mw[s]
        for j in range(i, min(i + band.shape[1], n_rows)):
            low = max(first[i], first[j])
            shared = min(here.stop, first[j] + starts[j + 1] - starts[j]) - low
            if shared <= 0:
                band[i, j - i] = 0.0
                continue
            a, b = low - first[i], starts[j] + low - first[j]
            band[i, j - i] = _both_products(
                by_mean[a : a + shared], mean[b : b + shared],
                by_slope[a : a + shared], slope[b : b + shared],
            )  # fmt: skip
