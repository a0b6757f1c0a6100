"""Least squares on supports, from Gram matrices only; the loops are compiled.

xx: (terms, terms) is a Gram matrix of columns in comparable units; a mask: (terms,) of bool is a
support.
"""

import numpy as np

from ep2sindy.runtime.compilation import compiled

# A column counts as dependent on others if their residual of its square falls below this share.
DEPENDENT = 1e-11

# A residual of the target's square below this share counts as rounding.
ROUNDING = 1e-15


@compiled
def solve(xx, rhs, active, n_active, out):
    """Solve xx[active][:, active] out = rhs[active] by Cholesky; False if columns depend."""
    lower = np.empty((n_active, n_active))
    for i in range(n_active):
        for j in range(i + 1):
            total = xx[active[i], active[j]]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i > j:
                lower[i, j] = total / lower[j, j]
            elif total <= DEPENDENT * xx[active[i], active[i]]:
                return False
            else:
                lower[i, i] = np.sqrt(total)
    for i in range(n_active):
        total = rhs[active[i]]
        for k in range(i):
            total -= lower[i, k] * out[k]
        out[i] = total / lower[i, i]
    for i in range(n_active - 1, -1, -1):
        total = out[i]
        for k in range(i + 1, n_active):
            total -= lower[k, i] * out[k]
        out[i] = total / lower[i, i]
    return True


@compiled
def independent_terms(xx):
    """Mask of a maximal independent set of terms; earlier terms take precedence."""
    n_terms = len(xx)
    mask = np.zeros(n_terms, dtype=np.bool_)
    lower = np.zeros((n_terms, n_terms))
    rows = np.empty(n_terms, dtype=np.int64)
    n_kept = 0
    for j in range(n_terms):
        rest = xx[j, j]
        for i in range(n_kept):
            total = xx[j, rows[i]]
            for k in range(i):
                total -= lower[n_kept, k] * lower[i, k]
            lower[n_kept, i] = total / lower[i, i]
            rest -= lower[n_kept, i] ** 2
        if rest > DEPENDENT * xx[j, j]:
            lower[n_kept, n_kept] = np.sqrt(rest)
            rows[n_kept] = j
            n_kept += 1
            mask[j] = True
    return mask


@compiled
def _fill_active(masks, m, active):
    """Write the indices of the terms of one mask into `active`; returns their number."""
    n_active = 0
    for j in range(masks.shape[1]):
        if masks[m, j]:
            active[n_active] = j
            n_active += 1
    return n_active


@compiled
def solve_masks(xx, rhs, masks):
    """Solve xx coef = rhs on each support; NaN if its columns are linearly dependent.

    rhs, masks and the returned coef: (masks, terms); coef is zero outside the support.
    """
    n_masks, n_terms = masks.shape
    coef = np.zeros((n_masks, n_terms))
    solution = np.empty(n_terms)
    active = np.empty(n_terms, dtype=np.int64)
    for m in range(n_masks):  # loops, since fancy indices would take seconds longer to compile
        n_active = _fill_active(masks, m, active)
        if solve(xx, rhs[m], active, n_active, solution):
            for i in range(n_active):
                coef[m, active[i]] = solution[i]
        else:
            for j in range(n_terms):
                coef[m, j] = np.nan
    return coef


def fit_masks(xx, xy, masks):
    """Least-squares coefficients of each support; NaN if its columns are linearly dependent.

    xy: (terms,), of the columns and one target.
    """
    return solve_masks(xx, np.where(masks, xy, 0.0), masks)


def explained_squares(coef, xx, xy):
    """Reduction of the target's sum of squares by each row of coef, on the rows of xx and xy."""
    return (coef * (2.0 * xy - coef @ xx)).sum(axis=1)
