"""Compiled integration of single runs, and of many: sums of products of states and inputs.

Rates are given as entries (table, product, target, weight), in ascending order of the products: row
k of `table` lists the columns, of states, inputs and a one, whose product is product k, and entry e
adds weight[e] times product[e] to the slope of state target[e]. Inputs are (breaks, pieces), breaks
(m + 1,) and pieces (powers, m, inputs): see `inputs.Curve`.

`advance` takes steps of the Dormand-Prince scheme of order eight, a tuple of its coefficients (a,
b, c, e3, e5, a_dense, c_dense, dense), see `runge_kutta`. Steps, errors and dense output are those
of SciPy's `DOP853`, so that a run differs from SciPy's by rounding only.
"""

import numpy as np

from ep2sindy.runtime.compilation import compiled

FINISHED, LOOK, CROSSED, FAILED = 0, 1, 2, 3  # reasons for which `advance` returns

SAFETY, MIN_FACTOR, MAX_FACTOR = 0.9, 0.2, 10.0  # safety factor, and bounds on the step ratio
EXPONENT = -1.0 / 8.0  # power of the error in the step size; the error estimate is of order seven


@compiled(error_model="numpy")
def _sum(table, product, target, weight, columns, slope):
    """Write the slopes of all states: the sums of the entries. Each product is taken once."""
    for i in range(len(slope)):
        slope[i] = 0.0
    value, before = 0.0, -1
    for e in range(len(product)):
        k = product[e]
        if k != before:
            value, before = columns[table[k, 0]], k
            for factor in range(1, table.shape[1]):
                value *= columns[table[k, factor]]
        slope[target[e]] += weight[e] * value


@compiled(error_model="numpy")
def _rates(equations, t, y, columns, slope):
    """Write the right-hand side at one state into `slope`; `columns` is workspace."""
    table, product, target, weight, breaks, pieces = equations
    n, n_inputs = len(y), pieces.shape[2]
    for i in range(n):
        columns[i] = y[i]
    if n_inputs:
        place, above = 0, pieces.shape[1]
        while above - place > 1:  # bisection for the span that contains t
            middle = (place + above) // 2
            if breaks[middle] <= t:
                place = middle
            else:
                above = middle
        fraction = (t - breaks[place]) / (breaks[place + 1] - breaks[place])
        for j in range(n_inputs):
            value = 0.0
            for power in range(len(pieces)):
                value = value * fraction + pieces[power, place, j]
            columns[n + j] = value
    _sum(table, product, target, weight, columns, slope)


@compiled(error_model="numpy")
def _stage(equations, t, y, h, weights, n_before, slopes, at, columns):
    """Compute stage slope number `n_before` of a step of length h from y."""
    for i in range(len(y)):
        value = 0.0
        for s in range(n_before):
            value += slopes[s, i] * weights[s]
        at[i] = y[i] + value * h
    _rates(equations, t, at, columns, slopes[n_before])


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
def _between(shape, start, fraction, out):
    """Write the state at a given fraction of a step into `out`."""
    for i in range(len(start)):
        value = 0.0
        for k in range(7):
            value = (value + shape[6 - k, i]) * (fraction if k % 2 == 0 else 1.0 - fraction)
        out[i] = start[i] + value


