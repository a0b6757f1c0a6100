"""One point of a pointwise study, compiled: rows, Gram matrices of all draws, and supports.

At each of thousands of points the arrays are small, and calls of NumPy would cost several times the
arithmetic. A support is held as a code, in which bit j stands for term j; -1 is none. Columns are
terms, then targets, each contiguous in memory.
"""

import numpy as np

from ep2sindy.regression.gram_kernels import fill_solutions
from ep2sindy.regression.row_kernels import dot, spread
from ep2sindy.regression.search_kernels import search_subsets
from ep2sindy.runtime.compilation import GIVEN_ARRAYS, REORDERED, compiled

# REORDERED for kernels that make arrays, or assign whole ones.
OWN_ARRAYS = {key: value for key, value in REORDERED.items() if key not in GIVEN_ARRAYS}


@compiled(**OWN_ARRAYS)
def smooth(values, first, middle, last, out):
    """Write weighted sums over the window about each sample; at the ends, over the last full one.

    values, out: (variables, samples). middle: (window,) weights. first, last: (half, window).
    """
    n_samples, half = values.shape[1], len(middle) // 2
    for v in range(len(values)):
        for i in range(half):
            begin, end = 0.0, 0.0
            for k in range(len(middle)):
                begin += first[i, k] * values[v, k]
                end += last[i, k] * values[v, n_samples - len(middle) + k]
            out[v, i], out[v, n_samples - half + i] = begin, end
        within = out[v, half : n_samples - half]
        for i in range(len(within)):
            within[i] = 0.0
        for k in range(len(middle)):  # outermost, so that the samples fill the vector units
            moved = values[v, k : k + len(within)]
            for i in range(len(within)):
                within[i] += middle[k] * moved[i]


@compiled(**OWN_ARRAYS)
def differentiate(values, weights, out):
    """Write second-order differences. weights: (3, samples), of three neighbours of each sample."""
    last = values.shape[1] - 1
    for v in range(len(values)):
        for i in range(1, last):
            out[v, i] = (
                weights[0, i] * values[v, i - 1]
                + weights[1, i] * values[v, i]
                + weights[2, i] * values[v, i + 1]
            )
        out[v, 0], out[v, last] = 0.0, 0.0
        for k in range(3):
            out[v, 0] += weights[k, 0] * values[v, k]
            out[v, last] += weights[k, last] * values[v, last - 2 + k]


@compiled(**OWN_ARRAYS)
def fill_rows(known, table, rates, train, test, train_rows, test_rows, scale):
    """Write the scaled columns of terms and targets at the training and the held-out samples.

    known: (variables + 1, samples), the last of ones. table: `Library.table`. scale: (columns,),
    to be filled with the norms of the training columns, 1 for a column of zeros.
    """
    n_terms, column = len(table), np.empty(known.shape[1])
    for j in range(len(scale)):
        if j < n_terms:
            first = known[table[j, 0]]
            for i in range(len(column)):
                column[i] = first[i]
            for k in range(1, table.shape[1]):
                if table[j, k] < len(known) - 1:
                    factor = known[table[j, k]]
                    for i in range(len(column)):
                        column[i] *= factor[i]
        else:
            rate = rates[j - n_terms]
            for i in range(len(column)):
                column[i] = rate[i]
        largest, squares = 0.0, 0.0
        for i in range(len(train)):
            train_rows[j, i] = column[train[i]]
            largest = max(largest, abs(train_rows[j, i]))
        over = 1.0 / largest if largest > 0.0 else 1.0  # squares of densities would overflow
        for i in range(len(train)):
            squares += (train_rows[j, i] * over) ** 2
        scale[j] = largest * np.sqrt(squares) if largest > 0.0 else 1.0
        share = 1.0 / scale[j]
        for i in range(len(train)):
            train_rows[j, i] *= share
        for i in range(len(test)):
            test_rows[j, i] = column[test[i]] * share


@compiled(**OWN_ARRAYS)
def fill_running_sums(rows, means, sums):
    """Write the sums over the rows before of the products of all pairs, less their means.

    About their means sums stay small, and keep their digits. means: (pairs,). sums: (rows + 1,
    pairs).
    """
    n_columns = len(rows)
    for pair in range(sums.shape[1]):
        sums[0, pair] = 0.0
    row = np.empty(n_columns)
    for i in range(rows.shape[1]):
        for a in range(n_columns):
            row[a] = rows[a, i]
        pair = 0
        for a in range(n_columns):
            for b in range(a, n_columns):
                sums[i + 1, pair] = sums[i, pair] + (row[a] * row[b] - means[pair])
                pair += 1


@compiled(**OWN_ARRAYS)
def add_steps(starts, places, steps, running, means, n_drawn, sums):
    """Write the sums of products of every draw, from the places where its weights change.

    The weight of row i less that of the row before is minus a step; by parts, the weighted sum is
    that of steps times running sums. Draws of blocks have few steps.
    starts: (draws + 1,), of each draw in places and steps. means: taken off the running sums.
    n_drawn: (draws,) sum of weights.
    """
    for d in range(len(sums)):
        for pair in range(sums.shape[1]):
            sums[d, pair] = n_drawn[d] * means[pair]
        for k in range(starts[d], starts[d + 1]):
            for pair in range(sums.shape[1]):
                sums[d, pair] += steps[k] * running[places[k], pair]


