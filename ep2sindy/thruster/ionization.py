"""The ionization rate coefficient of a field that holds the electron temperature."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.thruster import propellants
from ep2sindy.thruster.propellant_files import propellant
from ep2sindy.thruster.tables import read_columns


def ionization_rate(
    field: xr.Dataset, *, gas: str = "xenon", table: str | Path | None = None
) -> xr.Dataset:
    """Add R_ion in m^3/s, the ionization rate coefficient of a gas, computed from T_e_eV.

    Parameters
    ----------
    field : Dataset
        Field with T_e_eV.
    gas : str, default 'xenon'
        "xenon", from the fits of `ep2sindy.thruster.propellants`; "krypton" or "argon", from the
        tables of `propellant`, linear between their rows.
    table : str or Path, optional
        CSV file of T_e in eV (increasing) and rate in m^3/s of any gas, used instead of `gas`,
        linear between its rows. Further columns and lines of text are ignored.

    Returns
    -------
    Dataset
        The field with R_ion.

    Raises
    ------
    ValueError
        If the field has R_ion already or no T_e_eV, or T_e_eV leaves a table. Tables are never
        extrapolated.
    """
    if "R_ion" in field:
        raise ValueError(
            "the field already has R_ion: leave this step out, or R_ion out of the file's mapping"
        )
    if "T_e_eV" not in field:
        raise ValueError(f"R_ion needs T_e_eV; this field has {list(field.data_vars)}")
    if table is not None and gas != "xenon":
        raise ValueError(
            f"a table says the rates of its own gas, got gas={gas!r} next to {table}; leave one out"
        )
    T_e_eV = field["T_e_eV"].astype(np.float64)
    rate: Callable = propellants.ionization_rate
    if table is not None or gas != "xenon":
        if table is not None:
            (T_eV, rates), hint = read_rate_table(Path(table)), f"extend {table}"
        else:
            known = propellant(gas)
            hint = "keep_where leaves cells out, or give a table of your own"
            T_eV, rates = np.array(known.T_e_eV), np.array(known.ionization_rate)
        low, high = float(T_e_eV.min()), float(T_e_eV.max())
        if low < T_eV[0] or high > T_eV[-1]:
            raise ValueError(
                f"T_e_eV must stay in the rate table, {T_eV[0]:g} to {T_eV[-1]:g} eV: it runs "
                f"from {low:g} to {high:g} eV; {hint}"
            )
        rate = partial(np.interp, xp=T_eV, fp=rates)
    R_ion = xr.apply_ufunc(rate, T_e_eV, dask="parallelized", output_dtypes=[np.float64])
    return field.assign(R_ion=R_ion.drop_attrs(deep=False).assign_attrs(units="m^3/s"))


def read_rate_table(path: Path) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
    """First two columns of a CSV file: T_e in eV, increasing, and rate in m^3/s."""
    _, columns = read_columns(path, "rate table")
    if min(columns.shape) < 2 or np.any(np.diff(columns[0]) <= 0):
        raise ValueError(
            "a rate table must have two columns, T_e in eV (increasing) and rate in m^3/s, and two "
            f"rows or more: {path} has {len(columns)} columns, the first {columns[0].tolist()}"
        )
    return columns[0], columns[1]
