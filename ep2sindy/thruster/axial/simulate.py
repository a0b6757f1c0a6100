"""Run the axial fluid model and return its record as an xarray.Dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.runtime.progress import Advance, Progress, as_progress
from ep2sindy.thruster.axial import kernels
from ep2sindy.thruster.axial import state_kernels as recorded
from ep2sindy.thruster.axial.electron_kernels import electron_step, start_density
from ep2sindy.thruster.axial.model import (
    CFL,
    Follower,
    build_model,
    cell_faces,
    followers_of,
    lengths_and_centres,
)
from ep2sindy.thruster.axial.output import POWERS, field_columns, labelled, series_of
from ep2sindy.thruster.axial.settings import Settings, to_json
from ep2sindy.thruster.axial.starts import (
    Beginning,
    GuessedStart,
    Restart,
    Start,
    end_of,
    stored_energy,
)
from ep2sindy.thruster.axial.state_kernels import AxialModel, AxialState, new_sums, new_work
from ep2sindy.thruster.balance import INFLOW
from ep2sindy.thruster.cache import read_or_run
from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.thruster.propellants import describe_uncovered
from ep2sindy.thruster.recording import CHUNK_ROWS, March, record_samples, warm_up
from ep2sindy.thruster.verdict import outcome


def simulate(
    thruster: Thruster,
    operating_point: OperatingPoint,
    *,
    duration_s: float = 18e-3,
    warm_up_s: float = 2e-3,
    sample_s: float = 1.5e-6,
    averaged: bool = True,
    n_cells: int = 100,
    stretch: float = 2.0,
    reconstruct: bool = True,
    cfl: float = CFL,
    coldest_T_e_eV: float = 0.0,
    initial: Start | xr.Dataset | str | Path | None = None,
    cache: str | Path | bool | None = None,
    progress: Progress | bool = True,
) -> xr.Dataset:
    """Simulate one operating point and record it at equal steps after a warm-up.

    A diverged run ends at its last finite sample and has that status; it is not an error.

    Parameters
    ----------
    thruster : Thruster
        The thruster.
    operating_point : OperatingPoint
        Its voltage and flow.
    duration_s : float, default 0.018
        Length of the record in s.
    warm_up_s : float, default 0.002
        Time in s that is simulated before the record.
    sample_s : float, default 1.5e-06
        Sampling step in s.
    averaged : bool, default True
        True records averages over each sampling step, like probes and the output of most codes,
        with the products and fluxes that close the balance. False records the values at the end of
        the step, which alias faster oscillations.
    n_cells : int, default 100
        Number of cells of the grid.
    stretch : float, default 2.0
        Length of the plume's cells relative to the channel's. 1 makes all equal.
    reconstruct : bool, default True
        True uses van Leer's slopes, False fluxes of first order, also of heat.
    cfl : float, default CFL
        Courant number (CFL), which limits the time step; above 0, at most 1.
    coldest_T_e_eV : float, default 0.0
        Lower bound of T_e, like the 1.5 eV of HallThruster.jl. The energy balance then lacks the
        added heat.
    initial : GuessedStart, ColdStart, SoftStart, Restart, Dataset or path, optional
        The initial state. None takes `GuessedStart()`; a Dataset or a NetCDF file continues from
        the end of another run.
    cache : str, Path or bool, optional
        Folder in which this simulation is stored, or from which it is read, with the same values.
        True takes your cache folder. The file's name holds a hash of all parameters and of the
        sources, so that a changed formula never yields an old result.
    progress : Progress or bool, default True
        True shows a bar.

    Returns
    -------
    Dataset
        The record over ("time", "z"), with time in s from the end of the warm-up: fields (float32)
        and series (float64), listed in docs/thruster.md. Its attributes hold the parameters as
        JSON, `initial`, `status` (see `assess_status`), `cycle`, `f_kHz`, mean and standard
        deviation of I_d, thrust, specific impulse and efficiency, and `mass_balance` and
        `energy_balance` (out plus stored over in).

    Raises
    ------
    ValueError
        If the settings cannot be run.
    OSError
        If the cache cannot be written.

    Examples
    --------
    >>> point = ep.thruster.OPERATING_POINTS[3]
    >>> field = ep.thruster.simulate(
    ...     ep.thruster.Thruster(), point, duration_s=5e-5, warm_up_s=0.0, progress=False
    ... )
    >>> field["n_i"].dims
    ('time', 'z')
    """
    run = duration_s, warm_up_s, sample_s, averaged
    settings = Settings(*run, n_cells, stretch, reconstruct, cfl, coldest_T_e_eV)
    start = GuessedStart() if initial is None else initial
    if isinstance(start, xr.Dataset | str | Path):
        start = Restart(start)
    compute = partial(simulate_as, settings, thruster, operating_point, start, progress=progress)
    parameters = {"thruster": thruster, "operating_point": operating_point, "settings": settings}
    parameters["initial"] = start.label
    return read_or_run(cache, f"thruster_{operating_point.label}", parameters, compute, progress)


def simulate_as(
    settings: Settings,
    thruster: Thruster,
    point: OperatingPoint,
    start: Start,
    *,
    progress: Progress | bool,
) -> xr.Dataset:
    """Run `simulate` with its settings as one value."""
    parameters = to_json({"thruster": thruster, "operating_point": point, "settings": settings})
    faces = cell_faces(thruster, settings.n_cells, settings.stretch)
    model = build_model(
        thruster, point, faces, end_s=settings.duration_s + settings.sample_s, cfl=settings.cfl,
        reconstruct=settings.reconstruct, coldest_eV=settings.coldest_T_e_eV,
    )  # fmt: skip
    beginning = start.begin(model, lengths_and_centres(faces)[1], parameters)
    followers = followers_of(thruster, model, beginning.state, faces)
    n_samples = sum(sample_counts(beginning, settings))
    with as_progress(progress).stage(n_samples, "sample", point.label) as advance:
        record = run(model, beginning, settings, advance, followers)
    plume, sample_s = thruster.plume, settings.sample_s
    columns = field_columns(
        charges=len(record.state.n_i), averaged=settings.averaged, spreads=plume is not None
    )
    cathode_V = point.voltage - float(model.supply[0])
    series = series_of(record.series, model, cathode_V=cathode_V, sample_s=sample_s, plume=plume)
    profiles = end_of(record.state)
    field = labelled(columns, record.fields, series, profiles, sample_s=sample_s, faces=faces)
    field.attrs = {
        "title": "1-D axial Hall-thruster fluid model",
        "parameters": parameters,
        INFLOW: model.neutral_inflow,
        "initial": f"{start.label}, {beginning.note}" if beginning.note else start.label,
        **outcome(field, point, ion_mass=model.ion_mass, diverged=record.diverged),
    }
    if field.sizes["time"]:
        field.attrs["I_wall_mean"] = float(field["I_wall"].mean())
        seconds = sample_s * field.sizes["time"]
        field.attrs["energy_balance"] = energy_balance(field, record, seconds)
        if "dn_n_dt" in field:
            field.attrs["mass_balance"] = mass_balance(field, model, seconds)
    hottest, end = float(record.state.hottest_eV[0]), record.state.instant
    field.attrs["rates"] = describe_uncovered(thruster.propellant, hottest) or "covered"
    # Data that a restart needs besides the profiles.
    needed = {"I_d": recorded.CURRENT, "V": recorded.VOLTAGE, "I_supply": recorded.SUPPLY_CURRENT}
    field.attrs |= {f"end_{name}": float(end[place]) for name, place in needed.items()}
    return field


@dataclass(frozen=True, eq=False)
class Record:
    """The samples of a run, its final state, and the heat stored at the record's two ends, in J."""

    fields: Float[np.ndarray, "sums samples cells"]
    series: Float[np.ndarray, "samples series"]
    state: AxialState
    stored_J: tuple[float, float]
    diverged: bool


