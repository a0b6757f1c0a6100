"""Compiled covariance of weak rows, whose windows are short stretches of neighbouring samples."""

import numpy as np

from ep2sindy.runtime.compilation import SEPARATE_ARRAYS, compiled


@compiled
def band_width(first, last):
    """Largest distance between two rows whose windows overlap, plus one."""
    width, ordered = 1, True
    for i in range(len(first) - 1):
        ordered = ordered and first[i] <= first[i + 1]
    for i in range(len(first)):
        for j in range(i + width, len(first)):
            if first[j] <= last[i] and first[i] <= last[j]:
                width = j - i + 1
            elif ordered:
                break
    return width


@compiled(fastmath={"reassoc", "contract"}, **SEPARATE_ARRAYS)
def banded_covariance(starts, first, mean, slope, of_mean, of_both, of_slope, band):
    """Write the covariance of the rows to band[k, i], of row i + k with row i.

    The windows of row i are mean[starts[i]:starts[i + 1]] and slope in the same places, over
    samples from first[i] on. A unit of a sample's noise moves the row by mean times some factor, of
    the terms, minus slope times another, of the target; of_mean, of_both and of_slope (samples,)
    are the sums over all variables of the products of these factors.
    """
    n_rows, longest = len(first), 0
    for i in range(n_rows):
        longest = max(longest, starts[i + 1] - starts[i])
    by_mean, by_slope = np.empty(longest), np.empty(longest)
    for i in range(n_rows):
        length = starts[i + 1] - starts[i]
        for s in range(length):
            m, w, k = mean[starts[i] + s], slope[starts[i] + s], first[i] + s
            by_mean[s] = m * of_mean[k] - w * of_both[k]
            by_slope[s] = w * of_slope[k] - m * of_both[k]
        for j in range(i, min(i + len(band), n_rows)):
            low = max(first[i], first[j])
            high = min(first[i] + length, first[j] + starts[j + 1] - starts[j])
            here, there = low - first[i], starts[j] + low - first[j]
            total = 0.0
            for s in range(high - low):
                total += by_mean[here + s] * mean[there + s] + by_slope[here + s] * slope[there + s]
            band[j - i, i] = total
