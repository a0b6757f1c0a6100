"""Compiled Kalman smoother of the twice integrated Wiener process, with exact diffuse start.

In every kernel, steps: (samples - 1,) are time steps of order one, and values: (samples, columns).
The state at a sample is (signal, slope, bend), where bend is the second derivative. The third
derivative of the signal is white noise of density `ratio`, in units in which the measurement noise
has variance one. All columns share one ratio, so the gains, which do not depend on the values,
are computed once.

The kernels use loops because array expressions and slices take seconds longer to compile.
"""

from typing import Any, NamedTuple

import numpy as np

from ep2sindy.runtime.compilation import SEPARATE_ARRAYS, compiled

# Variance of the rounding errors of values scaled to unit range; less noise cannot be detected.
ROUNDING = np.finfo(np.float64).eps ** 2


# Each value waits for the one before: a product and a sum in one instruction shorten the wait.
CHAIN: dict[str, Any] = {"fastmath": {"contract"}}

# How loops over ratios are compiled, so that several go through the vector units at once.
SIDE_BY_SIDE = {**CHAIN, "error_model": "numpy", **SEPARATE_ARRAYS}

# Difference of two steps that count as even, and change of the filter's variances that ends them.
EVEN, SETTLED = 1e-9, 1e-13


class Gains(NamedTuple):
    """Kalman gains and covariances, the same for all columns.

    parabola: (3, 3), maps the first three samples to the state at the third.
    gain: (samples, 3), Kalman gains; variance: (samples,), variances of the innovations. Both are
    filled from the fourth sample on.
    slope_cov: (samples, 3), covariance of the slope at a sample with the state there, given the
    samples so far; at the first two samples, covariance with the state at the third.
    """

    parabola: np.ndarray
    gain: np.ndarray
    variance: np.ndarray
    slope_cov: np.ndarray


@compiled
def _parabola(h1, h2):
    """Matrix from the first three samples to the state of their parabola at the third."""
    both = h1 + h2
    state = np.zeros((3, 3))
    state[0, 2] = 1.0
    state[1, 0], state[1, 1] = h2 / (both * h1), -both / (h2 * h1)
    state[1, 2] = (both + h2) / (both * h2)
    state[2, 0], state[2, 1], state[2, 2] = 2.0 / (both * h1), -2.0 / (h2 * h1), 2.0 / (both * h2)
    return state


@compiled
def _signal_cov(a, b):
    """Covariance of a process of unit density, at times `a` and `b` after it left a parabola."""
    low, lag = min(a, b), abs(a - b)
    return low**5 / 20.0 + lag * low**4 / 8.0 + lag**2 * low**3 / 12.0


@compiled
def _slope_signal_cov(a, b):
    """Derivative of `_signal_cov` by its first argument."""
    if a <= b:
        return a**4 / 8.0 + (b - a) * a**3 / 3.0 + (b - a) ** 2 * a**2 / 4.0
    return b**4 / 8.0 + (a - b) * b**3 / 6.0


@compiled
def _start(steps, ratio, slope_cov):
    """Start the filter at the third sample, where the samples first determine the state.

    Backwards in time from there, the signal departs from the state's parabola as a process of
    the same law. This departure and the measurement noise are the only errors of the three
    samples. Returns the parabola and the covariance of the state as L D L', (3,) and (3,);
    fills three rows of slope_cov.
    """
    ages = (steps[0] + steps[1], steps[1], 0.0)
    parabola = _parabola(steps[0], steps[1])
    # Errors of the first two samples, decorrelated; the third sample has measurement noise only.
    first = 1.0 + ratio * _signal_cov(ages[0], ages[0])
    shared = ratio * _signal_cov(ages[0], ages[1]) / first
    second = 1.0 + ratio * (_signal_cov(ages[1], ages[1]) - shared * _signal_cov(ages[0], ages[1]))
    a1, b1 = parabola[1, 0] + shared * parabola[1, 1], parabola[1, 1]
    a2, b2 = parabola[2, 0] + shared * parabola[2, 1], parabola[2, 1]
    d1 = first * a1 * a1 + second * b1 * b1
    l10, l20, l21 = parabola[1, 2], parabola[2, 2], (first * a1 * a2 + second * b1 * b2) / d1
    a2, b2 = a2 - l21 * a1, b2 - l21 * b1
    d2 = first * a2 * a2 + second * b2 * b2
    slope_row = (l10, l10 * l10 + d1, l10 * l20 + l21 * d1)
    bend_row = (l20, slope_row[2], l20 * l20 + l21 * l21 * d1 + d2)
    for k in range(3):
        for j in range(3):
            slope_cov[k, j] = slope_row[j] - ages[k] * bend_row[j]
        for i in range(3):
            shared = ratio * _slope_signal_cov(ages[k], ages[i])
            for j in range(3):
                slope_cov[k, j] += shared * parabola[j, i]
    return parabola, (l10, l20, l21), (1.0, d1, d2)


