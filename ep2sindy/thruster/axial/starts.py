"""Starts of a simulation: a guess, an ignition, a quiet discharge, or the end of another run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.data.readers.registry import reader_of
from ep2sindy.data.readers.source import damage_named
from ep2sindy.runtime.files import read_json
from ep2sindy.thruster.axial import state_kernels as recorded
from ep2sindy.thruster.axial.state_kernels import AxialModel, AxialState
from ep2sindy.thruster.checks import check_positive
from ep2sindy.thruster.constants import E_CHARGE

Profile = Float[np.ndarray, " cells"]
# Arrays of a run's cells at its last instant, from which another run can continue.
END = "end_"
SPECIES = ("n_i", "flux_i")  # one array for every charge
CELLS = ("n_n", "T_e_eV", "energy_e", "drift_eV", "E_z", "wall_loss_rate")
RATES = ("R_ion", "R_double", "R_second", "R_triple", "R_ion_double", "R_third")
UNITS = {
    "n_i": "m^-3", "flux_i": "m^-2/s", "n_n": "m^-3", "T_e_eV": "eV", "energy_e": "eV*m^-3",
    "drift_eV": "eV", "E_z": "V/m", "wall_loss_rate": "1/s", "tangent": "1",
    **dict.fromkeys(RATES, "m^3/s"),
}  # fmt: skip
# A run can continue another one only if these are equal.
FIXED = (
    "channel_length", "domain_length", "inner_radius", "outer_radius", "propellant",
    "charge_states",
)  # fmt: skip


FIRST_FRACTIONS = (0.01, 0.001)  # of the electrons, from ions of charge 2 and 3


class Beginning(NamedTuple):
    """A first state, and how a run continues from it.

    whole: whether the state is complete, as left by another run. resistance: series resistance in
    ohm during the first hold_s, before the run begins; None takes the thruster's. note: warning on
    the start.
    """

    state: AxialState
    whole: bool = False
    hold_s: float = 0.0
    resistance: float | None = None
    note: str = ""


@dataclass(frozen=True)
class GuessedStart:
    """A discharge-like plasma: T_e peaks at the exit, where the neutrals are depleted."""

    label: ClassVar[str] = "guessed profiles"

    def begin(self, model: AxialModel, z: Profile, parameters: str) -> Beginning:
        channel_length = json.loads(parameters)["thruster"]["channel_length"]
        place = z / channel_length  # 1 at the exit
        n_i = np.full(z.size, 5e17)
        u_i = -1000.0 + 8000.0 * place
        n_n = _gas(model) * np.clip(1.0 - place, 0.05, 1.0)
        T_e = model.anode_T_e_eV + 10.0 * np.exp(-0.5 * ((place - 1.0) / 0.4) ** 2)
        return Beginning(_state(parameters, [n_i], [n_i * u_i], n_n, T_e))


@dataclass(frozen=True)
class ColdStart:
    """A hard start: a thin, cold, uniform plasma in a channel full of gas, which then ignites.

    Parameters
    ----------
    n_i : float, default 3e+17
        Density of the ions in m^-3.
    u_i : float, default 1000.0
        Speed of the ions in m/s.
    T_e_eV : float, default 3.0
        Electron temperature in eV.

    Raises
    ------
    ValueError
        If a number is not positive.
    """

    n_i: float = 3e17
    u_i: float = 1000.0
    T_e_eV: float = 3.0

    def __post_init__(self) -> None:
        check_positive(self, "n_i", "u_i", "T_e_eV")

    @property
    def label(self) -> str:
        return f"a uniform plasma of {self.n_i} m^-3, {self.T_e_eV} eV, {self.u_i} m/s"

    def begin(self, model: AxialModel, z: Profile, parameters: str) -> Beginning:
        n_i, T_e = np.full(z.size, self.n_i), np.full(z.size, self.T_e_eV)
        return Beginning(_state(parameters, [n_i], [self.u_i * n_i], _gas(model), T_e))


@dataclass(frozen=True)
class SoftStart:
    """A soft start: a discharge kept quiet by a high series resistance, which is then removed.

    Parameters
    ----------
    resistance : float, default 40.0
        Series resistance in the quiet phase, in ohm.
    hold_s : float, default 0.0015
        Duration of the quiet phase in s.

    Raises
    ------
    ValueError
        If a number is not positive.
    """

    resistance: float = 40.0
    hold_s: float = 1.5e-3

    def __post_init__(self) -> None:
        check_positive(self, "resistance", "hold_s")

    @property
    def label(self) -> str:
        return f"a discharge kept quiet by {self.resistance} ohm for {self.hold_s} s"

    def begin(self, model: AxialModel, z: Profile, parameters: str) -> Beginning:
        guessed = GuessedStart().begin(model, z, parameters)
        return guessed._replace(hold_s=self.hold_s, resistance=self.resistance)


@dataclass(frozen=True, eq=False)
class Restart:
    """The end of another run, from which this one continues.

    The operating point, the transport and the circuit may differ. On another grid the profiles are
    interpolated.

    Parameters
    ----------
    run : Dataset or str or Path
        A Dataset of `simulate`, or the path of a NetCDF file of one.

    Raises
    ------
    ValueError
        If it is not such a run, it diverged, or its thruster differs.
    """

    run: xr.Dataset | str | Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "run", _ended_run(self.run))

    @property
    def _end(self) -> xr.Dataset:
        assert isinstance(self.run, xr.Dataset)
        return self.run

    @property
    def label(self) -> str:
        digest = hashlib.sha256()
        for name in sorted(n for n in map(str, self._end.data_vars) if n.startswith(END)):
            digest.update(self._end[name].values.tobytes())
        return f"the end of another run ({digest.hexdigest()[:12]})"

    def begin(self, model: AxialModel, z: Profile, parameters: str) -> Beginning:
        _check_same_thruster(self._end.attrs["parameters"], parameters)
        points = self._end["z"].values
        same = np.array_equal(points, z[1:-1])
        charges = json.loads(parameters)["thruster"]["charge_states"]

        def cells(name: str) -> Profile:
            values = self._end[END + name].values
            return np.pad(values, 1, mode="edge") if same else np.interp(z, points, values)

        ions, flux = ([cells(_of(name, k)) for k in range(charges)] for name in SPECIES)
        state = _state(parameters, ions, flux, cells("n_n"), cells("T_e_eV"))
        state.drift_eV[1:-1] = cells("drift_eV")[1:-1]
        if END + "tangent" in self._end:
            state.tangent[:] = cells("tangent")
        current = state.instant[recorded.CURRENT] = float(self._end.attrs["end_I_d"])
        state.instant[recorded.SUPPLY_CURRENT] = self._end.attrs.get("end_I_supply", current)
        at_rest = model.supply[0] - model.resistance * current
        state.instant[recorded.VOLTAGE] = self._end.attrs.get("end_V", at_rest)
        if not same:
            return Beginning(state, note=f"interpolated from {points.size} to {z.size - 2} cells")
        state.energy[:], state.E[:] = cells("energy_e"), cells("E_z")
        state.wall_loss[:] = cells("wall_loss_rate")
        for k, name in enumerate(RATES[: len(state.rates)]):
            state.rates[k] = cells(name)
        return Beginning(state, whole=True)


# Each has a unique `label`, and makes the first state from the centres z of all cells in m, ghosts
# included, and the run's parameters as JSON.
Start = GuessedStart | ColdStart | SoftStart | Restart


def _gas(model: AxialModel) -> Profile:
    """Density of the neutrals without ionisation, in m^-3."""
    at_faces = model.neutral_inflow / (model.neutral_speed * model.spread_at)
    return np.pad(0.5 * (at_faces[1:] + at_faces[:-1]), 1, mode="edge")


def _of(name: str, k: int) -> str:
    """Variable name by charge: `n_i` of the first charge, `n_i2` of the second."""
    return name if k == 0 else f"{name}{k + 1}"


def end_of(state: AxialState) -> dict[str, tuple[Profile, str]]:
    """The arrays that `Restart` reads, with units, by the names of a Dataset's variables."""
    charges = len(state.n_i)
    cells = (state.n_n, state.T_e_eV, state.energy, state.drift_eV, state.E, state.wall_loss)
    kept = dict(zip(CELLS, cells, strict=True))
    for k in range(charges):
        kept |= {_of("n_i", k): state.n_i[k], _of("flux_i", k): state.flux_i[k]}
    kept |= dict(zip(RATES, state.rates, strict=False))
    if state.tangent.any():
        kept["tangent"] = state.tangent
    return {END + n: (v[1:-1].copy(), UNITS[n.rstrip("23")]) for n, v in kept.items()}


