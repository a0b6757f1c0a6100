"""Compiled Kalman smoother of the twice integrated Wiener process, with exact diffuse start.

In every kernel, steps: (samples - 1,) are time steps of order one, and values: (samples, columns).
The state at a sample is (signal, slope, bend), where bend is the second derivative. The third
derivative of the signal is white noise of density `ratio`, in units in which the measurement noise
has variance one. All columns share one ratio, so the gains, which do not depend on the values,
are computed once.

The kernels are loops, and are given all arrays that they fill, because array expressions, slices
and new arrays take seconds longer to compile.
"""

import numpy as np

from ep2sindy.runtime.compilation import INNER, LOOPS, compiled

# Variance of the rounding errors of values scaled to unit range; less noise cannot be detected.
ROUNDING = np.finfo(np.float64).eps ** 2

# Difference of two steps that count as even, and change of the filter's variances that ends them.
EVEN, SETTLED = 1e-9, 1e-13


@compiled(inline="always")
def _fill_parabola(h1, h2, parabola):
    """Matrix from the first three samples to the state of their parabola at the third."""
    both = h1 + h2
    parabola[0, 0], parabola[0, 1], parabola[0, 2] = 0.0, 0.0, 1.0
    parabola[1, 0], parabola[1, 1] = h2 / (both * h1), -both / (h2 * h1)
    parabola[1, 2], parabola[2, 0] = (both + h2) / (both * h2), 2.0 / (both * h1)
    parabola[2, 1], parabola[2, 2] = -2.0 / (h2 * h1), 2.0 / (both * h2)


@compiled(**INNER)
def _start(h1, h2, ratio, parabola):
    """Covariance L D L' of the state at the third sample, where the samples first determine it.

    Backwards in time from there, the signal departs from the state's parabola as a process of
    the same law. This departure and the measurement noise are the only errors of the three
    samples. Returns l10, l20, l21, d0, d1, d2.
    """
    # Errors of the first two samples, decorrelated; the third sample has measurement noise only.
    second = 1.0 + ratio * h2**5 / 20.0
    first = 1.0 + ratio * (h1 + h2) ** 5 / 20.0
    both = ratio * (h2**5 / 20.0 + h1 * h2**4 / 8.0 + h1 * h1 * h2**3 / 12.0)
    shared = both / first
    second -= shared * both
    a1, b1 = parabola[1, 0] + shared * parabola[1, 1], parabola[1, 1]
    a2, b2 = parabola[2, 0] + shared * parabola[2, 1], parabola[2, 1]
    d1 = first * a1 * a1 + second * b1 * b1
    l21 = (first * a1 * a2 + second * b1 * b2) / d1
    a2, b2 = a2 - l21 * a1, b2 - l21 * b1
    d2 = first * a2 * a2 + second * b2 * b2
    return parabola[1, 2], parabola[2, 2], l21, 1.0, d1, d2


@compiled(inline="always")
def _slope_signal_cov(a, b):
    """Covariance of slope and signal of a process of unit density, `a` and `b` after a parabola."""
    if a <= b:
        return a**4 / 8.0 + (b - a) * a**3 / 3.0 + (b - a) ** 2 * a**2 / 4.0
    return b**4 / 8.0 + (a - b) * b**3 / 6.0


@compiled(**INNER)  # a call would keep ratios side by side from the vector units
def _predict(h, ratio, l10, l20, l21, d0, d1, d2):
    """Propagate the covariance P = L D L' to F P F' + Q over a step h by weighted Gram-Schmidt.

    Only projections are subtracted, so samples far closer together than the mean step cost few
    digits; computing F P F' directly would lose them all (Bierman 1977, Factorization Methods for
    Discrete Sequential Estimation).
    """
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
    return l10, l20, l21, new0, new1, new2


@compiled(**INNER)
def _hardly_changed(d0, d1, d2, old0, old1, old2):
    return (
        abs(d0 - old0) <= SETTLED * d0
        and abs(d1 - old1) <= SETTLED * d1
        and abs(d2 - old2) <= SETTLED * d2
    )


