"""The unit that an array's numbers count: stated, named, ours, or only likely."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from math import isclose

from ep2sindy.data.conversion import SUFFIX_UNITS, conversion
from ep2sindy.data.held import Held
from ep2sindy.data.mapping import Variable
from ep2sindy.data.quantities import AXES, Quantity, likely_time_unit, named_unit
from ep2sindy.library.units import unit_like


def is_of(unit: str, like: str) -> bool:
    return bool(unit) and unit != "1" and unit_like(unit, like=like)


def with_unit(ours: str, one: Held, quantity: Quantity, guesses: dict[str, str]) -> Variable:
    """The unit that the file says, its name's ending, ours, or else the likely one."""
    stated = one.unit if is_of(one.unit, quantity.unit) or converts(ours, one.unit) else ""
    stated = stated or _ending(ours, one.name)
    if not stated and not quantity.fits(one.size):
        likely = [
            unit for unit in quantity.others if quantity.fits(one.size, conversion(ours, unit)[0])
        ]
        if likely:
            guesses[ours] = (
                f"{ours} ({one.name!r}) is about {one.size:.2g}, as if the file counted in "
                f"{' or '.join(likely)}, and it names no unit: give it"
            )
            stated = likely[0]
    return Variable(one.name, stated or quantity.unit)


def with_time_unit(
    time: Variable,
    one: Held,
    variables: Mapping[str, Variable],
    said_s: float | None,
    guesses: dict[str, str],
) -> Variable:
    """The unit of time where the file names none: that in which its steps are those it says.

    Else a plasma's record shows it in its steps. said_s: the step that a scalar such as fs says.
    """
    if one.unit not in ("", "1") or _ending("time", one.name) or one.step is None:
        return time
    for unit in ("s", *AXES["time"].others):
        if said_s and isclose(one.step * conversion("time", unit)[0], said_s, rel_tol=1e-3):
            return replace(time, unit=unit)
    likely = likely_time_unit(one.step, variables)
    if likely is None:
        return time
    guesses["time"] = (
        f"time ({one.name!r}) goes in steps of {one.step:.2g}, as if the file counted in {likely}, "
        "and it names no unit: give it"
    )
    return replace(time, unit=likely)


def _ending(ours: str, name: str) -> str:
    """The unit at the end of a name, if our name can have it."""
    unit = named_unit(re.split(r"[/.]", name)[-1])[1]
    return unit if unit and converts(ours, unit) else ""


def converts(ours: str, unit: str, *, is_variable: bool = False) -> bool:
    if unit in ("", "1"):
        return False
    try:
        conversion(ours, unit, is_variable=is_variable)
    except ValueError:
        return False
    return True


def own_unit(ours: str, one: Held) -> str:
    """The unit that the file says, if numbers can be converted from it; else none."""
    suffixes = [unit for suffix, unit in SUFFIX_UNITS.items() if ours.endswith(f"_{suffix}")]
    options = (one.unit, named_unit(ours)[1] or "", *suffixes)
    return next((unit for unit in options if converts(ours, unit, is_variable=True)), "1")
