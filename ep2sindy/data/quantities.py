"""Names and units in files: conversion to SI, quantities of a thruster, axes, counters."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from ep2sindy.data.numbers import without_marks
from ep2sindy.data.readers.table_layout import split_name
from ep2sindy.library.units import (
    PLAIN,
    UNIT_ERRORS,
    check_unit,
    is_count,
    netcdf_powers,
    registry,
    time_unit_in,
    unit_product,
)
from ep2sindy.runtime.values import Columns

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


STEP_DOUBT = "step_doubt"  # attribute of a field: how dt_s contradicts the file's own times


class DoubtfulUnit(UserWarning):
    """Warns that a step contradicts the file's own times."""


def _names(text: str) -> frozenset[tuple[str, ...]]:
    """Names between commas, each a sorted tuple of words as `words_of` returns it."""
    return frozenset(tuple(sorted(name.split())) for name in text.split(","))


# Names that say by themselves what they are.
FULL = {
    "n_i": _names("ion density, plasma density"),
    "n_n": _names("neutral density"),
    "u_iz": _names("ion velocity z, ion axial velocity, ion velocity"),
    "u_ir": _names("ion velocity r, ion radial velocity"),
    "T_e_eV": _names("electron temperature"),
    "R_ion": _names("ionization rate"),
    "I_d": _names("discharge current"),
    "V_d": _names("discharge voltage"),
}

# Names that other things bear too, which count only next to a unit that fits.
SHORT = {
    "n_i": _names("n i, ni, n ion, nion, n plasma, i density"),
    "n_n": _names("n n, nn, n neutral, nneutral, na, n a, ng, n g"),
    "u_iz": _names("u i z, uiz, u i, ui, v i z, viz, v i, vi, u z, uz, v z, vz"),
    "u_ir": _names("u i r, uir, v i r, vir, u r, ur, v r, vr"),
    "T_e_eV": _names("t e, te, tev, t e ev, t electron, e temperature"),
    "R_ion": _names("r i, r ion, rion, k ion, kion, k i, rate, i rate, k iz, kiz, iz rate"),
    "I_d": _names("i d, id, d current, current, idis, i discharge"),
    "V_d": _names("v d, vd, u d, ud, d voltage, voltage, vdis, udis"),
}

ELECTRONS = _names("n e, ne, electron density")  # their density is n_i where no charge is left

AXIS_NAMES = {
    "time": _names("t, time, times, timestamp, tvec, seconds, sec"),
    "z": _names("z, axial, zz"),
    "r": _names("r, radial, rr"),
}

# Names of what numbers or labels samples: no time without a step, and no signal.
COUNTERS = frozenset({
    "cycle", "step", "iteration", "iter", "it", "frame", "index", "idx", "sample", "samples",
    "counter", "count", "sequence", "seq", "row", "record", "id", "ids", "no", "nr",
})  # fmt: skip

# Variables that can be computed if a file lacks them: name -> (source variable, step of `prepare`).
MADE_FROM = {"R_ion": ("T_e_eV", "ep2sindy.thruster.ionization_rate")}

# Meaning -> words that stand for it in names; "" for words without meaning.
MEANINGS = {
    "density": "densities dens number",
    "ion": "ions",
    "neutral": "neutrals neut atom atoms",
    "velocity": "vel speed",
    "radial": "radius rad",
    "temperature": "temp",
    "electron": "electrons elec",
    "discharge": "anode",
    "current": "curr",
    "ionization": "ionisation",
    "": "coefficient coeff coef grid pos position coord coordinate coords points cells centers "
    "centres axis vec vector cell avg mean average averaged data field si",
}
WORDS = {word: meaning for meaning, words in MEANINGS.items() for word in words.split()}

