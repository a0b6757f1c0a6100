"""From the unit that a file counts in to the one that our name for the quantity means."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import xarray as xr

from ep2sindy.data.fields import COORDINATE_UNITS
from ep2sindy.library.units import (
    PLAIN,
    check_unit,
    netcdf_powers,
    registry,
    unit_errors,
    unit_product,
)

# What our usual names mean: a unit of another kind is a mistake in the mapping.
KNOWN_UNITS = {
    "n_i": "m^-3", "n_n": "m^-3", "u_iz": "m/s", "u_ir": "m/s", "R_ion": "m^3/s",
    "I_d": "A", "V_d": "V",
}  # fmt: skip

NAMED_UNITS = ("V", "A", "W", "N", "Pa", "J", "T")

# Names that end so keep this unit; all others are SI.
SUFFIX_UNITS = {"eV": "eV", "kHz": "kHz", "MHz": "MHz", "mg_s": "mg/s", "mN": "mN", "us": "us"}


def to_si(array: xr.DataArray, ours: str, unit: str, *, is_variable: bool = False) -> xr.DataArray:
    """Convert to SI, or to the unit of the name's suffix; a unit that fits already costs nothing.

    is_variable: a z is then a quantity of one's own, not the coordinate.
    Raises ValueError for an unknown unit, one that the suffix cannot hold, or one that
    contradicts the file's own attribute.
    """
    factor, offset, target = conversion(ours, unit, is_variable=is_variable)
    stated = str(array.attrs.get("units", ""))
    if stated not in ("", "1") and not same_unit(unit, stated):
        raise ValueError(
            f"the unit of {ours} must agree with the file: the mapping says {unit!r}, the file "
            f"{stated!r}; set it to what the numbers count"
        )
    if (factor, offset) != (1.0, 0.0):
        array = array * factor + offset
    return array.drop_attrs().assign_attrs(units=target)


def conversion(ours: str, unit: str, *, is_variable: bool = False) -> tuple[float, float, str]:
    """Factor, offset and target unit that take numbers in `unit` to the unit our name means."""
    suffixes = (u for suffix, u in SUFFIX_UNITS.items() if ours.endswith(f"_{suffix}"))
    known = KNOWN_UNITS if is_variable else COORDINATE_UNITS | KNOWN_UNITS
    target = known.get(ours) or next(suffixes, None)
    if unit == (target or "1") and unit in PLAIN | {"1"}:
        return 1.0, 0.0, unit
    try:
        given = _ruler(unit)
        given = given.to("kelvin") if target and given.check("[temperature]") else given
        # k_B T for a temperature that counts in eV
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


def same_unit(unit: str, stated: str) -> bool:
    """Whether both texts mean one unit; a text that is no unit says nothing against."""
    try:
        a, b = _ruler(unit).to_base_units(), _ruler(counted_in(stated)).to_base_units()
    except unit_errors():
        return True
    return a.check(b.dimensionality) and np.allclose(a.magnitude, b.magnitude, rtol=1e-9, atol=0.0)


def counted_in(stated: str) -> str:
    """The unit that times count: days, of `days since 1970-01-01`, as NetCDF says it."""
    return re.split(r"\s+since\s", stated, maxsplit=1)[0].strip()


def _ruler(unit: str) -> Any:
    """0, 1 and 2 of a unit, which show its factor, its offset and whether it is linear."""
    check_unit(unit)
    one: Any = registry().Quantity(netcdf_powers(unit))
    return registry().Quantity(np.arange(3.0) * one.magnitude, one.units)
