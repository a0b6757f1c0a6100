"""Compiled searches on Gram matrices: lasso paths, thresholding, best subsets.

In every kernel, xx: (terms, terms) is a Gram matrix of columns in comparable units, and
xy: (terms,) holds their products with one target. A mask: (terms,) of bool is a support.
"""

from typing import Any

import numpy as np

from ep2sindy.regression.gram_kernels import (
    DEPENDENT,
    ROUNDING,
    WITHIN,
    append_term,
    extend,
    substitute,
)
from ep2sindy.runtime.compilation import LOOPS, compiled

PATH_PER_TERM = 8  # supports on a lasso path, per term, at which it ends; they may come and go


# Why a term cannot join a lasso path: it is active, or it has just left with that sign.
ACTIVE, LEFT_POSITIVE, LEFT_NEGATIVE = 1, 2, 3


@compiled(**WITHIN)
def _next_event(coef, slope, correlation, drift, level, active, n_active, closed):
    """Next knot of the lasso path below the penalty `level`: step, term, and whether it joins."""
    step, term, joins = level, -1, False
    # A coefficient reaches zero, b_j + step slope_j = 0, and its term leaves.
    for i in range(n_active):
        j = active[i]
        if coef[j] * slope[i] < 0.0 and -coef[j] / slope[i] < step:
            step, term, joins = -coef[j] / slope[i], j, False
    for j in range(len(coef)):
        if closed[j] == ACTIVE:
            continue
        # A correlation meets plus or minus the level, c_j - step drift_j = +-(level - step).
        if closed[j] != LEFT_POSITIVE and 1.0 - drift[j] > 1e-12:
            distance = max((level - correlation[j]) / (1.0 - drift[j]), 0.0)
            if distance < step:
                step, term, joins = distance, j, True
        if closed[j] != LEFT_NEGATIVE and 1.0 + drift[j] > 1e-12:
            distance = max((level + correlation[j]) / (1.0 + drift[j]), 0.0)
            if distance < step:
                step, term, joins = distance, j, True
    return step, term, joins


def lasso_path(xx, xy, max_terms):
    """All supports on the exact lasso path, from the empty one to `max_terms` or all terms.

    Homotopy in the penalty, in which terms join and leave (Osborne, Presnell & Turlach 2000,
    doi:10.1093/imanum/20.3.389; Efron et al. 2004, doi:10.1214/009053604000000067). The Cholesky
    factor of the active terms grows by a row where one joins, and is made anew from the place where
    one leaves.
    """
    n = len(xy)
    masks = np.empty((PATH_PER_TERM * (n + 1), n), dtype=np.bool_)
    scratch = np.empty((n, n)), np.empty((5, n)), np.empty((2, n), dtype=np.int64)
    return masks[: _lasso_path(xx, xy, max_terms, *scratch, masks)]


@compiled(**LOOPS)
def _lasso_path(xx, xy, max_terms, lower, vectors, places, masks):
    """Write the supports of `lasso_path` to masks (room, terms); returns how many.

    lower: (terms, terms), vectors: (5, terms) and places: (2, terms) of int are scratch.
    """
    n_terms = len(xy)
    coef, correlation, drift = vectors[0], vectors[1], vectors[2]
    slope, signs, active = vectors[3], vectors[4], places[0]
    closed = places[1]  # 0 for terms that can join
    n_active = np.int64(0)  # as a bare 0 it would have callees compiled twice
    left, level = -1, 0.0
    # At b = 0 the correlations are c = X^T y; above the largest of them no term is active.
    for j in range(n_terms):
        coef[j], correlation[j], closed[j] = 0.0, xy[j], 0
        level = max(level, abs(xy[j]))
    floor = 1e-13 * level
    n_masks = _write_support(active, n_active, masks, np.int64(0))
    while level > floor and n_masks < len(masks):
        # Between two knots b_A and c are linear in the level: d b_A = slope, d c = -drift.
        _fill_drift(xx, slope, active, n_active, drift)
        if left >= 0:  # with the sign it had, it would rejoin at this same knot
            closed[left] = LEFT_POSITIVE if correlation[left] > 0.0 else LEFT_NEGATIVE
        step, term, joins = _next_event(
            coef, slope, correlation, drift, level, active, n_active, closed
        )
        if left >= 0:
            closed[left], left = 0, -1
        _move(step, coef, slope, active, n_active, correlation, drift, signs)
        level -= step
        if term < 0:
            break
        if joins:
            closed[term] = ACTIVE
            if not append_term(xx, active, n_active, term, lower):
                # It depends on the active terms; the path continues without it.
                substitute(lower, signs, active, n_active, slope)
                continue
            active[n_active] = term
            n_active += 1
        else:
            n_active = _leave(xx, active, n_active, term, lower)
            coef[term], closed[term], left = 0.0, 0, term
        # c_A = level sign(c_A) holds on the next segment: G_A slope = sign(c_A).
        substitute(lower, signs, active, n_active, slope)
        if n_active > max_terms:
            break
        n_masks = _write_support(active, n_active, masks, n_masks)
    return n_masks


