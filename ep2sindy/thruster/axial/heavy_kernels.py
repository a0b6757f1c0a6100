"""Compiled ions and neutrals: finite volumes with van Leer's slopes and Heun's steps."""

import math

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial import state_kernels as recorded
from ep2sindy.thruster.axial.electron_kernels import COLDEST_EV, sheath_drop
from ep2sindy.thruster.axial.state_kernels import ENTRY, FAST, LOOP, ONE, inside
from ep2sindy.thruster.constants import E_CHARGE

TINY = 1e-60  # avoids 0/0
RAREST = 1e-12  # least density of a higher charge, of the first: near the anode nothing makes them


@compiled(inline="always")
def half_slope(q, i, to_left, to_right):
    """Half of van Leer's slope, a*b/(a + b) of the differences, as numerator and denominator.

    It is 0 at an extremum.
    """
    a = (q[i] - q[i - ONE]) * to_left[i]
    b = (q[i + ONE] - q[i]) * to_right[i]
    return max(a * b, 0.0) * (a + b), (a + b) ** 2 + TINY  # a branch is not vectorised


@compiled(inline="always")
def quotients(a, p, b, q, c, r, d, s):
    """a/p, b/q, c/r and d/s by one division, which takes as long as sixteen products.

    The product of all denominators must not overflow, nor vanish.
    """
    pq, rs = p * q, r * s
    inverse = 1.0 / (pq * rs)
    per_pq, per_rs = inverse * rs, inverse * pq
    return a * q * per_pq, b * p * per_pq, c * s * per_rs, d * r * per_rs


@compiled(**LOOP)
def half_slopes(n, u, nn, to_left, to_right, weight, s_n, s_u, s_nn):
    """Half slopes of ions, their speed and the neutrals, 0 in the two outermost cells."""
    for i in inside(n):
        a, p = half_slope(n, i, to_left, to_right)
        b, q = half_slope(u, i, to_left, to_right)
        c, r = half_slope(nn, i, to_left, to_right)
        a, b, c, _ = quotients(a, p, b, q, c, r, 0.0, 1.0)
        s_n[i], s_u[i], s_nn[i] = weight * a, weight * b, weight * c
    s_n[1] = s_n[-2] = s_u[1] = s_u[-2] = s_nn[1] = s_nn[-2] = 0.0


@compiled(**LOOP)
def ratios(g, n, u):
    for i in inside(n):
        u[i] = g[i] / n[i]


@compiled(**FAST)
def start_speeds(state, w):
    """Speeds of the ions; every step ends with those of the next."""
    for k in range(state.n_i.shape[0]):
        ratios(state.flux_i[k], state.n_i[k], w.u[k])


@compiled(inline="always")
def rusanov(n_l, u_l, n_r, u_r, c2, c):
    """Rusanov fluxes of ion density and ion flux between two states."""
    g_l, g_r = n_l * u_l, n_r * u_r
    s = max(abs(u_l), abs(u_r)) + c
    through = 0.5 * (g_l + g_r - s * (n_r - n_l))
    return through, 0.5 * (g_l * u_l + g_r * u_r + c2 * (n_l + n_r) - s * (g_r - g_l))


@compiled(**LOOP)
def fluxes_between(n, u, s_n, s_u, c2, flux, momentum_flux):
    """Fluxes of ions through all faces between two cells."""
    c = np.sqrt(c2)
    for i in range(ONE, np.uint64(n.size) - ONE - ONE):
        j = i + ONE
        flux[i], momentum_flux[i] = rusanov(
            n[i] + s_n[i], u[i] + s_u[i], n[j] - s_n[j], u[j] - s_u[j], c2, c
        )


@compiled(**FAST)
def fluxes_at_ends(n, g, u, c2, bohm, flux, momentum_flux):
    """Fluxes of ions at the anode, at the Bohm speed or faster, and freely at the cathode plane."""
    flux[0], momentum_flux[0] = rusanov(n[1], min(u[1], -bohm), n[1], u[1], c2, np.sqrt(c2))
    flux[-2] = g[-2]
    momentum_flux[-2] = g[-2] * u[-2] + c2 * n[-2]


