"""Compiled electrons: Ohm's law, and one implicit solve for their temperature per step."""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial.collision_kernels import collisions
from ep2sindy.thruster.axial.state_kernels import (
    CURRENT,
    ENTRY,
    FAST,
    ONE,
    P_ANODE,
    P_CATHODE,
    P_INELASTIC,
    P_IONS,
    P_WALL,
    POWER,
    SUPPLY,
    SUPPLY_CURRENT,
    THRUST,
    VOLTAGE,
    WALL_CURRENT,
    faces,
    inside,
)
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON

COLDEST_EV = 1.0  # least T_e of the ghost cells: a steep end could turn them negative


@compiled(**FAST)
def fill_ghosts(values):
    values[0] = values[1]
    values[-1] = values[-2]


@compiled(**FAST)
def sum_charges(state):
    """Electron density and charge flux of all ions, including the ghost cells."""
    n, g, n_e, flux_q = state.n_i, state.flux_i, state.n_e, state.flux_q
    for k in range(n.shape[0]):
        fill_ghosts(n[k])
        fill_ghosts(g[k])
    first, first_flux = n[0], g[0]
    for i in range(n_e.size):
        n_e[i] = first[i]
    for i in range(n_e.size):
        flux_q[i] = first_flux[i]
    for k in range(1, n.shape[0]):
        for i in range(n_e.size):
            n_e[i] += (k + 1.0) * n[k, i]
        for i in range(n_e.size):
            flux_q[i] += (k + 1.0) * g[k, i]


@compiled(**FAST)
def follow_log(state):
    """Update ln n_e by its change in one step: 2 (r - 1)/(r + 1) is ln r to third order."""
    n_e, log_n, before = state.n_e, state.log_n[0], state.log_n[1]
    for i in range(n_e.size):
        log_n[i] += 2.0 * (n_e[i] - before[i]) / (n_e[i] + before[i])
    for i in range(n_e.size):
        before[i] = n_e[i]


@compiled(**ENTRY)
def start_density(state):
    """Compute the electron density and its logarithm anew."""
    sum_charges(state)
    for i in range(state.n_e.size):
        state.log_n[0, i] = np.log(state.n_e[i])
        state.log_n[1, i] = state.n_e[i]


@compiled(**FAST)
def sheath_drop(state, model):
    """Potential of the plasma above the anode in V, by the last current: see AnodeSheath."""
    T, n = max(state.T_e_eV[1], COLDEST_EV), state.n_e[1]
    electrons = state.instant[CURRENT] / (E_CHARGE * model.area) - state.flux_q[1]
    thermal = 0.25 * n * np.sqrt(8.0 * E_CHARGE * T / (np.pi * M_ELECTRON))
    if not model.sheath or electrons <= 0.0 or electrons >= thermal:
        return 0.0
    return -T * np.log(electrons / thermal)


@compiled(**FAST)
def supply_voltage(state, model):
    """Voltage of the supply in V at the present time, linear between the model's steps."""
    supply, place = model.supply, state.clock[0] * model.supply_rate
    if supply.size == 1 or place <= 0.0:
        return supply[0]
    below = min(int(place), supply.size - 2)
    return supply[below] + (place - below) * (supply[below + 1] - supply[below])


@compiled(**FAST)
def thevenin(state, model, dt):
    """Source in V and resistance in ohm that the discharge sees over an implicit step of dt.

    With dt = 0 the circuit is at rest: no voltage over the coil, no current into the capacitor.
    """
    source, resistance = state.instant[SUPPLY], model.resistance
    if dt == 0.0:
        return source, resistance
    inertia = model.inductance / dt
    source, resistance = source + inertia * state.instant[SUPPLY_CURRENT], resistance + inertia
    if model.capacitance == 0.0:
        return source, resistance
    held = model.capacitance / dt
    parallel = 1.0 / (1.0 / resistance + held)
    return (source / resistance + held * state.instant[VOLTAGE]) * parallel, parallel


@compiled(**FAST)
def follow_circuit(state, model, dt, behind):
    """Record the voltage behind the circuit, and the current that the supply gives."""
    instant = state.instant
    if dt == 0.0 or model.capacitance == 0.0:
        instant[SUPPLY_CURRENT] = instant[CURRENT]
    else:
        inertia = model.inductance / dt
        driven = instant[SUPPLY] + inertia * instant[SUPPLY_CURRENT] - behind
        instant[SUPPLY_CURRENT] = driven / (model.resistance + inertia)
    instant[VOLTAGE] = behind