@compiled(**WITHIN)
def _write_support(active, n_active, masks, m):
    """Write the mask of the active terms in row m; returns the next row."""
    for j in range(masks.shape[1]):
        masks[m, j] = False
    for i in range(n_active):
        masks[m, active[i]] = True
    return m + 1


@compiled(**WITHIN)
def _move(step, coef, slope, active, n_active, correlation, drift, signs):
    """Move coefficients and correlations along the path, and write the signs of the latter."""
    for i in range(n_active):
        coef[active[i]] += step * slope[i]
    for j in range(len(drift)):
        correlation[j] -= step * drift[j]
        signs[j] = np.sign(correlation[j])


@compiled(**WITHIN)
def _fill_drift(xx, slope, active, n_active, drift):
    """Write the rate at which each term's correlation decreases along the path."""
    # drift = G[:, A] slope
    for j in range(len(drift)):
        drift[j] = 0.0
    for i in range(n_active):
        for j in range(len(drift)):
            drift[j] += xx[active[i], j] * slope[i]


@compiled(**WITHIN)
def _leave(xx, active, n_active, term, lower):
    """Take a term out of the active ones and their factor; returns how many are left."""
    kept = 0
    while active[kept] != term:
        kept += 1
    for i in range(kept + 1, n_active):  # independent of each other before, so they still are
        append_term(xx, active, kept, active[i], lower)
        active[kept] = active[i]
        kept += 1
    return kept


def threshold_terms(xx, xy, thresholds, masks):
    """Drop terms from masks (thresholds, terms) until all that are left exceed the threshold."""
    n = len(xy)
    _threshold_terms(
        xx, xy, thresholds, masks, np.empty((n, n)), np.empty(n), np.empty(n, dtype=np.int64)
    )


@compiled(**LOOPS)
def _threshold_terms(xx, xy, thresholds, masks, lower, coef, active):
    n_active = np.int64(0)
    for m in range(len(masks)):
        dropped = True
        while dropped:
            n_active, solved = extend(xx, masks[m], active, n_active, lower)
            substitute(lower, xy, active, n_active, coef)
            dropped = False
            for i in range(n_active):
                if not (solved and abs(coef[i]) > thresholds[m]):
                    masks[m, active[i]], dropped = False, True


# For kernels that are given their arrays; sweeps are made in place, so these are not separate ones.
PLAIN: dict[str, Any] = {"error_model": "numpy"}
PLAIN_INNER = {**PLAIN, "no_cpython_wrapper": True}


@compiled(**PLAIN_INNER)
def _sweep(source, target, j, size):
    """Eliminate column j: remove its contribution from the rows and columns after j."""
    # Schur complement: G[a, b] <- G[a, b] - G[a, j] G[j, b] / G[j, j]; last, of the target's
    # square, the residual squares.
    for a in range(j + 1, size):
        ratio = source[a, j] / source[j, j]
        for b in range(a, size):
            target[a, b] = source[a, b] - ratio * source[b, j]
            target[b, a] = target[a, b]


@compiled(**PLAIN_INNER)
def _join(total, residual, rounding, n_problems):
    """Multiply the product of residuals by one more, in logarithms; plain if there is only one."""
    return residual if n_problems == 1 else total + np.log(max(residual, rounding))


@compiled(**PLAIN_INNER)
def _least_residual(matrices, first, size, smallest, scratch):
    """Product of residuals if all columns from `first` on are used: a bound for a subtree."""
    total = 0.0
    for p in range(len(matrices)):
        for a in range(first, size):  # slices would take seconds longer to compile
            for b in range(first, size):
                scratch[a, b] = matrices[p, a, b]
        for j in range(first, size - 1):
            if scratch[j, j] > smallest[p, j]:
                _sweep(scratch, scratch, j, size)
        total = _join(total, scratch[size - 1, size - 1], smallest[p, size - 1], len(matrices))
    return total


@compiled(**PLAIN_INNER)
def _offer(residual, chosen, n_chosen, best, best_masks):
    """Insert a subset into the list of the best of its size, sorted by residual, if it is."""
    rank = best.shape[1]
    while rank > 0 and residual < best[n_chosen, rank - 1]:
        rank -= 1
    if rank == best.shape[1]:
        return
    n_terms = best_masks.shape[2]
    for r in range(best.shape[1] - 1, rank, -1):
        best[n_chosen, r] = best[n_chosen, r - 1]
        for j in range(n_terms):
            best_masks[n_chosen, r, j] = best_masks[n_chosen, r - 1, j]
    best[n_chosen, rank] = residual
    for j in range(n_terms):
        best_masks[n_chosen, rank, j] = False
    for i in range(n_chosen):
        best_masks[n_chosen, rank, chosen[i]] = True