@compiled(**LOOP)
def birth(rate, n_e, source, speed, consumed, gain, momentum_gain, first):
    """Ions from neutrals, with the neutrals' speed or at rest; if first, forget what was there."""
    keep = 0.0 if first else 1.0
    for i in inside(source):
        born = rate[i] * n_e[i] * source[i]
        consumed[i] = keep * consumed[i] + born
        gain[i] = keep * gain[i] + born
        momentum_gain[i] = keep * momentum_gain[i] + born * speed[i]


@compiled(**LOOP)
def further_birth(rate, n_e, source, g, loss, drag, gain, momentum_gain):
    """Ions from ions of a lower charge, which lose them; they keep their speed."""
    for i in inside(source):
        born, taken = rate[i] * n_e[i] * source[i], rate[i] * n_e[i] * g[i]
        loss[i] -= born
        drag[i] -= taken
        gain[i] += born
        momentum_gain[i] += taken


@compiled(**FAST)
def births(n, g, nn, state, model, w):
    """Gains of ions of every charge, of their flux, and the neutrals consumed."""
    n_e = n[0]
    for k in range(1, n.shape[0]):
        w.gain[k] = 0.0
        w.momentum_gain[k] = 0.0
        for i in inside(nn):
            w.n_e[i] = n_e[i] + (k + 1.0) * n[k, i]
        n_e = w.n_e
    rates, speed = state.rates, model.birth_speed
    birth(rates[0], n_e, nn, speed, w.consumed, w.gain[0], w.momentum_gain[0], True)
    for t in range(model.further.shape[0]):
        below, above = model.further[t, 0] - 1, model.further[t, 1] - 1
        gain, momentum_gain = w.gain[above], w.momentum_gain[above]
        if below < 0:
            birth(rates[t + 1], n_e, nn, speed, w.consumed, gain, momentum_gain, False)
        else:
            loss, drag = w.gain[below], w.momentum_gain[below]
            further_birth(rates[t + 1], n_e, n[below], g[below], loss, drag, gain, momentum_gain)


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


@compiled(**LOOP)
def follow_ions(
    new, new_g, new_u, n, g, flux, momentum_flux, gain, momentum_gain, E, loss, per_before,
    per_behind,
    neutralised, walled, through, keep, dt, weight, charge, to_wall, c2, first,
):  # fmt: skip
    """new = keep new + (1 - keep) (n + dt dn/dt), the same of the ion flux, their ratio, and sums.

    If first, forget how many ions were neutralised before.
    """
    take, others = 1.0 - keep, 0.0 if first else 1.0
    for i in inside(n):
        lost, before, behind = to_wall * loss[i], per_before[i], per_behind[i]
        gone, inflow = lost * n[i], flux[i - ONE]
        d_n = inflow * before - flux[i] * behind + gain[i] - gone
        widening = c2 * n[i] * (behind - before)  # pressure on the sides of a cell that widens
        d_g = momentum_flux[i - ONE] * before - momentum_flux[i] * behind + widening
        d_g += momentum_gain[i] + charge * n[i] * E[i] - lost * g[i]
        neutralised[i] = others * neutralised[i] + gone
        walled[i] += weight * gone
        through[i] += weight * inflow
        next_n = keep * new[i] + take * (n[i] + dt * d_n)
        next_g = keep * new_g[i] + take * (g[i] + dt * d_g)
        new[i], new_g[i], new_u[i] = next_n, next_g, next_g / next_n


@compiled(**LOOP)
def neutral_fluxes(nn, slopes, speed, wave, flux):
    """Upwind fluxes of neutrals behind every cell; with `wave`, Rusanov's at that much more."""
    for i in inside(nn):
        flux[i] = speed[i] * (nn[i] + slopes[i])
    if wave > 0.0:
        for i in range(1, nn.size - 2):
            flux[i] -= 0.5 * wave * (nn[i + 1] - slopes[i + 1] - nn[i] - slopes[i])


@compiled(**LOOP)
def follow_neutrals(
    new, nn, flux, consumed, neutralised, per_before, per_behind, ionized, through, keep, dt, weight
):
    """As `follow_ions`, of the neutrals."""
    take = 1.0 - keep
    for i in inside(nn):
        inflow = flux[i - ONE]
        d_nn = inflow * per_before[i] - flux[i] * per_behind[i] + neutralised[i] - consumed[i]
        ionized[i] += weight * consumed[i]
        through[i] += weight * inflow
        new[i] = keep * new[i] + take * (nn[i] + dt * d_nn)