@compiled(error_model="numpy")
def _room(y, n_bounded, blow_up):
    """`blow_up` minus the largest absolute of the first states; negative beyond it."""
    largest = 0.0
    for i in range(n_bounded):
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
        # The stages k_s = f(t + c_s h, x + h sum_r a_sr k_r), then the end x + h sum_s b_s k_s.
        for s in range(1, 12):
            now = min(t + c[s] * h, before_end)
            _stage(equations, now, y, h, a[s], s, slopes, at, columns)
        for i in range(len(y)):
            value = 0.0
            for s in range(12):
                value += slopes[s, i] * b[s]
            at[i] = y[i] + h * value
        _rates(equations, before_end, at, columns, slopes[12])
        calls += 12
        # An error above one repeats the step, shorter; below one it sets the length of the next.
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
    equations, scheme, times, stops, out, y, slope, t, h, place, calls, limit, n_bounded, blow_up,
    rtol,
):  # fmt: skip
    """Integrate to the last of `times`, filling rows of `out` from `place` on.

    stops: times at which inputs jump or bend, then the last time: no step goes beyond. y and slope
    are updated in place. h: the step to try. Returns the reason for stopping, the time, the step to
    try next, the next place and the number of evaluations. Reasons: FINISHED; LOOK: `limit`
    evaluations have been exceeded; CROSSED: the largest of the first n_bounded states crossed
    `blow_up` in the last step, and samples are filled up to the crossing; FAILED: the step became
    too small.
    """
    n, slopes, shape = len(y), np.empty((16, len(y))), np.empty((7, len(y)))
    at, room, columns = np.empty(n), np.empty(n), np.ones(n + equations[5].shape[2] + 1)
    for i in range(n):  # array expressions take seconds longer to compile
        slopes[0, i] = slope[i]
    inside = _room(y, n_bounded, blow_up) >= 0.0
    stop = np.searchsorted(stops, t, "right")
    while t < times[-1]:
        ahead, length, h, n_calls = _step(
            equations, scheme, t, h, stops[stop], y, at, slopes, columns, rtol
        )
        calls += n_calls
        if ahead == t:
            return FAILED, t, h, place, calls
        over = calls > limit  # checked before the evaluations for dense output, as in SciPy
        crossed = (_room(at, n_bounded, blow_up) >= 0.0) != inside
        if times[place] <= ahead:
            _polynomial(equations, scheme, t, length, y, at, slopes, room, columns, shape)
            calls += 3
            while place < len(times) and times[place] <= ahead:
                _between(shape, y, (times[place] - t) / length, out[place])
                if crossed and (_room(out[place], n_bounded, blow_up) >= 0.0) != inside:
                    break
                place += 1
        t = ahead
        if t == stops[stop]:
            stop += 1
            _rates(equations, t, at, columns, slopes[12])
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
def _runge_kutta(table, product, target, weight, leads, weights, drive, h, x, slopes, columns):
    """One step of order four of length h; updates x in place.

    drive: (inputs, 3), at the start, middle and end of the step. leads, weights: of the tableau of
    the classical scheme, in which every stage leads on from the one before alone.
    """
    n = len(x)
    # k_s = f(x + h a_(s, s - 1) k_(s - 1), u), then x += h sum_s w_s k_s.
    for stage in range(4):
        for i in range(n):
            ahead = h * leads[stage, stage - 1] * slopes[stage - 1, i] if stage else 0.0
            columns[i] = x[i] + ahead
        for j in range(len(drive)):
            columns[n + j] = drive[j, (stage + 1) // 2]
        _sum(table, product, target, weight, columns, slopes[stage])
    for i in range(n):
        for stage in range(4):
            x[i] += h * weights[stage] * slopes[stage, i]


@compiled(error_model="numpy")
def run_many(
    table, product, target, weight, first, leads, weights, starts, steps_s, drive, moves,
    n_substeps, centre, reach,
):  # fmt: skip
    """Integrate many models from many starts by classical Runge-Kutta steps.

    first: (models + 1,), the entries of model m are those from first[m] to first[m + 1]. starts:
    (models, windows, n); steps_s: (windows, steps); drive: (windows, steps, inputs, 3); moves:
    (models, windows, samples, n), added at every sample, or without samples. Returns the states
    (models, windows, samples, n) after every n_substeps steps; NaN from where a state is farther
    than reach (n,) from the centre (n,).
    """
    n_models, n_windows, n = starts.shape
    n_samples = steps_s.shape[1] // n_substeps
    paths = np.full((n_models, n_windows, n_samples, n), np.nan)
    x, slopes, columns = np.empty(n), np.empty((4, n)), np.ones(n + drive.shape[2] + 1)
    for m in range(n_models):
        own = slice(first[m], first[m + 1])
        entries = table, product[own], target[own], weight[own]
        for w in range(n_windows):
            bounded = True
            for i in range(n):
                x[i] = starts[m, w, i]
            for k in range(n_samples):
                for step in range(k * n_substeps, (k + 1) * n_substeps * bounded):
                    at, h = drive[w, step], steps_s[w, step]
                    _runge_kutta(*entries, leads, weights, at, h, x, slopes, columns)
                for i in range(n):
                    if moves.shape[2]:
                        x[i] += moves[m, w, k, i]
                    bounded = bounded and abs(x[i] - centre[i]) <= reach[i]
                if not bounded:
                    break
                for i in range(n):
                    paths[m, w, k, i] = x[i]
    return paths


@compiled(error_model="numpy")
def approach(rates, jacobian, leads, weights, centre, bound, until, times_rate, floor, y, t, left):
    """Runge-Kutta steps of many starts until a time, each of length times_rate / max(rate, floor).

    rates, jacobian: entries of the right-hand side and of its derivatives, whose norm is the rate.
    y: (starts, n), t and left: (starts,), the steps that each start may still take, are updated in
    place. Returns flags, false for starts that left the bound about the centre.
    """
    n_starts, n = y.shape
    kept, derivatives = np.ones(n_starts, dtype=np.bool_), np.empty(n * n)
    slopes, columns = np.empty((4, n)), np.ones(n + 1)
    none = np.empty((0, 3))
    for p in range(n_starts):
        x = y[p]
        while kept[p] and left[p] > 0 and t[p] < until:
            for i in range(n):
                columns[i] = x[i]
            _sum(*jacobian, columns, derivatives)
            square = 0.0
            for i in range(n * n):
                square += derivatives[i] * derivatives[i]
            h = times_rate / max(np.sqrt(square), floor)
            _runge_kutta(*rates, leads, weights, none, h, x, slopes, columns)
            t[p] += h
            left[p] -= 1
            for i in range(n):
                kept[p] = kept[p] and abs(x[i] - centre[i]) <= bound
    return kept