@compiled(inline="always")  # a call would keep ratios side by side from the vector units
def _predict(h, ratio, lower, diagonal):
    """Propagate the covariance P = L D L' to F P F' + Q over a step h by weighted Gram-Schmidt.

    Only projections are subtracted, so samples far closer together than the mean step cost few
    digits; computing F P F' directly would lose them all (Bierman 1977, Factorization Methods for
    Discrete Sequential Estimation).
    """
    (l10, l20, l21), (d0, d1, d2) = lower, diagonal
    half, rate = 0.5 * h * h, 1.0 / h
    # Entries 0, 1, 2 of the columns a, b, c of F L, and of the columns of Q = L D L' too:
    # (1, e1, e2) of weight e, (0, 1, f2) of weight f, (0, 0, 1) of weight `last`.
    a0, b0, c0 = 1.0 + h * l10 + half * l20, h + half * l21, half
    a1, b1, c1, e1 = l10 + h * l20, 1.0 + h * l21, h, 2.5 * rate
    a2, b2, c2, e2, f2 = l20, l21, 1.0, 10.0 / 3.0 * rate * rate, 4.0 * rate
    last = ratio * h / 9.0
    f = ratio * h * h * h / 48.0
    e = f * h * h * 2.4
    new0 = d0 * a0 * a0 + d1 * b0 * b0 + d2 * c0 * c0 + e
    l10 = (d0 * a0 * a1 + d1 * b0 * b1 + d2 * c0 * c1 + e * e1) / new0
    l20 = (d0 * a0 * a2 + d1 * b0 * b2 + d2 * c0 * c2 + e * e2) / new0
    a1, b1, c1, e1 = a1 - l10 * a0, b1 - l10 * b0, c1 - l10 * c0, e1 - l10
    a2, b2, c2, e2 = a2 - l20 * a0, b2 - l20 * b0, c2 - l20 * c0, e2 - l20
    new1 = d0 * a1 * a1 + d1 * b1 * b1 + d2 * c1 * c1 + e * e1 * e1 + f
    l21 = (d0 * a1 * a2 + d1 * b1 * b2 + d2 * c1 * c2 + e * e1 * e2 + f * f2) / new1
    a2, b2, c2 = a2 - l21 * a1, b2 - l21 * b1, c2 - l21 * c1
    e2, f2 = e2 - l21 * e1, f2 - l21
    new2 = d0 * a2 * a2 + d1 * b2 * b2 + d2 * c2 * c2 + e * e2 * e2 + f * f2 * f2 + last
    return (l10, l20, l21), (new0, new1, new2)


@compiled(**CHAIN)
def gains(steps, ratio):
    """Kalman gains and covariances of the filter over all samples."""
    n_samples = len(steps) + 1
    gain, variance = np.zeros((n_samples, 3)), np.ones(n_samples)
    slope_cov = np.empty((n_samples, 3))
    parabola, lower, diagonal = _start(steps, ratio, slope_cov)
    settled = False  # at even steps the covariance soon repeats itself
    for k in range(3, n_samples):
        settled = settled and abs(steps[k - 1] - steps[k - 2]) <= EVEN
        if settled:
            variance[k] = variance[k - 1]
            for i in range(3):
                gain[k, i], slope_cov[k, i] = gain[k - 1, i], slope_cov[k - 1, i]
            continue
        before = diagonal
        lower, (d0, d1, d2) = _predict(steps[k - 1], ratio, lower, diagonal)
        l10, l20, l21 = lower
        variance[k] = d0 + 1.0
        d0 /= variance[k]  # measuring the signal changes no other entry of L D L'
        diagonal = (d0, d1, d2)
        gain[k, 0], gain[k, 1], gain[k, 2] = d0, l10 * d0, l20 * d0
        slope_cov[k, 0] = l10 * d0
        slope_cov[k, 1] = l10 * l10 * d0 + d1
        slope_cov[k, 2] = l10 * l20 * d0 + l21 * d1
        settled = abs(steps[k - 1] - steps[k - 2]) <= EVEN
        for i in range(3):
            settled = settled and abs(diagonal[i] - before[i]) <= SETTLED * diagonal[i]
    return Gains(parabola, gain, variance, slope_cov)


