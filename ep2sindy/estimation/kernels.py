"""Compiled kernels of the trajectory likelihood: filter and smoother.

A record has n samples of d states; p coefficients are free. The flow maps a state over one step
between samples; `flow`: (n - 1, d, d + p) holds its derivatives with respect to the state, then to
the coefficients. Everything is linearised about a path: `defects` (n - 1, d) is the flow minus the
next state of the path, `residuals` (n, d) is the samples minus the path, and the unknowns are
corrections of the path. With F_k the derivatives by the state, G_k those by the coefficients and c
the change of these, the correction x_k of a state follows

    x_(k+1) = F_k x_k + G_k c + defects_k + process noise,    residuals_k = x_k + noise

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
    # Innovation e = y_i - x_i with its derivatives by the coefficients, and its variance
    # s = P_ii + R_i.
    _copy(state[i], row)
    row[0] -= residual
    spread = row[cov + i] + variance
    # Kalman gain K_j = P_ji / s.
    weight = 1.0 / spread
    for j in range(len(state)):
        gain[j] = weight * state[j, cov + i]
    # Kalman update of the other states: x_j + K_j e, and P_jl - K_j P_il.
    for j in range(len(state)):
        if j != i:
            _add(row, -gain[j], state[j])
    # Kalman update of state i itself: x_i + K_i e = y_i - (R_i / s) e, and P_il R_i / s. The usual
    # differences would lose digits where the state was far less certain than the sample.
    left = weight * variance
    own = state[i]
    for c in range(len(own)):
        own[c] = left * row[c]
    own[0] += residual
    # The covariance is symmetric: column i becomes row i.
    for j in range(len(state)):
        state[j, cov + i] = own[cov + j]
    return spread, weight


@compiled(**INNER)
def _step(flow, defect, process, state, cov, ahead, row):
    """Write to `ahead` the rows of all states, propagated over one step."""
    d = len(flow)
    for i in range(d):
        # Prediction of the mean and its derivatives: F x + defect, and F dx/dc + G. The columns of
        # the covariance hold row i of F P meanwhile.
        new = ahead[i]
        new[0] = defect[i]
        _copy(flow[i, d:], new[1:cov])
        for c in range(cov, len(new)):
            new[c] = 0.0
        for j in range(d):
            _add(state[j], flow[i, j], new)
        # Prediction of the covariance, F P F' + Q: its lower triangle, and the mirror image.
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
    state = np.zeros((d, -(-(cov + d) // VECTOR) * VECTOR))  # rounded up
    state[:, cov : cov + d] = free_start * np.eye(d)
    return state, cov


def marginalise(flow, defects, residuals, variance, process, free_start):
    """Marginalise all states: the squares as a quadratic function of the coefficients alone.

    variance: (n, d), of the samples' noise; process: (n - 1, d), of the flow's error; free_start:
    prior variance of the first state. A residual that is not finite counts as a missing sample.
    Returns hessian (p, p), gradient (p,), least, and the sum of the logarithms of the innovations'
    variances. For a change c of the coefficients the squares are least - 2 gradient' c + c' hessian
    c. Exact for the linearised problem (de Jong 1991, doi:10.1214/aos/1176348139).
    """
    n, d = residuals.shape
    state, cov = _at_start(d, flow.shape[2] - d, free_start)
    n_rows = max(FEWEST, PIECE // cov)
    whitened, room = np.empty((min(n, max(1, n_rows // d)), d, cov)), _workspace_of(state)
    gram, log_spread, case = np.zeros((cov, cov)), 0.0, (defects, residuals, variance, process)
    # Each whitened row is (-e, -de/dc) / sqrt(s) of one sample, so that the sum of their squares, a
    # quadratic function of c, is the sum over samples of e^2 / s.
    for first in range(0, n, len(whitened)):
        log_spread += _filter(first, flow, *case, state, cov, *room, whitened, *_no_history(d))
        rows = whitened[: n - first].reshape(-1, cov)
        gram += rows.T @ rows
    return gram[1:, 1:], -gram[0, 1:], gram[0, 0], log_spread


def filter_states(flow, defects, residuals, variance, process, free_start):
    """Innovations (n, d), and mean (d,) and covariance (d, d) of the last state's correction.

    An innovation is what a sample brings that the past did not tell, in its standard deviation; NaN
    where nothing was measured. Arguments as for `smooth_corrections`.
    """
    n, d = residuals.shape
    state, cov = _at_start(d, 0, free_start)
    whitened, case = np.empty((n, d, cov)), (defects, residuals, variance, process)
    _filter(0, flow, *case, state, cov, *_workspace_of(state), whitened, *_no_history(d))
    found = np.where(np.isfinite(residuals), -whitened[:, :, 0], np.nan)
    return found, state[:, 0], state[:, cov : cov + d]


def smooth_corrections(flow, defects, residuals, variance, process, free_start):
    """Corrections (n, d) of all states of the path that minimise the squares, given all samples.

    Arguments as for `marginalise`, but only the first d columns of `flow` are used. The backward
    pass is the adjoint of the filter, which inverts no matrix (Bierman 1973,
    doi:10.1016/0005-1098(73)90089-3).
    """
    n, d = residuals.shape
    state, cov = _at_start(d, 0, free_start)
    whitened, case = np.empty((n, d, cov + d)), (defects, residuals, variance, process)
    history = np.empty((n, d)), np.empty((n, *state.shape))
    _filter(0, flow, *case, state, cov, *_workspace_of(state), whitened, *history)
    found = np.empty((n, d))
    _look_back(flow, whitened, *history, cov, np.zeros((2, d)), found)
    return found


def _workspace_of(state):
    """Scratch of `_filter`: the rows ahead, one row, and the gains."""
    return np.empty_like(state), np.empty(state.shape[1]), np.empty(len(state))


def _no_history(d):
    """Arrays without room for the roots and states of `_filter`."""
    return np.empty((0, d)), np.empty((0, d, 0))


@compiled(**LOOPS)
def _filter(
    first, flow, defects, residuals, variance, process, state, cov, ahead, row, gain, whitened,
    roots, states,
):  # fmt: skip
    """Filter the samples from `first` on, as many as `whitened` (samples, d, columns) has room for.

    state: the rows before the first sample, then before the next one. Written to `whitened` are the
    first columns of each observed row (see `_observe`), over the standard deviation of the
    innovation; zero where nothing was measured. Kept, if they have room, are the inverses of these
    deviations in `roots` (n, d), and in `states` (n, d, columns) the rows before each sample.
    Returns the sum of the logarithms of the innovations' variances.
    """
    product, log_spread = 1.0, 0.0
    for k in range(first, min(first + len(whitened), len(residuals))):
        if len(states):
            for i in range(len(state)):
                _copy(state[i], states[k, i])
        for i in range(len(state)):
            out, root = whitened[k - first, i], 0.0
            # Innovation of sample (k, i) given all before it, unless nothing was measured.
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
            # In units of its standard deviation; with its row of the covariance for `_look_back`.
            for c in range(len(out)):
                out[c] = root * row[c]
            if len(roots):
                roots[k, i] = root
        # Prediction of the next state.
        if k < len(flow):
            _step(flow[k], defects[k], process[k], state, cov, ahead, row)
            for i in range(len(state)):
                _copy(ahead[i], state[i])
    return log_spread + np.log(product)


@compiled(**LOOPS)
def _look_back(flow, whitened, roots, states, cov, adjoints, found):
    """Write the corrections to `found` (n, d), from what the filter kept of every sample.

    With P_k and x_k the filter's before sample k, the smoothed correction is x_k - P_k a_k, where
    the adjoint a_k sums up what this sample and all later ones tell.
    """
    (n, d), adjoint, carried = found.shape, adjoints[0], adjoints[1]
    for k in range(n - 1, -1, -1):
        # Adjoint recursion over the step: a = F' a_(k+1); zero after the last sample.
        for j in range(d):
            carried[j] = 0.0
        if k < n - 1:
            for i in range(d):
                for j in range(d):
                    carried[j] += flow[k, i, j] * adjoint[i]
        _copy(carried, adjoint)
        # Adjoint recursion over the samples, last first, with s and P_i: of each at its update:
        # a_i = a_i - (e + P_i: a) / s.
        for i in range(d - 1, -1, -1):
            value = -whitened[k, i, 0]
            for j in range(d):
                value += whitened[k, i, cov + j] * adjoint[j]
            adjoint[i] -= roots[k, i] * value
        # Smoothed correction: x_k - P_k a_k.
        for i in range(d):
            value = states[k, i, 0]
            for j in range(d):
                value -= states[k, i, cov + j] * adjoint[j]
            found[k, i] = value
