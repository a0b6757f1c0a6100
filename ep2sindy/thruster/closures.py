"""Closures tabulated over the electron temperature: each formula exists once, in NumPy."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.parameters import Thruster
from ep2sindy.thruster.propellants import FURTHER_IONIZATIONS, PropellantTable

TABLE_STEP_EV = 0.02  # linear interpolation is then within 5e-4 of the formulas above 2 eV
TABLE_TOP_EV = 200.0  # the fits end below; a higher T_e counts as divergence

# Columns, one row per temperature; coefficients in SI, energies in eV.
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
    DRIFT_EVENTS,
    FURTHER,
) = range(11)
TRANSITIONS = tuple(FURTHER_IONIZATIONS)  # charges before and after, one column each from FURTHER


def closure_table(thruster: Thruster) -> Float[np.ndarray, "temperatures columns"]:
    """Tabulate every closure at steps of TABLE_STEP_EV; columns as named in this module.

    From FURTHER on stand the coefficients of TRANSITIONS up to the thruster's highest charge.
    """
    T = table_temperatures()
    rates, wall, mass = thruster.propellant, thruster.wall, thruster.propellant.mass
    further = further_transitions(thruster)
    table = np.zeros((T.size, FURTHER + len(further)))
    table[:, IONIZATION] = rates.ionization(T)
    table[:, EVENTS] = rates.events(T)
    table[:, MOMENTUM] = rates.momentum(T)
    table[:, INELASTIC] = rates.energy_loss(T)
    table[:, COULOMB] = rates.coulomb(T)
    table[:, COULOMB_LOG] = coulomb_log_at_unit_density(T)
    table[:, WALL_COLLISION] = wall.collision(T, thruster.gap, mass)
    table[:, WALL_POWER] = wall.power(T, thruster.gap, mass)
    table[:, ION_LOSS] = wall.ion_loss(T, thruster.gap, mass)
    table[:, DRIFT_EVENTS] = rates.drift_events(T)
    for column, (charge, higher) in enumerate(further, FURTHER):
        assert isinstance(rates, PropellantTable)  # the thruster checks this
        table[:, column] = rates.further_ionization(charge, higher, T)
    return table


def table_temperatures() -> Float[np.ndarray, " temperatures"]:
    """Electron temperatures in eV of the rows of a closure table."""
    T = TABLE_STEP_EV * np.arange(round(TABLE_TOP_EV / TABLE_STEP_EV) + 1)
    T[0] = 0.1 * TABLE_STEP_EV  # the formulas divide by T; all rates vanish at so low a T
    return T


def further_transitions(thruster: Thruster) -> list[tuple[int, int]]:
    """Charges before and after of the transitions that a thruster's ions take beyond X -> X+."""
    return [pair for pair in TRANSITIONS if pair[1] <= thruster.highest_charge]


def coulomb_log_at_unit_density(T_e_eV: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """ln(Lambda) of electron-ion collisions plus 0.5 ln(n in m^-3).

    Source: NRL Plasma Formulary, with its formulas for T_e below and above 10 eV.
    """
    cold, hot = 1e-6 * T_e_eV**-3, 1e-6 * T_e_eV**-2
    return np.where(T_e_eV < 10.0, 23.0 - 0.5 * np.log(cold), 24.0 - 0.5 * np.log(hot))
