"""From parameters to the arrays of the compiled loop: grid, closure table, first state."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster import kernels
from ep2sindy.thruster.anode import FixedAnode
from ep2sindy.thruster.constants import E_CHARGE, K_BOLTZMANN, M_ELECTRON
from ep2sindy.thruster.parameters import OperatingPoint, Thruster

TABLE_STEP_EV = 0.01  # linear interpolation is then within 1e-4 of the formulas above 1 eV
TABLE_TOP_EV = 200.0  # a mean energy beyond counts as divergence: the fits end below
CFL = 0.8


def closure_table(thruster: Thruster) -> Float[np.ndarray, "temperatures 9"]:
    """Tabulate every closure at steps of TABLE_STEP_EV; columns as named in `kernels`."""
    T = TABLE_STEP_EV * np.arange(round(TABLE_TOP_EV / TABLE_STEP_EV) + 1)
    T[0] = 0.1 * TABLE_STEP_EV  # the formulas divide by T; nothing happens this cold
    rates, wall, mass = thruster.propellant, thruster.wall, thruster.propellant.mass
    table = np.empty((T.size, 9))
    table[:, kernels.IONIZATION] = rates.ionization(T)
    table[:, kernels.EVENTS] = rates.events(T)
    table[:, kernels.MOMENTUM] = rates.momentum(T)
    table[:, kernels.INELASTIC] = rates.energy_loss(T)
    table[:, kernels.COULOMB] = rates.coulomb(T)
    table[:, kernels.COULOMB_LOG] = 23.0 - 0.5 * np.log(1e-6 * T**-3)  # less 0.5 ln(n)
    table[:, kernels.WALL_COLLISION] = wall.collision(T, thruster.gap, mass)
    table[:, kernels.WALL_POWER] = wall.power(T, thruster.gap, mass)
    table[:, kernels.ION_LOSS] = wall.ion_loss(T, thruster.gap, mass)
    return table


def cell_centres(thruster: Thruster, n_cells: int) -> Float[np.ndarray, " z"]:
    """Centres of the interior cells in m, from the anode."""
    return (np.arange(n_cells) + 0.5) * thruster.domain_length / n_cells


def check_solved(thruster: Thruster) -> None:
    """Raise ValueError for what a thruster may have and these kernels do not solve."""
    asked = {
        "an AnodeSheath": not isinstance(thruster.anode, FixedAnode),
        "charge_states 2": thruster.charge_states > 1,
        "conduction_coulomb": thruster.conduction_coulomb > 0.0,
    }
    if unsolved := [name for name, is_asked in asked.items() if is_asked]:
        raise ValueError(f"the axial model does not solve {' or '.join(unsolved)} yet")


def build_model(thruster: Thruster, point: OperatingPoint, n_cells: int) -> kernels.Model:
    """Gather every constant of one run; arrays hold one ghost cell at each end."""
    check_solved(thruster)
    mass = thruster.propellant.mass
    dz = thruster.domain_length / n_cells
    distance = (np.arange(n_cells + 2) - 0.5) * dz - thruster.channel_length
    omega_ce = E_CHARGE * thruster.magnetic_field.at(distance) / M_ELECTRON
    inflow = 1e-6 * point.mass_flow_mg_s / (mass * thruster.area)
    return kernels.Model(
        dz=dz,
        area=thruster.area,
        ion_mass=mass,
        sound_speed_squared=K_BOLTZMANN * thruster.ion_temperature / mass,
        neutral_speed=point.neutral_speed,
        neutral_inflow=inflow,
        voltage=point.voltage - thruster.cathode_potential,
        resistance=thruster.series_resistance,
        pressure_factor=thruster.pressure_factor,
        conduction_factor=thruster.conduction_factor,
        drift_weight=thruster.propellant.drift_weight,
        anode_T_e_eV=thruster.anode.T_e_eV,
        cathode_T_e_eV=thruster.cathode_T_e_eV,
        cfl=CFL,
        omega_ce=omega_ce,
        anomalous=thruster.transport.at(distance) * omega_ce,
        wall_ion_weight=thruster.wall.ion_weight(distance),
        wall_collision_weight=thruster.wall.collision_weight(distance),
        wall_power_weight=thruster.wall.power_weight(distance),
        table=closure_table(thruster),
        table_step_eV=TABLE_STEP_EV,
    )


def initial_state(thruster: Thruster, model: kernels.Model) -> kernels.State:
    """A gentle guess: a violent start can starve the anode of electrons and end the run."""
    size = model.omega_ce.size
    z = (np.arange(size) - 0.5) * model.dz / thruster.channel_length  # 1 at the exit
    n_i = np.full(size, 5e17)
    u_i = -1000.0 + 8000.0 * z
    n_n = model.neutral_inflow / model.neutral_speed * np.clip(1.0 - z, 0.05, 1.0)
    T_e = model.anode_T_e_eV + 10.0 * np.exp(-0.5 * ((z - 1.0) / 0.4) ** 2)
    return kernels.State(
        n_i=n_i,
        flux_i=n_i * u_i,
        n_n=n_n,
        T_e_eV=T_e,
        energy=1.5 * n_i * T_e,
        drift_eV=np.zeros(size),
        E=np.zeros(size),
        ionization=np.zeros(size),
        wall_loss=np.zeros(size),
        current=np.zeros(1),
        left=np.zeros(1),
    )
