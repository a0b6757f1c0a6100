"""Compiled integration of one free run: the Dormand-Prince scheme of eighth order.

The equations are sums of products, given as a tuple (table, coef, scale, breaks, pieces). The
columns are the states, the inputs and a one; row k of `table` lists the columns whose product is
term k. coef: (terms, n), already divided by the scale of the state. scale: (n,), factors from the
solver's states to SI. breaks: (m + 1,), pieces: (powers, m, inputs): see `inputs.Curve`.

The scheme is a tuple of its coefficients (a, b, c, e3, e5, a_dense, c_dense, dense), as published:
Hairer, Norsett & Wanner 1993, Solving Ordinary Differential Equations I, II.5, II.6 and II.10;
`solve.scheme` returns them. Steps, errors and dense output are those of SciPy's `DOP853`, so that
a run differs from SciPy's by rounding only.
"""

import numpy as np

from ep2sindy.runtime.compilation import compiled

FINISHED, LOOK, CROSSED, FAILED = 0, 1, 2, 3  # reasons for which `advance` returns

SAFETY, MIN_FACTOR, MAX_FACTOR = 0.9, 0.2, 10.0  # safety factor, and bounds on the step ratio
EXPONENT = -1.0 / 8.0  # power of the error in the step size; the error estimate is of order seven


@compiled(error_model="numpy")
def _add_terms(table, coef, columns, slope):
    """Write the slopes of all states: the sum over terms of coef times the product of columns."""
    for i in range(len(slope)):
        slope[i] = 0.0
    for k in range(len(table)):
        value = columns[table[k, 0]]
        for factor in range(1, table.shape[1]):
            value *= columns[table[k, factor]]
        for i in range(len(slope)):
            slope[i] += value * coef[k, i]


@compiled(error_model="numpy")
def rates(equations, t, y, columns, slope):
    """Write the right-hand side at one state into `slope`; `columns` is workspace, in SI."""
    table, coef, scale, breaks, pieces = equations
    n, n_inputs = len(y), pieces.shape[2]
    for i in range(n):
        columns[i] = y[i] * scale[i]
    if n_inputs:
        place, above = 0, pieces.shape[1]
        while above - place > 1:  # bisection for the span that contains t
            middle = (place + above) // 2
            if breaks[middle] <= t:
                place = middle
            else:
                above = middle
        share = (t - breaks[place]) / (breaks[place + 1] - breaks[place])
        for j in range(n_inputs):
            value = 0.0
            for power in range(len(pieces)):
                value = value * share + pieces[power, place, j]
            columns[n + j] = value
    _add_terms(table, coef, columns, slope)


@compiled(error_model="numpy")
def _stage(equations, t, y, h, weights, n_before, slopes, at, columns):
    """Compute stage slope number `n_before` of a step of length h from y."""
    for i in range(len(y)):
        value = 0.0
        for s in range(n_before):
            value += slopes[s, i] * weights[s]
        at[i] = y[i] + value * h
    rates(equations, t, at, columns, slopes[n_before])


@compiled(error_model="numpy")
def _error(e3, e5, slopes, h, y, at, rtol):
    """Norm of a step's error, one if it equals the tolerance."""
    fifth, third = 0.0, 0.0
    for i in range(len(y)):
        allowed = rtol + max(abs(y[i]), abs(at[i])) * rtol
        five, three = 0.0, 0.0
        for s in range(len(e5)):
            five += slopes[s, i] * e5[s]
            three += slopes[s, i] * e3[s]
        fifth += (five / allowed) ** 2
        third += (three / allowed) ** 2
    if fifth == 0.0 and third == 0.0:
        return 0.0
    return abs(h) * fifth / np.sqrt((fifth + 0.01 * third) * len(y))


@compiled(error_model="numpy")
def _polynomial(equations, scheme, t, h, start, end, slopes, at, columns, shape):
    """Write the dense output of a step into `shape`, for `_between`. Takes three evaluations."""
    a_dense, c_dense, dense = scheme[5], scheme[6], scheme[7]
    for k in range(3):
        _stage(equations, t + c_dense[k] * h, start, h, a_dense[k], 13 + k, slopes, at, columns)
    for i in range(len(start)):
        moved = end[i] - start[i]
        shape[0, i] = moved
        shape[1, i] = h * slopes[0, i] - moved
        shape[2, i] = 2.0 * moved - h * (slopes[12, i] + slopes[0, i])
        for k in range(4):
            value = 0.0
            for s in range(16):
                value += dense[k, s] * slopes[s, i]
            shape[3 + k, i] = h * value


