"""Data of the compiled loop: constants of a run, its state, and its sums.

Cell arrays hold one ghost cell at each end: index 0 lies behind the anode, index -1 beyond the
cathode plane; cells 1 .. n are the domain. Face i lies between cells i and i + 1. Species arrays
have one row per charge state.

A step at 100 cells costs a few microseconds, of which the start of every loop is a part: loops over
cells therefore do as much as the compiler can vectorise. Functions that hold one are `LOOP`.
"""

from typing import Any, NamedTuple

import numpy as np

from ep2sindy.runtime.compilation import SEPARATE_ARRAYS, compiled

# Sums may be reordered, but infinities and NaNs must be preserved: they end a run. Nothing is
# allocated in a kernel, so that references need not be counted, which costs half of what loops do.
ENTRY: dict[str, Any] = {
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
    "_nrt": False,
}
# For functions that only kernels call. Wrappers for Python would double the time to compile.
# They are inlined, since a call costs as much as a loop over the cells.
FAST: dict[str, Any] = {
    **ENTRY,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "forceinline": True,
}
# For functions whose array arguments are separate ones: the compiler need not look whether a value
# written is read by the next. Never pass one array twice, nor a row next to the matrix that has it.
LOOP: dict[str, Any] = {**FAST, **SEPARATE_ARRAYS}
NO_NAN: dict[str, Any] = {**LOOP, "fastmath": {*FAST["fastmath"], "nnan"}}  # for a maximum

SHORTEST_STEP = 1e-5  # of a sample: a run that needs shorter steps has diverged

# Quantities recorded, in the order of `Sums.cells`: averages over a sample, or its last values.
CELL_SUMS = (
    N_N, T_E, R_ION, E_Z, IONIZATION, WALL_LOSS, ENERGY, FACE_N, CHANGE_N, SPREAD,
    N_I, U_IZ, FLUX_I, FACE_I, CHANGE_I,
) = range(15)  # fmt: skip
PER_CHARGE = 5  # the last five repeat for every further charge state
SERIES_SUMS = (
    CURRENT, THRUST, WALL_CURRENT, BEAM, IONS_OUT, NEUTRALS_OUT,
    POWER, P_IONS, P_INELASTIC, P_WALL, P_ANODE, P_CATHODE, VOLTAGE, SUPPLY, SUPPLY_CURRENT,
    TANGENT,
) = range(16)  # fmt: skip


# Unsigned indices: numba wraps negative ones around, which prevents vectorisation.
ONE = np.uint64(1)


@compiled(**FAST)
def inside(values):
    """Indices of all cells except the ghosts."""
    return range(ONE, np.uint64(values.size) - ONE)


@compiled(**FAST)
def faces(values):
    """Indices of all faces; each is that of the cell on its anode side."""
    return range(np.uint64(0), np.uint64(values.size) - ONE)


class AxialModel(NamedTuple):
    """Everything that the compiled loop needs and that is constant in time."""

    dz: np.ndarray  # (n + 2,), m: lengths of the cells
    inverse_dz: np.ndarray  # (n + 2,), 1/m
    per_between: np.ndarray  # (n + 1,), 1/m: of the distance of the centres next to each face
    per_span: np.ndarray  # (n + 2,), 1/m: of the distance of the centres next to each cell
    to_left: np.ndarray  # (n + 2,): length of a cell over the distance to its left neighbour
    to_right: np.ndarray  # (n + 2,)
    slope_weight: float  # 1: van Leer's slopes; 0: none
    area: float  # m^2, of the channel
    spread: np.ndarray  # (n + 2,), area of the plasma over that of the channel
    spread_at: np.ndarray  # (n + 1,), the same at the faces
    per_spread: np.ndarray  # (n + 2,), 1 over it
    per_spread_at: np.ndarray  # (n + 1,)
    per_before: np.ndarray  # (n + 2,), 1/m: spread of the face before a cell over spread times dz
    per_behind: np.ndarray  # (n + 2,), 1/m: of the face behind it
    ion_mass: float  # kg
    sound_speed_squared: float  # k_B T_i / m, m^2/s^2
    neutral_before: np.ndarray  # per_before of the neutrals; another one only in comparisons
    neutral_behind: np.ndarray
    neutral_speed: np.ndarray  # (n + 1,), m/s, at the faces
    neutral_wave: float  # m/s: wave speed beyond it in the neutrals' flux, 0 but in comparisons
    birth_speed: np.ndarray  # (n + 2,), of ions born of neutrals, m/s
    neutral_inflow: float  # 1/(m^2 s)
    supply: np.ndarray  # V_s - V_c in V, at equal steps from t = 0; one value if constant
    supply_rate: float  # 1/s, of these steps
    resistance: float  # ohm
    inductance: float  # H
    capacitance: float  # F
    pressure_factor: float  # p_e = pressure_factor * n * T_e
    conduction_factor: float  # kappa = factor / (1 + coulomb * nu_ei / nu) * mu * n * T_e
    conduction_coulomb: float
    drift_weight: float  # 1: rates include the electrons' drift energy; 0: they do not
    drift_credit: bool  # some inelastic events take their energy from it, not from the heat
    sheath: bool  # whether the anode has a sheath; else its temperature is fixed
    sheath_weight: float  # fraction of its drop that electrons pay with heat
    anode_T_e_eV: float  # eV
    cathode_T_e_eV: float  # eV
    coldest_eV: float  # lower bound of T_e; with one, the energy balance does not close
    cfl: float
    omega_ce: np.ndarray  # (n + 2,), rad/s
    anomalous: np.ndarray  # (n + 2,), 1/s
    wall_ion_weight: np.ndarray  # (n + 2,): ion loss, electron collisions and power loss
    wall_collision_weight: np.ndarray
    wall_power_weight: np.ndarray
    table: np.ndarray  # (temperatures, columns), as `closure_table` fills it
    table_step_eV: float
    further: np.ndarray  # (k, 2): charges before and after the ionisations next to X -> X+
    further_eV: np.ndarray  # (k,), their energies


