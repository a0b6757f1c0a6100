"""Compiled electrons: Ohm's law, and one implicit solve for their temperature per step."""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial.collision_kernels import collisions
from ep2sindy.thruster.axial.state_kernels import (
    CURRENT,
    ENTRY,
    FAST,
    LOOP,
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


@compiled(**LOOP)
def add_charge(n_e, flux_q, n, g, z):
    for i in range(n_e.size):
        n_e[i] += z * n[i]
        flux_q[i] += z * g[i]


@compiled(**FAST)
def sum_charges(state):
    """Electron density and charge flux of all ions, including the ghost cells."""
    state.n_e[:] = 0.0
    state.flux_q[:] = 0.0
    for k in range(state.n_i.shape[0]):
        fill_ghosts(state.n_i[k])
        fill_ghosts(state.flux_i[k])
        add_charge(state.n_e, state.flux_q, state.n_i[k], state.flux_i[k], k + 1.0)


@compiled(**LOOP)
def follow_log(n_e, log_n, before):
    """Update ln n_e by its change in one step: 2 (r - 1)/(r + 1) is ln r to third order."""
    for i in range(n_e.size):
        log_n[i] += 2.0 * (n_e[i] - before[i]) / (n_e[i] + before[i])
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


@compiled(**LOOP)
def drive_and_load(n, g, T, per_mobility, gradient, model):
    """Integrals over the plasma of Ohm's law; writes the pressure gradient in eV/m^4.

    The first, in V, drives the current beside the supply; the second is the resistance, times e and
    the channel's area.
    """
    dz, per_span, spread, drive, load = model.dz, model.per_span, model.spread, 0.0, 0.0
    for i in inside(n):
        rise = n[i + ONE] * T[i + ONE] - n[i - ONE] * T[i - ONE]
        rise *= model.pressure_factor * per_span[i]
        per_n = dz[i] / n[i]
        gradient[i] = rise
        drive += per_n * (g[i] * per_mobility[i] + rise)
        load += per_n * per_mobility[i] / spread[i]
    return drive, load


@compiled(**LOOP)
def field_of_current(total, n, g, per_nu, per_mobility, gradient, spread, weight, E, heating, K):
    """Field in V/m, heating -n u_e E in eV/(m^3 s) and the drift's energy K in eV."""
    for i in inside(n):
        backwards = total / spread[i] - g[i]  # -n u_e
        per_n = 1.0 / n[i]
        field = (backwards * per_mobility[i] - gradient[i]) * per_n
        E[i] = field
        heating[i] = backwards * field  # 2 n K nu + u_e dp_e/dz
        # K = m_e (1 + (omega/nu)^2) u_e^2 / 2 = u_e^2 / (2 mu nu), in eV
        K[i] = weight * (backwards * per_n) ** 2 * per_mobility[i] * per_nu[i]


@compiled(**FAST)
def ohm(state, model, dt, drop, w):
    """Current, field, drift energy and heating; returns I_d over e and the channel's area.

    drop: voltage of the anode's sheath in V, which adds to the voltage over the plasma.
    """
    n, g, plasma = state.n_e, state.flux_q, E_CHARGE * model.area
    drive, load = drive_and_load(n, g, state.T_e_eV, w.per_mobility, w.gradient, model)
    state.instant[SUPPLY] = supply_voltage(state, model)
    source, resistance = thevenin(state, model, dt)
    current = (source + drop + drive) / (load / plasma + resistance)
    total = current / plasma
    counted = 0.5 if model.drift_weight > 0.0 else 0.0
    field_of_current(
        total, n, g, w.per_nu, w.per_mobility, w.gradient, model.spread, counted,
        state.E, w.heating, state.drift_eV,
    )  # fmt: skip
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


@compiled(**LOOP)
def conductivities(n, T, mobility, coulomb, per_nu, model, kappa):
    """Heat conductivity of the electrons in every cell, in 1/(m s)."""
    factor, shared = model.conduction_factor, model.conduction_coulomb
    for i in range(n.size):
        kappa[i] = factor * mobility[i] * n[i] * T[i] / (1.0 + shared * coulomb[i] * per_nu[i])


@compiled(**LOOP)
def heat_through_faces(g, total, kappa, model, down, up):
    """Convection and conduction: the flux through face i is down[i] T[i] + up[i] T[i + 1].

    Patankar's power law, which is within 3 % of the exact flux between two fixed temperatures:
    central where conduction dominates, upwind where convection does (Patankar, Numerical Heat
    Transfer and Fluid Flow, 1980, section 5.2-6). Without slopes, upwind everywhere.
    """
    per_between, spread, steep = model.per_between, model.spread_at, 0.1 * model.slope_weight
    for i in faces(g):
        flux = 2.5 * (0.5 * (g[i] + g[i + ONE]) - total / spread[i])
        conducting = 0.5 * (kappa[i] + kappa[i + ONE]) * per_between[i]
        conducting *= max(1.0 - steep * abs(flux) / conducting, 0.0) ** 5
        down[i] = max(flux, 0.0) + conducting
        up[i] = min(flux, 0.0) - conducting


@compiled(**LOOP)
def transport_of_heat(dt, n, down, up, per_before, per_behind, lower, diagonal, upper):
    """Equations of the next T_e: what is stored, and what passes through the faces."""
    for i in inside(n):
        before, behind = dt * per_before[i], dt * per_behind[i]
        lower[i] = -before * down[i - ONE]
        upper[i] = behind * up[i]
        diagonal[i] = 1.5 * n[i] + (behind * down[i] - before * up[i - ONE])


@compiled(**LOOP)
def sources_of_heat(
    dt, energy, T, heating, inelastic, inelastic_slope, wall, wall_slope, diagonal, known, before
):
    """Add heating and losses, implicit by the losses' slopes, and keep the present T_e."""
    for i in inside(T):
        slope = dt * (inelastic_slope[i] + wall_slope[i])
        before[i] = T[i]
        known[i] = energy[i] + slope * T[i] + dt * (heating[i] - inelastic[i] - wall[i])
        diagonal[i] += slope


@compiled(**LOOP)
def settle(n, T, before, coldest, inelastic_slope, wall_slope, energy, inelastic, wall):
    """Energy at the new temperature, and the losses that it paid."""
    for i in inside(n):
        T[i] = max(T[i], coldest)
        rise = T[i] - before[i]
        energy[i] = 1.5 * n[i] * T[i]
        inelastic[i] += inelastic_slope[i] * rise
        wall[i] += wall_slope[i] * rise


@compiled(**FAST)
def heat(state, model, dt, total, drop, w):
    """New electron temperature: implicit convection, conduction and linearised losses.

    The losses in w become those at the new temperature.
    """
    n, T, down, up = state.n_e, state.T_e_eV, w.down, w.up
    conductivities(n, T, w.mobility, w.coulomb, w.per_nu, model, w.kappa)
    heat_through_faces(state.flux_q, total, w.kappa, model, down, up)
    if model.sheath:  # no gradient of T; each electron takes 2 T and climbs the sheath
        flux = state.flux_q[1] - total
        down[0] = 2.5 * max(flux, 0.0)
        up[0] = min(flux, 0.0) * (2.0 + model.sheath_weight * drop / T[1])
    transport_of_heat(
        dt, n, down, up, model.per_before, model.per_behind, w.lower, w.diagonal, w.upper
    )
    sources_of_heat(
        dt, state.energy, T, w.heating, w.inelastic, w.inelastic_slope, w.wall, w.wall_slope,
        w.diagonal, w.known, w.before,
    )  # fmt: skip
    solve_from_both_ends(w.lower, w.diagonal, w.upper, w.known, T, w.c, w.d)
    settle(
        n, T, w.before, model.coldest_eV, w.inelastic_slope, w.wall_slope, state.energy,
        w.inelastic, w.wall,
    )  # fmt: skip


@compiled(**LOOP)
def integrals(g, E, inelastic, wall, dz, spread):
    """Of the ions' work, the field and the two losses over the plasma, per channel area."""
    work = drop = lost = to_wall = 0.0
    for i in inside(g):
        volume = dz[i] * spread[i]
        work += volume * g[i] * E[i]
        drop += dz[i] * E[i]
        lost += volume * inelastic[i]
        to_wall += volume * wall[i]
    return work, drop, lost, to_wall


@compiled(**LOOP)
def drained(n, loss, dz, spread):
    """Ions lost to the walls per channel area and time."""
    total = 0.0
    for i in inside(n):
        total += dz[i] * spread[i] * n[i] * loss[i]
    return total


@compiled(**FAST)
def record_powers(state, model, total, w):
    """Record currents, thrust and power terms, as named in `SERIES_SUMS`."""
    instant, dz, spread, T = state.instant, model.dz, model.spread, state.T_e_eV
    work, drop, lost, to_wall = integrals(state.flux_q, state.E, w.inelastic, w.wall, dz, spread)
    on_wall = thrust = 0.0
    for k in range(state.n_i.shape[0]):
        z, n, flux = k + 1.0, state.n_i[k], state.flux_i[k]
        on_wall += z**1.5 * drained(n, state.wall_loss, dz, spread)
        thrust += flux[-2] * flux[-2] / n[-2]
    watts, end = E_CHARGE * model.area, model.spread_at[-1]
    instant[THRUST] = model.ion_mass * model.area * end * thrust
    instant[WALL_CURRENT] = watts * on_wall
    instant[POWER] = instant[CURRENT] * drop
    instant[P_IONS] = watts * work
    instant[P_INELASTIC] = watts * lost
    instant[P_WALL] = watts * to_wall
    instant[P_ANODE] = -watts * (w.down[0] * T[0] + w.up[0] * T[1])
    instant[P_CATHODE] = watts * end * (w.down[-2] * T[-2] + w.up[-2] * T[-1])


@compiled(**FAST)
def follow_electrons(state, model, dt, w):
    """Collisions, discharge current, field and new temperature; returns False if the run breaks."""
    T = state.T_e_eV
    state.clock[0] += dt
    sum_charges(state)
    follow_log(state.n_e, state.log_n[0], state.log_n[1])
    fill_ghosts(state.n_n)
    # The ends of the domain, half a cell outside the last centres, are held at their temperature.
    T[0] = max(2.0 * model.anode_T_e_eV - T[1], COLDEST_EV)
    if model.sheath:  # electrons from the anode have its temperature; otherwise T[1] is taken
        T[0] = T[1] if state.instant[CURRENT] > 0.0 else model.anode_T_e_eV
    T[-1] = max(2.0 * model.cathode_T_e_eV - T[-2], COLDEST_EV)
    if not collisions(state, model, w):
        return False
    drop = sheath_drop(state, model)
    total = ohm(state, model, dt, drop, w)
    if not np.isfinite(total):
        return False
    heat(state, model, dt, total, drop, w)
    record_powers(state, model, total, w)
    return True


@compiled(**ENTRY)
def electron_step(state, model, dt, w):
    """`follow_electrons` by itself."""
    return follow_electrons(state, model, dt, w)
