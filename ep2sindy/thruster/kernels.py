"""Compiled inner loop: ions and neutrals by SSP-RK2, electrons by one tridiagonal solve per step.

Cell arrays hold one ghost cell at each end: index 0 lies behind the anode, index -1 beyond the
cathode plane; cells 1 .. n are the domain. Face i lies between cells i and i + 1.
"""

from typing import NamedTuple

import numpy as np

from ep2sindy.machine.compilation import compiled
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON

COLDEST_EV = 1.0  # of the ghost cells: a steep end would otherwise turn them negative

# Columns of `Model.table`, one row per electron temperature; coefficients in SI, energies in eV.
(
    IONIZATION,
    INELASTIC,
    EVENTS,
    MOMENTUM,
    COULOMB,
    COULOMB_LOG,
    WALL_COLLISION,
    WALL_POWER,
    ION_LOSS,
) = range(9)


class Model(NamedTuple):
    """Everything the compiled loop needs that does not change in time."""

    dz: float  # m
    area: float  # m^2
    ion_mass: float  # kg
    sound_speed_squared: float  # k_B T_i / m, m^2/s^2
    neutral_speed: float  # m/s
    neutral_inflow: float  # 1/(m^2 s)
    voltage: float  # V_0 - V_c, V
    resistance: float  # ohm
    pressure_factor: float  # p_e = pressure_factor * n * T_e
    conduction_factor: float  # kappa = conduction_factor * mu * n * T_e
    drift_weight: float  # 1: rates see the electrons' drift energy; 0: they do not
    anode_T_e_eV: float  # eV
    cathode_T_e_eV: float  # eV
    cfl: float
    omega_ce: np.ndarray  # (n + 2,), rad/s
    anomalous: np.ndarray  # (n + 2,), 1/s
    wall_ion_weight: np.ndarray  # (n + 2,): ion loss, electron collisions and power loss
    wall_collision_weight: np.ndarray
    wall_power_weight: np.ndarray
    table: np.ndarray  # (temperatures, 9)
    table_step_eV: float


class State(NamedTuple):
    """Cell arrays that the loop advances in place, (n + 2,) each."""

    n_i: np.ndarray  # m^-3
    flux_i: np.ndarray  # n_i u_i, 1/(m^2 s)
    n_n: np.ndarray  # m^-3
    T_e_eV: np.ndarray
    energy: np.ndarray  # 1.5 n_i T_e, eV/m^3
    drift_eV: np.ndarray  # K, kinetic energy of the electrons' drift
    E: np.ndarray  # V/m
    ionization: np.ndarray  # k, m^3/s
    wall_loss: np.ndarray  # nu_iw, 1/s
    current: np.ndarray  # (1,), A
    left: np.ndarray  # (1,), atoms that left through the cathode plane, 1/m^2


@compiled(inline="always")
def half_slope(left, centre, right):
    """Half the van Leer slope: a*b/(a+b) of the two differences, 0 at an extremum."""
    a = centre - left
    b = right - centre
    return a * b / (a + b) if a * b > 0.0 else 0.0


@compiled(inline="always")
def rusanov(n_l, u_l, n_r, u_r, c2):
    """Rusanov fluxes of ion density and ion flux between two states; c2: sound speed squared."""
    g_l, g_r = n_l * u_l, n_r * u_r
    s = max(abs(u_l), abs(u_r)) + np.sqrt(c2)
    flux_n = 0.5 * (g_l + g_r) - 0.5 * s * (n_r - n_l)
    flux_g = 0.5 * (g_l * u_l + g_r * u_r + c2 * (n_l + n_r)) - 0.5 * s * (g_r - g_l)
    return flux_n, flux_g


@compiled
def face_fluxes(n, g, nn, model, u, f_n, f_g, f_nn):
    """Fluxes of ion density, ion flux and neutrals through faces 0 .. cells.

    Anode: the ghost state leaves at the Bohm speed or faster, and what leaves as ions returns
    as neutrals. Cathode plane: everything leaves freely.
    """
    cells = n.size - 2
    c2 = model.sound_speed_squared
    bohm = np.sqrt(E_CHARGE * model.anode_T_e_eV / model.ion_mass)
    for i in range(1, cells + 1):
        u[i] = g[i] / n[i]
    f_n[0], f_g[0] = rusanov(n[1], min(u[1], -bohm), n[1], u[1], c2)
    f_nn[0] = model.neutral_inflow - f_n[0]
    n_l, u_l, nn_l = n[1], u[1], nn[1]  # first order in the two outermost cells
    for i in range(1, cells):
        j = i + 1
        n_r, u_r, s_n, s_u, s_nn = n[j], u[j], 0.0, 0.0, 0.0
        if j < cells:
            s_n = half_slope(n[i], n[j], n[j + 1])
            s_u = half_slope(u[i], u[j], u[j + 1])
            s_nn = half_slope(nn[i], nn[j], nn[j + 1])
        f_n[i], f_g[i] = rusanov(n_l, u_l, n_r - s_n, u_r - s_u, c2)
        f_nn[i] = model.neutral_speed * nn_l
        n_l, u_l, nn_l = n_r + s_n, u_r + s_u, nn[j] + s_nn
    f_n[cells] = g[cells]
    f_g[cells] = g[cells] * u[cells] + c2 * n[cells]
    f_nn[cells] = model.neutral_speed * nn[cells]


