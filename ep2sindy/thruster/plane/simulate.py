"""Run the (z, r) fluid model and return its record as an xarray.Dataset."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.thruster.axial.settings import Settings, to_json
from ep2sindy.thruster.balance import INFLOW
from ep2sindy.thruster.cache import read_or_run
from ep2sindy.thruster.closures import (
    TABLE_STEP_EV,
    WALL_COLLISION,
    WALL_POWER,
    closure_table,
    table_temperatures,
)
from ep2sindy.thruster.constants import E_CHARGE, K_BOLTZMANN, M_ELECTRON
from ep2sindy.thruster.parameters import NeutralSpeed, OperatingPoint, Thruster
from ep2sindy.thruster.plane import state_kernels as kernels
from ep2sindy.thruster.plane.grid import MaskedGrid
from ep2sindy.thruster.plane.kernels import advance
from ep2sindy.thruster.plane.state_kernels import PlaneModel, PlaneState, new_work
from ep2sindy.thruster.propellants import XenonFits
from ep2sindy.thruster.recording import (
    CHUNK_ROWS,
    March,
    as_dataset,
    notes,
    record_samples,
    warm_up,
)
from ep2sindy.thruster.transport import AnomalousTransport, FunctionTransport
from ep2sindy.thruster.verdict import outcome
from ep2sindy.thruster.walls import FixedAnode, SheathWall

PLANES = {  # variable -> unit, long name; in the order of the compiled loop
    "n_i": ("m^-3", "ion density"),
    "n_n": ("m^-3", "neutral density"),
    "u_iz": ("m/s", "axial ion velocity"),
    "u_ir": ("m/s", "radial ion velocity, outward"),
}
PROFILES = {
    "T_e_eV": ("eV", "electron temperature, of z alone"),
    "R_ion": ("m^3/s", "ionisation rate coefficient, of z alone"),
    "E_z": ("V/m", "axial electric field where the density is the reference density"),
}
SERIES = {
    "I_d": ("A", "discharge current"),
    "thrust": ("N", "axial ion momentum that leaves the domain"),
    "mass_out": ("kg", "xenon that left the domain since the start"),
    "mass_held": ("kg", "xenon in the domain"),
    "V_d": ("V", "discharge voltage behind the series resistance"),
}

# Its cycle is nearly the same on every grid from 62 x 74 on: see docs/thruster.md.
THRUSTER_2D = Thruster(
    transport=AnomalousTransport(c_channel=1 / 300, c_plume=1 / 160, transition=3e-3),
    propellant=XenonFits(drift_weight=0.0),
    wall=SheathWall(),
    conduction_factor=2.4,
    series_resistance=2.0,
)
"""The thruster that `simulate_2d` takes if none is given."""
OPERATING_POINT_2D = OperatingPoint(300.0, 5.0, neutral_speed=240.0)
"""The operating point that `simulate_2d` takes if none is given."""


def simulate_2d(
    thruster: Thruster = THRUSTER_2D,
    operating_point: OperatingPoint = OPERATING_POINT_2D,
    *,
    duration_s: float = 18e-3,
    warm_up_s: float = 2e-3,
    sample_s: float = 1.5e-6,
    n_z: int = 41,
    n_r: int = 49,
    averaged: bool = True,
    cache: str | Path | bool | None = None,
    progress: Progress | bool = True,
) -> xr.Dataset:
    """Simulate one operating point in (z, r) and sample it at equal steps after a warm-up.

    The electrons are quasi-one-dimensional, so that T_e_eV and R_ion do not depend on r. A diverged
    run ends at its last finite sample and has that status; it is not an error.

    Parameters
    ----------
    thruster : Thruster, default THRUSTER_2D
        The thruster.
    operating_point : OperatingPoint, default OPERATING_POINT_2D
        Its voltage and flow.
    duration_s : float, default 0.018
        Length of the record in s.
    warm_up_s : float, default 0.002
        Time in s that is simulated before the record.
    sample_s : float, default 1.5e-06
        Sampling step in s.
    n_z : int, default 41
        Number of grid points along z.
    n_r : int, default 49
        Number of grid points along r.
    averaged : bool, default True
        True records the mean over the sampling step that ends at each time. False records the state
        at that time, which aliases oscillations faster than half the sampling rate.
    cache : str, Path or bool, optional
        As in `simulate`. With the default settings the file takes some 300 MB.
    progress : Progress or bool, default True
        True shows a bar.

    Returns
    -------
    Dataset
        The record over ("time", "z", "r"), with time in s from the end of the warm-up: PLANES over
        all three (float32, NaN in the thruster's body), PROFILES over time and z, SERIES over time
        (float64). Attributes are as in `simulate`.

    Raises
    ------
    ValueError
        If the settings cannot be run.
    OSError
        If the cache cannot be written.
    """
    settings = {
        "duration_s": duration_s, "warm_up_s": warm_up_s, "sample_s": sample_s,
        "n_z": n_z, "n_r": n_r, "averaged": averaged,
    }  # fmt: skip
    parameters = {"thruster": thruster, "operating_point": operating_point, "settings": settings}
    run = partial(simulate_as, parameters, progress=progress)
    return read_or_run(cache, f"plane_{operating_point.label}", parameters, run, progress)


def simulate_as(parameters: dict[str, Any], *, progress: Progress | bool) -> xr.Dataset:
    """Run `simulate_2d` with the thruster, the operating point and the settings as one value."""
    thruster: Thruster = parameters["thruster"]
    operating_point: OperatingPoint = parameters["operating_point"]
    settings: dict[str, Any] = parameters["settings"]
    sample_s, averaged = settings["sample_s"], settings["averaged"]
    duration_s, warm_up_s = settings["duration_s"], settings["warm_up_s"]
    Settings(duration_s, warm_up_s, sample_s)  # raises ValueError for invalid ones
    check_thruster(thruster, operating_point)
    grid = MaskedGrid(thruster, settings["n_z"], settings["n_r"])
    model = build_model(thruster, operating_point, grid)
    n_warm_up, n_samples = round(warm_up_s / sample_s), round(duration_s / sample_s) + 1
    state, watch = initial_state(grid, model), as_progress(progress)
    rows = Rows.allocate(min(n_warm_up, CHUNK_ROWS), grid)
    with watch.stage(n_warm_up + n_samples, "sample", operating_point.label) as advance:
        n_rows = warm_up(rows.march(state, model, sample_s, averaged), n_warm_up, advance)
        if n_rows is None:  # if the warm-up diverges, its last finite samples are the record
            rows = Rows.allocate(n_samples, grid)
            march = rows.march(state, model, sample_s, averaged)
            n_rows = record_samples(march, n_samples, advance)
    field = labelled(rows.until(n_rows), sample_s, grid)
    drop = thruster.series_resistance * field["I_d"].values
    field["V_d"] = ("time", operating_point.voltage - drop, notes(*SERIES["V_d"]))
    field.attrs = {
        "title": "2-D (z, r) Hall-thruster fluid model",
        "note": "electrons are quasi-one-dimensional: T_e_eV, R_ion and E_z depend on z alone",
        "parameters": to_json(parameters),
        INFLOW: model.neutral_inflow,
        "initial": "guessed profiles",
        **outcome(field, operating_point, ion_mass=model.ion_mass, diverged=n_rows < n_samples),
    }
    if field.sizes["time"] > 1:
        field.attrs["mass_balance"] = mass_balance(field, operating_point)
    return field


@dataclass(frozen=True)
class Rows:
    """Sampled arrays, one row per sample."""

    planes: Float[np.ndarray, "planes time z r"]
    profiles: Float[np.ndarray, "time profiles z"]
    series: Float[np.ndarray, "time series"]

    @staticmethod
    def allocate(n_rows: int, grid: MaskedGrid) -> Rows:
        """Arrays for n_rows samples; planes are NaN in the thruster's body."""
        return Rows(
            np.full((len(PLANES), n_rows, grid.n_z, grid.n_r), np.nan, np.float32),
            np.empty((n_rows, len(PROFILES), grid.n_z), np.float32),
            np.empty((n_rows, len(SERIES) - 1)),
        )

    def until(self, n_rows: int) -> Rows:
        """The first rows, as views."""
        return Rows(self.planes[:, :n_rows], self.profiles[:n_rows], self.series[:n_rows])

    def march(self, state: PlaneState, model: PlaneModel, sample_s: float, averaged: bool) -> March:
        """A function that records samples of a run into these rows."""
        work = new_work(*state.E.shape)

        def march(rows: slice) -> int:
            out = tuple(self.planes[:, rows]), self.profiles[rows], self.series[rows]
            return advance(state, model, work, sample_s, averaged, *out)

        return march


def labelled(rows: Rows, sample_s: float, grid: MaskedGrid) -> xr.Dataset:
    """Label the sampled arrays with dimensions, units and names, without copying the planes."""
    data: dict[str, tuple] = {
        name: (("time", "z", "r"), plane, notes(*entry))
        for (name, entry), plane in zip(PLANES.items(), rows.planes, strict=True)
    }
    for k, (name, entry) in enumerate(PROFILES.items()):
        data[name] = (("time", "z"), np.ascontiguousarray(rows.profiles[:, k]), notes(*entry))
    for k, name in enumerate(list(SERIES)[:-1]):
        data[name] = (("time",), rows.series[:, k].copy(), notes(*SERIES[name]))
    return as_dataset(data, sample_s=sample_s, n_samples=len(rows.series), z=grid.z, r=grid.r)


def mass_balance(field: xr.Dataset, point: OperatingPoint) -> float:
    """Xenon that left plus xenon that accumulated, over xenon that entered."""
    ends = field[["mass_out", "mass_held"]].isel(time=[0, -1])
    left, accumulated = (float(np.diff(ends[name])[0]) for name in ("mass_out", "mass_held"))
    entered = 1e-6 * point.mass_flow_mg_s * float(field["time"][-1] - field["time"][0])
    return (left + accumulated) / entered


# Constants and first state of the compiled loops, from parameters and grid.


CFL = 0.8
NEUTRAL_DIFFUSION = 1.1  # m^2/s, radial: a mean speed of some 200 m/s over the channel's width


def check_thruster(thruster: Thruster, point: OperatingPoint) -> None:
    """Raise ValueError for closures that the (z, r) model does not support."""
    if not isinstance(thruster.wall, SheathWall):
        raise ValueError(
            "the (z, r) model computes the flux to the walls and needs their sheath: wall must be "
            f"a SheathWall, got {type(thruster.wall).__name__}"
        )
    unsolved = {
        "an AnodeSheath": not isinstance(thruster.anode, FixedAnode),
        "a circuit": thruster.circuit is not None,
        "a shielded wall": thruster.wall.shielded_T_e_eV is not None,
        "a plume that spreads": thruster.plume is not None,
        "a supply whose voltage varies": point.supply is not None,
        "a transport by a function": isinstance(thruster.transport, FunctionTransport),
        "a background gas": point.background is not None,
        "a neutral speed that varies": isinstance(point.neutral_speed, NeutralSpeed),
        f"charge_states {thruster.charge_states}": thruster.highest_charge > 1,
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


def plane_table(thruster: Thruster) -> Float[np.ndarray, "temperatures columns"]:
    """`closure_table` with wall losses per ion that reaches the wall.

    In the axial model, electrons reach the wall at scale * ratio * sqrt(e T_e/m) n / gap, times
    1/(1 - gamma). Here the computed flux of ions to the wall replaces the factor
    ratio * sqrt(e T_e/m) n / gap.
    """
    table = closure_table(thruster)
    wall = SheathWall(ion_scale=1.0)  # that ions reach with ratio * sqrt(e T_e/m) / gap
    ions = wall.ion_loss(table_temperatures(), thruster.gap, thruster.propellant.mass)
    table[:, [WALL_COLLISION, WALL_POWER]] /= np.asarray(ions)[:, None]
    return table


def build_model(thruster: Thruster, point: OperatingPoint, grid: MaskedGrid) -> kernels.PlaneModel:
    """Gather all constants of one run."""
    distance = grid.z - thruster.channel_length
    omega_ce = E_CHARGE * thruster.magnetic_field.at(distance) / M_ELECTRON
    mass = thruster.propellant.mass
    return kernels.PlaneModel(
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
        neutral_speed=float(point.neutral_speed_at(np.zeros(1))[0]),
        neutral_diffusion=NEUTRAL_DIFFUSION,
        neutral_inflow=1e-6 * point.mass_flow_mg_s / (mass * thruster.area),
        voltage=point.voltage - thruster.cathode_potential,
        resistance=thruster.series_resistance,
        conduction_factor=thruster.conduction_factor,
        drift_weight=thruster.propellant.drift_weight,
        boundary_T_e_eV=thruster.cathode_T_e_eV,
        cfl=CFL,
        omega_ce=omega_ce,
        anomalous=thruster.transport_at(distance, point.background) * omega_ce,
        table=plane_table(thruster),
        table_step_eV=TABLE_STEP_EV,
    )


def initial_state(grid: MaskedGrid, model: kernels.PlaneModel) -> kernels.PlaneState:
    """A smooth first guess, uniform in r except for a thin plasma next to the beam."""
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
) -> kernels.PlaneState:
    """A state with given densities, axial ion flux and temperature, without radial motion."""
    shape = (grid.n_z, grid.n_r)
    inside = (n_i * grid.area).sum(axis=1, where=grid.plasma)

    def empty() -> kernels.Gas:
        return kernels.Gas(*(np.zeros(shape) for _ in kernels.Gas._fields))

    along_z = ("drift_eV", "ionization", "reference_field", "wall", "side")
    gas = empty()
    gas.n[:], gas.flux_z[:], gas.neutrals[:] = n_i, flux_z, n_n
    return kernels.PlaneState(
        gas=gas,
        stage=empty(),
        E=np.zeros(shape),
        log_n=np.zeros(shape),
        T_e_eV=T_e_eV.copy(),
        energy=1.5 * inside * T_e_eV,
        **{name: np.zeros(grid.n_z) for name in along_z},
        current=np.zeros(1),
        left=np.zeros(1),
    )
