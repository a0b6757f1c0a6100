"""Compiled electrons: Ohm's law, and one implicit solve for their temperature per step."""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial import state_kernels as recorded
from ep2sindy.thruster.axial.collision_kernels import collisions
from ep2sindy.thruster.axial.state_kernels import ENTRY, FAST, LOOP, ONE, faces, inside
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON

HUGE = 1e200  # of determinants, far from overflow
COLDEST_EV = 1.0  # least T_e of the ghost cells: a steep end could turn them negative


@compiled(**FAST)
def fill_ghosts(values):
    values[0] = values[1]
    values[-1] = values[-2]


@compiled(**LOOP)
def add_charge(n_e, flux_q, n, g, z):
    """Add the ions of charge z; those of charge 1 come first, and replace what was there."""
    keep = 1.0 if z > 1.0 else 0.0
    for i in range(n_e.size):
        n_e[i] = keep * n_e[i] + z * n[i]
        flux_q[i] = keep * flux_q[i] + z * g[i]


@compiled(**FAST)
def sum_charges(state):
    """Electron density and charge flux of all ions, including the ghost cells."""
    for k in range(state.n_i.shape[0]):
        fill_ghosts(state.n_i[k])
        fill_ghosts(state.flux_i[k])
        add_charge(state.n_e, state.flux_q, state.n_i[k], state.flux_i[k], k + 1.0)


@compiled(**LOOP)
def follow_log(n_e, log_n, before, per_n):
    """Update ln n_e by its change in one step: 2 (r - 1)/(r + 1) is ln r to third order.

    The one division is also that of per_n = 1/n_e.
    """
    for i in range(n_e.size):
        n, both = n_e[i], n_e[i] + before[i]
        inverse = 1.0 / (n * both)
        log_n[i] += 2.0 * (n - before[i]) * (n * inverse)
        per_n[i] = both * inverse
        before[i] = n


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
    electrons = state.instant[recorded.CURRENT] / (E_CHARGE * model.area) - state.flux_q[1]
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
    source, resistance = state.instant[recorded.SUPPLY], model.resistance
    if dt == 0.0:
        return source, resistance
    inertia = model.inductance / dt
    source = source + inertia * state.instant[recorded.SUPPLY_CURRENT]
    resistance = resistance + inertia
    if model.capacitance == 0.0:
        return source, resistance
    held = model.capacitance / dt
    parallel = 1.0 / (1.0 / resistance + held)
    return (source / resistance + held * state.instant[recorded.VOLTAGE]) * parallel, parallel


@compiled(**FAST)
def follow_circuit(state, model, dt, behind):
    """Record the voltage behind the circuit, and the current that the supply gives."""
    instant = state.instant
    if dt == 0.0 or model.capacitance == 0.0:
        instant[recorded.SUPPLY_CURRENT] = instant[recorded.CURRENT]
    else:
        inertia = model.inductance / dt
        driven = instant[recorded.SUPPLY] + inertia * instant[recorded.SUPPLY_CURRENT] - behind
        instant[recorded.SUPPLY_CURRENT] = driven / (model.resistance + inertia)
    instant[recorded.VOLTAGE] = behind


@compiled(**LOOP)
def drive_and_load(n, per_n, g, T, per_mobility, gradient, model):
    """Integrals over the plasma of Ohm's law; writes the pressure gradient in eV/m^4.

    The first, in V, drives the current next to the supply; the second is the resistance, times e
    and the channel's area.
    """
    dz, per_span, per_spread = model.dz, model.per_span, model.per_spread
    drive = load = 0.0
    for i in inside(n):
        rise = n[i + ONE] * T[i + ONE] - n[i - ONE] * T[i - ONE]
        rise *= model.pressure_factor * per_span[i]
        gradient[i] = rise
        length = dz[i] * per_n[i]
        drive += length * (g[i] * per_mobility[i] + rise)
        load += length * per_mobility[i] * per_spread[i]
    return drive, load


@compiled(**LOOP)
def field_of_current(total, per_n, g, per_nu, per_mobility, gradient, weight, E, heating, K, model):
    """Field in V/m, heating -n u_e E in eV/(m^3 s) and the drift's energy K in eV.

    Returns the field's integral over the plasma, and that of its work on the ions per channel area.
    """
    dz, spread, per_spread, drop, work = model.dz, model.spread, model.per_spread, 0.0, 0.0
    for i in inside(g):
        backwards = total * per_spread[i] - g[i]  # -n u_e
        field = (backwards * per_mobility[i] - gradient[i]) * per_n[i]
        E[i] = field
        heating[i] = backwards * field  # 2 n K nu + u_e dp_e/dz
        # K = m_e (1 + (omega/nu)^2) u_e^2 / 2 = u_e^2 / (2 mu nu), in eV
        K[i] = weight * (backwards * per_n[i]) ** 2 * per_mobility[i] * per_nu[i]
        drop += dz[i] * field
        work += dz[i] * spread[i] * g[i] * field
    return drop, work