class AxialState(NamedTuple):
    """Cell arrays that the loop advances in place."""

    n_i: np.ndarray  # (charges, n + 2), m^-3
    flux_i: np.ndarray  # (charges, n + 2), n_i u_i, 1/(m^2 s)
    n_n: np.ndarray  # (n + 2,), m^-3
    T_e_eV: np.ndarray  # (n + 2,)
    energy: np.ndarray  # (n + 2,), 1.5 n_e T_e, eV/m^3
    drift_eV: np.ndarray  # (n + 2,), K, kinetic energy of the electrons' drift
    n_e: np.ndarray  # (n + 2,), m^-3
    flux_q: np.ndarray  # (n + 2,), charge flux of all ions over e
    log_n: np.ndarray  # (2, n + 2): ln n_e and the n_e it was taken at
    E: np.ndarray  # (n + 2,), V/m
    rates: np.ndarray  # (1 + k, n + 2), m^3/s: X -> X+ and the model's further ionisations
    wall_loss: np.ndarray  # (n + 2,), 1/s, of singly charged ions
    tangent: np.ndarray  # (n + 2,), of the plume's half-angle
    instant: np.ndarray  # (series,), the series' present values
    clock: np.ndarray  # (1,), s since the record began
    hottest_eV: np.ndarray  # (1,), highest T_e + 2 K/3 at the ends of samples


class Sums(NamedTuple):
    """Integrals over the time of one sample."""

    cells: np.ndarray  # (cell sums, n + 2)
    series: np.ndarray  # (series,)


def new_sums(n_cell_sums: int, size: int) -> Sums:
    """Zeros for cells, with ghosts, of this number."""
    return Sums(np.zeros((n_cell_sums, size)), np.zeros(len(SERIES_SUMS)))


class Scratch(NamedTuple):
    """Arrays of the loop that no step needs from the one before."""

    u: np.ndarray  # (charges, n + 2), speeds of the ions
    slope_n: np.ndarray  # (n + 2,), as all that follow but where stated; half slopes: of ions,
    slope_u: np.ndarray  # of their speed,
    slope_nn: np.ndarray  # of neutrals
    flux: np.ndarray  # through the face behind each cell
    momentum_flux: np.ndarray
    gain: np.ndarray  # (charges, n + 2): of ions by ionisation, and of their flux
    momentum_gain: np.ndarray  # (charges, n + 2)
    consumed: np.ndarray  # neutrals
    neutralised: np.ndarray  # ions at the walls
    n_e: np.ndarray
    stage_n: np.ndarray  # (charges, n + 2): of Heun's first stage
    stage_flux: np.ndarray  # (charges, n + 2)
    stage_nn: np.ndarray
    per_n: np.ndarray  # m^3, over the density of electrons
    per_mobility: np.ndarray  # V s/m^2
    nu: np.ndarray  # 1/s: of collisions that T_e alone decides
    per_nu: np.ndarray  # s: over the frequency of all collisions
    coulomb: np.ndarray  # 1/s, electron-ion collisions
    events: np.ndarray  # m^3/s, and what each costs, in eV
    cost: np.ndarray
    heating: np.ndarray  # eV/(m^3 s), and the losses, with their slopes in T_e
    inelastic: np.ndarray
    inelastic_slope: np.ndarray
    wall: np.ndarray
    wall_slope: np.ndarray
    gradient: np.ndarray  # of the pressure
    kappa: np.ndarray  # of conduction, in the cells
    down: np.ndarray  # heat through the face behind each cell: down T + up T of the next
    up: np.ndarray
    lower: np.ndarray  # equations of the heat
    diagonal: np.ndarray
    upper: np.ndarray
    known: np.ndarray
    c: np.ndarray
    d: np.ndarray
    before: np.ndarray  # T_e before the step


def new_work(charges: int, size: int) -> Scratch:
    """Zeros for cells, with ghosts, of this number."""
    per_charge = ("u", "gain", "momentum_gain", "stage_n", "stage_flux")
    shapes = {k: (charges, size) if k in per_charge else size for k in Scratch._fields}
    return Scratch(**{k: np.zeros(shape) for k, shape in shapes.items()})