# HallThruster.jl's names, for the lowest charge state.
HALLTHRUSTER = {
    r"ions\.\w+\.0\.n|ni\.0|ni_1": "n_i",
    r"ions\.\w+\.0\.u|ui\.0|ui_1": "u_iz",
    r"neutrals\.\w+\.n": "n_n",
    r"grid|grid\.(z|cell_centers|cellcenters)": "z",
}

# Names of scalars that give the time step in s, or the sampling rate in Hz.
STEPS = frozenset({"dt", "dts", "deltat", "timestep", "sampletime", "samplinginterval"})
RATES = frozenset({"fs", "samplingrate", "samplerate", "samplingfrequency", "fshz"})

# Units written at the end of a name. Their case counts: `mM` is no millimetre.
ENDINGS = {
    "s": "s", "ms": "ms", "us": "us", "ns": "ns", "m": "m", "cm": "cm", "mm": "mm", "eV": "eV",
    "ev": "eV", "K": "K", "A": "A", "mA": "mA", "V": "V", "mV": "mV", "kV": "kV", "m3": "m^-3",
    "cm3": "cm^-3", "m_s": "m/s", "km_s": "km/s", "m3_s": "m^3/s", "cm3_s": "cm^3/s",
}  # fmt: skip


def split_unit(name: str) -> tuple[str, str]:
    """Split a unit off the end of a name: `t_us` gives `t` and `us`; the unit is "" if absent."""
    for ending in sorted(ENDINGS, key=len, reverse=True):
        if name.endswith(f"_{ending}") and len(name) > len(ending) + 1:
            return name[: -len(ending) - 1], ENDINGS[ending]
    return name, ""


def last_of(name: str) -> str:
    """Last part of a path such as `plasma/n_i`; a slash in brackets, as in `x (1/ml)`, is none."""
    return re.split(r"[/.]", re.sub(r"(?<=.)\s*[(\[].*?[)\]]", "", name).rstrip(". "))[-1]


def words_of(name: str) -> tuple[str, ...]:
    """Words of a name, sorted: `ionDensity` and `density_ion` give the same. T alone is no t."""
    if name == "T":
        return ("T",)
    parts = (part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name))
    return tuple(sorted(word for word in (WORDS.get(part, part) for part in parts) if word))


def step_given_by(name: str, value: float) -> float | None:
    """Time step in s that a scalar of this name gives, or None if it is no step or rate."""
    last = last_of(name)
    plain = re.sub(r"[^a-z]", "", last.lower())
    if not (np.isfinite(value) and value > 0):
        return None
    return value if plain in STEPS else 1.0 / value if plain in RATES else None


def is_counter_name(name: str) -> bool:
    """True for the name of what numbers samples, or labels them: `frame`, `id`, `Sample_No`."""
    words = words_of(last_of(name))
    return bool(words) and {*words} <= COUNTERS


def _in_hallthruster(name: str) -> str | None:
    """Our name for one of HallThruster.jl."""
    return next((ours for text, ours in HALLTHRUSTER.items() if re.fullmatch(text, name)), None)


def axis_of(name: str) -> str | None:
    """The axis that a name in a file says, with or without a unit at its end; None for none."""
    last = last_of(name)
    if (ours := _in_hallthruster(name)) in AXIS_NAMES:
        return ours
    for axis, names in AXIS_NAMES.items():
        if {words_of(last), words_of(split_unit(last)[0])} & names:
            return axis
    return "time" if time_unit_in(last) else None


def axis_unit(axis: str, name: str, file_unit: str) -> str:
    """Unit of an axis: the one in the file, or in its name; "" if neither is given."""
    in_name = (time_unit_in(last_of(name)) or "") if axis == "time" else ""
    options = (file_unit, in_name, split_unit(last_of(name))[1])
    unit = COORDINATE_UNITS[axis]
    return next((u for u in options if u and (u == unit or converts(axis, u))), "")


