"""Electrons along z: sums over r, Ohm's law, the field on the grid, one solve for T_e per step."""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial.collision_kernels import between_rows
from ep2sindy.thruster.axial.state_kernels import ENTRY, ONE
from ep2sindy.thruster.closures import (
    COULOMB,
    COULOMB_LOG,
    EVENTS,
    INELASTIC,
    IONIZATION,
    MOMENTUM,
    WALL_COLLISION,
    WALL_POWER,
)
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON

SIDE_ENERGY = 2.5  # enthalpy in T_e that an electron carries along with an ion leaving sideways
SQRT_HALF_BITS = 0x3FE6A09E667F3BCD  # bits of the double 1/sqrt(2)


@compiled(inline="always")
def logarithm(x):
    """ln(x) of a positive normal double to 1e-15 of 1 + |ln x|, without a call, so it vectorises.

    x = m 2^e with m in sqrt(1/2) to sqrt(2), and ln(m) = 2 artanh((m - 1)/(m + 1)).
    """
    bits = np.float64(x).view(np.int64)
    e = (bits - SQRT_HALF_BITS) >> 52
    m = np.int64(bits - (e << 52)).view(np.float64)
    f = (m - 1.0) / (m + 1.0)
    s = f * f
    series = 1 / 9 + s * (1 / 11 + s * (1 / 13 + s * (1 / 15 + s / 17)))
    series = 1.0 + s * (1 / 3 + s * (1 / 5 + s * (1 / 7 + s * series)))
    return e * 0.6931471805599453 + 2.0 * f * series


@compiled(**ENTRY)
def sum_columns(state, model, columns):
    """Sums over r, and the logarithm of the density."""
    gas = state.gas
    carried = 0.0  # ions per s that left sideways; their electrons come from outside
    for i in range(columns.n.size):
        n_a = flux = n_neutrals = n_n = n_log = 0.0
        for j in range(model.lower[i], model.upper[i]):
            n = gas.n[i, j]
            weight = n * model.area[j]
            state.log_n[i, j] = logarithm(n)
            n_a += weight
            flux += gas.flux_z[i, j] * model.area[j]
            n_neutrals += weight * gas.neutrals[i, j]
            n_n += weight * n
            n_log += weight * state.log_n[i, j]
        columns.n[i], columns.n_neutrals[i], columns.n_n[i] = n_a, n_neutrals, n_n
        columns.log_ref[i] = n_log / n_a
        columns.flux[i] = flux + carried + 0.5 * state.side[i] * model.dz
        carried += state.side[i] * model.dz
    i = model.exit_column
    for j in range(model.lower[i], model.upper[i]):
        if j < model.lower[i - 1] or j >= model.upper[i - 1]:
            state.log_n[i - 1, j] = state.log_n[i, j]


@compiled(**ENTRY)
def collisions(state, model, columns):
    """Collision frequency, conductance and losses; returns False if a table ends."""
    table, per_eV, top = model.table, 1.0 / model.table_step_eV, model.table.shape[0] - 1.0
    for i in range(columns.n.size):
        n = columns.n[i]
        x = state.T_e_eV[i] * per_eV
        y = x + model.drift_weight * state.drift_eV[i] * 2.0 / 3.0 * per_eV
        if not (x >= 0.0 and y < top and n > 0.0):
            return False
        row, hot = np.uint64(x), np.uint64(y)
        fraction, hot_fraction = x - row, y - hot
        neutrals, ions = columns.n_neutrals[i] / n, columns.n_n[i] / n
        walls = state.wall[i] / n  # 1/s
        log_lambda = between_rows(table, row, fraction, COULOMB_LOG) - 0.5 * np.log(ions)
        nu = (
            neutrals * between_rows(table, row, fraction, MOMENTUM)
            + neutrals * between_rows(table, hot, hot_fraction, EVENTS)
            + ions * log_lambda * between_rows(table, row, fraction, COULOMB)
            + walls * between_rows(table, hot, hot_fraction, WALL_COLLISION)
            + model.anomalous[i]
        )
        columns.nu[i] = nu
        columns.conductance[i] = E_CHARGE / M_ELECTRON * nu / (nu**2 + model.omega_ce[i] ** 2) * n
        columns.loss[i] = columns.n_neutrals[i] * between_rows(table, hot, hot_fraction, INELASTIC)
        columns.loss[i] += state.wall[i] * between_rows(table, hot, hot_fraction, WALL_POWER)
        columns.loss[i] += state.side[i] * SIDE_ENERGY * state.T_e_eV[i]
        inelastic = table[hot + ONE, INELASTIC] - table[hot, INELASTIC]
        wall = table[hot + ONE, WALL_POWER] - table[hot, WALL_POWER]
        slope = columns.n_neutrals[i] * inelastic + state.wall[i] * wall
        columns.loss_slope[i] = max(slope * per_eV, 0.0) + state.side[i] * SIDE_ENERGY
        state.ionization[i] = between_rows(table, hot, hot_fraction, IONIZATION)
    return True


@compiled(inline="always")
def ghost(T, boundary):
    """Temperature half a cell outside a boundary with fixed temperature."""
    return max(2.0 * boundary - T, 0.3 * boundary)