@compiled(**LOOPS)
def _gains(steps, ratio, parabola, gain, variance, slope_cov):
    """Fill in Kalman gains and covariances, the same for all columns.

    parabola: (3, 3), maps the first three samples to the state at the third. gain: (samples, 3),
    and variance: (samples,), of the innovations, are filled from the fourth sample on.
    slope_cov: (samples, 3), covariance of the slope at a sample with the state there, given the
    samples so far; at the first two samples, covariance with the state at the third.
    """
    h1, h2 = steps[0], steps[1]
    _fill_parabola(h1, h2, parabola)
    l10, l20, l21, d0, d1, d2 = _start(h1, h2, ratio, parabola)
    shared, bend = l10 * l20 + l21 * d1, l20 * l20 + l21 * l21 * d1 + d2
    for k in range(3):
        age = (h1 if k < 1 else 0.0) + (h2 if k < 2 else 0.0)
        slope_cov[k, 0] = l10 - age * l20
        slope_cov[k, 1] = l10 * l10 + d1 - age * shared
        slope_cov[k, 2] = shared - age * bend
        for i in range(2):  # no signal departs from the parabola at the third sample
            moved = ratio * _slope_signal_cov(age, h2 + (h1 if i < 1 else 0.0))
            slope_cov[k, 1] += moved * parabola[1, i]
            slope_cov[k, 2] += moved * parabola[2, i]
    settled = False  # at even steps the covariance soon repeats itself
    for k in range(3, len(variance)):
        even = abs(steps[k - 1] - steps[k - 2]) <= EVEN
        if not (settled and even):
            old0, old1, old2 = d0, d1, d2
            l10, l20, l21, d0, d1, d2 = _predict(steps[k - 1], ratio, l10, l20, l21, d0, d1, d2)
            spread = d0 + 1.0
            d0 /= spread  # measuring the signal changes no other entry of L D L'
            settled = even and _hardly_changed(d0, d1, d2, old0, old1, old2)
        variance[k] = spread
        gain[k, 0], gain[k, 1], gain[k, 2] = d0, l10 * d0, l20 * d0
        slope_cov[k, 0] = l10 * d0
        slope_cov[k, 1] = l10 * l10 * d0 + d1
        slope_cov[k, 2] = l10 * l20 * d0 + l21 * d1


@compiled(**LOOPS)
def _filter(steps, values, parabola, gain, innovation, slopes):
    """Fill in innovations, and filtered slopes: each given the samples up to it."""
    n_samples, n_columns = values.shape
    for j in range(n_columns):
        signal = slope = bend = 0.0
        for i in range(3):
            signal += parabola[0, i] * values[i, j]
            slope += parabola[1, i] * values[i, j]
            bend += parabola[2, i] * values[i, j]
            innovation[i, j] = 0.0
        slopes[0, j] = slope - (steps[0] + steps[1]) * bend
        slopes[1, j] = slope - steps[1] * bend
        slopes[2, j] = slope
        for k in range(3, n_samples):
            h = steps[k - 1]
            turned = slope + h * bend
            predicted = signal + 0.5 * h * (slope + turned)
            missed = values[k, j] - predicted
            innovation[k, j] = missed
            signal = predicted + gain[k, 0] * missed
            slope = turned + gain[k, 1] * missed
            bend += gain[k, 2] * missed
            slopes[k, j] = slope


def likelihood(steps, values, ratio):
    """Log-likelihood of the samples (samples,) after the third, and the variance of their noise.

    The variance of the measurement noise is profiled out: its most likely value is returned. A
    constant that depends on neither the values nor the ratio is left out.
    """
    return _likelihood(steps, values, ratio, np.empty((3, 3)))