@compiled(**FAST)
def ohm(state, model, dt, drop, w):
    """Current, field, drift energy and heating; returns I_d over e and the channel's area.

    drop: voltage of the anode's sheath in V, which adds to the voltage over the plasma. Records the
    power of the current in the field, and that of the field's work on the ions.
    """
    g, per_n, plasma = state.flux_q, w.per_n, E_CHARGE * model.area
    drive, load = drive_and_load(
        state.n_e, per_n, g, state.T_e_eV, w.per_mobility, w.gradient, model
    )
    state.instant[recorded.SUPPLY] = supply_voltage(state, model)
    source, resistance = thevenin(state, model, dt)
    current = (source + drop + drive) / (load / plasma + resistance)
    total = current / plasma
    counted = 0.5 if model.drift_weight > 0.0 else 0.0
    along, work = field_of_current(
        total, per_n, g, w.per_nu, w.per_mobility, w.gradient, counted, state.E, w.heating,
        state.drift_eV, model,
    )  # fmt: skip
    state.instant[recorded.CURRENT] = current
    state.instant[recorded.POWER] = current * along
    state.instant[recorded.P_IONS] = plasma * work
    follow_circuit(state, model, dt, source - resistance * current)
    return total


@compiled(inline="always")
def pivot(diagonal, product, longer, shorter):
    """Determinant of the rows up to the next, and over it that of one row less, `longer`.

    By ratios of determinants no row waits for the division of the one before. product: of the two
    coefficients that couple both.
    """
    determinant = diagonal * longer - product * shorter
    return determinant, longer / determinant


@compiled(**LOOP)
def solve_from_both_ends(lower, diagonal, upper, known, T, c, d):
    """Solve a tridiagonal system for T[1:-1]; T[0] and T[-1] are given.

    Elimination runs from both ends to the middle, so that two chains overlap in time. What the next
    row needs stays in variables: to read back what was just written takes as long as a product.
    """
    size = np.uint64(diagonal.size)
    middle = (size - ONE) // np.uint64(2)  # last row eliminated from the left
    left, shorter_left, d_left = 1.0, 0.0, T[0]
    right, shorter_right, d_right = 1.0, 0.0, T[-1]
    for i in range(ONE, middle + ONE):
        product = lower[i] * upper[i - ONE]
        longer, inverse = pivot(diagonal[i], product, left, shorter_left)
        shorter_left, left = left, longer
        d_left = known[i] * inverse - lower[i] * inverse * d_left
        c[i], d[i] = upper[i] * inverse, d_left
        j = size - ONE - i
        if j > middle:
            product = upper[j] * lower[j + ONE]
            longer, inverse = pivot(diagonal[j], product, right, shorter_right)
            shorter_right, right = right, longer
            d_right = known[j] * inverse - upper[j] * inverse * d_right
            c[j], d[j] = lower[j] * inverse, d_right
        if left > HUGE or right > HUGE:  # only ratios count
            shorter_left, left = shorter_left / left, 1.0
            shorter_right, right = shorter_right / right, 1.0
    after = middle + ONE
    low = (d[middle] - c[middle] * d[after]) / (1.0 - c[middle] * c[after])
    high = d[after] - c[after] * low
    T[middle], T[after] = low, high
    for k in range(ONE, middle):
        i, j = middle - k, after + k
        low = d[i] - c[i] * low
        T[i] = low
        if j < size - ONE:
            high = d[j] - c[j] * high
            T[j] = high


@compiled(**LOOP)
def heat_through_faces(g, total, kappa, model, down, up):
    """Convection and conduction: the flux through face i is down[i] T[i] + up[i] T[i + 1].

    Patankar's power law, which is within 3 % of the exact flux between two fixed temperatures:
    central where conduction dominates, upwind where convection does (Patankar, Numerical Heat
    Transfer and Fluid Flow, 1980, section 5.2-6). Without slopes, upwind everywhere.
    """
    per_between, per_spread = model.per_between, model.per_spread_at
    steep = 0.1 * model.slope_weight
    for i in faces(g):
        flux = 2.5 * (0.5 * (g[i] + g[i + ONE]) - total * per_spread[i])
        conducting = 0.5 * (kappa[i] + kappa[i + ONE]) * per_between[i]
        conducting *= max(1.0 - steep * abs(flux) / conducting, 0.0) ** 5
        down[i] = max(flux, 0.0) + conducting
        up[i] = min(flux, 0.0) - conducting


@compiled(**LOOP)
def equations_of_heat(
    dt, n, T, energy, down, up, per_before, per_behind, heating, inelastic, inelastic_slope, wall,
    wall_slope, lower, diagonal, upper, known, T_before,
):  # fmt: skip
    """Equations of the next T_e: what is stored, what passes through the faces, and sources.

    Losses are implicit by their slopes. The present T_e is kept.
    """
    for i in inside(n):
        before, behind = dt * per_before[i], dt * per_behind[i]
        slope = dt * (inelastic_slope[i] + wall_slope[i])
        lower[i] = -before * down[i - ONE]
        upper[i] = behind * up[i]
        diagonal[i] = 1.5 * n[i] + (behind * down[i] - before * up[i - ONE]) + slope
        known[i] = energy[i] + slope * T[i] + dt * (heating[i] - inelastic[i] - wall[i])
        T_before[i] = T[i]