@compiled(**CHAIN)
def _filter(steps, values, known):
    """Innovations, and filtered slopes: each given the samples up to it."""
    n_samples, n_columns = values.shape
    innovation, slopes = np.empty((n_samples, n_columns)), np.empty((n_samples, n_columns))
    for j in range(n_columns):
        signal = slope = bend = 0.0
        for i in range(3):
            signal += known.parabola[0, i] * values[i, j]
            slope += known.parabola[1, i] * values[i, j]
            bend += known.parabola[2, i] * values[i, j]
        slopes[0, j] = slope - (steps[0] + steps[1]) * bend
        slopes[1, j] = slope - steps[1] * bend
        slopes[2, j] = slope
        innovation[0, j] = innovation[1, j] = innovation[2, j] = 0.0
        for k in range(3, n_samples):
            h = steps[k - 1]
            turned = slope + h * bend
            predicted = signal + 0.5 * h * (slope + turned)
            missed = values[k, j] - predicted
            innovation[k, j] = missed
            signal = predicted + known.gain[k, 0] * missed
            slope = turned + known.gain[k, 1] * missed
            bend += known.gain[k, 2] * missed
            slopes[k, j] = slope
    return innovation, slopes


@compiled(**CHAIN)
def likelihood(steps, values, ratio):
    """Log-likelihood of the samples (samples,) after the third, and the variance of their noise.

    The variance of the measurement noise is profiled out: its most likely value is returned. A
    constant that depends on neither the values nor the ratio is left out. `gains` and `_filter` in
    one loop that stores nothing, for a search tries many ratios.
    """
    n_samples, slope_cov = len(values), np.empty((3, 3))
    parabola, lower, diagonal = _start(steps, ratio, slope_cov)
    signal = slope = bend = 0.0
    for i in range(3):
        signal += parabola[0, i] * values[i]
        slope += parabola[1, i] * values[i]
        bend += parabola[2, i] * values[i]
    weight = gain0 = gain1 = gain2 = log = total = log_variance = 0.0
    settled = False
    for k in range(3, n_samples):
        h = steps[k - 1]
        even = abs(h - steps[k - 2]) <= EVEN
        if not (settled and even):
            before = diagonal
            lower, (d0, d1, d2) = _predict(h, ratio, lower, diagonal)
            variance = d0 + 1.0
            weight, log = 1.0 / variance, np.log(variance)
            d0 /= variance
            diagonal = (d0, d1, d2)
            gain0, gain1, gain2 = d0, lower[0] * d0, lower[1] * d0
            settled = even
            for i in range(3):
                settled = settled and abs(diagonal[i] - before[i]) <= SETTLED * diagonal[i]
        turned = slope + h * bend
        predicted = signal + 0.5 * h * (slope + turned)
        missed = values[k] - predicted
        signal = predicted + gain0 * missed
        slope = turned + gain1 * missed
        bend += gain2 * missed
        total += weight * missed**2
        log_variance += log
    noise = max(total / (n_samples - 3), ROUNDING)
    return -0.5 * ((n_samples - 3) * np.log(noise) + log_variance), noise


@compiled(**SIDE_BY_SIDE)
def _advance(h, ratios, l10, l20, l21, d0, d1, d2, variance, weight, gain1, gain2):
    """Propagate the covariance L D L' of every ratio over a step h, and measure, as in `gains`.

    All arrays: (ratios,). The gain of the signal is the new d0; gain1 and gain2 are those of slope
    and bend. variance: of the innovation; weight: its inverse.
    """
    for r in range(len(ratios)):
        before = (l10[r], l20[r], l21[r]), (d0[r], d1[r], d2[r])
        lower, diagonal = _predict(h, ratios[r], before[0], before[1])
        l10[r], l20[r], l21[r] = lower
        variance[r], weight[r] = diagonal[0] + 1.0, 1.0 / (diagonal[0] + 1.0)
        d0[r], d1[r], d2[r] = diagonal[0] / variance[r], diagonal[1], diagonal[2]
        gain1[r], gain2[r] = l10[r] * d0[r], l20[r] * d0[r]