def _state(
    parameters: str,
    n_i: Sequence[Profile],
    flux_i: Sequence[Profile],
    n_n: Profile,
    T_e_eV: Profile,
) -> AxialState:
    """A state with these profiles; a single ion profile means singly charged ions."""
    size, charges = n_n.size, json.loads(parameters)["thruster"]["charge_states"]
    n, g = np.array(n_i), np.array(flux_i)
    if len(n) < charges:  # few electrons come from ions of higher charges
        fractions = np.array(FIRST_FRACTIONS[: charges - 1])
        given = np.append(1.0 - fractions.sum(), fractions / np.arange(2.0, charges + 1.0))[:, None]
        n, g = given * n, given * np.sqrt(np.arange(1.0, charges + 1.0))[:, None] * g
    n_e = n.T @ np.arange(1.0, charges + 1.0)
    zeros = np.zeros((3, size))
    return AxialState(
        n_i=n, flux_i=g, n_n=n_n.copy(), T_e_eV=T_e_eV.copy(), energy=1.5 * n_e * T_e_eV,
        drift_eV=zeros[0], n_e=n_e, flux_q=zeros[1], log_n=np.ones((2, size)), E=zeros[2],
        rates=np.zeros((charges * (charges + 1) // 2, size)), wall_loss=np.zeros(size),
        tangent=np.zeros(size), instant=np.zeros(len(recorded.SERIES_SUMS)),
        clock=np.zeros(1), hottest_eV=np.zeros(1),
    )  # fmt: skip


def stored_energy(state: AxialState, model: AxialModel) -> float:
    """Thermal energy of the electrons in J."""
    return E_CHARGE * model.area * float((state.energy * model.spread)[1:-1] @ model.dz[1:-1])


def _ended_run(run: xr.Dataset | str | Path) -> xr.Dataset:
    if not isinstance(run, xr.Dataset):
        path = Path(run)
        reader_of(path)  # it must be there, and lead to no other file
        with (
            damage_named(path),
            xr.open_dataset(path, engine="h5netcdf", decode_times=False) as stored,
        ):
            ends = [name for name in stored.data_vars if str(name).startswith(END)]
            run = stored[ends].load()
    if END + "n_n" not in run or "parameters" not in run.attrs:
        raise ValueError(
            f"a restart must be a run of simulate, which keeps its end (end_n_n, ...): this one "
            f"has {list(run.data_vars)[:12]}"
        )
    if run.attrs["status"] == "diverged":
        raise ValueError(
            "a run continues only from one that did not diverge, and this one did: its end "
            "is no physics; start from ColdStart or SoftStart"
        )
    return run


def _check_same_thruster(theirs: str, ours: str) -> None:
    before: Mapping[str, object] = read_json(theirs)["thruster"]
    now: Mapping[str, object] = json.loads(ours)["thruster"]
    for name in FIXED:
        if before.get(name) != now.get(name):
            raise ValueError(
                f"a run continues only in the same thruster: {name} was {before.get(name)} and is "
                f"{now.get(name)}; start from ColdStart or SoftStart"
            )