@compiled(**LOOP)
def hold_above_zero(n, g, u, n_1, g_1, u_1):
    """Let rare ions of a higher charge move with the singly charged ones."""
    for i in inside(n):
        least = RAREST * n_1[i]
        rare = n[i] < least
        n[i] = least if rare else n[i]
        g[i] = RAREST * g_1[i] if rare else g[i]
        u[i] = u_1[i] if rare else u[i]


@compiled(**FAST)
def stage_of_ions(k, new, new_g, n, g, nn, keep, dt, state, model, sums, w):
    """One stage of Heun's step for ions of charge k + 1; returns their flux into the anode."""
    flux, c2, z = w.flux, model.sound_speed_squared, k + 1.0
    charge, weight = z * E_CHARGE / model.ion_mass, 0.5 * dt
    to_left, to_right, limit = model.to_left, model.to_right, model.slope_weight
    u = w.u[k]
    half_slopes(n, u, nn, to_left, to_right, limit, w.slope_n, w.slope_u, w.slope_nn)
    fluxes_between(n, u, w.slope_n, w.slope_u, c2, flux, w.momentum_flux)
    fluxes_at_ends(n, g, u, c2, leaving_speed(charge, state, model), flux, w.momentum_flux)
    cells = sums.cells
    follow_ions(
        new, new_g, u, n, g, flux, w.momentum_flux, w.gain[k], w.momentum_gain[k], state.E,
        state.wall_loss,
        model.per_before, model.per_behind, w.neutralised, cells[recorded.WALL_LOSS],
        cells[recorded.FACE_I + recorded.PER_CHARGE * k], keep, dt, weight, charge, np.sqrt(z), c2,
        k == 0,
    )  # fmt: skip
    leaving = flux[-2] * model.spread_at[-1]
    sums.series[recorded.BEAM] += weight * z * leaving
    sums.series[recorded.IONS_OUT] += weight * leaving
    return flux[0]


@compiled(**FAST)
def stage(new, new_g, new_nn, n, g, nn, keep, dt, state, model, sums, w):
    """One stage of Heun's step; adds half of dt times fluxes and sources to the sums."""
    flux, weight = w.flux, 0.5 * dt
    births(n, g, nn, state, model, w)
    at_anode = 0.0
    for k in range(n.shape[0]):
        at_anode += stage_of_ions(
            k, new[k], new_g[k], n[k], g[k], nn, keep, dt, state, model, sums, w
        )
    for k in range(1, n.shape[0]):
        hold_above_zero(new[k], new_g[k], w.u[k], new[0], new_g[0], w.u[0])
    neutral_fluxes(nn, w.slope_nn, model.neutral_speed, model.neutral_wave, flux)
    flux[0] = model.neutral_inflow - at_anode
    follow_neutrals(
        new_nn, nn, flux, w.consumed, w.neutralised, model.neutral_before, model.neutral_behind,
        sums.cells[recorded.IONIZATION], sums.cells[recorded.FACE_N], keep, dt, weight,
    )  # fmt: skip
    sums.series[recorded.NEUTRALS_OUT] += weight * flux[-2] * model.spread_at[-1]


@compiled(**FAST)
def follow_heavy(state, model, dt, sums, w):
    """One SSP-RK2 (Heun) step of ions and neutrals in a frozen field; w.u holds their speeds.

    The entries of `sums` match the changes of this step to rounding.
    """
    n, g, nn = state.n_i, state.flux_i, state.n_n
    new, new_g, new_nn, keep = w.stage_n, w.stage_flux, w.stage_nn, 0.0
    for _ in range(2):  # one copy of the code for both stages
        stage(new, new_g, new_nn, n, g, nn, keep, dt, state, model, sums, w)
        n, g, nn, new, new_g, new_nn, keep = new, new_g, new_nn, n, g, nn, 0.5


@compiled(**ENTRY)
def heavy_step(state, model, dt, sums, w):
    """`follow_heavy` by itself."""
    start_speeds(state, w)
    follow_heavy(state, model, dt, sums, w)


@compiled(**FAST)
def add_scaled(total, values, weight):
    for i in range(total.size):
        total[i] += weight * values[i]
