"""Compiled collisions of electrons, with neutrals, ions and walls, from the table of closures."""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial.state_kernels import FAST, LOOP, ONE
from ep2sindy.thruster.closures import (
    COULOMB,
    COULOMB_LOG,
    DRIFT_EVENTS,
    EVENTS,
    FURTHER,
    INELASTIC,
    ION_LOSS,
    IONIZATION,
    MOMENTUM,
    WALL_COLLISION,
    WALL_POWER,
)
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON


@compiled(**LOOP)
def within_table(T, per_eV, top):
    """Whether every temperature lies in the closure table; not-a-number does not."""
    n_off = 0
    for i in range(T.size):
        n_off += 0 if 0.0 <= T[i] * per_eV <= top else 1
    return n_off == 0


@compiled(inline="always")
def between_rows(table, row, fraction, column):
    """Linear interpolation between two rows of the closure table."""
    below = table[row, column]
    return below + fraction * (table[row + ONE, column] - below)


@compiled(inline="always")
def with_slope(table, row, fraction, column, per_eV):
    """A loss rate in eV m^3/s or eV/s and its slope in T_e; the slope is 0 where the loss falls."""
    below = table[row, column]
    rise = table[row + ONE, column] - below
    return below + fraction * rise, max(rise, 0.0) * per_eV


@compiled(**LOOP)
def by_temperature(T, n, nn, log_n, model, nu, coulomb, ion_loss, wall, wall_slope):
    """Collisions that T_e alone decides; their frequency goes to nu, in 1/s.

    Also electron-ion collisions, in 1/s; the ions' loss to the walls, in 1/s; the electrons' loss
    of energy there, in eV/(m^3 s), with its slope in T_e.
    """
    table, per_eV = model.table, 1.0 / model.table_step_eV
    for i in range(T.size):
        place = T[i] * per_eV
        row = np.uint64(place)
        fraction = place - row
        log_lambda = between_rows(table, row, fraction, COULOMB_LOG) - 0.5 * log_n[i]
        coulomb[i] = n[i] * between_rows(table, row, fraction, COULOMB) * log_lambda
        with_neutrals = nn[i] * between_rows(table, row, fraction, MOMENTUM)
        on_wall = model.wall_collision_weight[i] * between_rows(
            table, row, fraction, WALL_COLLISION
        )
        nu[i] = with_neutrals + coulomb[i] + model.anomalous[i] + on_wall
        ion_loss[i] = model.wall_ion_weight[i] * between_rows(table, row, fraction, ION_LOSS)
        loss, slope = with_slope(table, row, fraction, WALL_POWER, per_eV)
        wall[i] = n[i] * model.wall_power_weight[i] * loss
        wall_slope[i] = n[i] * model.wall_power_weight[i] * slope


@compiled(**LOOP)
def by_energy(T, drift, n, nn, model, nu, coulomb, per_nu, per_mobility, kappa, rate, loss, slope):
    """Inelastic collisions, at T_e + 2 K/3; with them the mobility's inverse and conductivity.

    The mobility is unit * nu/(nu^2 + omega^2), the heat conductivity factor * mobility * n * T_e/
    (1 + shared * coulomb/nu), in 1/(m s). One division serves both: it takes as long as sixteen
    products.

    K, the energy of the electrons' drift, is large in a spike of the field, while electrons stay
    cold: where it leads beyond the table, the table's end is taken.
    """
    table, per_eV, top = model.table, 1.0 / model.table_step_eV, model.table.shape[0] - 2.0
    weight, omega, unit = model.drift_weight * 2.0 / 3.0, model.omega_ce, E_CHARGE / M_ELECTRON
    factor, shared = unit * model.conduction_factor, model.conduction_coulomb
    for i in range(T.size):
        place = min((T[i] + weight * drift[i]) * per_eV, top)
        row = np.uint64(place)
        fraction = place - row
        frequency = nu[i] + nn[i] * between_rows(table, row, fraction, EVENTS)
        squares, hindered = frequency**2 + omega[i] ** 2, frequency + shared * coulomb[i]
        inverse = 1.0 / (frequency * squares * hindered)
        per_nu[i] = inverse * squares * hindered
        per_mobility[i] = squares * per_nu[i] / unit
        kappa[i] = factor * n[i] * T[i] * (frequency**2 * (frequency * inverse))
        rate[i] = between_rows(table, row, fraction, IONIZATION)
        lost, steep = with_slope(table, row, fraction, INELASTIC, per_eV)
        loss[i], slope[i] = n[i] * nn[i] * lost, n[i] * nn[i] * steep


@compiled(**LOOP)
def by_column(T, drift, model, column, out):
    """One more column of the closure table, at T_e + 2 K/3."""
    table, per_eV, top = model.table, 1.0 / model.table_step_eV, model.table.shape[0] - 2.0
    weight = model.drift_weight * 2.0 / 3.0
    for i in range(T.size):
        place = min((T[i] + weight * drift[i]) * per_eV, top)
        row = np.uint64(place)
        out[i] = between_rows(table, row, place - row, column)


@compiled(**FAST)
def collisions(state, model, w):
    """Frequencies, rates, losses and so on at the present T_e; False if it leaves the table."""
    T, drift, n, nn = state.T_e_eV, state.drift_eV, state.n_e, state.n_n
    if not within_table(T, 1.0 / model.table_step_eV, model.table.shape[0] - 2.0):
        return False
    by_temperature(
        T, n, nn, state.log_n[0], model, w.nu, w.coulomb, state.wall_loss, w.wall, w.wall_slope
    )
    by_energy(
        T, drift, n, nn, model, w.nu, w.coulomb, w.per_nu, w.per_mobility, w.kappa,
        state.rates[0], w.inelastic, w.inelastic_slope,
    )  # fmt: skip
    if model.drift_credit:
        by_column(T, drift, model, DRIFT_EVENTS, w.events)
        pay(w.inelastic, n, nn, w.events, drift, -1.0)
    for k in range(model.further.shape[0]):
        by_column(T, drift, model, FURTHER + k, state.rates[k + 1])
        below = model.further[k, 0]
        source = nn if below == 0 else state.n_i[below - 1]
        w.cost[:] = model.further_eV[k]
        pay(w.inelastic, n, source, state.rates[k + 1], w.cost, 1.0)
    return True


@compiled(**LOOP)
def pay(loss, n, source, rate, energy, sign):
    """Add the energy in eV/(m^3 s) that events of this rate cost, or subtract what drift pays."""
    for i in range(loss.size):
        loss[i] += sign * n[i] * source[i] * rate[i] * energy[i]
