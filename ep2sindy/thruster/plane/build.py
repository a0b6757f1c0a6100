"""From parameters and grid to the compiled loops' constants and first state."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster import closures as axial
from ep2sindy.thruster.closures import TABLE_STEP_EV, closure_table
from ep2sindy.thruster.constants import E_CHARGE, K_BOLTZMANN, M_ELECTRON
from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.thruster.plane import state_kernels as kernels
from ep2sindy.thruster.plane.grid import MaskedGrid
from ep2sindy.thruster.walls import SHEATH_DENSITY_RATIO, FixedAnode, SheathWall

CFL = 0.8
NEUTRAL_DIFFUSION = 1.1  # m^2/s, radial: a mean speed of some 200 m/s over the channel's width


def check_thruster(thruster: Thruster) -> None:
    """Raise ValueError for closures that have no meaning here."""
    if not isinstance(thruster.wall, SheathWall):
        raise ValueError(
            "the (z, r) model computes the flux to the walls and needs their sheath: wall must be "
            f"a SheathWall, got {type(thruster.wall).__name__}"
        )
    unsolved = {
        "an AnodeSheath": not isinstance(thruster.anode, FixedAnode),
        "charge_states 2": thruster.charge_states > 1,
        "conduction_coulomb": thruster.conduction_coulomb > 0.0,
        "an anode and a cathode of different T_e_eV": (
            thruster.anode.T_e_eV != thruster.cathode_T_e_eV
        ),
    }
    if asked := [name for name, is_asked in unsolved.items() if is_asked]:
        raise ValueError(
            f"the (z, r) model does not solve {', '.join(asked)}; simulate along the axis alone "
            "(data=simulation), or leave it out"
        )
    if thruster.pressure_factor != 1.0:
        raise ValueError(
            "the (z, r) model takes p_e = n T_e along the field lines: pressure_factor must be 1, "
            f"got {thruster.pressure_factor!r}"
        )


def plane_table(thruster: Thruster) -> Float[np.ndarray, "temperatures 8"]:
    """The closures over T_e, wall losses per ion that reaches the wall; columns as in `kernels`.

    The axial model has electrons arrive at scale * ratio * sqrt(e T_e/m) n / gap, times
    1/(1 - gamma); here the flux of ions to the wall, which is computed, stands for the factor
    ratio * sqrt(e T_e/m) n / gap.
    """
    axial_table = closure_table(thruster)
    T = TABLE_STEP_EV * np.arange(len(axial_table))
    T[0] = 0.1 * TABLE_STEP_EV
    bohm = np.sqrt(E_CHARGE * T / thruster.propellant.mass)
    ions = SHEATH_DENSITY_RATIO * bohm / thruster.gap  # 1/s
    table = np.empty((T.size, 8))
    for name in ("IONIZATION", "INELASTIC", "EVENTS", "MOMENTUM", "COULOMB", "COULOMB_LOG"):
        table[:, getattr(kernels, name)] = axial_table[:, getattr(axial, name)]
    table[:, kernels.WALL_COLLISIONS] = axial_table[:, axial.WALL_COLLISION] / ions
    table[:, kernels.WALL_ENERGY] = axial_table[:, axial.WALL_POWER] / ions
    return table


def build_model(thruster: Thruster, point: OperatingPoint, grid: MaskedGrid) -> kernels.Model:
    """Gather every constant of one run."""
    distance = grid.z - thruster.channel_length
    omega_ce = E_CHARGE * thruster.magnetic_field.at(distance) / M_ELECTRON
    mass = thruster.propellant.mass
    return kernels.Model(
        dz=grid.dz,
        dr=grid.dr,
        exit_column=grid.exit_column,
        lower=grid.lower.astype(np.uint64),
        upper=grid.upper.astype(np.uint64),
        area=grid.area,
        per_area=1.0 / grid.area,
        perimeter=grid.perimeter,
        ion_mass=mass,
        ion_sound_squared=K_BOLTZMANN * thruster.ion_temperature / mass,
        electron_sound_squared=E_CHARGE / mass,
        neutral_speed=point.neutral_speed,
        neutral_diffusion=NEUTRAL_DIFFUSION,
        neutral_inflow=1e-6 * point.mass_flow_mg_s / (mass * thruster.area),
        voltage=point.voltage - thruster.cathode_potential,
        resistance=thruster.series_resistance,
        conduction_factor=thruster.conduction_factor,
        drift_weight=thruster.propellant.drift_weight,
        boundary_T_e_eV=thruster.cathode_T_e_eV,
        cfl=CFL,
        omega_ce=omega_ce,
        anomalous=thruster.transport.at(distance) * omega_ce,
        table=plane_table(thruster),
        table_step_eV=TABLE_STEP_EV,
    )


def initial_state(grid: MaskedGrid, model: kernels.Model) -> kernels.State:
    """A gentle guess, uniform in r but for a thin plasma beside the beam."""
    shape = (grid.n_z, grid.n_r)
    z = grid.z / grid.thruster.channel_length  # 1 at the exit
    beam = np.zeros(grid.n_r, dtype=bool)
    beam[grid.n_side : grid.n_r - grid.n_side] = True
    n_i = np.where(beam, 5e17, 5e16) * np.ones(shape)
    neutrals = model.neutral_inflow / model.neutral_speed * np.clip(1.0 - z, 0.05, 1.0)
    T_e = model.boundary_T_e_eV + 10.0 * np.exp(-0.5 * ((z - 1.0) / 0.4) ** 2)
    flux_z = n_i * (-1000.0 + 8000.0 * z)[:, None]
    n_n = np.repeat(neutrals[:, None], grid.n_r, axis=1)
    return state_of(grid, n_i, flux_z, n_n, T_e)


def state_of(
    grid: MaskedGrid,
    n_i: Float[np.ndarray, "z r"],
    flux_z: Float[np.ndarray, "z r"],
    n_n: Float[np.ndarray, "z r"],
    T_e_eV: Float[np.ndarray, " z"],
) -> kernels.State:
    """State of given densities, axial ion flux and temperature, without radial motion."""
    shape = (grid.n_z, grid.n_r)
    inside = (n_i * grid.area).sum(axis=1, where=grid.plasma)

    def empty() -> kernels.Gas:
        return kernels.Gas(*(np.zeros(shape) for _ in kernels.Gas._fields))

    gas = empty()
    gas.n[:], gas.flux_z[:], gas.neutrals[:] = n_i, flux_z, n_n
    return kernels.State(
        gas=gas,
        stage=empty(),
        E=np.zeros(shape),
        log_n=np.zeros(shape),
        T_e_eV=T_e_eV.copy(),
        energy=1.5 * inside * T_e_eV,
        drift_eV=np.zeros(grid.n_z),
        ionization=np.zeros(grid.n_z),
        reference_field=np.zeros(grid.n_z),
        wall=np.zeros(grid.n_z),
        side=np.zeros(grid.n_z),
        current=np.zeros(1),
        left=np.zeros(1),
    )