@compiled(**OWN_ARRAYS)
def gram(rows, out):
    """Write the products of all columns: (columns, columns)."""
    for a in range(len(rows)):
        for b in range(a, len(rows)):
            out[a, b] = out[b, a] = dot(rows[a], rows[b])


@compiled(**OWN_ARRAYS)
def alike(states, limit):
    """True if two states are correlated by more than `limit`."""
    unit = np.empty(states.shape)
    for s in range(len(states)):
        row, own = states[s], unit[s]
        mean = 0.0
        for i in range(len(row)):
            mean += row[i]
        mean /= len(row)
        for i in range(len(row)):
            own[i] = row[i] - mean
        share = 1.0 / np.sqrt(dot(own, own))
        for i in range(len(row)):
            own[i] *= share
        for r in range(s):
            if abs(dot(unit[r], unit[s])) >= limit:
                return True
    return False


@compiled
def _code(mask):
    """Code of a mask."""
    code = 0
    for j in range(len(mask)):
        if mask[j]:
            code |= 1 << j
    return code


@compiled
def _write_mask(code, mask):
    """Write the mask of a code; returns its number of terms."""
    size = 0
    for j in range(len(mask)):
        mask[j] = (code >> j) & 1 == 1
        size += mask[j]
    return size


@compiled
def _order_by_size(values, order):
    """Write the places of the values, the largest in size first, equal ones in order."""
    for a in range(len(values)):  # insertion; numba's sort takes a second to compile
        place = a
        while place > 0 and abs(values[order[place - 1]]) < abs(values[a]):
            order[place] = order[place - 1]
            place -= 1
        order[place] = a


@compiled
def supports_of_draws(xx, xy, yy, largest, max_terms, most_work, codes):
    """Write the best support of every size in every draw, for each equation.

    codes: (equations, draws, sizes), with -1 where there is none. Returns false if a support is not
    proven best.
    """
    n_draws, n_equations, n_terms = xy.shape
    ordered_xx, ordered_xy = np.empty((1, n_terms, n_terms)), np.empty((1, n_terms))
    ordered_yy, mask = np.empty(1), np.empty(n_terms, dtype=np.bool_)
    order = np.empty(n_terms, dtype=np.int64)
    depth = min(max_terms, n_terms)
    levels = np.empty((depth + 1, 1, n_terms + 1, n_terms + 1))
    smallest = np.empty((1, n_terms + 1))
    scratch, best = np.empty((n_terms + 1, n_terms + 1)), np.empty((depth + 1, 1))
    chosen, following = np.empty(depth + 1, dtype=np.int64), np.empty(depth + 1, dtype=np.int64)
    best_masks = np.empty((depth + 1, 1, n_terms), dtype=np.bool_)
    for e in range(n_equations):
        for d in range(n_draws):
            _order_by_size(xy[d, e], order)
            for size in range(codes.shape[2]):
                codes[e, d, size] = -1
            for a in range(n_terms):
                ordered_xy[0, a] = xy[d, e, order[a]]
                for b in range(n_terms):
                    ordered_xx[0, a, b] = xx[d, order[a], order[b]]
            ordered_yy[0] = yy[d, e]
            if not search_subsets(
                ordered_xx, ordered_xy, ordered_yy, most_work, levels, smallest, scratch, chosen,
                following, best, best_masks,
            ):  # fmt: skip
                return False
            for size in range(min(largest, depth) + 1):
                if best[size, 0] < np.inf:
                    for a in range(n_terms):
                        mask[order[a]] = best_masks[size, 0, a]
                    codes[e, d, size] = _code(mask)
    return True


@compiled
def best_of_sizes(codes, train, judge, best):
    """Write the support of each size that explains most on the rows that judge.

    train, judge: (columns, columns), Gram matrices. best: (equations, sizes) of codes.
    """
    n_equations, n_draws, n_sizes = codes.shape
    n_terms = len(train) - n_equations
    mask = np.empty((1, n_terms), dtype=np.bool_)
    rhs, fit = np.empty((1, n_terms)), np.empty((1, n_terms))
    lower, solution = np.empty((n_terms, n_terms)), np.empty(n_terms)
    active = np.empty(n_terms, dtype=np.int64)
    for e in range(n_equations):
        y = n_terms + e
        best[e, 0] = 0
        for size in range(1, n_sizes):
            most, best[e, size] = -np.inf, -1
            for d in range(n_draws):
                code, earlier = codes[e, d, size], 0
                while codes[e, earlier, size] != code:
                    earlier += 1
                if code < 0 or earlier < d:
                    continue
                _write_mask(code, mask[0])
                for a in range(n_terms):
                    rhs[0, a] = train[y, a] if mask[0, a] else 0.0
                fill_solutions(train, rhs, mask, fit, lower, solution, active)
                coef = fit[0]
                explained = 0.0
                for a in range(n_terms):
                    change = 2.0 * judge[y, a]
                    for b in range(n_terms):
                        change -= coef[b] * judge[a, b]
                    explained += coef[a] * change
                if explained > most:  # false for the NaN of dependent terms
                    most, best[e, size] = explained, code


