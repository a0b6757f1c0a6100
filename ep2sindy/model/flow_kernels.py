"""Compiled Runge-Kutta steps of many samples at once, with the derivatives of their ends.

LANES samples go through all stages side by side: what they need stays in the cache, and every
innermost loop is over the lanes, a few vector operations. Loops this short cost about as much to
start as to run: sixteen lanes take twice as long for two or three states.

The derivatives are not integrated column by column. A change of the slope at stage s changes the
end of the step by the matrix `gains[s]`, which follows from the Jacobians of the later stages. So
each coefficient costs four products per state, however the states are coupled.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ep2sindy.runtime.compilation import LOOPS, compiled

LANES = 64


class SumsOfProducts(NamedTuple):
    """Right-hand sides and their derivatives as weighted sums of products of columns.

    table: (products, factors), columns whose product it is: states, inputs, and ones last.
    Entry e adds weight[e] times product[e] to sum target[e]. The sums are the slopes of the d
    states, then the derivative of the slope of state row[q] by state factor[q], then the derivative
    of the slope of state equation[r] by coefficient column[r]. reach: (d, d), true where a step
    carries a change of state k to state j, by four Jacobian entries at most.
    """

    table: np.ndarray
    product: np.ndarray
    target: np.ndarray
    weight: np.ndarray
    row: np.ndarray
    factor: np.ndarray
    equation: np.ndarray
    column: np.ndarray
    reach: np.ndarray


def sums_of_products(
    table: np.ndarray, weights: Float[np.ndarray, "d columns products"]
) -> SumsOfProducts:
    """Rates and derivatives as the kernel takes them, without the weights that are zero.

    table: (products, factors), as of a library over states and inputs. Columns of the weights: the
    rate, its derivatives by each state, then by each coefficient.
    """
    there = weights != 0.0
    needed, product, target, *where = _order_of_sums(there.shape, there.tobytes())
    table = table if len(needed) == len(table) else table[needed]
    return SumsOfProducts(table, product, target, weights[there], *where)


@lru_cache(maxsize=256)  # a fit takes many steps in which the same weights stay zero
def _order_of_sums(shape: tuple[int, int, int], there: bytes) -> tuple[np.ndarray, ...]:
    """The products that are used, and the fields of `SumsOfProducts` that hold no weights.

    There is a sum of products for every rate, then for every derivative that is not zero.
    """
    d, width = shape[:2]
    state, column, product = np.nonzero(np.frombuffer(there, dtype=np.bool_).reshape(shape))
    by_state, by_coefficient = (column > 0) & (column <= d), column > d
    code = state * width + column
    pairs, pair = np.unique(code[by_state], return_inverse=True)
    sources, source = np.unique(code[by_coefficient], return_inverse=True)
    target = state.copy()
    target[by_state] = d + pair
    target[by_coefficient] = d + len(pairs) + source
    row, factor = pairs // width, pairs % width - 1
    carried = np.eye(d)
    carried[row, factor] = 1.0
    reach = np.linalg.matrix_power(carried, 4) > 0.0
    # Columns of `nonzero` are strided, and the kernel would be compiled once more for them; those
    # of `unique` are not.
    needed, product = np.unique(product, return_inverse=True)
    return needed, product, target, row, factor, sources // width, sources % width - 1 - d, reach


@compiled(inline="always")
def _place(s, here, inputs, position, first, h, leads, sums, columns):
    """Columns at stage s: the state, then the inputs, at `position` and from sample `first`."""
    d, last = len(here), inputs.shape[1] - 1
    for m in range(inputs.shape[2]):
        for i in range(LANES):
            sample = first + i if first + i < last else last
            columns[d + m, i] = inputs[position, sample, m]
    for j in range(d):
        for i in range(LANES):
            columns[j, i] = here[j, i]
        for earlier in range(s):
            lead = leads[s, earlier]
            if lead != 0.0:
                for i in range(LANES):
                    columns[j, i] += lead * h[i] * sums[earlier, j, i]


@compiled(inline="always")
def _sum_products(s, columns, table, product, target, weight, values, sums):
    """Values of the products, and their weighted sums, at stage s."""
    one = len(columns) - 1
    for m in range(len(table)):
        for i in range(LANES):
            values[m, i] = columns[table[m, 0], i]
        for k in range(1, table.shape[1]):
            if table[m, k] != one:
                for i in range(LANES):
                    values[m, i] *= columns[table[m, k], i]
    for e in range(sums.shape[1]):
        for i in range(LANES):
            sums[s, e, i] = 0.0
    for e in range(len(product)):
        for i in range(LANES):
            sums[s, target[e], i] += weight[e] * values[product[e], i]


@compiled(inline="always")
def _gains(sums, row, factor, leads, weights, h, gains, by_state):
    """Change of the end of a step per change of the slope at each stage, and of its start."""
    d = len(by_state)
    # The end is x + sum_s w_s h k_s: by_state starts as the identity, gains[s] as w_s h times it.
    for j in range(d):
        for k in range(d):
            for i in range(LANES):
                by_state[j, k, i] = 1.0 if j == k else 0.0
                for s in range(4):
                    gains[s, j, k, i] = weights[s] * h[i] if j == k else 0.0
    # Backwards over the stages, k_later = f(x + h sum_s a_(later, s) k_s), so that
    # gains[s] += h a_(later, s) gains[later] J_later, and then by_state += gains[s] J_s.
    for s in range(3, -1, -1):
        for later in range(s + 1, 4):
            lead = leads[later, s]
            if lead != 0.0:
                for j in range(d):
                    for q in range(len(row)):
                        for i in range(LANES):
                            product = lead * h[i] * gains[later, j, row[q], i]
                            gains[s, j, factor[q], i] += product * sums[later, d + q, i]
        for j in range(d):
            for q in range(len(row)):
                for i in range(LANES):
                    by_state[j, factor[q], i] += gains[s, j, row[q], i] * sums[s, d + q, i]


@compiled(inline="always")
def _carry(by, by_state, reach, first, total):
    """Carry all derivatives (columns, d, lanes) over a step; before the first they are trivial."""
    d = len(by_state)
    for c in range(len(by)):
        for j in range(d):
            for i in range(LANES):
                total[j, i] = by_state[j, c, i] if first and c < d else 0.0
            if not first:
                for k in range(d):
                    if reach[j, k]:
                        for i in range(LANES):
                            total[j, i] += by_state[j, k, i] * by[c, k, i]
        for j in range(d):
            for i in range(LANES):
                by[c, j, i] = total[j, i]


@compiled(inline="always")
def _add_sources(by, gains, sums, n_jacobian, reach, equation, column):
    """Add what the coefficients change directly within the step."""
    d = gains.shape[1]
    for r in range(len(equation)):
        c, e, at = d + column[r], equation[r], d + n_jacobian + r
        for j in range(d):
            if reach[j, e]:
                for i in range(LANES):
                    by[c, j, i] += (
                        gains[0, j, e, i] * sums[0, at, i]
                        + gains[1, j, e, i] * sums[1, at, i]
                        + gains[2, j, e, i] * sums[2, at, i]
                        + gains[3, j, e, i] * sums[3, at, i]
                    )


def advance(states, inputs, steps, tableau, equations, ends, slopes):
    """Write the states at the end of every step to `ends` (n, d), and derivatives to `slopes`.

    slopes: (n, d, d + coefficients) and more, whose further columns are not touched, or (n, d, 0)
    if none are asked for; by the states at the start, then by the coefficients. steps: (n,), length
    of one substep. inputs: (stride * substeps + 1, n, inputs), at the positions of the tableau.
    """
    d, column = states.shape[1], equations.column
    n_columns = d + column.max(initial=-1) + 1 if slopes.shape[2] else 0
    n_sums = d + len(equations.row) + len(column)
    _advance(
        states, inputs, steps, *tableau, *equations, ends, slopes,
        np.ones((d + inputs.shape[2] + 1, LANES)), np.empty((len(equations.table), LANES)),
        np.empty((4, n_sums, LANES)), *np.empty((2, d, LANES)), np.empty(LANES),
        np.empty((n_columns, d, LANES)), np.empty((d, d, LANES)), np.empty((4, d, d, LANES)),
    )  # fmt: skip


@compiled(**LOOPS)
def _advance(
    states, inputs, steps, leads, weights, places, stride,
    table, product, target, weight, row, factor, equation, column, reach, ends, slopes,
    columns, values, sums, here, total, h, by, by_state, gains,
):  # fmt: skip
    """`advance`, with the fields of its tuples one by one and with what it computes in between."""
    (n, d), n_columns = states.shape, len(by)
    for first in range(0, n, LANES):
        for i in range(LANES):
            k = first + i if first + i < n else n - 1  # lanes beyond the end repeat the last sample
            h[i] = steps[k]
            for j in range(d):
                here[j, i] = states[k, j]
        for place in range(0, len(inputs) - 1, stride):
            for s in range(4):
                _place(s, here, inputs, place + places[s], first, h, leads, sums, columns)
                _sum_products(s, columns, table, product, target, weight, values, sums)
            for j in range(d):
                for s in range(4):
                    for i in range(LANES):
                        here[j, i] += weights[s] * h[i] * sums[s, j, i]
            if n_columns:
                _gains(sums, row, factor, leads, weights, h, gains, by_state)
                _carry(by, by_state, reach, place == 0, total)
                _add_sources(by, gains, sums, len(row), reach, equation, column)
        for i in range(min(LANES, n - first)):
            for j in range(d):
                ends[first + i, j] = here[j, i]
                for c in range(n_columns):
                    slopes[first + i, j, c] = by[c, j, i]
