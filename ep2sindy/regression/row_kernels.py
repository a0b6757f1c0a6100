"""Compiled passes over the rows of a regression: scaling, sums of products, residuals, draws.

Columns are terms, then targets; each is contiguous in memory, (columns, rows).
"""

import numpy as np

from ep2sindy.runtime.compilation import REORDERED, compiled

TILE = 1024  # rows whose residual stays in the fastest cache


@compiled(**REORDERED)
def dot(left, right):
    """Scalar product."""
    total = 0.0
    for i in range(len(left)):
        total += left[i] * right[i]
    return total


@compiled(**REORDERED)
def spread(values):
    """Sum of squares about the mean, exactly zero for a constant."""
    mean, squares = 0.0, 0.0
    for i in range(len(values)):
        mean += values[i] - values[0]
    mean /= len(values)
    for i in range(len(values)):
        squares += (values[i] - values[0] - mean) ** 2
    return squares


@compiled(**REORDERED)
def gather_columns(values, places, norms, first, columns):
    """Write some rows of values, (rows, _), over their norms, to the columns from `first` on."""
    for j in range(len(norms)):
        column, share = columns[first + j], 1.0 / norms[j]
        for i in range(len(places)):
            column[i] = values[places[i], j] * share


@compiled(**REORDERED)
def fill_products(columns, first, n_rows, products):
    """Write the products of all pairs of columns, of n_rows from row `first` on: (pairs, room)."""
    pair, end = 0, first + n_rows
    for a in range(len(columns)):
        left = columns[a, first:end]
        for b in range(a, len(columns)):
            right, out = columns[b, first:end], products[pair, :n_rows]
            for i in range(len(out)):  # views, whose indices need no check, fill the vector units
                out[i] = left[i] * right[i]
            pair += 1


@compiled
def scale_draws(sums, kept, xx, xy, yy, scale):
    """Write the Gram matrices of every draw, its kept terms scaled to unit norm.

    sums: (draws, pairs). kept: (draws, terms). xx, xy, yy, scale: as in `Resamples`.
    """
    n_terms = kept.shape[1]
    n_columns = n_terms + xy.shape[1]
    for d in range(len(sums)):
        pair = 0
        for a in range(n_columns):
            if a < n_terms:
                is_there = kept[d, a] and sums[d, pair] > 0.0
                scale[d, a] = 1.0 / np.sqrt(sums[d, pair]) if is_there else 0.0
            for b in range(a, n_columns):
                if b < n_terms:
                    xx[d, a, b] = xx[d, b, a] = sums[d, pair]
                elif a < n_terms:
                    xy[d, b - n_terms, a] = sums[d, pair] * scale[d, a]
                elif a == b:
                    yy[d, a - n_terms] = sums[d, pair]
                pair += 1
        for a in range(n_terms):
            for b in range(n_terms):
                xx[d, a, b] *= scale[d, a] * scale[d, b]


@compiled
def count_drawn(first, ends, n_drawn, block, counts):
    """Count how often each row occurs in every draw of runs of `block` rows.

    first: of each run. ends: (draws,), number of runs up to each draw, of which n_drawn rows count;
    the last run is cut. counts: (draws, rows).
    """
    start = 0
    for d in range(len(ends)):
        row, left = counts[d], n_drawn[d]
        for i in range(len(row)):
            row[i] = 0.0
        for place in first[start : ends[d]]:
            if block == 1:
                row[place] += 1.0
                continue
            for i in range(place, place + min(block, left)):
                row[i] += 1.0
            left -= block
        start = ends[d]


@compiled(**REORDERED)
def add_residuals(columns, target, coef, left, products, squares):
    """Add to `squares` the squares of every fit's residual, and to `products` those with its terms.

    Every fit goes over the rows once, with its own terms alone: a product of matrices would take
    all terms, and the residuals of all fits would leave the cache before they are squared.
    target: number of a column. coef: (fits, terms). products: (fits, terms), or (0, terms) if they
    are not asked for. left: (TILE,), scratch.
    """
    n_rows, n_terms = columns.shape[1], coef.shape[1]
    for start in range(0, n_rows, len(left)):
        end = min(start + len(left), n_rows)
        here = left[: end - start]
        for k in range(len(coef)):
            aim = columns[target, start:end]
            for i in range(len(here)):
                here[i] = aim[i]
            for j in range(n_terms):
                if coef[k, j] != 0.0:
                    term, factor = columns[j, start:end], coef[k, j]
                    for i in range(len(here)):
                        here[i] -= factor * term[i]
            squares[k] += dot(here, here)
            for j in range(n_terms if len(products) else 0):
                if coef[k, j] != 0.0:
                    products[k, j] += dot(here, columns[j, start:end])