def sample_counts(beginning: Beginning, settings: Settings) -> tuple[int, int, int]:
    """Numbers of samples of the hold, the warm-up and the record."""
    step = settings.sample_s
    seconds = (beginning.hold_s, settings.warm_up_s, settings.duration_s)
    n_hold, n_warm_up, n_recorded = (round(each / step) for each in seconds)
    return n_hold, n_warm_up, n_recorded + 1


def run(
    model: AxialModel,
    beginning: Beginning,
    settings: Settings,
    advance: Advance,
    followers: Sequence[Follower] = (),
) -> Record:
    """Hold, warm up and record; a run that breaks ends with its last complete sample."""
    state, quiet = beginning.state, model
    if beginning.resistance is not None:
        quiet = model._replace(resistance=beginning.resistance)
    n_hold, n_warm_up, n_samples = sample_counts(beginning, settings)
    state.clock[0] = -settings.sample_s * (n_hold + n_warm_up)
    for follow in followers:
        follow(0.0)
    whole = beginning.whole or first_fields(state, model)
    for each, n_rows in ((quiet, n_hold), (model, n_warm_up)):
        march, *_ = _march(each, state, settings, CHUNK_ROWS, followers)
        whole = whole and warm_up(march, n_rows, advance) is None
    before, state.hottest_eV[0], state.clock[0] = stored_energy(state, model), 0.0, 0.0
    n_rows = n_samples if whole else 0
    march, fields, series = _march(model, state, settings, n_rows, followers)
    filled = record_samples(march, len(series), advance)
    return Record(
        fields[:, :filled],
        series[:filled],
        state,
        (before, stored_energy(state, model)),
        diverged=filled < n_samples,
    )


