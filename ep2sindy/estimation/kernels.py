"""Compiled kernels of the trajectory likelihood: sensitivities, filter, smoother.

A record has n samples of d states; p coefficients are free. The flow maps a state over one step
between samples; `flow`: (n - 1, d, d + p) holds its derivatives with respect to the state, then to
the coefficients. Everything is linearised about a path: `misses` (n - 1, d) is the flow minus the
next state of the path, `residuals` (n, d) is the samples minus the path, and the unknowns are
departures from the path.

The kernels are loops, and are given all arrays that they fill, because array expressions and new
arrays take seconds more to compile.
"""

from typing import NamedTuple

import numpy as np

from ep2sindy.runtime.compilation import LOOPS, compiled


def sensitivities(jacobians, terms, equation, column, leads, weights, steps, slopes):
    """One Runge-Kutta step of the sensitivities; `slopes` (n, d, d + p) is advanced in place.

    Columns beyond those of the p coefficients are not touched.

    jacobians: (stages, n, d, d) and terms: (stages, n, products), at the stages of each step.
    leads, weights: (stages,), of the method, as shares of the step; steps: (n,), in time.
    Coefficient c multiplies terms[..., column[c]] in equation[c]. A sample passes all stages before
    the next one comes, so that what it needs stays in the cache.
    """
    buffers = np.empty((3, slopes.shape[1], slopes.shape[1] + len(equation)))
    _sensitivities(jacobians, terms, equation, column, leads, weights, steps, slopes, *buffers)


@compiled(**LOOPS)
def _sensitivities(
    jacobians, terms, equation, column, leads, weights, steps, slopes, here, slope, total
):
    d, width = here.shape
    for k in range(len(slopes)):
        for i in range(d):
            for c in range(width):
                slope[i, c] = 0.0
                total[i, c] = slopes[k, i, c]
        for s in range(len(leads)):
            lead, weight = leads[s] * steps[k], weights[s] * steps[k]
            for i in range(d):
                for c in range(width):
                    here[i, c] = slopes[k, i, c] + lead * slope[i, c]
            for i in range(d):
                for c in range(width):
                    slope[i, c] = 0.0
                for j in range(d):
                    factor = jacobians[s, k, i, j]
                    if factor != 0.0:
                        for c in range(width):
                            slope[i, c] += factor * here[j, c]
            for c in range(width - d):
                slope[equation[c], d + c] += terms[s, k, column[c]]
            for i in range(d):
                for c in range(width):
                    total[i, c] += weight * slope[i, c]
        for i in range(d):
            for c in range(width):
                slopes[k, i, c] = total[i, c]


@compiled(inline="always")
def _observe(i, residual, variance, mean, by_coef, cov, gain):
    """Update with one sample of state i; returns its innovation and the innovation's variance."""
    d, p = by_coef.shape
    spread = cov[i, i] + variance
    innovation = residual - mean[i]
    for j in range(d):
        gain[j] = cov[j, i] / spread
    for j in range(d):
        mean[j] += gain[j] * innovation
        if j != i:
            for a in range(p):
                by_coef[j, a] -= gain[j] * by_coef[i, a]
    for a in range(p):
        by_coef[i, a] *= 1.0 - gain[i]
    for j in range(d):
        for m in range(j + 1):
            cov[j, m] -= gain[j] * gain[m] * spread
            cov[m, j] = cov[j, m]
    return innovation, spread


@compiled(inline="always")
def _step(flow, miss, mean, by_coef, cov, process, buffer):
    """Propagate mean, its derivatives by the coefficients, and covariance over one step."""
    d, p = by_coef.shape
    for i in range(d):
        value = miss[i]
        for j in range(d):
            value += flow[i, j] * mean[j]
        buffer[i, 0] = value
        for a in range(p):
            buffer[i, 1 + a] = flow[i, d + a]
        for j in range(d):
            for a in range(p):  # innermost, where it is a sum of vectors
                buffer[i, 1 + a] += flow[i, j] * by_coef[j, a]
        for m in range(d):
            value = 0.0
            for j in range(d):
                value += flow[i, j] * cov[j, m]
            buffer[i, 1 + p + m] = value
    for i in range(d):
        mean[i] = buffer[i, 0]
        for a in range(p):
            by_coef[i, a] = buffer[i, 1 + a]
        for m in range(i + 1):
            value = 0.0
            for j in range(d):
                value += buffer[i, 1 + p + j] * flow[m, j]
            cov[i, m] = value
            cov[m, i] = value
        cov[i, i] += process[i]


