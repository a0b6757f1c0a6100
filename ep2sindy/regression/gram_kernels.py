"""Compiled least squares on supports, from Gram matrices only, and the covariance of weak rows.

The rule of rank is that of `least_squares.LeastSquares`: DEPENDENT serves both.

xx: (terms, terms) is a Gram matrix of columns in comparable units; a mask: (terms,) of bool is a
support.
"""

import numpy as np

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.runtime.compilation import INNER_REORDERED, LOOPS, REORDERED, compiled

WITHIN = {**LOOPS, "no_cpython_wrapper": True}  # for kernels that only kernels call

# A column counts as dependent on others if they leave less than this fraction of its square.
DEPENDENT = 1e-11

# What is left of the target's square counts as rounding below this fraction.
ROUNDING = 1e-15


@compiled(**WITHIN)
def append_term(xx, active, n_active, term, lower):
    """Write the row by which a term extends the Cholesky factor of the active ones.

    Returns false if the term depends on them. The diagonal of a factor holds reciprocals, since a
    division takes longer than the rest of an inner loop.
    """
    # Row of L in L L^T = G: L[n, i] = (G[n, i] - sum_k L[n, k] L[i, k]) / L[i, i], and
    # L[n, n]^2 = G[n, n] - sum_i L[n, i]^2, the square that the active terms leave of the new one.
    rest = xx[term, term]
    for i in range(n_active):
        total = xx[term, active[i]]
        for k in range(i):
            total -= lower[n_active, k] * lower[i, k]
        lower[n_active, i] = total * lower[i, i]
        rest -= lower[n_active, i] ** 2
    if not rest > DEPENDENT * xx[term, term]:
        return False
    lower[n_active, n_active] = 1.0 / np.sqrt(rest)
    return True


@compiled(**WITHIN)
def substitute(lower, rhs, active, n_active, out):
    """Solve xx[active][:, active] out = rhs[active] by the Cholesky factor of the active terms."""
    # Forward: L u = rhs.
    for i in range(n_active):
        total = rhs[active[i]]
        for k in range(i):
            total -= lower[i, k] * out[k]
        out[i] = total * lower[i, i]
    # Backward: L^T out = u, column by column, since rows of L lie together in memory.
    for i in range(n_active - 1, -1, -1):
        out[i] *= lower[i, i]
        for k in range(i):
            out[k] -= lower[i, k] * out[i]


@compiled(**LOOPS)
def factorise(xx, active, lower):
    """Write the first independent terms, earlier ones first, and their factor; returns how many."""
    n_active = np.int64(0)  # as a bare 0 it would have callees compiled twice
    for j in range(len(xx)):
        if append_term(xx, active, n_active, j, lower):
            active[n_active] = j
            n_active += 1
    return n_active


def independent_terms(xx):
    """Mask of a maximal independent set of terms; earlier terms take precedence."""
    active, mask = np.empty(len(xx), dtype=np.int64), np.zeros(len(xx), dtype=np.bool_)
    mask[active[: factorise(xx, active, np.empty(xx.shape))]] = True
    return mask


@compiled(**WITHIN)
def extend(xx, mask, active, n_active, lower):
    """Write the terms of a mask and their factor; returns how many, and whether they are so.

    active: n_active terms that have a row of the factor already. Masks in the order of
    `bootstraps.pool` often begin with the terms of the one before, whose rows are kept.
    """
    n_same = np.int64(0)  # as a bare 0 it would have callees compiled twice
    for j in range(len(mask)):
        if not mask[j]:
            continue
        if n_same == n_active or active[n_same] != j:
            n_active = n_same  # the rows behind belong to other terms
            if not append_term(xx, active, n_active, j, lower):
                return n_active, False
            active[n_active] = j
            n_active += 1
        n_same += 1
    return n_same, True


def solve_masks(xx, rhs, masks):
    """Solve xx coef = rhs on each support; NaN if its columns are linearly dependent.

    rhs: (masks, terms), or (1, terms) for all. masks and the returned coef: (masks, terms); coef is
    zero outside the support.
    """
    n_terms, coef = masks.shape[1], np.empty(masks.shape)
    scratch = np.empty((n_terms, n_terms)), np.empty(n_terms), np.empty(n_terms, dtype=np.int64)
    fill_solutions(xx, rhs, masks, coef, *scratch)
    return coef


@compiled(**LOOPS)
def fill_solutions(xx, rhs, masks, coef, lower, solution, active):
    """Write the solutions of `solve_masks` to coef (masks, terms).

    lower: (terms, terms), solution: (terms,) and active: (terms,) of int are scratch.
    """
    n_active = np.int64(0)
    for m in range(len(masks)):
        # L L^T = G_S for the support S, then G_S b_S = rhs_S; b = 0 elsewhere.
        n_active, solved = extend(xx, masks[m], active, n_active, lower)
        for j in range(coef.shape[1]):
            coef[m, j] = 0.0 if solved else np.nan
        if solved:
            substitute(lower, rhs[min(m, len(rhs) - 1)], active, n_active, solution)
            for i in range(n_active):
                coef[m, active[i]] = solution[i]


def fit_masks(xx, xy, masks):
    """Least-squares coefficients of each support; NaN if its columns are linearly dependent.

    xy: (terms,), of the columns and one target.
    """
    return solve_masks(xx, xy[None], masks)


def explained_squares(coef, xx, xy):
    """Reduction of the target's sum of squares by each row of coef, on the rows of xx and xy."""
    return (coef * (2.0 * xy - coef @ xx)).sum(axis=1)


def invert_gram(xx):
    """Inverses of Gram matrices under the rule of `LeastSquares`: what is dependent stays out.

    xx: (..., terms, terms), of columns in any units. A column of zeros has zeros in the inverse.
    """
    size = np.sqrt(zero_to_one(np.maximum(np.diagonal(xx, axis1=-2, axis2=-1), 0.0)))
    sizes = size[..., :, None] * size[..., None, :]
    unit = xx / sizes
    inverse = np.empty_like(unit)
    for index in np.ndindex(unit.shape[:-2]):
        one = unit[index]
        inverse[index] = (
            np.linalg.inv(one)
            if independent_terms(one).all()
            else np.linalg.pinv(one, rcond=DEPENDENT, hermitian=True)
        )
    return inverse / sizes


# The covariance of weak rows. The windows of row i are mean[starts[i]:starts[i + 1]] and slope in
# the same places, over samples from first[i] on. Loops run over slices: with sums of indices in
# them they would stay scalar.


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