@compiled(**FAST)
def ohm(state, model, dt, drop, w):
    """Electric field and drift energy; writes the heating -n u_e E to w[2]; returns I_d/(e A).

    drop: voltage of the anode's sheath in V, which adds to the voltage over the plasma.
    """
    n, g, T, E, drift = state.n_e, state.flux_q, state.T_e_eV, state.E, state.drift_eV
    nu, mobility, heating, gradient = w[0], w[1], w[2], w[7]
    factor, between, dz = model.pressure_factor, model.between, model.dz
    for i in inside(n):
        rise = n[i + ONE] * T[i + ONE] - n[i - ONE] * T[i - ONE]
        gradient[i] = factor * rise / (between[i - ONE] + between[i])
    drive = 0.0
    for i in inside(n):
        drive += dz[i] * (g[i] / mobility[i] + gradient[i]) / n[i]
    load = 0.0
    for i in inside(n):
        load += dz[i] / (n[i] * mobility[i])
    plasma = E_CHARGE * model.area
    state.instant[SUPPLY] = supply_voltage(state, model)
    source, resistance = thevenin(state, model, dt)
    current = (source + drop + drive) / (load / plasma + resistance)
    total = current / plasma
    for i in inside(n):
        E[i] = ((total - g[i]) / mobility[i] - gradient[i]) / n[i]
    for i in inside(n):
        heating[i] = (total - g[i]) * E[i]  # 2 n K nu + u_e dp_e/dz
    if model.drift_weight > 0.0:  # K = m_e (1 + (omega/nu)^2) u_e^2 / 2 = u_e^2 / (2 mu nu), in eV
        for i in inside(n):
            drift[i] = 0.5 * ((g[i] - total) / n[i]) ** 2 / (mobility[i] * nu[i])
    state.instant[CURRENT] = current
    follow_circuit(state, model, dt, source - resistance * current)
    return total


@compiled(**FAST)
def solve_from_both_ends(lower, diagonal, upper, known, T, c, d):
    """Solve a tridiagonal system for T[1:-1]; T[0] and T[-1] are given.

    Elimination runs from both ends to the middle, so that two chains of divisions overlap in time.
    """
    size = diagonal.size
    middle = (size - 1) // 2  # last row eliminated from the left
    c[0], d[0], c[size - 1], d[size - 1] = 0.0, T[0], 0.0, T[size - 1]
    j = size - 1
    for i in range(1, middle + 1):
        j -= 1
        inverse = 1.0 / (diagonal[i] - lower[i] * c[i - 1])
        c[i] = upper[i] * inverse
        d[i] = (known[i] - lower[i] * d[i - 1]) * inverse
        if j > middle:
            other = 1.0 / (diagonal[j] - upper[j] * c[j + 1])
            c[j] = lower[j] * other
            d[j] = (known[j] - upper[j] * d[j + 1]) * other
    T[middle] = (d[middle] - c[middle] * d[middle + 1]) / (1.0 - c[middle] * c[middle + 1])
    T[middle + 1] = d[middle + 1] - c[middle + 1] * T[middle]
    j = middle + 1
    for i in range(middle - 1, 0, -1):
        T[i] = d[i] - c[i] * T[i + 1]
        j += 1
        if j < size - 1:
            T[j] = d[j] - c[j] * T[j - 1]
    while j < size - 2:
        j += 1
        T[j] = d[j] - c[j] * T[j - 1]


@compiled(**FAST)
def heat_through_faces(state, model, total, drop, kappa, down, up, w):
    """Convection and conduction: the flux through face i is down[i] T[i] + up[i] T[i + 1].

    Patankar's power law, which is within 3 % of the exact flux between two fixed temperatures:
    central where conduction dominates, upwind where convection does (Patankar, Numerical Heat
    Transfer and Fluid Flow, 1980, section 5.2-6). w holds the collision frequency, the mobility,
    and in w[17] the electron-ion collision frequency.
    """
    n, g, T, mobility, between = state.n_e, state.flux_q, state.T_e_eV, w[1], model.between
    for i in range(n.size):
        kappa[i] = model.conduction_factor * mobility[i] * n[i] * T[i]
    if model.conduction_coulomb > 0.0:
        for i in range(n.size):
            kappa[i] /= 1.0 + model.conduction_coulomb * w[17, i] / w[0, i]
    for i in faces(n):
        kappa[i] = 0.5 * (kappa[i] + kappa[i + ONE]) / between[i]
    for i in faces(n):
        flux = 0.5 * (g[i] + g[i + ONE]) - total
        conducted = kappa[i] * max(1.0 - 0.25 * abs(flux) / kappa[i], 0.0) ** 5
        down[i] = 2.5 * max(flux, 0.0) + conducted
        up[i] = 2.5 * min(flux, 0.0) - conducted
    if model.sheath:  # no gradient of T; each electron takes 2 T and climbs the sheath
        flux = g[1] - total
        down[0] = 2.5 * max(flux, 0.0)
        up[0] = min(flux, 0.0) * (2.0 + model.sheath_weight * drop / T[1])


