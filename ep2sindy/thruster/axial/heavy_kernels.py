"""Compiled ions and neutrals: finite volumes with van Leer's slopes and Heun's steps."""

import math

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial.electron_kernels import COLDEST_EV, sheath_drop
from ep2sindy.thruster.axial.state_kernels import (
    BEAM,
    ENTRY,
    FACE_I,
    FACE_N,
    FAST,
    IONIZATION,
    IONS_OUT,
    NEUTRALS_OUT,
    ONE,
    PER_CHARGE,
    WALL_LOSS,
    faces,
    inside,
)
from ep2sindy.thruster.constants import E_CHARGE

TINY = 1e-60  # avoids 0/0


@compiled(**FAST)
def half_slopes(values, model, s):
    """Half of van Leer's slope in every cell: a*b/(a + b) of the differences to both sides.

    The slope is 0 at an extremum, and in the two outermost cells.
    """
    to_left, to_right = model.to_left, model.to_right
    for i in inside(values):
        a = (values[i] - values[i - ONE]) * to_left[i]
        b = (values[i + ONE] - values[i]) * to_right[i]
        s[i] = max(a * b, 0.0) * (a + b) / ((a + b) ** 2 + TINY)  # a branch would not vectorise
    s[1] = s[-2] = 0.0
    if not model.reconstruct:
        s[:] = 0.0


@compiled(**FAST)
def ion_fluxes(n, g, c2, bohm, model, w, f_n, f_g):
    """Rusanov fluxes of ion density and ion flux through faces 0 .. cells; w: 3 rows of work.

    Anode: the ghost state leaves at the Bohm speed or faster. Cathode plane: ions leave freely.
    """
    cells, c = n.size - 2, np.sqrt(c2)
    u, s_n, s_u = w[0], w[1], w[2]
    for i in inside(n):
        u[i] = g[i] / n[i]
    half_slopes(n, model, s_n)
    half_slopes(u, model, s_u)
    n_l, u_l = n[1], min(u[1], -bohm)
    for i in faces(n):
        j = i + ONE
        n_r, u_r = n[j] - s_n[j], u[j] - s_u[j]
        g_l, g_r = n_l * u_l, n_r * u_r
        s = max(abs(u_l), abs(u_r)) + c
        f_n[i] = 0.5 * (g_l + g_r - s * (n_r - n_l))
        f_g[i] = 0.5 * (g_l * u_l + g_r * u_r + c2 * (n_l + n_r) - s * (g_r - g_l))
        n_l, u_l = n[j] + s_n[j], u[j] + s_u[j]
    f_n[cells] = g[cells]
    f_g[cells] = g[cells] * u[cells] + c2 * n[cells]


@compiled(**FAST)
def births(n, g, nn, state, model, gain, momentum, consumed):
    """Gains of ions of every charge in density and momentum over mass, and the neutrals consumed.

    Ions from neutrals start with the neutrals' speed or at rest; ions from ions keep their speed.
    """
    charges, size = n.shape
    single, double, second = state.rates[0], state.rates[1], state.rates[2]
    first, speed, gain_1, momentum_1 = n[0], model.birth_speed, gain[0], momentum[0]
    if charges == 1:
        for i in range(size):
            born = single[i] * first[i] * nn[i]
            consumed[i] = born
            gain_1[i] = born
            momentum_1[i] = born * speed
        return
    for i in range(size):
        n_e = first[i] + 2.0 * n[1, i]
        once, twice = single[i] * n_e * nn[i], double[i] * n_e * nn[i]
        again = second[i] * n_e * first[i]
        u = g[0, i] / first[i]
        gain_1[i] = once - again
        gain[1, i] = twice + again
        momentum_1[i] = once * speed - again * u
        momentum[1, i] = twice * speed + again * u
        consumed[i] = once + twice


@compiled(**FAST)
def neutral_fluxes(nn, model, at_anode, slopes, f_nn):
    """Upwind fluxes of neutrals; ions that reached the anode return as neutrals.

    With `neutral_wave` they are Rusanov fluxes at that much more than the neutrals' speed.
    """
    half_slopes(nn, model, slopes)
    f_nn[0] = model.neutral_inflow - at_anode
    for i in inside(nn):
        f_nn[i] = model.neutral_speed * (nn[i] + slopes[i])
    if model.neutral_wave > 0.0:
        for i in range(1, nn.size - 2):
            jump = nn[i + 1] - slopes[i + 1] - nn[i] - slopes[i]
            f_nn[i] -= 0.5 * model.neutral_wave * jump


