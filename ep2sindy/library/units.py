"""Units as short strings: "m^-3", "m^3/s", "1". Only the strings are handled; values stay in SI."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from tokenize import TokenError
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pint


# Symbols that pint keeps as they are, so that products of their powers need no registry.
PLAIN = frozenset(
    {"s", "step", "m", "A", "V", "eV", "K", "T", "kg", "Hz", "W", "N", "J", "C", "Pa"}
)
_PLAIN_FACTOR = re.compile(rf"({'|'.join(PLAIN)}|1)(?:\^(-?\d{{1,2}}))?")


# Permitted notation of a unit. Pint evaluates the text, so expensive expressions are excluded: no
# power of a power, no nested brackets.
_SIGNED = r"[({]?\s*[+-]?\d{1,2}(?:\.\d{1,2})?(?:/\d)?\s*[)}]?"
_POWER = rf"(?:\s*(?:\^|\*\*)\s*{_SIGNED})?"
_NUMBER = r"\d{1,20}(?:\.\d{0,20})?(?:[eE][+-]?\d{1,2})?"
_ONE = rf"(?:{_NUMBER}|[^\W\d]\w*(?:-\d{{1,2}}(?!\d))?|°\s?\w+|%){_POWER}"
_JOIN = r"(?:\s*[*/.·×]\s*|\s+)"
_FACTOR = rf"(?:{_ONE}|\({_ONE}(?:{_JOIN}{_ONE})*\){_POWER})"
_UNIT = re.compile(rf"\s*{_FACTOR}(?:{_JOIN}{_FACTOR})*\s*")
_FACTOR_BEFORE = re.compile(rf"{_NUMBER}\s+(?=[^\W\d])")  # of `1e17 m^-3`
LONGEST = 60  # largest number of characters in a unit


def check_unit(unit: str) -> None:
    """Raise ValueError for text that is not written as a unit, before it is evaluated."""
    if len(unit) > LONGEST or not _UNIT.fullmatch(unit):
        shown = repr(unit) if len(unit) <= LONGEST else f"{unit[:LONGEST]!r}..."
        raise ValueError(
            f"a unit must be written as symbols and numbers joined by * / and ^, such as 'm^-3' "
            f"or '1e19 m^-3', got {shown}; '1' is that of a pure number, 'm^-3' that of a count "
            "in a volume"
        )


# What pint raises for text that is not a unit.
UNIT_ERRORS = (ValueError, TypeError, AttributeError, ArithmeticError, AssertionError, TokenError)


@cache
def registry() -> pint.UnitRegistry:
    """Return the package's only pint registry; importing and building it takes 0.25 s."""
    import pint

    def plain(text: str) -> str:  # LaTeX's m^{-3}, which newer releases of pint do not read
        return text.replace("{", "(").replace("}", ")")

    found: pint.UnitRegistry = pint.UnitRegistry(preprocessors=[plain])
    found.define("step = second")  # of times that count samples: displayed as steps, see `Clock`
    return found


@cache
def _powers(unit: str) -> dict[str, float]:
    """Exponents of a unit's symbols: symbol -> exponent; an unknown unit counts as one symbol."""
    if unit in ("", "1"):
        return {}
    if (plain := _plain_powers(unit)) is not None:
        return plain
    try:
        check_unit(unit)
        parsed = registry().parse_units(unit)
    except UNIT_ERRORS:
        return {unit: 1.0}
    return {registry().get_symbol(name): float(p) for name, p in parsed._units.items()}  # type: ignore[arg-type]


def _plain_powers(unit: str) -> dict[str, float] | None:
    """Exponents for simple units such as `m^-3 s^-1` or `m^3/s`; None for all others."""
    found: dict[str, float] = {}
    for k, divided in enumerate(unit.split("/")):
        for text in divided.split(" "):
            factor = _PLAIN_FACTOR.fullmatch(text)
            if factor is None or (k and " " in divided):  # m/s V is ambiguous
                return None
            symbol, power = factor.groups()
            if symbol != "1":
                found[symbol] = found.get(symbol, 0.0) + (-1.0 if k else 1.0) * float(power or 1)
    return found


@cache
def unit_like(text: str, like: str | None = None) -> bool:
    """True if a text is a unit, perhaps with a factor; with `like`, if it converts to that unit."""
    try:
        check_unit(text)
        plain = _FACTOR_BEFORE.sub("", text.strip())
        parsed = registry().parse_units(netcdf_powers(plain)) if plain else None
    except UNIT_ERRORS:
        return False
    if parsed is None or like is None:
        return parsed is not None
    return parsed.is_compatible_with(like)


def is_count(unit: str) -> bool:
    """True for named things counted in a known unit, such as `animals/ml`."""
    things, _, per = unit.partition("/")
    is_word = bool(re.fullmatch(r"[^\W\d_]{2,}", things.strip()))
    return is_word and unit_like(per.strip()) and not unit_like(unit)


def netcdf_powers(unit: str) -> str:
    """Rewrite powers in netCDF's notation: `m-3` becomes `m^-3`."""
    return re.sub(r"\b([A-Za-zµ]+)(-?\d+)\b", r"\1^\2", unit)


def unit_product(factors: Iterable[tuple[str, int | float]]) -> str:
    """Multiply units raised to powers: [("m^-3", 2), ("m^3/s", 1)] -> "m^-3 s^-1"."""
    total: dict[str, float] = {}
    for unit, power in factors:
        for symbol, exponent in _powers(unit).items():
            total[symbol] = total.get(symbol, 0.0) + power * exponent
    parts = [s if p == 1 else f"{s}^{p:g}" for s, p in total.items() if p != 0]
    return " ".join(parts) or "1"