@compiled(error_model="numpy")
def _between(shape, start, share, out):
    """Write the state at a given fraction of a step into `out`."""
    for i in range(len(start)):
        value = 0.0
        for k in range(7):
            value = (value + shape[6 - k, i]) * (share if k % 2 == 0 else 1.0 - share)
        out[i] = start[i] + value


@compiled(error_model="numpy")
def _room(y, blow_up):
    """`blow_up` minus the largest absolute state; negative beyond it."""
    largest = 0.0
    for i in range(len(y)):
        largest = max(largest, abs(y[i]))
    return blow_up - largest


@compiled(error_model="numpy")
def _step(equations, scheme, t, h, end_t, y, at, slopes, columns, rtol):
    """One step within the tolerance, from y to `at`; the slope at `at` is row 12 of `slopes`.

    Inputs that jump at its end have not jumped yet.
    Returns the time reached, the length of the step, the length to try next and the number of
    evaluations. If the step became too small, the time returned is the start of the step.
    """
    a, b, c, e3, e5 = scheme[0], scheme[1], scheme[2], scheme[3], scheme[4]
    least = 10.0 * (np.nextafter(t, np.inf) - t)
    h, calls, again = max(h, least), 0, False
    while h >= least:
        ahead = min(t + h, end_t)
        h = ahead - t
        before_end = np.nextafter(ahead, -np.inf)
        for s in range(1, 12):
            now = min(t + c[s] * h, before_end)
            _stage(equations, now, y, h, a[s], s, slopes, at, columns)
        for i in range(len(y)):
            value = 0.0
            for s in range(12):
                value += slopes[s, i] * b[s]
            at[i] = y[i] + h * value
        rates(equations, before_end, at, columns, slopes[12])
        calls += 12
        error = _error(e3, e5, slopes, h, y, at, rtol)
        if error < 1.0:
            factor = MAX_FACTOR
            if error > 0.0:
                factor = min(MAX_FACTOR, SAFETY * error**EXPONENT)
            if again:
                factor = min(1.0, factor)
            return ahead, h, h * factor, calls
        # An error that is not finite shortens the step by the smallest factor allowed.
        factor = SAFETY * error**EXPONENT
        h *= factor if factor > MIN_FACTOR else MIN_FACTOR
        again = True
    return t, h, h, calls


@compiled(error_model="numpy")
def advance(
    equations, scheme, times, stops, out, y, slope, t, h, place, calls, limit, blow_up, rtol
):
    """Integrate to the last of `times`, filling rows of `out` from `place` on.

    stops: times at which inputs jump or bend, then the last time: no step goes beyond. y and slope
    are updated in place. h: the step to try. Returns the reason for stopping, the time, the step to
    try next, the next place and the number of evaluations. Reasons: FINISHED; LOOK: `limit`
    evaluations have been exceeded; CROSSED: the largest state crossed `blow_up` in the last step,
    and samples are filled up to the crossing; FAILED: the step became too small.
    """
    n = len(y)
    slopes, shape = np.empty((16, n)), np.empty((7, n))
    at, room, columns = np.empty(n), np.empty(n), np.ones(n + equations[4].shape[2] + 1)
    for i in range(n):  # array expressions take seconds longer to compile
        slopes[0, i] = slope[i]
    inside = _room(y, blow_up) >= 0.0
    stop = np.searchsorted(stops, t, "right")
    while t < times[-1]:
        ahead, length, h, n_calls = _step(
            equations, scheme, t, h, stops[stop], y, at, slopes, columns, rtol
        )
        calls += n_calls
        if ahead == t:
            return FAILED, t, h, place, calls
        over = calls > limit  # checked before the evaluations for dense output, as in SciPy
        crossed = (_room(at, blow_up) >= 0.0) != inside
        if times[place] <= ahead:
            _polynomial(equations, scheme, t, length, y, at, slopes, room, columns, shape)
            calls += 3
            while place < len(times) and times[place] <= ahead:
                _between(shape, y, (times[place] - t) / length, out[place])
                if crossed and (_room(out[place], blow_up) >= 0.0) != inside:
                    break
                place += 1
        t = ahead
        if t == stops[stop]:
            stop += 1
            rates(equations, t, at, columns, slopes[12])
            calls += 1
        for i in range(n):
            y[i] = at[i]
            slopes[0, i] = slopes[12, i]
            slope[i] = slopes[12, i]
        if crossed:
            return CROSSED, t, h, place, calls
        if over:
            return LOOK, t, h, place, calls
    return FINISHED, t, h, place, calls


