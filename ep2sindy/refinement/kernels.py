"""Compiled recurrences over windows: condense linearised trajectories, propagate their changes.

maps: (points, windows, steps, n, n + p + 1): derivatives of the end of each step by its node and
by the p scalings, then this end itself. nodes: (points, windows, samples, n).
n_start is n if the starts of the windows are free, 0 if they are fixed to the data. Columns of a
condensed system: the window's start, the scalings, the right-hand side.
"""

import numpy as np

from ep2sindy.runtime.compilation import INNER_REORDERED, REORDERED, compiled


@compiled(**INNER_REORDERED)
def _triangle(columns: np.ndarray, n_rows: int, out: np.ndarray) -> None:
    """Write R of a QR decomposition by Householder reflections.

    columns: (columns, rows), overwritten.
    """
    n_columns = len(columns)
    for i in range(min(n_columns, n_rows)):
        pivot = columns[i, i:n_rows]  # counted from zero, the loops below fill the vector units
        square = 0.0
        for r in range(len(pivot)):
            square += pivot[r] * pivot[r]
        norm = np.sqrt(square)
        if norm != 0.0:  # NaN must spread
            alpha = -norm if pivot[0] > 0.0 else norm
            beta = 1.0 / (norm * (norm + abs(pivot[0])))
            pivot[0] -= alpha
            for j in range(i + 1, n_columns):
                other = columns[j, i:n_rows]
                product = 0.0
                for r in range(len(pivot)):
                    product += pivot[r] * other[r]
                product *= beta
                for r in range(len(pivot)):
                    other[r] -= product * pivot[r]
            out[i, i] = alpha
        for j in range(i + 1, n_columns):
            out[i, j] = columns[j, i]


@compiled(**INNER_REORDERED)
def _add(row: np.ndarray, factor: float, total: np.ndarray) -> None:
    for c in range(len(row)):
        total[c] += factor * row[c]


@compiled(**INNER_REORDERED)
def _advance(by: np.ndarray, nodes: np.ndarray, x: np.ndarray, new: np.ndarray) -> None:
    """Propagate the columns of `x` (n, columns) over a step; the last column is the defect.

    by: (n, n + p + 1), of the step; nodes: (n,), at its end.
    """
    n, n_columns = x.shape
    n_start = n_columns - (by.shape[1] - n)
    for j in range(n):
        # What the step adds itself: F_s of the scalings, and the defect F(x_k) - x_(k+1).
        for c in range(n_start):
            new[j, c] = 0.0
        for c in range(n_start, n_columns):
            new[j, c] = by[j, n + c - n_start]
        new[j, n_columns - 1] -= nodes[j]
        # F_x times the columns so far: dx_(k+1) = F_x dx_k + F_s ds + defect.
        for v in range(n):
            _add(x[v], by[j, v], new[j])
    for j in range(n):
        for c in range(n_columns):
            x[j, c] = new[j, c]


def condense(
    maps: np.ndarray, nodes: np.ndarray, data: np.ndarray, weights: np.ndarray, n_start: int
) -> np.ndarray:
    """Triangular factors R of weights * (linearised trajectory - data), window by window.

    data: (points, windows, samples, n); weights: (points, n).
    Returns (points, windows, columns, columns).
    """
    (n_points, n_windows, n_samples, n), width = nodes.shape, maps.shape[-1]
    n_columns = n_start + width - n
    out = np.zeros((n_points, n_windows, n_columns, n_columns))
    columns, (x, new) = np.empty((n_columns, n_samples * n)), np.empty((2, n, n_columns))
    _condense(maps, nodes, data, weights, n_start, out, columns, x, new)
    return out


@compiled(**REORDERED)
def _condense(maps, nodes, data, weights, n_start, out, columns, x, new):
    n_samples, (n, n_columns) = nodes.shape[2], x.shape
    for p in range(len(maps)):
        for w in range(maps.shape[1]):
            # dx of the first node, by the start (the identity), the scalings (zero) and one.
            for j in range(n):
                for c in range(n_columns):
                    x[j, c] = 0.0
                if n_start:
                    x[j, j] = 1.0
                else:
                    x[j, n_columns - 1] = data[p, w, 0, j] - nodes[p, w, 0, j]
            for k in range(n_samples):
                # Rows of the least squares: W (dx_k + x_k - data_k).
                for j in range(n):
                    row = k * n + j
                    for c in range(n_columns):
                        columns[c, row] = weights[p, j] * x[j, c]
                    off = nodes[p, w, k, j] - data[p, w, k, j]
                    columns[n_columns - 1, row] += weights[p, j] * off
                if k + 1 < n_samples:
                    _advance(maps[p, w, k], nodes[p, w, k + 1], x, new)
            _triangle(columns, n_samples * n, out[p, w])


@compiled
def starts(condensed: np.ndarray, change: np.ndarray, n: int) -> np.ndarray:
    """Best change of each window's free start for a given change of the scalings (points, p).

    Returns (points, windows, n).
    """
    n_points, n_windows, n_columns, _ = condensed.shape
    out = np.empty((n_points, n_windows, n))
    for p in range(n_points):
        for w in range(n_windows):
            # Back substitution in R_start d_start = -(R_scaling d_scaling + r).
            r = condensed[p, w]
            for i in range(n - 1, -1, -1):
                total = -r[i, n_columns - 1]
                for c in range(n, n_columns - 1):
                    total -= r[i, c] * change[p, c - n]
                for c in range(i + 1, n):
                    total -= r[i, c] * out[p, w, c]
                out[p, w, i] = total / r[i, i]
    return out


@compiled
def propagate(
    maps: np.ndarray, nodes: np.ndarray, start: np.ndarray, change: np.ndarray
) -> np.ndarray:
    """Changes of the nodes that close the linearised defects inside each window.

    start: (points, windows, n), change of each window's first node; change: (points, p) and more,
    of which the columns that the maps lack have no effect.
    """
    n_points, n_windows, n_steps, n, width = maps.shape
    out = np.empty(nodes.shape)
    for p in range(n_points):
        for w in range(n_windows):
            out[p, w, 0] = start[p, w]
            for k in range(n_steps):
                # dx_(k+1) = F_x dx_k + F_s ds + the defect F(x_k) - x_(k+1).
                for j in range(n):
                    total = maps[p, w, k, j, width - 1] - nodes[p, w, k + 1, j]
                    for v in range(n):
                        total += maps[p, w, k, j, v] * out[p, w, k, v]
                    for i in range(width - 1 - n):
                        total += maps[p, w, k, j, n + i] * change[p, i]
                    out[p, w, k + 1, j] = total
    return out