@compiled(**FAST)
def heat(state, model, dt, total, drop, w):
    """New electron temperature: implicit convection, conduction and linearised losses.

    Writes the energy fluxes through the two ends, in eV/(m^2 s) towards the cathode, to w[0, 0] and
    w[0, 1], and the losses at the new temperature to w[3] and w[5].
    """
    n, T, energy, inverse_dz = state.n_e, state.T_e_eV, state.energy, model.inverse_dz
    heating, inelastic, slope_in, wall, slope_wall = w[2], w[3], w[4], w[5], w[6]
    diagonal, known, kappa, down, up, c, d = w[7], w[8], w[9], w[10], w[11], w[12], w[13]
    lower, upper, before = w[14], w[15], w[16]
    heat_through_faces(state, model, total, drop, kappa, down, up, w)
    for i in range(n.size):
        before[i] = T[i]
    for i in range(n.size):
        diagonal[i] = dt * (slope_in[i] + slope_wall[i])
    for i in range(n.size):
        known[i] = energy[i] + diagonal[i] * T[i]
    for i in range(n.size):
        known[i] += dt * (heating[i] - inelastic[i] - wall[i])
    for i in inside(n):
        lower[i] = -dt * inverse_dz[i] * down[i - ONE]
    for i in inside(n):
        upper[i] = dt * inverse_dz[i] * up[i]
    for i in inside(n):
        diagonal[i] += 1.5 * n[i] + dt * inverse_dz[i] * (down[i] - up[i - ONE])
    solve_from_both_ends(lower, diagonal, upper, known, T, c, d)
    if model.coldest_eV > 0.0:
        for i in inside(n):
            T[i] = max(T[i], model.coldest_eV)
    for i in inside(n):
        energy[i] = 1.5 * n[i] * T[i]
    for i in inside(n):
        inelastic[i] += slope_in[i] * (T[i] - before[i])
    for i in inside(n):
        wall[i] += slope_wall[i] * (T[i] - before[i])
    w[0, 0] = down[0] * T[0] + up[0] * T[1]
    w[0, 1] = down[-2] * T[-2] + up[-2] * T[-1]


@compiled(**FAST)
def record_powers(state, model, total, w):
    """Record currents, thrust and power terms, as named in `SERIES_SUMS`."""
    g, E, dz = state.flux_q, state.E, model.dz
    inelastic, wall, instant = w[3], w[5], state.instant
    n, last = state.n_e, g.size - 2
    ions = drop = collisions_lost = to_walls = drained = thrust = 0.0
    for i in inside(n):
        ions += dz[i] * g[i] * E[i]
    for i in inside(n):
        drop += dz[i] * E[i]
    for i in inside(n):
        collisions_lost += dz[i] * inelastic[i]
    for i in inside(n):
        to_walls += dz[i] * wall[i]
    for k in range(state.n_i.shape[0]):
        z, n_k, flux, lost = k + 1.0, state.n_i[k], state.flux_i[k], state.wall_loss
        for i in inside(n):
            drained += z**1.5 * dz[i] * n_k[i] * lost[i]
        thrust += flux[last] * flux[last] / n_k[last]
    watts = E_CHARGE * model.area
    instant[THRUST] = model.ion_mass * model.area * thrust
    instant[WALL_CURRENT] = watts * drained
    instant[POWER] = instant[CURRENT] * drop
    instant[P_IONS] = watts * ions
    instant[P_INELASTIC] = watts * collisions_lost
    instant[P_WALL] = watts * to_walls
    instant[P_ANODE] = -watts * w[0, 0]
    instant[P_CATHODE] = watts * w[0, 1]


@compiled(**ENTRY)
def electron_step(state, model, dt, rows, w):
    """Collisions, discharge current, field and new temperature; returns False if the run breaks."""
    T = state.T_e_eV
    state.clock[0] += dt
    sum_charges(state)
    follow_log(state)
    fill_ghosts(state.n_n)
    # The ends of the domain, half a cell outside the last centres, are held at their temperature.
    T[0] = max(2.0 * model.anode_T_e_eV - T[1], COLDEST_EV)
    if model.sheath:  # electrons from the anode have its temperature; otherwise T[1] is taken
        T[0] = T[1] if state.instant[CURRENT] > 0.0 else model.anode_T_e_eV
    T[-1] = max(2.0 * model.cathode_T_e_eV - T[-2], COLDEST_EV)
    if not collisions(state, model, rows, w):
        return False
    drop = sheath_drop(state, model)
    total = ohm(state, model, dt, drop, w)
    if not np.isfinite(total):
        return False
    heat(state, model, dt, total, drop, w)
    record_powers(state, model, total, w)
    return True