def with_prefix(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit that bring a value between 1 and 1000: 1.4e4 in Hz -> (1e-3, "kHz")."""
    prefixes = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
    power = 3 * math.floor(math.log10(value) / 3) if 0 < value < math.inf else 0
    power = min(max(power, -9), 9)
    return 10.0**-power, f"{prefixes[power]}{unit}"


# Units of time as names of columns, and at the end of names for time.
TIME_WORDS = frozenset({"t", "time", "times", "elapsed", "in"})
UNITS_OF_TIME = {
    word: unit
    for name, unit in {
        "second": "s", "minute": "min", "hour": "h", "day": "day", "week": "week",
        "month": "month", "year": "year",
    }.items()
    for word in (name, f"{name}s")
}  # fmt: skip
SHORT_UNITS = {
    "s": "s", "sec": "s", "ms": "ms", "us": "us", "ns": "ns", "min": "min", "mins": "min",
    "h": "h", "hr": "h", "hrs": "h", "d": "day", "wk": "week", "yr": "year", "yrs": "year",
    "y": "year",
}  # fmt: skip

# Units in which dates are counted.
CALENDAR = ("day", "h", "min", "s")


def time_unit_in(name: str) -> str | None:
    """Unit of time that a name says: `Year` gives `year`, `Time (h)` gives `h`; else None.

    A short unit such as `h` counts only next to a word for time; T is none.
    """
    if re.match(r"T\b", name):
        return None
    words = re.findall(r"[^\W\d_]+", name.lower())
    units = [word for word in words if word not in TIME_WORDS]
    if len(units) != 1:
        return None
    word = units[0].replace("µ", "u").replace("μ", "u")
    return UNITS_OF_TIME.get(word) or (SHORT_UNITS.get(word) if len(words) == 2 else None)


def seconds_in(unit: str) -> float:
    """Length of a unit of time in s, also of one with a factor such as `1e-6 s`.

    Raises ValueError for text that is not a unit of time.
    """
    try:
        check_unit(unit)
        return float(registry().Quantity(unit).to("s").magnitude)
    except UNIT_ERRORS as error:
        raise ValueError(
            f"a unit of time must be such as 's', 'us', 'h' or 'year', got {unit!r}"
        ) from error


def calendar_unit(step_s: float) -> str:
    """The longest of day, h, min and s that is no longer than a step."""
    return next((unit for unit in CALENDAR if seconds_in(unit) <= step_s), "s")


@dataclass(frozen=True)
class Clock:
    """Unit in which times are displayed, such as years; all values and files stay in seconds.

    Seconds are displayed with SI prefixes, as 71 µs and 14.1 kHz. Times that count samples are in
    steps everywhere.

    Parameters
    ----------
    unit : str, default 's'
        Name of the unit.
    seconds : float, default 1.0
        Length of the unit in s.
    """

    unit: str = "s"
    seconds: float = 1.0

    @property
    def of_values(self) -> str:
        """Unit of time of all values: s, or step for times that count samples."""
        return "step" if self.unit == "step" else "s"

    def key(self, name: str) -> tuple[str, float]:
        """Name in files of a number in seconds or Hz, and a factor: (`f_per_step`, 1e3) of `f_kHz`.

        Only times that count samples change them.
        """
        if self.unit != "step":
            return name, 1.0
        per_step = re.sub("_(k?Hz|per_s)$", "_per_step", name)
        return re.sub("_s$", "_steps", per_step), 1e3 if name.endswith("_kHz") else 1.0

    @staticmethod
    def of(unit: str) -> Clock:
        """Clock for the unit of time in a file; units of a second or less give seconds.

        Of times that count samples the unit is `step`, which all values take for a second.

        Raises ValueError for text that is not a unit of time.
        """
        if unit == "s":
            return SECONDS
        seconds = seconds_in(unit)
        return SECONDS if seconds <= 1.0 and unit != "step" else Clock(unit, seconds)

    def scale(self, duration_s: float) -> tuple[float, str]:
        """Factor from seconds to the displayed unit, and that unit: (1e6, "µs")."""
        if self.unit != "s":
            return 1.0 / self.seconds, self.unit
        return with_prefix(duration_s, "s")

    def frequency_scale(self, frequency_Hz: float) -> tuple[float, str]:
        """Factor from Hz to the displayed unit, and that unit: (1e-3, "kHz"), (3.2e7, "1/year")."""
        if self.unit != "s":
            return self.seconds, f"1/{self.unit}"
        return with_prefix(frequency_Hz, "Hz")

    def duration_text(self, duration_s: float, *, digits: int = 3) -> str:
        """Duration as text: `182 µs`, `21 years`; a dash if it is not finite."""
        factor, unit = self.scale(duration_s)
        count = f"{duration_s * factor:.{digits}g}"
        many = "s" if count != "1" and self.unit in ("step", "day", "week", "month", "year") else ""
        return f"{count} {unit}{many}" if math.isfinite(duration_s) else "-"

    def frequency_text(self, frequency_Hz: float) -> str:
        """Frequency as text: `14.1 kHz`, `0.1 per year`; a dash if it is not finite."""
        factor, unit = self.frequency_scale(frequency_Hz)
        text = f"{frequency_Hz * factor:.4g} {unit.replace('1/', 'per ')}"
        return text if math.isfinite(frequency_Hz) else "-"

    def rate_unit(self, unit: str) -> str:
        """Unit of a time derivative. unit: that of the variable."""
        if self.unit == self.of_values:
            return unit_product([(unit, 1), (self.unit, -1)])
        return f"{'' if unit == '1' else unit} {self.unit}^-1".strip()


SECONDS = Clock()