@compiled(**OWN_ARRAYS)
def _residual(rows, target, coef, out):
    """Write target - sum of coef times column; returns its sum of squares."""
    aim = rows[target]
    for i in range(len(out)):
        out[i] = aim[i]
    for a in range(len(coef)):
        if coef[a] != 0.0:
            row = rows[a]
            for i in range(len(out)):
                out[i] -= coef[a] * row[i]
    return dot(out, out)


@compiled(**OWN_ARRAYS)
def fit_best(best, gram, train_rows, test_rows, refined, coef, squares, r2_train, r2_test):
    """Fit the best support of every size to the training rows, and score it on both.

    As in `pareto_front`, solutions of the Gram matrix are refined by the residuals of the rows.
    refined: correction, as a share of coefficients, that needs no other one. best: (equations,
    sizes) of codes. coef: (equations, sizes, terms), of scaled columns. squares:
    of the training residuals. r2_test: NaN if no rows are held out.
    """
    n_equations, n_sizes, n_terms = coef.shape
    mask = np.empty((1, n_terms), dtype=np.bool_)
    rhs, fit = np.empty((1, n_terms)), np.empty((1, n_terms))
    lower, solution = np.empty((n_terms, n_terms)), np.empty(n_terms)
    active = np.empty(n_terms, dtype=np.int64)
    left, left_test = np.empty(train_rows.shape[1]), np.empty(test_rows.shape[1])
    for e in range(n_equations):
        y = n_terms + e
        total = spread(train_rows[y])
        total_test = spread(test_rows[y])
        for size in range(n_sizes):
            for a in range(n_terms):
                coef[e, size, a] = 0.0
            if best[e, size] < 0:
                continue
            _write_mask(best[e, size], mask[0])
            for a in range(n_terms):
                rhs[0, a] = gram[y, a] if mask[0, a] else 0.0
            fill_solutions(gram, rhs, mask, fit, lower, solution, active)
            for a in range(n_terms):
                coef[e, size, a] = fit[0, a]
            for _ in range(2):
                _residual(train_rows, y, coef[e, size], left)
                for a in range(n_terms):
                    rhs[0, a] = dot(left, train_rows[a]) if mask[0, a] else 0.0
                fill_solutions(gram, rhs, mask, fit, lower, solution, active)
                largest, longest = 0.0, 0.0
                for a in range(n_terms):
                    coef[e, size, a] += fit[0, a]
                    longest = max(longest, abs(fit[0, a]))
                    largest = max(largest, abs(coef[e, size, a]))
                if longest <= refined * largest:
                    break  # the next step would be as much smaller again
            squares[e, size] = _residual(train_rows, y, coef[e, size], left)
            r2_train[e, size] = 1.0 - squares[e, size] / total
            tested = _residual(test_rows, y, coef[e, size], left_test)
            r2_test[e, size] = 1.0 - tested / total_test


@compiled
def count_terms(codes, kept, inclusion):
    """Write the share of draws, of those that kept a term, whose support of each size held it.

    inclusion: (equations, sizes, terms).
    """
    n_equations, n_draws, n_sizes = codes.shape
    n_terms = kept.shape[1]
    for a in range(n_terms):
        n_kept = 0
        for d in range(n_draws):
            n_kept += kept[d, a]
        for e in range(n_equations):
            for size in range(n_sizes):
                n_held = 0
                for d in range(n_draws):
                    code = codes[e, d, size]
                    n_held += code >= 0 and (code >> a) & 1 == 1
                inclusion[e, size, a] = n_held / max(n_kept, 1)


@compiled
def fit_draws(codes, chosen, xx, xy, scale, coef):
    """Fit each draw's own support of the size chosen for an equation: as `Resamples.fits`.

    chosen: (equations,) of codes. coef: (draws, equations, terms), of the problem's scaled columns.
    """
    n_draws, n_equations, n_terms = coef.shape
    mask = np.empty((1, n_terms), dtype=np.bool_)
    rhs, fit = np.empty((1, n_terms)), np.empty((1, n_terms))
    lower, solution = np.empty((n_terms, n_terms)), np.empty(n_terms)
    active = np.empty(n_terms, dtype=np.int64)
    for e in range(n_equations):
        size = _write_mask(chosen[e], mask[0])
        for d in range(n_draws):
            own = codes[e, d, size]
            _write_mask(own if own >= 0 else chosen[e], mask[0])
            for a in range(n_terms):
                mask[0, a] &= scale[d, a] > 0.0
                rhs[0, a] = xy[d, e, a] if mask[0, a] else 0.0
            fill_solutions(xx[d], rhs, mask, fit, lower, solution, active)
            for a in range(n_terms):
                coef[d, e, a] = fit[0, a] * scale[d, a]