@compiled(**LOOPS)
def _likelihood(steps, values, ratio, parabola):
    """`_gains` and `_filter` in one loop that stores nothing, for a search tries many ratios.

    The state is that predicted for the next sample. Nothing but one product then waits for the
    sample before; through prediction and correction in turn, twice as many operations would.
    """
    n_samples = len(values)
    _fill_parabola(steps[0], steps[1], parabola)
    l10, l20, l21, d0, d1, d2 = _start(steps[0], steps[1], ratio, parabola)
    signal = slope = bend = 0.0
    for i in range(3):
        signal += parabola[0, i] * values[i]
        slope += parabola[1, i] * values[i]
        bend += parabola[2, i] * values[i]
    signal += steps[2] * (slope + 0.5 * steps[2] * bend)
    slope += steps[2] * bend
    weight = gain1 = gain2 = log = squares = logs = 0.0
    settled = False
    for k in range(3, n_samples):
        h = steps[k - 1]
        even = abs(h - steps[k - 2]) <= EVEN
        if not (settled and even):
            old0, old1, old2 = d0, d1, d2
            l10, l20, l21, d0, d1, d2 = _predict(h, ratio, l10, l20, l21, d0, d1, d2)
            variance = d0 + 1.0
            weight, log = 1.0 / variance, np.log(variance)
            d0 /= variance  # the gain of the signal
            gain1, gain2 = l10 * d0, l20 * d0
            settled = even and _hardly_changed(d0, d1, d2, old0, old1, old2)
        ahead = steps[k] if k < n_samples - 1 else 0.0
        half = 0.5 * ahead * ahead
        missed = values[k] - signal
        signal = signal + ahead * slope + half * bend + (d0 + ahead * gain1 + half * gain2) * missed
        slope = slope + ahead * bend + (gain1 + ahead * gain2) * missed
        bend += gain2 * missed
        squares += weight * missed**2
        logs += log
    noise = squares / (n_samples - 3)
    if noise < ROUNDING:
        noise = ROUNDING
    return -0.5 * ((n_samples - 3) * np.log(noise) + logs), noise


@compiled(inline="always")
def _follow(h, k, values, gain0, gain1, gain2, weight, signal, slope, bend, total):
    """Predict sample k under every ratio, add the weighted square of the error, and correct."""
    for j in range(values.shape[1]):
        for r in range(len(weight)):
            turned = slope[j, r] + h * bend[j, r]
            predicted = signal[j, r] + 0.5 * h * (slope[j, r] + turned)
            missed = values[k, j] - predicted
            total[j, r] += weight[r] * missed * missed
            signal[j, r] = predicted + gain0[r] * missed
            slope[j, r] = turned + gain1[r] * missed
            bend[j, r] += gain2[r] * missed


@compiled(**LOOPS)
def _likelihoods(
    steps, values, ratios, parabola, l10, l20, l21, d0, d1, d2, signal, slope, bend,
    variance, weight, gain1, gain2, product, logs, total,
):  # fmt: skip
    """Add up the likelihoods, all ratios side by side, given the start of every filter.

    The gain of the signal is the new d0; gain1 and gain2 are those of slope and bend. variance: of
    the innovation; weight: its inverse. At even steps the last ratio of those whose gains change is
    let go once it has settled, so ratios in ascending order take the least time.
    """
    (n_samples, n_columns), n_ratios = values.shape, len(ratios)
    changing = n_ratios
    h1, h2 = steps[0], steps[1]
    _fill_parabola(h1, h2, parabola)
    for r in range(n_ratios):
        l10[r], l20[r], l21[r], d0[r], d1[r], d2[r] = _start(h1, h2, ratios[r], parabola)
        for j in range(n_columns):
            for i in range(3):
                signal[j, r] += parabola[0, i] * values[i, j]
                slope[j, r] += parabola[1, i] * values[i, j]
                bend[j, r] += parabola[2, i] * values[i, j]
    for k in range(3, n_samples):
        h = steps[k - 1]
        even = abs(h - steps[k - 2]) <= EVEN
        if not even:
            changing = n_ratios
        last = max(changing - 1, 0)
        old0, old1, old2 = d0[last], d1[last], d2[last]
        for r in range(changing):
            l10[r], l20[r], l21[r], new0, new1, new2 = _predict(
                h, ratios[r], l10[r], l20[r], l21[r], d0[r], d1[r], d2[r]
            )
            variance[r], weight[r] = new0 + 1.0, 1.0 / (new0 + 1.0)
            d0[r], d1[r], d2[r] = new0 / variance[r], new1, new2
            gain1[r], gain2[r] = l10[r] * d0[r], l20[r] * d0[r]
        if even and _hardly_changed(d0[last], d1[last], d2[last], old0, old1, old2):
            changing = last
        for r in range(n_ratios):
            product[r] *= variance[r]
        _follow(h, k, values, d0, gain1, gain2, weight, signal, slope, bend, total)
        if k % 8 == 0 or k == n_samples - 1:  # fewer logarithms; a product of eight is finite
            for r in range(n_ratios):
                logs[r] += np.log(product[r])
                product[r] = 1.0


