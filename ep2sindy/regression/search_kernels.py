"""Compiled searches on Gram matrices: lasso paths, thresholding, best subsets.

In every kernel, xx: (terms, terms) is a Gram matrix of columns in comparable units, and
xy: (terms,) holds their products with one target. A mask: (terms,) of bool is a support.
"""

import numpy as np

from ep2sindy.regression.gram_kernels import (
    DEPENDENT,
    ROUNDING,
    independent_terms,
    solve,
)
from ep2sindy.runtime.compilation import compiled


@compiled
def _next_event(coef, slope, correlation, drift, level, active, n_active, closed):
    """Next knot of the lasso path below the penalty `level`: step, term, and whether it joins."""
    step, term, joins = level, -1, False
    for i in range(n_active):
        j = active[i]
        if coef[j] * slope[i] < 0.0 and -coef[j] / slope[i] < step:
            step, term, joins = -coef[j] / slope[i], j, False
    for j in range(len(coef)):
        if closed[j]:
            continue
        for sign in (1.0, -1.0):
            closing = 1.0 - sign * drift[j]
            if closing > 1e-12:
                distance = max((level - sign * correlation[j]) / closing, 0.0)
                if distance < step:
                    step, term, joins = distance, j, True
    return step, term, joins


@compiled
def lasso_supports(xx, xy, max_terms):
    """All supports on the exact lasso path, from the empty one to `max_terms` or all terms.

    Homotopy in the penalty, in which terms join and leave (Osborne, Presnell & Turlach 2000,
    doi:10.1093/imanum/20.3.389; Efron et al. 2004, doi:10.1214/009053604000000067).
    """
    n_terms = len(xy)
    masks = np.zeros((8 * n_terms + 8, n_terms), dtype=np.bool_)
    coef, correlation, drift = np.zeros(n_terms), np.zeros(n_terms), np.zeros(n_terms)
    slope, signs = np.zeros(n_terms), np.zeros(n_terms)
    active = np.zeros(n_terms, dtype=np.int64)
    closed = np.zeros(n_terms, dtype=np.bool_)  # terms that cannot join: active, or barred
    n_active = np.int64(0)  # as a bare 0 it would have callees compiled twice
    n_masks, left, level = 1, -1, 0.0
    for j in range(n_terms):
        correlation[j] = xy[j]
        level = max(level, abs(xy[j]))
    floor = 1e-13 * level
    while level > floor and n_masks < len(masks):
        _fill_drift(xx, slope, active, n_active, drift)
        if left >= 0:
            closed[left] = True  # it would rejoin at this same knot
        step, term, joins = _next_event(
            coef, slope, correlation, drift, level, active, n_active, closed
        )
        if left >= 0:
            closed[left], left = False, -1
        _move(step, coef, slope, active, n_active, correlation, drift, signs)
        level -= step
        if term < 0:
            break
        if joins:
            active[n_active] = term
            n_active += 1
        else:
            n_active = _leave(active, n_active, term)
            coef[term], left = 0.0, term
        closed[term] = joins
        if not solve(xx, signs, active, n_active, slope):
            closed[term] = True  # it depends on the active terms; the path continues without it
            n_active = _leave(active, n_active, term)
            solve(xx, signs, active, n_active, slope)
            continue
        if n_active > max_terms:
            break
        for i in range(n_active):
            masks[n_masks, active[i]] = True
        n_masks += 1
    return masks[:n_masks]


@compiled
def _move(step, coef, slope, active, n_active, correlation, drift, signs):
    """Move coefficients and correlations along the path, and write the signs of the latter."""
    for i in range(n_active):
        coef[active[i]] += step * slope[i]
    for j in range(len(drift)):
        correlation[j] -= step * drift[j]
        signs[j] = np.sign(correlation[j])


@compiled
def _fill_drift(xx, slope, active, n_active, drift):
    """Write the rate at which each term's correlation decreases along the path."""
    for j in range(len(drift)):
        drift[j] = 0.0
        for i in range(n_active):
            drift[j] += xx[j, active[i]] * slope[i]


@compiled
def adaptive_lasso_supports(xx, xy, gamma, max_terms):
    """Supports on the path of the lasso with penalties |b_ols|^-gamma (Zou 2006).

    Scaling each column by |b_ols|^gamma makes this a plain lasso. A term that depends on earlier
    ones has no least-squares coefficient of its own and never joins.
    """
    n_terms = len(xy)
    kept, n_kept = _places(independent_terms(xx))
    fitted, scale, scaled_xy = np.zeros(n_terms), np.zeros(n_terms), np.zeros(n_terms)
    solve(xx, xy, kept, n_kept, fitted)
    for i in range(n_kept):
        scale[kept[i]] = abs(fitted[i]) ** gamma
    scaled_xx = np.zeros((n_terms, n_terms))
    for i in range(n_terms):
        scaled_xy[i] = xy[i] * scale[i]
        for j in range(n_terms):
            scaled_xx[i, j] = xx[i, j] * scale[i] * scale[j]
    return lasso_supports(scaled_xx, scaled_xy, max_terms)


@compiled
def _places(mask):
    """Indices of the true entries of a mask, and their number."""
    places, n_places = np.zeros(len(mask), dtype=np.int64), 0
    for j in range(len(mask)):
        if mask[j]:
            places[n_places] = j
            n_places += 1
    return places, n_places


