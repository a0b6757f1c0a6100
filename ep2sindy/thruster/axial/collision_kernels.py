"""Compiled collisions of electrons, with neutrals, ions and walls, from the table of closures."""

import numpy as np

from ep2sindy.runtime.compilation import compiled
from ep2sindy.thruster.axial.state_kernels import FAST, ONE
from ep2sindy.thruster.closures import (
    COULOMB,
    COULOMB_LOG,
    DOUBLE,
    DRIFT_EVENTS,
    EVENTS,
    INELASTIC,
    ION_LOSS,
    IONIZATION,
    MOMENTUM,
    SECOND,
    WALL_COLLISION,
    WALL_POWER,
)
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON


@compiled(**FAST)
def table_rows(T, drift, weight, model, row, share):
    """Row below T + 2 K/3 in the closure table, share of the row above; False off the table.

    T alone must lie in the table. The drift energy K is large in a spike of the field, while
    electrons stay cold: where it leads beyond the table, the table's end is taken.
    """
    per_eV, top = 1.0 / model.table_step_eV, model.table.shape[0] - 2.0
    weight = weight * 2.0 / 3.0
    most = top if weight > 0.0 else np.inf
    for i in range(T.size):
        share[i] = min((T[i] + weight * drift[i]) * per_eV, most)
    n_off = 0
    for i in range(T.size):
        n_off += 0 if 0.0 <= share[i] <= top else 1
    if n_off:
        return False
    for i in range(T.size):
        row[i] = np.uint64(share[i])
    for i in range(T.size):
        share[i] -= row[i]
    return True


@compiled(**FAST)
def lookup(table, row, share, column, out):
    """Linear interpolation between two rows of the closure table."""
    for i in range(out.size):
        below = table[row[i], column]
        out[i] = below + share[i] * (table[row[i] + ONE, column] - below)


@compiled(**FAST)
def loss_with_slope(table, row, share, column, per_eV, loss, slope):
    """A loss rate in eV m^3/s or eV/s and its slope in T_e; the slope is 0 where the loss falls."""
    for i in range(loss.size):
        below = table[row[i], column]
        rise = table[row[i] + ONE, column] - below
        loss[i] = below + share[i] * rise
        slope[i] = max(rise, 0.0) * per_eV


@compiled(**FAST)
def collisions(state, model, rows, w):
    """Collision frequency w[0] and mobility w[1], losses w[3] and w[5] with slopes w[4] and w[6].

    w[3] is the inelastic loss and w[5] the loss to the walls, in eV/(m^3 s). rows: (n + 2,).
    Returns False if T_e leaves the table.
    """
    table, row, share, T, drift = model.table, rows, w[8], state.T_e_eV, state.drift_eV
    nu, mobility, value, n, nn = w[0], w[1], w[7], state.n_e, state.n_n
    if not table_rows(T, drift, 0.0, model, row, share):
        return False
    lookup(table, row, share, COULOMB, value)
    lookup(table, row, share, COULOMB_LOG, mobility)
    lookup(table, row, share, MOMENTUM, nu)
    log_n, anomalous = state.log_n[0], model.anomalous
    nu_ei = w[17]
    for i in range(nu.size):
        nu_ei[i] = n[i] * value[i] * (mobility[i] - 0.5 * log_n[i])
        nu[i] = nn[i] * nu[i] + nu_ei[i] + anomalous[i]
    lookup(table, row, share, ION_LOSS, state.wall_loss)
    for i in range(nu.size):
        state.wall_loss[i] *= model.wall_ion_weight[i]
    lookup(table, row, share, WALL_COLLISION, value)
    on_wall, omega = model.wall_collision_weight, model.omega_ce
    for i in range(nu.size):
        nu[i] += on_wall[i] * value[i]
    weighted_loss(n, model.wall_power_weight, model, row, share, WALL_POWER, w[5], w[6])
    if model.drift_weight > 0.0 and not table_rows(T, drift, model.drift_weight, model, row, share):
        return False
    lookup(table, row, share, EVENTS, value)
    for i in range(nu.size):
        nu[i] += nn[i] * value[i]
    for i in range(nu.size):
        mobility[i] = E_CHARGE / M_ELECTRON * nu[i] / (nu[i] ** 2 + omega[i] ** 2)
    lookup(table, row, share, IONIZATION, state.rates[0])
    weighted_loss(n, nn, model, row, share, INELASTIC, w[3], w[4])
    if model.drift_credit:
        credit_drift(n, nn, drift, table, row, share, value, w[3])
    if state.n_i.shape[0] > 1:
        second_charge(state, model, row, share, w[3])
    return True


@compiled(**FAST)
def weighted_loss(n, weight, model, row, share, column, loss, slope):
    """n weight times a loss per electron and unit weight, and its slope in T_e."""
    loss_with_slope(model.table, row, share, column, 1.0 / model.table_step_eV, loss, slope)
    for i in range(n.size):
        loss[i] *= n[i] * weight[i]
        slope[i] *= n[i] * weight[i]


@compiled(**FAST)
def credit_drift(n, nn, drift, table, row, share, events, inelastic):
    """Subtract the inelastic loss that some propellants take from the drift, not the heat."""
    lookup(table, row, share, DRIFT_EVENTS, events)
    for i in range(n.size):
        inelastic[i] -= n[i] * nn[i] * events[i] * drift[i]


@compiled(**FAST)
def second_charge(state, model, row, share, inelastic):
    """Rate coefficients of the second charge state, and their energy cost for the electrons."""
    double, second, first = state.rates[1], state.rates[2], state.n_i[0]
    E_double, E_second = model.second_thresholds_eV
    lookup(model.table, row, share, DOUBLE, double)
    lookup(model.table, row, share, SECOND, second)
    for i in range(double.size):
        cost = state.n_n[i] * double[i] * E_double + first[i] * second[i] * E_second
        inelastic[i] += state.n_e[i] * cost