def first_fields(state: AxialState, model: AxialModel) -> bool:
    """Field, rates and current from the profiles, for the first step; False if that breaks."""
    start_density(state)
    return electron_step(state, model, 0.0, new_work(*state.n_i.shape))


def _march(
    model: AxialModel,
    state: AxialState,
    settings: Settings,
    n_rows: int,
    followers: Sequence[Follower],
) -> tuple[March, Float[np.ndarray, "sums samples cells"], Float[np.ndarray, "samples series"]]:
    """A function that records samples of a run into a slice of rows, and what it fills.

    These are the fields and series of n_rows samples.
    """
    n_fields = len(recorded.CELL_SUMS) + recorded.PER_CHARGE * (len(state.n_i) - 1)
    n_cells = state.n_n.size
    fields = np.empty((n_fields, n_rows, n_cells - 2), np.float32)
    series = np.empty((n_rows, len(recorded.SERIES_SUMS)))
    sums, work = new_sums(n_fields, n_cells), new_work(*state.n_i.shape)

    def march(rows: slice) -> int:
        filled = settings.sample_s, settings.averaged, fields[:, rows], series[rows]
        return kernels.advance(state, model, sums, work, *filled)

    def march_by_samples(rows: slice) -> int:
        for row in range(rows.start, rows.stop):
            for follow in followers:
                follow(settings.sample_s)
            if not march(slice(row, row + 1)):
                return row - rows.start
        return rows.stop - rows.start

    return (march_by_samples if followers else march), fields, series


def mass_balance(field: xr.Dataset, model: AxialModel, seconds: float) -> float:
    """Propellant that left plus propellant that accumulated, over propellant that entered."""
    heavy = [name for name in field.data_vars if str(name).startswith("dn_")]
    area = field["area"].astype(float) if "area" in field else 1.0
    gained = sum((field[name] * area).mean("time").astype(float) for name in heavy)
    per_area = model.ion_mass * model.area
    accumulated = per_area * float((gained * field["dz"]).sum()) * seconds
    return (float(field["mass_out"][-1]) + accumulated) / (
        per_area * model.neutral_inflow * seconds
    )


def energy_balance(field: xr.Dataset, record: Record, seconds: float) -> float:
    """Energy taken by field, collisions, walls and ends, plus the electrons' gain, over P_in."""
    out = sum(float(field[name].mean()) for name in POWERS[1:])
    stored = (record.stored_J[1] - record.stored_J[0]) / seconds
    return (out + stored) / float(field[POWERS[0]].mean())
