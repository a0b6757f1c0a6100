"""Compiled inner loop: sample after sample, heavy species and electrons in turn."""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial import state_kernels as recorded
from ep2sindy.thruster.axial.electron_kernels import follow_electrons, start_density
from ep2sindy.thruster.axial.heavy_kernels import add_scaled, follow_heavy, start_speeds
from ep2sindy.thruster.axial.state_kernels import ENTRY, FAST, NO_NAN, SHORTEST_STEP, inside


@compiled(**NO_NAN)
def fastest(u, inverse_dz, c):
    """Largest (|u| + c)/dz of a species, in 1/s."""
    top = 0.0
    for i in inside(u):
        top = max(top, (abs(u[i]) + c) * inverse_dz[i])
    return top


@compiled(**FAST)
def time_step(model, left, w):
    """Time step within the CFL number that divides the time left to the next sample equally."""
    c = np.sqrt(model.sound_speed_squared)
    top = 0.0
    for k in range(w.u.shape[0]):
        top = max(top, fastest(w.u[k], model.inverse_dz, c))
    return left / np.ceil(left * top / model.cfl)


@compiled(**FAST)
def add_instant(sums, state, weight, w):
    """Add weight times the present fields to the sums, except those that the heavy step adds."""
    cells = sums.cells
    add_scaled(cells[recorded.N_N], state.n_n, weight)
    add_scaled(cells[recorded.T_E], state.T_e_eV, weight)
    add_scaled(cells[recorded.R_ION], state.rates[0], weight)
    add_scaled(cells[recorded.E_Z], state.E, weight)
    add_scaled(cells[recorded.ENERGY], state.energy, weight)
    for k in range(state.n_i.shape[0]):
        at = recorded.PER_CHARGE * k
        add_scaled(cells[recorded.N_I + at], state.n_i[k], weight)
        add_scaled(cells[recorded.U_IZ + at], w.u[k], weight)
        add_scaled(cells[recorded.FLUX_I + at], state.flux_i[k], weight)
    add_scaled(sums.series, state.instant, weight)


@compiled(**FAST)
def add_changes(sums, state, sign):
    """Add the densities' gain over a sample; call with sign -1 before it and +1 after it."""
    add_scaled(sums.cells[recorded.CHANGE_N], state.n_n, sign)
    for k in range(state.n_i.shape[0]):
        add_scaled(sums.cells[recorded.CHANGE_I + recorded.PER_CHARGE * k], state.n_i[k], sign)


@compiled(**ENTRY)
def advance(state, model, sums, w, sample_s, averaged, fields, series):
    """Fill the rows of fields (cell sums, rows, cells) and series (rows, series); return how many.

    Rows hold averages over each sample, or the values at its end. If the run breaks, earlier rows
    remain.
    """
    size = state.n_n.size
    for row in range(series.shape[0]):
        start_density(state)
        start_speeds(state, w)
        sums.cells[:] = 0.0
        sums.series[:] = 0.0
        add_changes(sums, state, -1.0)
        left, weight = sample_s, sample_s
        while left > 1e-9 * sample_s:
            dt = time_step(model, left, w)
            if not averaged:  # keep the last step only
                sums.cells[:] = 0.0
                sums.series[:] = 0.0
                weight = dt
            if not dt > SHORTEST_STEP * sample_s:
                return row
            follow_heavy(state, model, dt, sums, w)
            if not follow_electrons(state, model, dt, w):
                return row
            add_instant(sums, state, dt, w)
            left -= dt
        add_changes(sums, state, 1.0)
        add_scaled(sums.cells[recorded.SPREAD], model.spread, weight)
        for i in range(size):
            reached = state.T_e_eV[i] + model.drift_weight * state.drift_eV[i] * 2.0 / 3.0
            state.hottest_eV[0] = max(state.hottest_eV[0], reached)
        for k in range(fields.shape[0]):
            for i in range(size - 2):
                fields[k, row, i] = sums.cells[k, i + 1] / weight
        for k in range(series.shape[1]):
            series[row, k] = sums.series[k] / weight
    return series.shape[0]