def quantity_of(name: str, file_unit: str, *, plasma: bool = False) -> tuple[str, str] | None:
    """Our name for an array, and the unit it has, "" for none; None if it keeps its own name.

    A short name needs a unit that fits, given or at its end; a full one stands for itself, unless
    its unit contradicts it. file_unit: "" for none. plasma: short names stand for themselves too.
    """
    last = last_of(name)
    base, ending = split_unit(last)
    unit = file_unit or ending
    spelled = {words_of(text) for text in (name, last, base)} if not last.isdigit() else set()
    exact = (_in_hallthruster(name), last, base)
    for ours, full in FULL.items():
        if ours in exact or spelled & (full | SHORT[ours]):
            is_full = plasma or bool(spelled & full)
            fits = converts(ours, unit, is_variable=True) if unit else is_full
            return (ours, unit) if fits else None
    return None


def own_unit(ours: str, file_unit: str) -> str:
    """Unit that a file states, or that the suffix of a name promises, if it converts; else "1".

    A count of named things that the file states, such as `animals/ml`, stays as it is.
    """
    if file_unit and is_count(file_unit):
        return file_unit
    options = (file_unit, _promised_unit(ours))
    return next((u for u in options if u and converts(ours, u, is_variable=True)), "1")


def columns_in_si(table: pd.DataFrame) -> tuple[Columns, dict[str, str]]:
    """Samples of a table's columns by the units in their names, and state -> unit."""
    values = np.empty(table.shape)
    units: dict[str, str] = {}
    for k, label in enumerate(table.columns):
        name, in_label = split_label(label)
        name, unit = quantity_of(name, in_label) or (name, own_unit(name, in_label))
        factor, zero = 1.0, 0.0
        if not is_count(unit):
            factor, zero, unit = conversion(name, unit or "1", is_variable=True)
        values[:, k] = factor * without_marks(table[label].to_numpy(dtype=np.float64)) + zero
        units[name] = unit
    return values, units


def split_label(label: str) -> tuple[str, str]:
    """Name and unit of a table's column; a label of one word holds the unit in its name."""
    return (label, "") if label.isidentifier() else split_name(label)


def time_unit(name: object) -> str | None:
    """Unit of a column of times that is called so, seconds by default; None for another column."""
    if not isinstance(name, str) or axis_of(name) != "time":
        return None
    return axis_unit("time", name, split_label(name)[1]) or "s"


# Conversion from the unit used in a file to the unit that our name for the quantity implies.


COORDINATE_UNITS = {"time": "s", "z": "m", "r": "m"}

# Units of our usual names. A unit of another dimension is a mistake in the mapping.
KNOWN_UNITS = {
    "n_i": "m^-3", "n_n": "m^-3", "u_iz": "m/s", "u_ir": "m/s", "R_ion": "m^3/s",
    "I_d": "A", "V_d": "V", "T_e_eV": "eV",
}  # fmt: skip

NAMED_UNITS = ("V", "A", "W", "N", "Pa", "J", "T")

# Names with one of these suffixes keep this unit; all others are SI.
SUFFIX_UNITS = {"eV": "eV", "kHz": "kHz", "MHz": "MHz", "mg_s": "mg/s", "mN": "mN", "us": "us"}


def to_si(array: xr.DataArray, ours: str, unit: str, *, is_variable: bool = False) -> xr.DataArray:
    """Convert an array to SI, or to the unit of its name's suffix.

    No arithmetic is done if the unit is already right, nor for a count of named things that the
    file itself states, such as `animals/ml`.
    is_variable: `ours` names a variable; a variable called z is then not the coordinate.
    Raises ValueError for an unknown unit, one that the suffix cannot hold, or one that
    contradicts the file's own attribute.
    """
    file_unit = str(array.attrs.get("units", ""))
    if is_variable and unit == file_unit and is_count(unit):
        return array.drop_attrs().assign_attrs(units=unit)
    factor, offset, target = conversion(ours, unit, is_variable=is_variable)
    if file_unit not in ("", "1") and not same_unit(unit, file_unit):
        raise ValueError(
            f"the unit of {ours} must agree with the file: the mapping says {unit!r}, the file "
            f"{file_unit!r}; set it to what the numbers count"
        )
    if (factor, offset) != (1.0, 0.0):
        from ep2sindy.data.blocks import scale  # here, for it loads xarray

        array = scale(array, factor=factor, offset=offset)
    return array.drop_attrs().assign_attrs(units=target)