@compiled(**ENTRY)
def ohm(state, model, columns):
    """Discharge current, field along z, drift energy and heating; returns I_d/e.

    n u_e = mu n (dphi*/dz - dT/dz - T d(ln n_ref)/dz), summed over r. phi* is the potential where
    n = n_ref; electrons gain heat as they climb it.
    """
    T, log_ref, last = state.T_e_eV, columns.log_ref, columns.n.size - 1
    drive, load, half = model.voltage, model.resistance, 0.5 / model.dz
    for i in range(last + 1):
        low = T[i - 1] if i > 0 else ghost(T[0], model.boundary_T_e_eV)
        high = T[i + 1] if i < last else ghost(T[last], model.boundary_T_e_eV)
        steep = log_ref[min(i + 1, last)] - log_ref[max(i - 1, 0)]
        columns.heating[i] = half * (high - low + T[i] * steep)  # pressure gradient over density
        drive += model.dz * (columns.flux[i] / columns.conductance[i] + columns.heating[i])
        load += model.dz / (E_CHARGE * columns.conductance[i])
    state.current[0] = drive / load
    total = state.current[0] / E_CHARGE
    for i in range(last + 1):
        flux = columns.flux[i] - total
        climb = flux / columns.conductance[i] + columns.heating[i]  # dphi*/dz
        u = flux / columns.n[i]
        # K = m_e (1 + (omega/nu)^2) u_e^2 / 2 = u_e^2 / (2 mu nu), in eV
        mobility = columns.conductance[i] / columns.n[i]
        state.drift_eV[i] = 0.5 * u * u / (mobility * columns.nu[i])
        state.reference_field[i] = -climb
        columns.heating[i] = flux * climb
        columns.electron_flux[i] = flux
    return total


@compiled(**ENTRY)
def spread_field(state, model, columns):
    """E(z, r) = -dphi*/dz - d/dz [T ln(n/n_ref)].

    Field lines along r are equipotentials except for the electrons' pressure.
    """
    T, log_n, last = state.T_e_eV, state.log_n, columns.n.size - 1
    half = 0.5 / model.dz
    for i in range(last + 1):
        before, after = max(i - 1, 0), min(i + 1, last)
        low = T[i - 1] if i > 0 else ghost(T[0], model.boundary_T_e_eV)
        high = T[i + 1] if i < last else ghost(T[last], model.boundary_T_e_eV)
        low, high = half * low, half * high
        here = state.reference_field[i] + high * columns.log_ref[after]
        here -= low * columns.log_ref[before]
        for j in range(model.lower[i], model.upper[i]):
            state.E[i, j] = here - high * log_n[after, j] + low * log_n[before, j]


@compiled(inline="always")
def exponential_weights(conduction, convection):
    """Weights of the temperatures on both sides of a face: exact between two fixed values.

    The flux is conduction * (B(-p) T_before - B(p) T_behind), p = convection/conduction, B(p) =
    p/(exp(p) - 1). The scheme is central if conduction dominates, and upwind if convection does.
    Source: Scharfetter & Gummel, IEEE Trans. Electron Devices 16 (1969) 64.
    """
    p = convection / conduction
    behind = p / np.expm1(p) if abs(p) > 1e-6 else 1.0 - 0.5 * p
    return conduction * (behind + p), conduction * behind


@compiled(**ENTRY)
def heat(state, model, dt, columns):
    """New electron temperature: implicit convection, conduction and losses, explicit heating."""
    T, n, last, edge = state.T_e_eV, columns.n, columns.n.size - 1, model.boundary_T_e_eV
    s, factor = dt / model.dz, model.conduction_factor / model.dz
    flux, conductance = columns.electron_flux, columns.conductance
    before, behind = exponential_weights(2.0 * factor * conductance[0] * edge, 2.5 * flux[0])
    c, d = 0.0, 0.0
    for i in range(last + 1):
        diagonal = 1.5 * n[i] + dt * columns.loss_slope[i] + s * behind
        lower = -s * before  # coefficient of the temperature before
        kept = columns.loss_slope[i] * T[i] + columns.heating[i] - columns.loss[i]
        right = state.energy[i] + dt * kept
        if i == 0:
            right, lower = right - lower * edge, 0.0
        if i < last:
            kappa = 0.5 * factor * (conductance[i] * T[i] + conductance[i + 1] * T[i + 1])
            before, behind = exponential_weights(kappa, 1.25 * (flux[i] + flux[i + 1]))
        else:
            before, behind = exponential_weights(
                2.0 * factor * conductance[i] * edge, 2.5 * flux[i]
            )
            right += s * behind * edge
        inverse = 1.0 / (diagonal + s * before - lower * c)
        c = -s * behind * inverse
        d = (right - lower * d) * inverse
        columns.upper[i], columns.right[i] = c, d
    T[last] = columns.right[last]
    for i in range(last - 1, -1, -1):
        T[i] = columns.right[i] - columns.upper[i] * T[i + 1]
    for i in range(last + 1):
        state.energy[i] = 1.5 * n[i] * T[i]


@compiled(**ENTRY)
def electron_step(state, model, dt, columns):
    """Sums, collisions, current, field and new temperature; returns False if the run breaks."""
    sum_columns(state, model, columns)
    if not collisions(state, model, columns):
        return False
    total = ohm(state, model, columns)
    spread_field(state, model, columns)
    heat(state, model, dt, columns)
    return np.isfinite(total)