@compiled(**LOOPS)
def _filter(
    flow, misses, residuals, variance, process, mean, by_coef, cov, gain, row, buffer, hessian,
    gradient, innovations, spreads, gains, means, covs,
):  # fmt: skip
    """Filter all samples, from the mean and covariance of the first state to those of the last.

    Returns least and log_spread of `eliminate`, and adds to its gradient and the lower triangle of
    its hessian. The last five arguments take the innovations (n, d) with their variances and gains
    (n, d, d), and means and covariances before each sample: if they are empty, nothing is kept. If
    they are not, the returned sums are left at zero.
    """
    (n, d), p = residuals.shape, len(gradient)
    kept = len(means) > 0
    least, log_spread = 0.0, 0.0
    for k in range(n):
        if kept:
            for i in range(d):
                means[k, i] = mean[i]
                for j in range(d):
                    covs[k, i, j] = cov[i, j]
        for i in range(d):
            if not np.isfinite(residuals[k, i]):
                continue
            for a in range(p):
                row[a] = by_coef[i, a]
            innovation, spread = _observe(
                i, residuals[k, i], variance[k, i], mean, by_coef, cov, gain
            )
            if kept:
                innovations[k, i], spreads[k, i] = innovation, spread
                for j in range(d):
                    gains[k, i, j] = gain[j]
            else:
                least += innovation * innovation / spread
                log_spread += np.log(spread)
            for a in range(p):
                share = row[a] / spread
                gradient[a] += share * innovation
                for b in range(a + 1):
                    hessian[a, b] += share * row[b]
        if k < n - 1:
            _step(flow[k], misses[k], mean, by_coef, cov, process[k], buffer)
    return least, log_spread


def eliminate(flow, misses, residuals, variance, process, free_start):
    """Eliminate all states: the squares as a quadratic function of the coefficients alone.

    variance: (n, d), of the samples' noise; process: (n - 1, d), of the flow's error; free_start:
    prior variance of the first state. A residual that is not finite counts as a missing sample.
    Returns hessian (p, p), gradient (p,), least, and the sum of the logarithms of the innovations'
    variances. For a change c of the coefficients the squares are least - 2 gradient' c + c' hessian
    c. Exact for the linearised problem (de Jong 1991, doi:10.1214/aos/1176348139).
    """
    d = residuals.shape[1]
    p = flow.shape[2] - d
    hessian, gradient, nothing = np.zeros((p, p)), np.zeros(p), np.empty((0, d))
    least, log_spread = _filter(
        flow, misses, residuals, variance, process, np.zeros(d), np.zeros((d, p)),
        free_start * np.eye(d), np.empty(d), np.empty(p), np.empty((d, 1 + p + d)), hessian,
        gradient, nothing, nothing, np.empty((0, d, d)), nothing, np.empty((0, d, d)),
    )  # fmt: skip
    return hessian + np.tril(hessian, -1).T, gradient, least, log_spread


class _Steps(NamedTuple):
    """What `_filter` found at every sample; NaN for innovations where nothing was measured.

    mean: (d,), cov: (d, d), of the last departure.
    """

    innovations: np.ndarray
    spreads: np.ndarray
    gains: np.ndarray
    means: np.ndarray
    covs: np.ndarray
    mean: np.ndarray
    cov: np.ndarray


def _filter_steps(flow, misses, residuals, variance, process, free_start):
    """Filter all samples under fixed coefficients, and keep every step."""
    n, d = residuals.shape
    mean, cov = np.zeros(d), free_start * np.eye(d)
    innovations, spreads = np.full((2, n, d), np.nan)
    means, (gains, covs) = np.empty((n, d)), np.empty((2, n, d, d))
    _filter(
        flow, misses, residuals, variance, process, mean, np.empty((d, 0)), cov, np.empty(d),
        np.empty(0), np.empty((d, 1 + d)), np.empty((0, 0)), np.empty(0), innovations, spreads,
        gains, means, covs,
    )  # fmt: skip
    return _Steps(innovations, spreads, gains, means, covs, mean, cov)


@compiled(**LOOPS)
def _smooth(flow, residuals, innovations, spreads, gains, means, covs, adjoint, carried):
    """Turn the means before the samples into departures, by the adjoint of the filter."""
    n, d = residuals.shape
    for k in range(n - 1, -1, -1):
        for j in range(d):
            carried[j] = 0.0
            for i in range(d):
                if k < n - 1:
                    carried[j] += flow[k, i, j] * adjoint[i]
        for j in range(d):
            adjoint[j] = carried[j]
        for i in range(d - 1, -1, -1):
            if np.isfinite(residuals[k, i]):
                value = innovations[k, i] / spreads[k, i]
                for j in range(d):
                    value += gains[k, i, j] * adjoint[j]
                adjoint[i] -= value
        for i in range(d):
            for j in range(d):
                means[k, i] -= covs[k, i, j] * adjoint[j]


def filtered(flow, misses, residuals, variance, process, free_start):
    """Innovations (n, d), and mean (d,) and covariance (d, d) of the last departure from the path.

    An innovation is what a sample brings that the past did not tell, in its standard deviation; NaN
    where nothing was measured. Arguments as for `departures`.
    """
    steps = _filter_steps(flow, misses, residuals, variance, process, free_start)
    return steps.innovations / np.sqrt(steps.spreads), steps.mean, steps.cov


def departures(flow, misses, residuals, variance, process, free_start):
    """Departures (n, d) of all states from the path that minimise the squares.

    Arguments as for `eliminate`, but only the first d columns of `flow` are used. The backward pass
    is the adjoint of the filter, which inverts no matrix (Bierman 1973,
    doi:10.1016/0005-1098(73)90089-3).
    """
    steps = _filter_steps(flow, misses, residuals, variance, process, free_start)
    adjoint, carried = np.zeros((2, residuals.shape[1]))
    _smooth(flow, residuals, *steps[:5], adjoint, carried)
    return steps.means