@compiled(inline="always")
def _begin(xx, xy, yy, levels, smallest, best, best_masks):
    """Write the first level, the bounds for zero, and the empty support as all that is known."""
    n_problems, n_terms = xy.shape
    # levels[0, p] = [X y]^T [X y] of problem p: the residual squares stand in the last place.
    for p in range(n_problems):
        for i in range(n_terms):
            for j in range(n_terms):
                levels[0, p, i, j] = xx[p, i, j]
            levels[0, p, i, n_terms] = levels[0, p, n_terms, i] = xy[p, i]
            smallest[p, i] = DEPENDENT * xx[p, i, i]
        levels[0, p, n_terms, n_terms] = yy[p]
        smallest[p, n_terms] = ROUNDING * yy[p] if yy[p] > 0.0 else 1.0
    for size in range(best.shape[0]):
        for rank in range(best.shape[1]):
            best[size, rank] = np.inf
    best[0, 0] = 0.0
    for j in range(n_terms):
        best_masks[0, 0, j] = False


@compiled(inline="always")
def _try_column(levels, level, j, smallest):
    """Product of residuals if column j is chosen as well, and whether it changes any."""
    n_problems, n_terms = levels.shape[1], levels.shape[2] - 1
    residual, adds = 0.0, False
    for p in range(n_problems):  # indexed directly: views would cost more than the arithmetic
        # RSS - (x_j^T r)^2 / x_j^T x_j, of what the chosen columns leave of x_j and y
        left, pivot = levels[level, p, n_terms, n_terms], levels[level, p, j, j]
        if pivot > smallest[p, j]:
            left -= levels[level, p, j, n_terms] ** 2 / pivot
            adds = True
        residual = _join(residual, left, smallest[p, n_terms], n_problems)
    return residual, adds


@compiled(inline="always")  # a call would cost the search 5 %
def _eliminate(levels, level, j, smallest):
    """Choose column j: write the residual Gram matrices of later columns to the next level."""
    for p in range(len(smallest)):
        here, below = levels[level, p], levels[level + 1, p]
        if here[j, j] > smallest[p, j]:
            _sweep(here, below, j, levels.shape[2])
        else:
            for a in range(j + 1, levels.shape[2]):
                for b in range(j + 1, levels.shape[2]):
                    below[a, b] = here[a, b]


@compiled(**PLAIN)
def search_subsets(
    xx, xy, yy, most_work, levels, smallest, scratch, chosen, following, best, best_masks
):
    """Search the supports of least residual of every size; returns false if it ended without proof.

    One support serves several problems, each with its own coefficients. The product of their
    residuals is minimised (for one problem, the residual), so the scales of the targets do not
    matter. If a column depends on those already chosen in a problem, its residual is unchanged.
    The search is depth first over subsets. Residual Gram matrices are kept at every level, so a
    leaf costs one division. A branch is cut if all of its columns together leave a larger
    residual than the best known (Furnival & Wilson 1974, doi:10.1080/00401706.1974.10489231).
    xx: (problems, terms, terms), the most informative columns first, for early cuts;
    xy: (problems, terms); yy: (problems,). most_work: multiplications after which the search ends.
    Writes residuals to best (sizes, n_best), infinite where there is no support, and supports to
    best_masks (sizes, n_best, terms), the empty one first. The others are scratch.
    """
    _begin(xx, xy, yy, levels, smallest, best, best_masks)
    n_problems, size = smallest.shape
    depth, n_best, n_terms = best.shape[0] - 1, best.shape[1], size - 1
    following[0], level, work = 0, 0, 0.0
    while level >= 0:
        j = following[level]
        if j >= n_terms or level == depth:
            level -= 1
            continue
        following[level] = j + 1
        residual, adds = _try_column(levels, level, j, smallest)
        if not adds:
            continue
        chosen[level] = j
        _offer(residual, chosen, level + 1, best, best_masks)
        if level + 1 == depth or j + 1 == n_terms:
            continue
        _eliminate(levels, level, j, smallest)
        # A branch is cut if even all its columns together leave more than the best of its size.
        worth_bounding = n_terms - j > 6 and depth - level > 2
        left = float(n_terms - j)
        work += n_problems * left * left * (1.0 + (left / 6.0 if worth_bounding else 0.0))
        if work > most_work:
            return False
        if worth_bounding and best[level + 2, n_best - 1] <= _least_residual(
            levels[level + 1], j + 1, size, smallest, scratch
        ):
            continue
        following[level + 1] = j + 1
        level += 1
    return True