@compiled
def heavy_rates(n, g, nn, state, model, w, d_n, d_g, d_nn):
    """Time derivatives of ion density, ion flux and neutral density in every cell."""
    f_n, f_g, f_nn = w[0], w[1], w[2]
    face_fluxes(n, g, nn, model, w[3], f_n, f_g, f_nn)
    charge = E_CHARGE / model.ion_mass
    inv_dz = 1.0 / model.dz
    for i in range(1, n.size - 1):
        born = state.ionization[i] * n[i] * nn[i]
        lost = state.wall_loss[i]
        push = charge * n[i] * state.E[i] + born * model.neutral_speed
        d_n[i] = (f_n[i - 1] - f_n[i]) * inv_dz + born - lost * n[i]
        d_g[i] = (f_g[i - 1] - f_g[i]) * inv_dz + push - lost * g[i]
        d_nn[i] = (f_nn[i - 1] - f_nn[i]) * inv_dz - born + lost * n[i]


@compiled
def heavy_step(state, model, dt, w):
    """One SSP-RK2 (Heun) step of ions and neutrals in a frozen field."""
    n, g, nn = state.n_i, state.flux_i, state.n_n
    heavy_rates(n, g, nn, state, model, w, w[4], w[5], w[6])
    leaving = w[0, -2] + w[2, -2]  # through the last face
    for i in range(1, n.size - 1):
        w[7, i] = n[i] + dt * w[4, i]
        w[8, i] = g[i] + dt * w[5, i]
        w[9, i] = nn[i] + dt * w[6, i]
    heavy_rates(w[7], w[8], w[9], state, model, w, w[4], w[5], w[6])
    state.left[0] += 0.5 * dt * (leaving + w[0, -2] + w[2, -2])
    for i in range(1, n.size - 1):
        n[i] = 0.5 * (n[i] + w[7, i] + dt * w[4, i])
        g[i] = 0.5 * (g[i] + w[8, i] + dt * w[5, i])
        nn[i] = 0.5 * (nn[i] + w[9, i] + dt * w[6, i])


@compiled(inline="always")
def lookup(table, row, share, column):
    """Linear interpolation between two rows of the closure table."""
    return table[row, column] + share * (table[row + 1, column] - table[row, column])


@compiled
def collisions(state, model, nu, mobility, kappa, source):
    """Collision frequency, mobility, conductivity and losses; False where a table ends."""
    n, nn, T, table = state.n_i, state.n_n, state.T_e_eV, model.table
    per_eV = 1.0 / model.table_step_eV
    top = table.shape[0] - 1.0
    for i in range(n.size):
        drift = model.drift_weight * state.drift_eV[i]
        x = T[i] * per_eV
        y = x + drift * 2.0 / 3.0 * per_eV  # mean energy 1.5 T + K as a temperature
        if not (x >= 0.0 and y < top and n[i] > 0.0):
            return False
        row, hot = int(x), int(y)
        share, hot_share = x - row, y - hot
        events = nn[i] * lookup(table, hot, hot_share, EVENTS)
        log_lambda = lookup(table, row, share, COULOMB_LOG) - 0.5 * np.log(n[i])
        nu[i] = (
            nn[i] * lookup(table, row, share, MOMENTUM)
            + events
            + n[i] * log_lambda * lookup(table, row, share, COULOMB)
            + model.wall_collision_weight[i] * lookup(table, hot, hot_share, WALL_COLLISION)
            + model.anomalous[i]
        )
        mobility[i] = E_CHARGE / M_ELECTRON * nu[i] / (nu[i] ** 2 + model.omega_ce[i] ** 2)
        kappa[i] = model.conduction_factor * mobility[i] * n[i] * T[i]
        # An event's energy is taken from drift and heat together; the drift pays K.
        inelastic = nn[i] * lookup(table, hot, hot_share, INELASTIC) - events * drift
        wall = model.wall_power_weight[i] * lookup(table, hot, hot_share, WALL_POWER)
        source[i] = -n[i] * (inelastic + wall)
        state.ionization[i] = lookup(table, hot, hot_share, IONIZATION)
        state.wall_loss[i] = model.wall_ion_weight[i] * lookup(table, row, share, ION_LOSS)
    return True