@compiled(**SIDE_BY_SIDE)
def _follow(h, value, gain0, gain1, gain2, weight, signal, slope, bend, total):
    """Predict one value under every ratio, add the weighted square of the error, and correct."""
    for r in range(len(total)):
        turned = slope[r] + h * bend[r]
        predicted = signal[r] + 0.5 * h * (slope[r] + turned)
        missed = value - predicted
        total[r] += weight[r] * missed * missed
        signal[r] = predicted + gain0[r] * missed
        slope[r] = turned + gain1[r] * missed
        bend[r] += gain2[r] * missed


@compiled
def likelihoods(steps, values, ratios):
    """Log-likelihood as in `likelihood`, of every column under every ratio: (columns, ratios).

    The filter is a chain of divisions that wait for each other. Under many ratios side by side they
    fill the vector units, and all columns share the gains.
    """
    (n_samples, n_columns), n_ratios = values.shape, len(ratios)
    rows, slope_cov = np.zeros((12, n_ratios)), np.zeros((3, 3))  # each shape takes compilation
    l10, l20, l21, d0, d1, d2 = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
    variance, weight, gain1, gain2 = rows[6], rows[7], rows[8], rows[9]
    log_variance, product = rows[10], rows[11]
    state, total = np.zeros((3 * n_columns, n_ratios)), np.zeros((n_columns, n_ratios))
    for r in range(n_ratios):
        parabola, lower, diagonal = _start(steps, ratios[r], slope_cov)
        (l10[r], l20[r], l21[r]), (d0[r], d1[r], d2[r]) = lower, diagonal
        product[r] = 1.0
        for j in range(n_columns):
            for a in range(3):
                for i in range(3):
                    state[3 * j + a, r] += parabola[a, i] * values[i, j]
    for k in range(3, n_samples):
        h = steps[k - 1]
        _advance(h, ratios, l10, l20, l21, d0, d1, d2, variance, weight, gain1, gain2)
        for j in range(n_columns):
            signal, slope, bend = state[3 * j], state[3 * j + 1], state[3 * j + 2]
            _follow(h, values[k, j], d0, gain1, gain2, weight, signal, slope, bend, total[j])
        for r in range(n_ratios):
            product[r] *= variance[r]
        if k % 8 == 0 or k == n_samples - 1:  # fewer logarithms; a product of eight is finite
            for r in range(n_ratios):
                log_variance[r] += np.log(product[r])
                product[r] = 1.0
    for j in range(n_columns):
        for r in range(n_ratios):
            noise = max(total[j, r] / (n_samples - 3), ROUNDING)
            total[j, r] = -0.5 * ((n_samples - 3) * np.log(noise) + log_variance[r])
    return total


@compiled(**CHAIN)
def smooth(steps, values, ratio):
    """Smoothed signal and slope per unit time, both (samples, columns), given all samples.

    The signal is the values minus the smoothed measurement noise, so no filtered state need be
    stored (Durbin & Koopman 2012, section 4.5).
    """
    known = gains(steps, ratio)
    innovation, slope = _filter(steps, values, known)
    n_samples, n_columns = values.shape
    signal = innovation  # row k is read before it is written
    for j in range(n_columns):
        r0 = r1 = r2 = 0.0  # gradient of the later samples' log-likelihood by the state
        for k in range(n_samples - 1, 2, -1):
            h, gain, shared = steps[k - 1], known.gain[k], known.slope_cov[k]
            slope[k, j] += shared[0] * r0 + shared[1] * r1 + shared[2] * r2
            noise = innovation[k, j] / known.variance[k]
            noise -= gain[0] * r0 + gain[1] * r1 + gain[2] * r2
            signal[k, j] = values[k, j] - noise
            r0 += noise
            turned = r1 + 0.5 * h * r0
            r1 += h * r0
            r2 += h * turned
        for k in range(3):
            shared, parabola = known.slope_cov[k], known.parabola
            slope[k, j] += shared[0] * r0 + shared[1] * r1 + shared[2] * r2
            signal[k, j] = values[k, j]
            signal[k, j] += parabola[0, k] * r0 + parabola[1, k] * r1 + parabola[2, k] * r2
    return signal, slope
