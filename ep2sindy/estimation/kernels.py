"""Compiled kernels of the trajectory likelihood: filter and smoother.

A record has n samples of d states; p coefficients are free. The flow maps a state over one step
between samples; `flow`: (n - 1, d, d + p) holds its derivatives with respect to the state, then to
the coefficients. Everything is linearised about a path: `misses` (n - 1, d) is the flow minus the
next state of the path, `residuals` (n, d) is the samples minus the path, and the unknowns are
departures from the path.

A filter keeps one row for each state: its mean, the derivatives of the mean by the p coefficients,
and its row of the covariance. The observation of a sample subtracts a multiple of one row from all
rows, and a step replaces each row by a sum of rows, so both are sums of contiguous numbers. The
kernels are loops, and are given all arrays that they fill, because array expressions and new arrays
take seconds more to compile.
"""

import numpy as np

from ep2sindy.runtime.compilation import INNER, LOOPS, compiled

VECTOR = 4  # numbers; rows are padded to whole ones
# Rows that wait for their product of matrices hold as many numbers as stay in the cache, but are
# enough that the product takes longer than its addition to the others.
PIECE, FEWEST = 2**15, 64
TINY, HUGE = 1e-100, 1e100  # bounds of a product of variances before its logarithm is taken


@compiled(**INNER)
def _add(row, factor, total):
    for c in range(len(row)):
        total[c] += factor * row[c]


@compiled(**INNER)
def _copy(row, out):
    for c in range(len(out)):
        out[c] = row[c]


@compiled(**INNER)
def _observe(i, residual, variance, state, cov, row, gain):
    """Update all rows with one sample of state i; returns the innovation's variance and its weight.

    cov: first column of the covariance. `row` becomes the row of state i before the update, with
    minus the innovation in place of its mean.
    """
    _copy(state[i], row)
    row[0] -= residual
    spread = row[cov + i] + variance
    weight = 1.0 / spread
    for j in range(len(state)):
        gain[j] = weight * state[j, cov + i]
    for j in range(len(state)):
        if j != i:
            _add(row, -gain[j], state[j])
    # What differences would lose where the state was far less certain than the sample.
    left = weight * variance
    own = state[i]
    for c in range(len(own)):
        own[c] = left * row[c]
    own[0] += residual
    for j in range(len(state)):
        state[j, cov + i] = own[cov + j]
    return spread, weight


@compiled(**INNER)
def _step(flow, miss, process, state, cov, ahead, row):
    """Write to `ahead` the rows of all states, propagated over one step."""
    d = len(flow)
    for i in range(d):
        new = ahead[i]
        new[0] = miss[i]
        _copy(flow[i, d:], new[1:cov])
        for c in range(cov, len(new)):
            new[c] = 0.0
        for j in range(d):
            _add(state[j], flow[i, j], new)
        for m in range(i + 1):
            row[m] = 0.0
            for j in range(d):
                row[m] += new[cov + j] * flow[m, j]
        for m in range(i + 1):
            new[cov + m] = row[m]
            ahead[m, cov + i] = row[m]
        new[cov + i] += process[i]


