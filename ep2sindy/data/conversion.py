"""Conversion from the unit used in a file to the unit that our name for the quantity implies."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from ep2sindy.library.units import (
    PLAIN,
    check_unit,
    is_count,
    netcdf_powers,
    registry,
    unit_errors,
    unit_product,
)

if TYPE_CHECKING:
    import xarray as xr

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
    stated = str(array.attrs.get("units", ""))
    if is_variable and unit == stated and is_count(unit):
        return array.drop_attrs().assign_attrs(units=unit)
    factor, offset, target = conversion(ours, unit, is_variable=is_variable)
    if stated not in ("", "1") and not same_unit(unit, stated):
        raise ValueError(
            f"the unit of {ours} must agree with the file: the mapping says {unit!r}, the file "
            f"{stated!r}; set it to what the numbers count"
        )
    if (factor, offset) != (1.0, 0.0):
        array = array * factor + offset
    return array.drop_attrs().assign_attrs(units=target)


def conversion(ours: str, unit: str, *, is_variable: bool = False) -> tuple[float, float, str]:
    """Factor, offset and target unit that convert numbers in `unit` to the unit of our name.

    A variable without a unit stays a pure number, whatever it is called.
    """
    if is_variable and unit == "1":
        return 1.0, 0.0, unit
    suffixes = (u for suffix, u in SUFFIX_UNITS.items() if ours.endswith(f"_{suffix}"))
    known = KNOWN_UNITS if is_variable else COORDINATE_UNITS | KNOWN_UNITS
    target = known.get(ours) or next(suffixes, None)
    if unit == (target or "1") and unit in PLAIN | {"1"}:
        return 1.0, 0.0, unit
    try:
        given = _ruler(unit)
        given = given.to("kelvin") if target and given.check("[temperature]") else given
        # A temperature in eV means k_B T.
        ruler = given.to(target, "boltzmann") if target else given.to_base_units()
    except unit_errors() as error:
        raise ValueError(
            f"the unit of {ours} must be one that converts to {target or 'SI'}: {unit!r} came "
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


def converts(ours: str, unit: str, *, is_variable: bool = False) -> bool:
    """True for a unit, other than that of a pure number, which converts to that of our name."""
    if unit in ("", "1"):
        return False
    try:
        conversion(ours, unit, is_variable=is_variable)
    except ValueError:
        return False
    return True


def same_unit(unit: str, stated: str) -> bool:
    """True if both texts mean the same unit, or if one of them is not a unit at all."""
    try:
        a, b = _ruler(unit).to_base_units(), _ruler(counted_in(stated)).to_base_units()
    except unit_errors():
        return True
    return a.check(b.dimensionality) and np.allclose(a.magnitude, b.magnitude, rtol=1e-9, atol=0.0)


def counted_in(stated: str) -> str:
    """Unit of a NetCDF time attribute: `days` for `days since 1970-01-01`."""
    return re.split(r"\s+since\s", stated, maxsplit=1)[0].strip()


def _ruler(unit: str) -> Any:
    """The values 0, 1 and 2 in a unit: they reveal its factor, its offset and any nonlinearity."""
    check_unit(unit)
    one: Any = registry().Quantity(netcdf_powers(unit))
    return registry().Quantity(np.arange(3.0) * one.magnitude, one.units)