def likelihoods(steps, values, ratios):
    """Log-likelihood as in `likelihood`, of every column under every ratio: (columns, ratios).

    The filter is a chain of divisions that wait for each other. Under many ratios side by side they
    fill the vector units, and all columns share the gains.
    """
    (n_samples, n_columns), n_ratios = values.shape, len(ratios)
    states, total = np.zeros((3, n_columns, n_ratios)), np.zeros((n_columns, n_ratios))
    factors, work, logs = np.empty((6, n_ratios)), np.ones((5, n_ratios)), np.zeros(n_ratios)
    parabola = np.empty((3, 3))
    _likelihoods(steps, values, ratios, parabola, *factors, *states, *work, logs, total)
    noise = np.maximum(total / (n_samples - 3), ROUNDING)
    return -0.5 * ((n_samples - 3) * np.log(noise) + logs)


@compiled(**LOOPS)
def _smooth(steps, values, innovation, parabola, gain, variance, slope_cov, slope):
    """Turn the innovations into the smoothed signal, and filtered slopes into smoothed ones."""
    n_samples, n_columns = values.shape
    signal = innovation  # row k is read before it is written
    for j in range(n_columns):
        r0 = r1 = r2 = 0.0  # gradient of the later samples' log-likelihood by the state
        for k in range(n_samples - 1, 2, -1):
            h = steps[k - 1]
            slope[k, j] += slope_cov[k, 0] * r0 + slope_cov[k, 1] * r1 + slope_cov[k, 2] * r2
            noise = innovation[k, j] / variance[k]
            noise -= gain[k, 0] * r0 + gain[k, 1] * r1 + gain[k, 2] * r2
            signal[k, j] = values[k, j] - noise
            r0 += noise
            turned = r1 + 0.5 * h * r0
            r1 += h * r0
            r2 += h * turned
        for k in range(3):
            slope[k, j] += slope_cov[k, 0] * r0 + slope_cov[k, 1] * r1 + slope_cov[k, 2] * r2
            signal[k, j] = values[k, j]
            signal[k, j] += parabola[0, k] * r0 + parabola[1, k] * r1 + parabola[2, k] * r2


def smooth(steps, values, ratio):
    """Smoothed signal and slope per unit time, both (samples, columns), given all samples.

    The signal is the values minus the smoothed measurement noise, so no filtered state need be
    stored (Durbin & Koopman 2012, section 4.5).
    """
    n_samples, (signal, slope) = len(values), np.empty((2, *values.shape))
    gain, slope_cov = np.empty((n_samples, 3)), np.empty((n_samples, 3))
    parabola, variance = np.empty((3, 3)), np.empty(n_samples)
    _gains(steps, ratio, parabola, gain, variance, slope_cov)
    _filter(steps, values, parabola, gain, signal, slope)
    _smooth(steps, values, signal, parabola, gain, variance, slope_cov, slope)
    return signal, slope