@compiled
def ohm(state, model, nu, mobility, gradient, source):
    """Discharge current, field and drift energy; heats by -n u_e E; returns I_d/(e A)."""
    n, g, T = state.n_i, state.flux_i, state.T_e_eV
    drive = model.voltage
    load = model.resistance
    half = 0.5 * model.pressure_factor / model.dz
    for i in range(1, n.size - 1):
        gradient[i] = half * (n[i + 1] * T[i + 1] - n[i - 1] * T[i - 1])
        drive += model.dz * (g[i] / mobility[i] + gradient[i]) / n[i]
        load += model.dz / (E_CHARGE * n[i] * mobility[i] * model.area)
    state.current[0] = drive / load
    total = state.current[0] / (E_CHARGE * model.area)
    for i in range(1, n.size - 1):
        flux = g[i] - total  # n u_e
        friction = -flux / mobility[i]
        state.E[i] = (friction - gradient[i]) / n[i]
        # K = m_e (1 + (omega/nu)^2) u_e^2 / 2 = u_e^2 / (2 mu nu), in eV
        state.drift_eV[i] = 0.5 * (flux / n[i]) ** 2 / (mobility[i] * nu[i])
        source[i] -= flux * state.E[i]  # 2 n K nu + u_e dp_e/dz
    return total


@compiled
def heat(state, model, dt, total, kappa, source, c, d):
    """New electron temperature: implicit upwind convection and conduction, explicit sources."""
    n, g, T = state.n_i, state.flux_i, state.T_e_eV
    s = dt / model.dz
    c[0], d[0] = 0.0, T[0]
    lower, diagonal = 0.0, 0.0
    for i in range(n.size - 1):
        flux = 0.5 * (g[i] + g[i + 1]) - total
        conduction = 0.5 * (kappa[i] + kappa[i + 1]) / model.dz
        down = s * (2.5 * max(flux, 0.0) + conduction)  # times T[i], leaves cell i
        up = s * (2.5 * min(flux, 0.0) - conduction)  # times T[i + 1]
        if i > 0:
            inverse = 1.0 / (diagonal + down - lower * c[i - 1])
            c[i] = up * inverse
            d[i] = (state.energy[i] + dt * source[i] - lower * d[i - 1]) * inverse
        lower, diagonal = -down, 1.5 * n[i + 1] - up
    for i in range(n.size - 2, 0, -1):
        T[i] = d[i] - c[i] * T[i + 1]
        state.energy[i] = 1.5 * n[i] * T[i]


@compiled
def electron_step(state, model, dt, w):
    """Collisions, discharge current, field and new temperature; False where the run breaks."""
    n, g, nn, T = state.n_i, state.flux_i, state.n_n, state.T_e_eV
    n[0], g[0], nn[0] = n[1], g[1], nn[1]
    n[-1], g[-1], nn[-1] = n[-2], g[-2], nn[-2]
    # The ends of the domain, half a cell outside the last centres, are held at their temperature.
    T[0] = max(2.0 * model.anode_T_e_eV - T[1], COLDEST_EV)
    T[-1] = max(2.0 * model.cathode_T_e_eV - T[-2], COLDEST_EV)
    nu, mobility, kappa, source = w[0], w[1], w[2], w[3]
    if not collisions(state, model, nu, mobility, kappa, source):
        return False
    total = ohm(state, model, nu, mobility, w[4], source)
    heat(state, model, dt, total, kappa, source, w[4], w[5])
    return np.isfinite(total)


@compiled
def time_step(state, model, left):
    """Equal share of the time left to the next sample that keeps the CFL number."""
    top = 0.0
    for i in range(1, state.n_i.size - 1):
        top = max(top, abs(state.flux_i[i] / state.n_i[i]))
    fastest = top + np.sqrt(model.sound_speed_squared)
    return left / np.ceil(left * fastest / (model.cfl * model.dz))


@compiled
def advance(state, model, sample_s, n_i, u, n_n, T_e, R, E, current, thrust, mass_out):
    """Fill the rows of the output arrays, one every `sample_s`; return (rows filled, steps)."""
    cells = state.n_i.size - 2
    steps = 0
    work = np.zeros((10, state.n_i.size))
    if not electron_step(state, model, 0.0, work):
        return 0, steps
    for row in range(current.size):
        left = sample_s
        while left > 1e-9 * sample_s:
            dt = time_step(state, model, left)
            heavy_step(state, model, dt, work)
            if not electron_step(state, model, dt, work):
                return row, steps
            left -= dt
            steps += 1
        for i in range(cells):
            n_i[row, i] = state.n_i[i + 1]
            u[row, i] = state.flux_i[i + 1] / state.n_i[i + 1]
            n_n[row, i] = state.n_n[i + 1]
            T_e[row, i] = state.T_e_eV[i + 1]
            R[row, i] = state.ionization[i + 1]
            E[row, i] = state.E[i + 1]
        current[row] = state.current[0]
        thrust[row] = model.ion_mass * model.area * state.flux_i[cells] * u[row, cells - 1]
        mass_out[row] = model.ion_mass * model.area * state.left[0]
    return current.size, steps
