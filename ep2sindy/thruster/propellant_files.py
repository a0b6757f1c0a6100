"""Propellants read from tables: the package's own gases, and a user's."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ep2sindy.data.readers.source import file_named
from ep2sindy.thruster.constants import ATOMIC_MASS
from ep2sindy.thruster.propellants import FURTHER_IONIZATIONS, FurtherIonization, PropellantTable
from ep2sindy.thruster.tables import read_columns

GASES = Path(__file__).parent / "gases"
RATES = ("ionization", "excitation", "momentum")


def propellant(name: str, *, coulomb_weight: float = 1.0) -> PropellantTable:
    """A gas that comes with the package: xenon, krypton, argon, or xenon_5eV.

    Parameters
    ----------
    name : str
        Name of the gas.
    coulomb_weight : float, default 1.0
        Factor on the frequency of Coulomb collisions.

    Returns
    -------
    PropellantTable
        Tables of its rates, linear between their rows.

    Raises
    ------
    ValueError
        If the gas is unknown.

    Notes
    -----
    Xenon and krypton are the tables of HallThruster.jl, for T_e up to 170 and 100 eV, with ions of
    up to three charges. Argon is computed from the cross sections of Phelps & Petrovic (1999), up
    to 100 eV. xenon_5eV has the ionization table of the stored runs of HallThruster.jl v0.22,
    linear over 5 eV. Each file in `gases/` names its sources. The default `XenonFits` are formulas.
    """
    if name == "xenon_5eV":
        return _resample_ionization(propellant("xenon", coulomb_weight=coulomb_weight), name)
    with (GASES / "gases.toml").open("rb") as file:
        gases = tomllib.load(file)
    if name not in gases:
        raise ValueError(
            f"there are the propellants {[*sorted(gases), 'xenon_5eV']}, got {name!r}; a table "
            "of your own is read by ep2sindy.thruster.read_propellant"
        )
    gas = read_propellant(GASES / f"{name}.csv", **gases[name])
    return replace(gas, coulomb_weight=coulomb_weight)


def _resample_ionization(xenon: PropellantTable, name: str) -> PropellantTable:
    """Xenon with the ionisation table of 5 eV steps, resampled at 1 eV of mean energy."""
    stored = _columns(GASES / "xenon_ionization_5eV.csv")
    energy = np.arange(1.0 + np.floor(stored["mean_energy_eV"][-1]))
    T_e_eV = energy / 1.5

    def resampled(rate: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(np.interp(T_e_eV, xenon.T_e_eV, rate))

    return replace(
        xenon,
        name=name,
        T_e_eV=tuple(T_e_eV),
        ionization_rate=tuple(np.interp(energy, stored["mean_energy_eV"], stored["ionization"])),
        excitation_rate=resampled(xenon.excitation_rate),
        momentum_rate=resampled(xenon.momentum_rate),
        further=tuple(replace(each, rate=resampled(each.rate)) for each in xenon.further),
    )


def read_propellant(
    path: str | Path,
    *,
    mass_u: float,
    ionization_eV: float,
    excitation_eV: float,
    further_eV: Mapping[str, float] | None = None,
    name: str | None = None,
) -> PropellantTable:
    """Read a gas of your own from a CSV file whose header names the columns.

    Parameters
    ----------
    path : str or Path
        The file. Its columns are T_e_eV or mean_energy_eV (which is 1.5 T_e), increasing;
        ionization, excitation and momentum, rate coefficients in m^3/s; for a second charge
        double_ionization (X -> X2+) and second_ionization (X+ -> X2+); for a third
        triple_ionization (X -> X3+), ion_double_ionization (X+ -> X3+) and third_ionization (X2+ ->
        X3+). Lines that begin with # are ignored.
    mass_u : float
        Mass of the atom in atomic mass units.
    ionization_eV, excitation_eV : float
        Energy that an electron loses per event, in eV.
    further_eV : Mapping, optional
        The same for higher charges, by column of the file: `{"double_ionization": 33.1, ...}`.
    name : str, optional
        Name of the gas. None takes that of the file.

    Returns
    -------
    PropellantTable
        Tables of its rates, linear between their rows.

    Raises
    ------
    ValueError
        If the file or a column is missing, a column is unknown, or there is a gap.
    """
    path, further_eV = Path(path), further_eV or {}
    columns = _columns(path)
    scale = {"T_e_eV": 1.0, "mean_energy_eV": 1.5}
    first = [column for column in scale if column in columns]
    known = {*scale, *RATES, *FURTHER_IONIZATIONS.values()}
    if len(first) != 1 or set(columns) - known or set(RATES) - set(columns):
        raise ValueError(
            f"{path} must have the columns T_e_eV or mean_energy_eV, {', '.join(RATES)}, and may "
            f"have {', '.join(FURTHER_IONIZATIONS.values())}: it has {list(columns)}"
        )
    if {*further_eV} != {*columns} & {*FURTHER_IONIZATIONS.values()}:
        raise ValueError(
            f"every further ionisation of {path} needs both its column and its energy in "
            f"further_eV: the columns are {list(columns)}, the energies of {list(further_eV)}"
        )
    rates: dict[str, Any] = {f"{key}_rate": columns[key] for key in RATES}
    further = tuple(
        FurtherIonization(*pair, rate=columns[key], energy_eV=further_eV[key])
        for pair, key in FURTHER_IONIZATIONS.items()
        if key in columns
    )
    with file_named(path):
        return PropellantTable(
            name=name or path.stem,
            mass=mass_u * ATOMIC_MASS,
            ionization_eV=ionization_eV,
            excitation_eV=excitation_eV,
            T_e_eV=tuple(value / scale[first[0]] for value in columns[first[0]]),
            further=further,
            **rates,
        )


def _columns(path: Path) -> dict[str, tuple[float, ...]]:
    """Columns of a CSV file by name; every cell must be a number."""
    header, columns = read_columns(path, "table of a propellant")
    return dict(zip(header, map(tuple, columns.tolist()), strict=False))  # none without a header