@compiled(**FAST)
def leaving_speed(charge, state, model):
    """Speed in m/s at which ions leave into the anode, for a charge over mass; see AnodeSheath."""
    if not model.sheath:
        return np.sqrt(charge * model.anode_T_e_eV)
    T, drop = max(state.T_e_eV[1], COLDEST_EV), sheath_drop(state, model)
    bohm = np.sqrt(charge * T + model.sound_speed_squared)
    if drop <= 0.0:
        return bohm
    x = drop / T
    chi = math.exp(-x) / (math.sqrt(math.pi * x) * (1.0 + math.erf(math.sqrt(x))))
    return bohm / np.sqrt(1.0 + chi)


@compiled(**FAST)
def ion_rates(k, n, g, state, model, sums, weight, w, d_n, d_g):
    """Time derivatives of density and flux of ions of charge k + 1; returns their anode flux.

    The rate of ions neutralised at the walls is added to w[4].
    """
    f_n, f_g, neutralised, gain, momentum = w[0], w[1], w[4], w[6 + k], w[8 + k]
    z, through, walled = k + 1.0, sums.cells[FACE_I + PER_CHARGE * k], sums.cells[WALL_LOSS]
    charge, to_wall = z * E_CHARGE / model.ion_mass, np.sqrt(z)
    bohm = leaving_speed(charge, state, model)
    ion_fluxes(n, g, model.sound_speed_squared, bohm, model, w[10:13], f_n, f_g)
    for i in inside(n):
        lost, per_dz = to_wall * state.wall_loss[i], model.inverse_dz[i]
        push = momentum[i] + charge * n[i] * state.E[i]
        d_n[i] = (f_n[i - ONE] - f_n[i]) * per_dz + gain[i] - lost * n[i]
        d_g[i] = (f_g[i - ONE] - f_g[i]) * per_dz + push - lost * g[i]
        neutralised[i] += lost * n[i]
        walled[i] += weight * lost * n[i]
        through[i] += weight * f_n[i - ONE]
    sums.series[BEAM] += weight * z * f_n[n.size - 2]
    sums.series[IONS_OUT] += weight * f_n[n.size - 2]
    return f_n[0]


@compiled(**FAST)
def heavy_rates(n, g, nn, state, model, sums, weight, w, d_n, d_g, d_nn):
    """Time derivatives of all heavy species; adds weight times fluxes and sources to the sums."""
    f_nn, consumed, neutralised = w[2], w[3], w[4]
    ionized, through = sums.cells[IONIZATION], sums.cells[FACE_N]
    births(n, g, nn, state, model, w[6:8], w[8:10], consumed)
    for i in inside(nn):
        neutralised[i] = 0.0
    at_anode = 0.0
    for k in range(n.shape[0]):
        at_anode += ion_rates(k, n[k], g[k], state, model, sums, weight, w, d_n[k], d_g[k])
    neutral_fluxes(nn, model, at_anode, w[5], f_nn)
    for i in inside(nn):
        exchange = neutralised[i] - consumed[i]
        d_nn[i] = (f_nn[i - ONE] - f_nn[i]) * model.inverse_dz[i] + exchange
        ionized[i] += weight * consumed[i]
        through[i] += weight * f_nn[i - ONE]
    sums.series[NEUTRALS_OUT] += weight * f_nn[nn.size - 2]


@compiled(**ENTRY)
def heavy_step(state, model, dt, sums, w):
    """One SSP-RK2 (Heun) step of ions and neutrals in a frozen field.

    w: (26, n + 2). The entries of `sums` match the changes of this step to rounding.
    """
    n, g, nn = state.n_i, state.flux_i, state.n_n
    n_1, g_1, nn_1 = w[16:18], w[18:20], w[20]
    d_n, d_g, d_nn = w[21:23], w[23:25], w[25]
    heavy_rates(n, g, nn, state, model, sums, 0.5 * dt, w, d_n, d_g, d_nn)
    for k in range(n.shape[0]):
        euler_step(n[k], d_n[k], dt, n_1[k])
        euler_step(g[k], d_g[k], dt, g_1[k])
    euler_step(nn, d_nn, dt, nn_1)
    heavy_rates(
        n_1[: n.shape[0]], g_1[: n.shape[0]], nn_1, state, model, sums, 0.5 * dt, w, d_n, d_g, d_nn
    )
    for k in range(n.shape[0]):
        heun_step(n[k], n_1[k], d_n[k], dt)
        heun_step(g[k], g_1[k], d_g[k], dt)
    heun_step(nn, nn_1, d_nn, dt)


@compiled(**FAST)
def euler_step(values, d, dt, following):
    for i in inside(values):
        following[i] = values[i] + dt * d[i]


@compiled(**FAST)
def heun_step(values, following, d, dt):
    for i in inside(values):
        values[i] = 0.5 * (values[i] + following[i] + dt * d[i])


@compiled(**FAST)
def add_scaled(total, values, weight):
    for i in range(total.size):
        total[i] += weight * values[i]