@compiled(error_model="numpy")
def _runge_kutta(table, coef, drive, h, x, total, slope, columns):
    """One classical Runge-Kutta step of length h; updates x in place.

    drive: (inputs, 3), at the start, middle and end of the step.
    Source: Hairer, Norsett & Wanner 1993, II.1.
    """
    n = len(x)
    for stage in range(4):
        ahead = 0.5 * h if stage < 3 else h
        for i in range(n):
            columns[i] = x[i] + ahead * slope[i] if stage else x[i]
        for j in range(len(drive)):
            columns[n + j] = drive[j, (stage + 1) // 2]
        _add_terms(table, coef, columns, slope)
        for i in range(n):
            if stage == 0:
                total[i] = slope[i]
            else:
                total[i] += (2.0 if stage < 3 else 1.0) * slope[i]
    for i in range(n):
        x[i] = x[i] + h / 6.0 * total[i]


@compiled(error_model="numpy")
def run_many(table, coefs, start, steps_s, drive, n_substeps, centre, reach):
    """Integrate many models from many starts by classical Runge-Kutta steps.

    coefs: (models, terms, states); start: (windows, states); steps_s: (windows, steps); drive:
    (windows, steps, inputs, 3). Returns the states (samples, states, models, windows) after every
    n_substeps steps, and flags (samples, models, windows), true while all states have stayed
    within reach (states,) of the centre. A run that left this range stays at its last state inside.
    """
    n_windows, n = start.shape
    n_models, n_samples = len(coefs), steps_s.shape[1] // n_substeps
    paths = np.empty((n_samples, n, n_models, n_windows))
    inside = np.empty((n_samples, n_models, n_windows), dtype=np.bool_)
    x, last = np.empty(n), np.empty(n)
    total, slope, columns = np.empty(n), np.empty(n), np.ones(n + drive.shape[2] + 1)
    for m in range(n_models):
        for w in range(n_windows):
            bounded = True
            for i in range(n):
                x[i] = last[i] = start[w, i]
            for k in range(n_samples):
                for step in range(k * n_substeps, (k + 1) * n_substeps * bounded):
                    at, h = drive[w, step], steps_s[w, step]
                    _runge_kutta(table, coefs[m], at, h, x, total, slope, columns)
                for i in range(n):
                    bounded = bounded and abs(x[i] - centre[i]) <= reach[i]
                for i in range(n):
                    last[i] = x[i] if bounded else last[i]
                    paths[k, i, m, w] = last[i]
                inside[k, m, w] = bounded
    return paths, inside


@compiled(error_model="numpy")
def approach(
    terms, coef, products, derivatives, centre, bound, until, times_rate, floor, y, t, left
):
    """Runge-Kutta steps of many starts until a time, each of length times_rate / max(rate, floor).

    terms, coef, products, derivatives: of a `ScaledModel`, whose Jacobian's norm is the rate. y:
    (starts, n), t and left: (starts,), the steps that each start may still take, are updated in
    place. Returns flags, false for starts that left the bound about the centre.
    """
    n_starts, n = y.shape
    kept, jacobian = np.ones(n_starts, dtype=np.bool_), np.empty(n * n)
    total, slope, columns = np.empty(n), np.empty(n), np.ones(n + 1)
    none = np.empty((0, 3))
    for p in range(n_starts):
        x = y[p]
        while kept[p] and left[p] > 0 and t[p] < until:
            for i in range(n):
                columns[i] = x[i]
            _add_terms(products, derivatives, columns, jacobian)
            square = 0.0
            for i in range(n * n):
                square += jacobian[i] * jacobian[i]
            h = times_rate / max(np.sqrt(square), floor)
            _runge_kutta(terms, coef, none, h, x, total, slope, columns)
            t[p] += h
            left[p] -= 1
            for i in range(n):
                kept[p] = kept[p] and abs(x[i] - centre[i]) <= bound
    return kept
