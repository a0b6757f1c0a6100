"""Data shared by the compiled loops: the constants of a run, and the arrays that they advance.

Arrays on the grid are (n_z, n_r), indexed [i, j]; column i is active for lower[i] <= j < upper[i].
Axial face i lies between columns i - 1 and i, radial face j between rows j - 1 and j. The bounds
are unsigned: a loop that might begin below zero would check the index at every access, and would
not vectorise. So neighbours in a row are j - ONE and j + ONE.
"""

from typing import Any, NamedTuple

import numpy as np


class PlaneModel(NamedTuple):
    """Everything that the compiled loops need and that is constant in time."""

    dz: float  # m
    dr: float  # m
    exit_column: int  # the first one beyond the channel
    lower: np.ndarray  # (n_z,), rows of the plasma
    upper: np.ndarray
    area: np.ndarray  # (n_r,), of a row's cross-section, m^2
    per_area: np.ndarray
    perimeter: np.ndarray  # (n_r + 1,), area of a radial face per length along z, m
    ion_mass: float  # kg
    ion_sound_squared: float  # k_B T_i / m, m^2/s^2
    electron_sound_squared: float  # e / m, per eV of T_e
    neutral_speed: float  # m/s
    neutral_diffusion: float  # m^2/s
    neutral_inflow: float  # 1/(m^2 s)
    voltage: float  # V_0 - V_c, V
    resistance: float  # ohm
    conduction_factor: float  # kappa = conduction_factor * mu * n * T_e
    drift_weight: float  # 1: rates include the electrons' drift energy; 0: they do not
    boundary_T_e_eV: float  # eV
    cfl: float
    omega_ce: np.ndarray  # (n_z,), rad/s
    anomalous: np.ndarray  # (n_z,), 1/s
    table: np.ndarray  # (temperatures, columns), as `plane_table` fills it
    table_step_eV: float


class Gas(NamedTuple):
    """Conserved quantities of ions and neutrals, and the derived velocities; (n_z, n_r)."""

    n: np.ndarray  # n_i, m^-3
    flux_z: np.ndarray  # n_i u_iz, 1/(m^2 s)
    flux_r: np.ndarray
    neutrals: np.ndarray  # m^-3
    u_z: np.ndarray  # m/s
    u_r: np.ndarray


class PlaneState(NamedTuple):
    """Arrays that the loops advance in place."""

    gas: Gas
    stage: Gas  # stage of the Runge-Kutta step
    E: np.ndarray  # (n_z, n_r), axial field, V/m
    log_n: np.ndarray  # (n_z, n_r), ln(n_i m^3)
    T_e_eV: np.ndarray  # (n_z,)
    energy: np.ndarray  # (n_z,), 1.5 N T_e, eV/m
    drift_eV: np.ndarray  # (n_z,), kinetic energy of the electrons' drift
    ionization: np.ndarray  # (n_z,), rate coefficient, m^3/s
    reference_field: np.ndarray  # (n_z,), -dphi*/dz, V/m
    wall: np.ndarray  # (n_z,), ions lost to walls in the last step, 1/(m s)
    side: np.ndarray  # (n_z,), ions that left through the sides of the plume, 1/(m s)
    current: np.ndarray  # (1,), A
    left: np.ndarray  # (1,), atoms and ions that left since the start


class Columns(NamedTuple):
    """Sums over r of densities times row areas; (n_z,) each."""

    n: np.ndarray  # 1/m
    flux: np.ndarray  # 1/s, with what the sides of the plume carry
    n_neutrals: np.ndarray  # sum of n_i n_n, 1/m^4
    n_n: np.ndarray  # sum of n_i^2
    log_ref: np.ndarray  # ln(n_ref)
    nu: np.ndarray  # 1/s
    conductance: np.ndarray  # mu N, 1/(m V s) * m^2
    loss: np.ndarray  # eV/(m s)
    loss_slope: np.ndarray  # 1/(m s)
    heating: np.ndarray  # eV/(m s)
    electron_flux: np.ndarray  # 1/s
    upper: np.ndarray
    right: np.ndarray


class Slopes(NamedTuple):
    """Half slopes in the cells of one column, (n_r,) each."""

    n: np.ndarray
    u_z: np.ndarray
    u_r: np.ndarray
    neutrals: np.ndarray


class Fluxes(NamedTuple):
    """Of ion density, ion momentum along z and r, and neutrals, for one column."""

    n: np.ndarray
    z: np.ndarray
    r: np.ndarray
    neutrals: np.ndarray


class Work(NamedTuple):
    """Scratch arrays. The heavy step goes from column to column, and keeps rows of one alone."""

    slopes_z: Slopes
    slopes_r: Slopes
    before: Fluxes  # (n_r,), through the faces before the column, and behind it
    behind: Fluxes
    radial: Fluxes  # (n_r + 1,), times the perimeter
    columns: Columns
    planes: np.ndarray  # (4, n_z, n_r), the sample: fields,
    profiles: np.ndarray  # (3, n_z), profiles along z,
    numbers: np.ndarray  # (2,), current and thrust


def new_work(n_z: int, n_r: int) -> Work:
    """Zeros for a grid of this shape."""

    def zeros(kind: Any, size: int) -> Any:
        return kind(*(np.zeros(size) for _ in kind._fields))

    return Work(
        slopes_z=zeros(Slopes, n_r),
        slopes_r=zeros(Slopes, n_r),
        before=zeros(Fluxes, n_r),
        behind=zeros(Fluxes, n_r),
        radial=zeros(Fluxes, n_r + 1),
        columns=zeros(Columns, n_z),
        planes=np.zeros((4, n_z, n_r)),
        profiles=np.zeros((3, n_z)),
        numbers=np.zeros(2),
    )