@compiled
def _leave(active, n_active, term):
    kept = 0
    for i in range(n_active):
        if active[i] != term:
            active[kept] = active[i]
            kept += 1
    return kept


@compiled
def thresholded_supports(xx, xy, thresholds):
    """Supports by sequentially thresholded least squares, iterated to convergence per threshold."""
    n_terms = len(xy)
    masks = np.zeros((len(thresholds), n_terms), dtype=np.bool_)
    start, solution = independent_terms(xx), np.zeros(n_terms)
    for m in range(len(thresholds)):
        for j in range(n_terms):
            masks[m, j] = start[j]
        while True:
            active, n_active = _places(masks[m])
            solve(xx, xy, active, n_active, solution)
            n_dropped = 0
            for i in range(n_active):
                if abs(solution[i]) <= thresholds[m]:
                    masks[m, active[i]] = False
                    n_dropped += 1
            if n_dropped == 0:
                break
    return masks


@compiled
def _sweep(source, target, j, size):
    """Eliminate column j: remove its contribution from the rows and columns after j."""
    for a in range(j + 1, size):
        ratio = source[a, j] / source[j, j]
        for b in range(a, size):
            target[a, b] = source[a, b] - ratio * source[b, j]
            target[b, a] = target[a, b]


@compiled
def _join(total, residual, rounding, n_problems):
    """Multiply the product of residuals by one more, in logarithms; plain if there is only one."""
    return residual if n_problems == 1 else total + np.log(max(residual, rounding))


@compiled
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


@compiled
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


@compiled
def _root(xx, xy, yy, depth):
    """Gram matrices of columns and target, room for `depth` levels, and the bounds for zero."""
    n_problems, n_terms = xy.shape
    levels = np.zeros((depth + 1, n_problems, n_terms + 1, n_terms + 1))
    smallest = np.empty((n_problems, n_terms + 1))
    for p in range(n_problems):
        for i in range(n_terms):
            for j in range(n_terms):
                levels[0, p, i, j] = xx[p, i, j]
            levels[0, p, i, n_terms] = levels[0, p, n_terms, i] = xy[p, i]
            smallest[p, i] = DEPENDENT * xx[p, i, i]
        levels[0, p, n_terms, n_terms] = yy[p]
        smallest[p, n_terms] = ROUNDING * yy[p] if yy[p] > 0.0 else 1.0
    return levels, smallest


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


@compiled
def best_subsets(xx, xy, yy, max_terms, n_best, most_work):
    """The `n_best` supports of least residual of every size up to max_terms, proven best or not.

    One support serves several problems, each with its own coefficients. The product of their
    residuals is minimised (for one problem, the residual), so the scales of the targets do not
    matter. If a column depends on those already chosen in a problem, its residual is unchanged.
    The search is depth first over subsets. Residual Gram matrices are kept at every level, so a
    leaf costs one division. A branch is cut if all of its columns together leave a larger
    residual than the best known (Furnival & Wilson 1974, doi:10.1080/00401706.1974.10489231).
    xx: (problems, terms, terms), the most informative columns first, for early cuts;
    xy: (problems, terms); yy: (problems,). most_work: multiplications after which the search ends
    without a proof.
    Returns (supports, terms) of bool, the empty support first, and whether they are proven best.
    """
    n_terms = xy.shape[1]
    depth = min(max_terms, n_terms)
    levels, smallest = _root(xx, xy, yy, depth)
    best = np.empty((depth + 1, n_best))
    for size in range(depth + 1):
        for rank in range(n_best):
            best[size, rank] = np.inf
    best[0, 0] = 0.0
    best_masks = np.zeros((depth + 1, n_best, n_terms), dtype=np.bool_)
    proven = _search(levels, smallest, best, best_masks, most_work)
    found = np.empty((best.size, n_terms), dtype=np.bool_)
    n_found = 0
    for size in range(depth + 1):
        for rank in range(n_best):
            if best[size, rank] < np.inf:
                for j in range(n_terms):
                    found[n_found, j] = best_masks[size, rank, j]
                n_found += 1
    return found[:n_found], proven


@compiled
def _search(levels, smallest, best, best_masks, most_work):
    """Branch and bound of `best_subsets`, from the Gram matrices of the first level.

    Returns false if it ended for the work that it had done.
    """
    n_problems, size = smallest.shape
    depth, n_best, n_terms = best.shape[0] - 1, best.shape[1], size - 1
    scratch = np.empty((size, size))
    chosen = np.zeros(depth + 1, dtype=np.int64)
    following = np.zeros(depth + 1, dtype=np.int64)
    level, work = 0, 0.0
    while level >= 0:
        j = following[level]
        if j >= n_terms or level == depth:
            level -= 1
            continue
        following[level] = j + 1
        residual, adds = 0.0, False
        for p in range(n_problems):  # indexed directly: views would cost more than the arithmetic
            left, pivot = levels[level, p, n_terms, n_terms], levels[level, p, j, j]
            if pivot > smallest[p, j]:
                left -= levels[level, p, j, n_terms] ** 2 / pivot
                adds = True
            residual = _join(residual, left, smallest[p, n_terms], n_problems)
        if not adds:
            continue
        chosen[level] = j
        _offer(residual, chosen, level + 1, best, best_masks)
        if level + 1 == depth or j + 1 == n_terms:
            continue
        _eliminate(levels, level, j, smallest)
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