def conversion(ours: str, unit: str, *, is_variable: bool = False) -> tuple[float, float, str]:
    """Factor, offset and target unit that convert numbers in `unit` to the unit of our name.

    A variable without a unit stays a pure number, whatever it is called.
    """
    if is_variable and unit == "1":
        return 1.0, 0.0, unit
    known = KNOWN_UNITS if is_variable else COORDINATE_UNITS | KNOWN_UNITS
    target = known.get(ours) or _promised_unit(ours) or None
    if unit == (target or "1") and unit in PLAIN | {"1"}:
        return 1.0, 0.0, unit
    try:
        given = _ruler(unit)
        given = given.to("kelvin") if target and given.check("[temperature]") else given
        # A temperature in eV means k_B T.
        ruler = given.to(target, "boltzmann") if target else given.to_base_units()
    except UNIT_ERRORS as error:
        raise ValueError(
            f"the unit of {ours} must be one that converts to {target or 'SI'}, got {unit!r} "
            f"({error or type(error).__name__}); write for example 'cm^-3', '1e19 m^-3', 'km/s'"
        ) from None
    zero, one, two = (float(value) for value in ruler.magnitude)
    powers = ruler.dimensionality.values()
    if not np.isclose(two - one, one - zero, atol=0.0) or any(power % 1 for power in powers):
        raise ValueError(
            f"the unit of {ours} must be a multiple of SI units: {unit!r} is not; write a gauss "
            "as '1e-4 T', and no decibels"
        )
    factor = float(f"{one - zero:.15g}")  # cm^-3 is 1e6 m^-3, not 999999.9999999999
    if target is None:
        unchanged = np.array_equal(given.magnitude, ruler.magnitude)
        plain = str(given.units if unchanged else ruler.units)
        named = (u for u in NAMED_UNITS if registry().Quantity(1, u).check(ruler.dimensionality))
        target = next(named, plain)
    return factor, zero, unit_product([(target, 1)])


def _promised_unit(ours: str) -> str:
    """Unit that the suffix of a name promises; "" for a name without one."""
    return next((u for suffix, u in SUFFIX_UNITS.items() if ours.endswith(f"_{suffix}")), "")


def converts(ours: str, unit: str, *, is_variable: bool = False) -> bool:
    """True for a unit, other than that of a pure number, which converts to that of our name."""
    if unit in ("", "1"):
        return False
    try:
        conversion(ours, unit, is_variable=is_variable)
    except ValueError:
        return False
    return True


def same_unit(unit: str, file_unit: str) -> bool:
    """True if both texts mean the same unit, or if one of them is not a unit at all."""
    try:
        a, b = _ruler(unit).to_base_units(), _ruler(counted_in(file_unit)).to_base_units()
    except UNIT_ERRORS:
        return True
    return a.check(b.dimensionality) and np.allclose(a.magnitude, b.magnitude, rtol=1e-9, atol=0.0)


def counted_in(attribute: str) -> str:
    """Unit of a NetCDF time attribute: `days` for `days since 1970-01-01`."""
    return re.split(r"\s+since\s", attribute, maxsplit=1)[0].strip()


def _ruler(unit: str) -> Any:
    """The values 0, 1 and 2 in a unit: they reveal its factor, its offset and any nonlinearity."""
    check_unit(unit)
    one: Any = registry().Quantity(netcdf_powers(unit))
    return registry().Quantity(np.arange(3.0) * one.magnitude, one.units)