def _at_start(d, p, free_start):
    """Rows of d states that nothing is known of, and the first column of their covariance."""
    cov = 1 + p
    state = np.zeros((d, -(-(cov + d) // VECTOR) * VECTOR))
    state[:, cov : cov + d] = free_start * np.eye(d)
    return state, cov


def eliminate(flow, misses, residuals, variance, process, free_start):
    """Eliminate all states: the squares as a quadratic function of the coefficients alone.

    variance: (n, d), of the samples' noise; process: (n - 1, d), of the flow's error; free_start:
    prior variance of the first state. A residual that is not finite counts as a missing sample.
    Returns hessian (p, p), gradient (p,), least, and the sum of the logarithms of the innovations'
    variances. For a change c of the coefficients the squares are least - 2 gradient' c + c' hessian
    c. Exact for the linearised problem (de Jong 1991, doi:10.1214/aos/1176348139).
    """
    n, d = residuals.shape
    state, cov = _at_start(d, flow.shape[2] - d, free_start)
    n_rows = max(FEWEST, PIECE // cov)
    told, room = np.empty((min(n, max(1, n_rows // d)), d, cov)), _room_of(state)
    gram, log_spread, case = np.zeros((cov, cov)), 0.0, (misses, residuals, variance, process)
    for first in range(0, n, len(told)):
        log_spread += _filter(first, flow, *case, state, cov, *room, told, *_nothing(d))
        rows = told[: n - first].reshape(-1, cov)
        gram += rows.T @ rows
    return gram[1:, 1:], -gram[0, 1:], gram[0, 0], log_spread


def filtered(flow, misses, residuals, variance, process, free_start):
    """Innovations (n, d), and mean (d,) and covariance (d, d) of the last departure from the path.

    An innovation is what a sample brings that the past did not tell, in its standard deviation; NaN
    where nothing was measured. Arguments as for `departures`.
    """
    n, d = residuals.shape
    state, cov = _at_start(d, 0, free_start)
    told, case = np.empty((n, d, cov)), (misses, residuals, variance, process)
    _filter(0, flow, *case, state, cov, *_room_of(state), told, *_nothing(d))
    found = np.where(np.isfinite(residuals), -told[:, :, 0], np.nan)
    return found, state[:, 0], state[:, cov : cov + d]


def departures(flow, misses, residuals, variance, process, free_start):
    """Departures (n, d) of all states from the path that minimise the squares.

    Arguments as for `eliminate`, but only the first d columns of `flow` are used. The backward pass
    is the adjoint of the filter, which inverts no matrix (Bierman 1973,
    doi:10.1016/0005-1098(73)90089-3).
    """
    n, d = residuals.shape
    state, cov = _at_start(d, 0, free_start)
    told, roots, states = np.empty((n, d, cov + d)), np.empty((n, d)), np.empty((n, *state.shape))
    case = misses, residuals, variance, process
    _filter(0, flow, *case, state, cov, *_room_of(state), told, roots, states)
    found = np.empty((n, d))
    _look_back(flow, told, roots, states, cov, np.zeros((2, d)), found)
    return found


def _room_of(state):
    """Scratch of `_filter`: the rows ahead, one row, and the gains."""
    return np.empty_like(state), np.empty(state.shape[1]), np.empty(len(state))


def _nothing(d):
    """Arrays that keep no roots and states of `_filter`."""
    return np.empty((0, d)), np.empty((0, d, 0))


@compiled(**LOOPS)
def _filter(
    first, flow, misses, residuals, variance, process, state, cov, ahead, row, gain, told, roots,
    states,
):  # fmt: skip
    """Filter the samples from `first` on, as many as `told` (samples, d, columns) has room for.

    state: the rows before the first sample, then before the next one. Written to `told` are the
    first columns of each observed row (see `_observe`), over the standard deviation of the
    innovation; zero where nothing was measured. Kept, if they have room, are the inverses of these
    deviations in `roots` (n, d), and in `states` (n, d, columns) the rows before each sample.
    Returns the sum of the logarithms of the innovations' variances.
    """
    product, log_spread = 1.0, 0.0
    for k in range(first, min(first + len(told), len(residuals))):
        if len(states):
            for i in range(len(state)):
                _copy(state[i], states[k, i])
        for i in range(len(state)):
            out, root = told[k - first, i], 0.0
            if np.isfinite(residuals[k, i]):
                spread, weight = _observe(i, residuals[k, i], variance[k, i], state, cov, row, gain)
                root = np.sqrt(weight)
                product *= spread
                if not TINY < product < HUGE:  # fewer logarithms
                    log_spread += np.log(product)
                    product = 1.0
            else:
                for c in range(len(row)):
                    row[c] = 0.0
            for c in range(len(out)):
                out[c] = root * row[c]
            if len(roots):
                roots[k, i] = root
        if k < len(flow):
            _step(flow[k], misses[k], process[k], state, cov, ahead, row)
            for i in range(len(state)):
                _copy(ahead[i], state[i])
    return log_spread + np.log(product)


@compiled(**LOOPS)
def _look_back(flow, told, roots, states, cov, adjoints, found):
    """Write the departures to `found` (n, d), from what the filter kept of every sample."""
    (n, d), adjoint, carried = found.shape, adjoints[0], adjoints[1]
    for k in range(n - 1, -1, -1):
        for j in range(d):
            carried[j] = 0.0
        if k < n - 1:
            for i in range(d):
                for j in range(d):
                    carried[j] += flow[k, i, j] * adjoint[i]
        _copy(carried, adjoint)
        for i in range(d - 1, -1, -1):
            value = -told[k, i, 0]
            for j in range(d):
                value += told[k, i, cov + j] * adjoint[j]
            adjoint[i] -= roots[k, i] * value
        for i in range(d):
            value = states[k, i, 0]
            for j in range(d):
                value -= states[k, i, cov + j] * adjoint[j]
            found[k, i] = value
