"""Names and units of a table's columns, from the lines above its rows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from ep2sindy.library.units import unit_like

# `Time (s)`, `CH1 [V]`, `I/A`.
WITH_UNIT = (re.compile(r"(.*\S)\s*[\(\[](.+)[\)\]]"), re.compile(r"(.*\S)\s*/\s*(\S+)"))

TIMES = frozenset({"time", "t", "x-axis", "x"})

NUMBER = re.compile(r"[+-]?[\d.,]+([eE][+-]?\d+)?")

# In a preamble, before the time step in s.
STEP = re.compile(
    r"(horizontal )?(sampl\w* (interval|period|time)|time (step|interval)|dt)\b.*", re.I
)


@dataclass(frozen=True)
class Header:
    """names: of the columns, their numbers where none are given; units: "" where none.

    step_s: of time, where a preamble says it.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    step_s: float | None = None


def header_of(above: Sequence[Sequence[str]], n_columns: int, *, strict: bool) -> Header:
    """From the cells of the lines above the rows.

    strict: a last line of several cells is a header, so that its number must be right.
    Raises ValueError where it is not.
    """
    step_s = _step_s(above)
    numbered = Header(tuple(map(str, range(n_columns))), ("",) * n_columns, step_s)
    if not above:
        return numbered
    if (counted := _counted(above, n_columns)) is not None:
        return counted
    names, units = above[-1], None
    if len(above) > 1 and _are_units(above[-1], above[-2]):
        names, units = above[-2], [unit.strip("()[] ") for unit in above[-1]]
    if len(names) != n_columns or all(NUMBER.fullmatch(name) for name in names):
        if strict and len(names) > 1:
            raise ValueError(
                f"the header must name every column: it has {len(names)} names, {list(names)}, and "
                f"the rows have {n_columns} columns; add the names, or take the header away and "
                "name columns by their numbers, from 0"
            )
        return numbered
    parted = [_parted(name) for name in names]
    units = units or [unit for _, unit in parted]
    units = [*units, *[""] * n_columns][:n_columns]
    return Header(_unique([name for name, _ in parted]), tuple(map(_plain, units)), step_s)


def _step_s(above: Sequence[Sequence[str]]) -> float | None:
    """What a preamble says of the time step."""
    for cells in above:
        if len(cells) > 1 and STEP.fullmatch(cells[0]) and NUMBER.fullmatch(cells[1]):
            return float(cells[1].replace(",", "."))
    return None


def _parted(name: str) -> tuple[str, str]:
    """A name and its unit; a text in brackets that is no unit stays with the name."""
    for pattern in WITH_UNIT:
        found = pattern.fullmatch(name)
        if found and unit_like(_plain(found[2])):
            return found[1].strip(), found[2].strip()
    return name, ""


def _plain(unit: str) -> str:
    """`Volt` and `μs` as `volt` and `us`."""
    unit = unit.strip().replace("µ", "u").replace("μ", "u")
    return unit if unit_like(unit) or not unit_like(unit.lower()) else unit.lower()


def _are_units(cells: Sequence[str], names: Sequence[str]) -> bool:
    """A line of units below the names: in brackets, or a unit of time below a word for time.

    `t,V` alone could be names or tonnes and volts.
    """
    if len(cells) > len(names) or not cells:
        return False
    texts = [cell for cell in cells if cell]
    if all(cell[:1] in "([" and cell[-1:] in ")]" for cell in texts):
        return unit_like(_plain(texts[0].strip("()[] ")))
    if len(cells) < len(names):
        return False
    first = _plain(cells[0])
    is_time = names[0].lower() in TIMES and unit_like(first, like="s")
    return is_time and all(unit_like(_plain(cell)) for cell in cells if cell)


def _counted(above: Sequence[Sequence[str]], n_columns: int) -> Header | None:
    """Rigol's: samples are counted, and the last cells of two lines say their start and step."""
    for k, cells in enumerate(above):
        words = [cell.lower() for cell in cells]
        if "increment" in words and k + 1 < len(above) and len(words) > n_columns:
            step_s = float(above[k + 1][words.index("increment")])
            units = [unit if unit_like(unit) else "" for unit in map(_plain, above[k + 1])]
            return Header(_unique(cells[:n_columns]), tuple(units[:n_columns]), step_s)
    return None


def _unique(names: Sequence[str]) -> tuple[str, ...]:
    """A name that comes again gets a number: x, x.1."""
    found: list[str] = []
    for k, name in enumerate(names):
        name = name or str(k)
        again = sum(each == name for each in names[:k])
        found.append(f"{name}.{again}" if again else name)
    return tuple(found)
