"""Units as short strings: "m^-3", "m^3/s", "1". Only names are handled; values stay SI."""

from __future__ import annotations

import math
import re
import tokenize
from collections.abc import Iterable
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pint


# Symbols that are their own base symbol: what they mean needs no registry.
PLAIN = frozenset({"s", "m", "A", "V", "eV"})


@cache
def registry() -> pint.UnitRegistry:
    """The one registry of the package; importing and building it takes a quarter of a second."""
    import pint

    return pint.UnitRegistry()


@cache
def _powers(unit: str) -> dict[str, float]:
    """Base symbol -> exponent of one unit string; an unknown unit stays a symbol of its own."""
    if unit in ("", "1"):
        return {}
    if unit in PLAIN:
        return {unit: 1.0}
    import pint

    try:
        parsed = registry().parse_units(unit)
    except (pint.PintError, AttributeError, ValueError, TypeError):
        return {unit: 1.0}
    return {registry().get_symbol(name): float(p) for name, p in parsed._units.items()}  # type: ignore[arg-type]


@cache
def unit_like(text: str, like: str | None = None) -> bool:
    """Whether a text is a unit, `like`: of the same kind as this one."""
    import pint

    try:
        parsed = registry().parse_units(netcdf_powers(text)) if text.strip() else None
    except (pint.PintError, AttributeError, ValueError, TypeError, tokenize.TokenError):
        return False
    if parsed is None or like is None:
        return parsed is not None
    return parsed.is_compatible_with(like)


def netcdf_powers(unit: str) -> str:
    """`m-3`, as netCDF writes it, as `m^-3`."""
    return re.sub(r"\b([A-Za-zµ]+)(-?\d+)\b", r"\1^\2", unit)


def unit_product(factors: Iterable[tuple[str, int]]) -> str:
    """Multiply units raised to integer powers: [("m^-3", 2), ("m^3/s", 1)] -> "m^-3 s^-1"."""
    total: dict[str, float] = {}
    for unit, power in factors:
        for symbol, exponent in _powers(unit).items():
            total[symbol] = total.get(symbol, 0.0) + power * exponent
    parts = [s if p == 1 else f"{s}^{p:g}" for s, p in total.items() if p != 0]
    return " ".join(parts) or "1"


def prefixed(value: float) -> tuple[float, str]:
    """Factor and SI prefix that bring a value between 1 and 1000: 1.4e4 -> (1e-3, "k")."""
    prefixes = {-9: "n", -6: "u", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
    power = 3 * math.floor(math.log10(value) / 3) if value > 0 else 0
    power = min(max(power, -9), 9)
    return 10.0**-power, prefixes[power]