@compiled(**LOOP)
def settle(n, T, before, coldest, inelastic, inelastic_slope, wall, wall_slope, energy, model):
    """Energy at the new temperature; returns both losses that it paid, per channel area."""
    dz, spread, lost, to_wall = model.dz, model.spread, 0.0, 0.0
    for i in inside(n):
        new, volume = max(T[i], coldest), dz[i] * spread[i]
        rise = new - before[i]
        T[i], energy[i] = new, 1.5 * n[i] * new
        lost += volume * (inelastic[i] + inelastic_slope[i] * rise)
        to_wall += volume * (wall[i] + wall_slope[i] * rise)
    return lost, to_wall


@compiled(**FAST)
def heat(state, model, dt, total, drop, w):
    """New electron temperature: implicit convection, conduction and linearised losses.

    Returns inelastic losses and losses to the walls per channel area.
    """
    n, T, down, up = state.n_e, state.T_e_eV, w.down, w.up
    heat_through_faces(state.flux_q, total, w.kappa, model, down, up)
    if model.sheath:  # no gradient of T; each electron takes 2 T and climbs the sheath
        flux = state.flux_q[1] - total
        down[0] = 2.5 * max(flux, 0.0)
        up[0] = min(flux, 0.0) * (2.0 + model.sheath_weight * drop / T[1])
    equations_of_heat(
        dt, n, T, state.energy, down, up, model.per_before, model.per_behind, w.heating,
        w.inelastic, w.inelastic_slope, w.wall, w.wall_slope, w.lower, w.diagonal, w.upper,
        w.known, w.before,
    )  # fmt: skip
    solve_from_both_ends(w.lower, w.diagonal, w.upper, w.known, T, w.c, w.d)
    return settle(
        n, T, w.before, model.coldest_eV, w.inelastic, w.inelastic_slope, w.wall, w.wall_slope,
        state.energy, model,
    )  # fmt: skip


@compiled(**LOOP)
def drained(n, loss, dz, spread):
    """Ions lost to the walls per channel area and time."""
    total = 0.0
    for i in inside(n):
        total += dz[i] * spread[i] * n[i] * loss[i]
    return total


@compiled(**FAST)
def record_powers(state, model, lost, to_wall, w):
    """Record currents, thrust and power terms, as named in `SERIES_SUMS`; those of `ohm` are."""
    instant, dz, spread, T = state.instant, model.dz, model.spread, state.T_e_eV
    on_wall = thrust = 0.0
    for k in range(state.n_i.shape[0]):
        z, n, flux = k + 1.0, state.n_i[k], state.flux_i[k]
        on_wall += z**1.5 * drained(n, state.wall_loss, dz, spread)
        thrust += flux[-2] * flux[-2] / n[-2]
    watts, end = E_CHARGE * model.area, model.spread_at[-1]
    instant[recorded.THRUST] = model.ion_mass * model.area * end * thrust
    instant[recorded.WALL_CURRENT] = watts * on_wall
    instant[recorded.P_INELASTIC] = watts * lost
    instant[recorded.P_WALL] = watts * to_wall
    instant[recorded.P_ANODE] = -watts * (w.down[0] * T[0] + w.up[0] * T[1])
    instant[recorded.P_CATHODE] = watts * end * (w.down[-2] * T[-2] + w.up[-2] * T[-1])


@compiled(**FAST)
def follow_electrons(state, model, dt, w):
    """Collisions, discharge current, field and new temperature; returns False if the run breaks."""
    T = state.T_e_eV
    state.clock[0] += dt
    sum_charges(state)
    follow_log(state.n_e, state.log_n[0], state.log_n[1], w.per_n)
    fill_ghosts(state.n_n)
    # The ends of the domain, half a cell outside the last centres, are held at their temperature.
    T[0] = max(2.0 * model.anode_T_e_eV - T[1], COLDEST_EV)
    if model.sheath:  # electrons from the anode have its temperature; otherwise T[1] is taken
        T[0] = T[1] if state.instant[recorded.CURRENT] > 0.0 else model.anode_T_e_eV
    T[-1] = max(2.0 * model.cathode_T_e_eV - T[-2], COLDEST_EV)
    if not collisions(state, model, w):
        return False
    drop = sheath_drop(state, model)
    total = ohm(state, model, dt, drop, w)
    if not np.isfinite(total):
        return False
    lost, to_wall = heat(state, model, dt, total, drop, w)
    record_powers(state, model, lost, to_wall, w)
    return True


@compiled(**ENTRY)
def electron_step(state, model, dt, w):
    """`follow_electrons` by itself."""
    return follow_electrons(state, model, dt, w)
