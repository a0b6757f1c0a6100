"""Names and units of a table's columns, from the lines above its rows."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from ep2sindy.library.units import unit_like

# `Time (s)`, `CH1 [V]`, `I/A`.
WITH_UNIT = (re.compile(r"(.*\S)\s*[\(\[](.+)[\)\]]"), re.compile(r"(.*\S)\s*/\s*(\S+)"))

TIMES = frozenset({"time", "t", "x-axis", "x"})

# Units of time that are hardly anything else: `a,b` may be years and barns.
SECONDS = frozenset({"s", "ms", "us", "µs", "μs", "ns", "sec", "second", "seconds"})

# What stands in a line of units for what has none.
NO_UNIT = frozenset({"", "-", "--", "1", "a.u.", "arb", "arb.", "counts", "none", "n/a"})

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


@dataclass(frozen=True)
class Line:
    """The cells of a line above the rows. number: in the file, from 1."""

    number: int
    cells: Sequence[str]
    is_comment: bool = False

    @property
    def is_word(self) -> bool:
        return len(self.cells) == 1 and not re.search(r"\s", self.cells[0])

    @property
    def has_numbers(self) -> bool:
        return any(NUMBER.fullmatch(cell) for cell in self.cells)

    def may_be_names(self, n_columns: int) -> bool:
        """As many words as columns; a line of several words is no single name."""
        fits = len(self.cells) == n_columns and (n_columns > 1 or self.is_word)
        return fits and not self.is_comment and not self.has_numbers

    @property
    def begins_with_time(self) -> bool:
        return bool(self.cells) and _parted(self.cells[0])[0].lower() in TIMES


def header_of(above: Sequence[Line], n_columns: int, *, strict: bool) -> Header:
    """From the lines above the rows.

    strict: a last line of several cells is a header, so that its number must be right.
    Raises ValueError where it is not, and where it may be a row with a word in it.
    """
    cells = [line.cells for line in above]
    step_s = _step_s(cells)
    numbered = Header(tuple(map(str, range(n_columns))), ("",) * n_columns, step_s)
    if not above:
        return numbered
    if (counted := _counted(cells, n_columns)) is not None:
        return counted
    has_units = len(above) > 1 and _are_units(cells[-1], cells[-2])
    names, units = (cells[-2], cells[-1]) if has_units else (cells[-1], [])
    if len(names) != n_columns or all(NUMBER.fullmatch(name) for name in names):
        if strict and len(names) > 1:
            raise ValueError(
                f"the header must name every column: it has {len(names)} names, {list(names)}, and "
                f"the rows have {n_columns} columns; add the names, or take the header away and "
                "name columns by their numbers, from 0"
            )
        return numbered
    if not has_units:
        _check_names(above, n_columns)
    parted = [_parted(name) for name in names]
    units = [_unit(cell) for cell in units] or [unit for _, unit in parted]
    units = [*units, *[""] * n_columns][:n_columns]
    return Header(_unique([name for name, _ in parted]), tuple(map(_plain, units)), step_s)


def _check_names(above: Sequence[Line], n_columns: int) -> None:
    """Raise ValueError for a last line that may be a row, or less than the names above it.

    Names for time leave no doubt, nor do comments; a preamble may have lines as long as its names.
    """
    last, before = above[-1], above[-2] if len(above) > 1 else None
    if last.begins_with_time or last.is_comment:
        return
    if last.has_numbers:
        raise ValueError(
            f"line {last.number}, {list(last.cells)}, is neither names nor a row of numbers: leave "
            "a cell empty whose number is missing, and begin names with one for time, such as 't'"
        )
    if before is None or not before.may_be_names(n_columns):
        return
    if before.begins_with_time or len(above) == 2:
        raise ValueError(
            f"lines {before.number} and {last.number} may both be names, {list(before.cells)} and "
            f"{list(last.cells)}: leave one of them, or begin it with #; a line of units stands "
            "in brackets, such as (s),(V)"
        )


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


def _unit(cell: str) -> str:
    """Of a line of units."""
    unit = cell.strip("()[] ")
    return "" if unit.lower() in NO_UNIT else unit


def _are_units(cells: Sequence[str], names: Sequence[str]) -> bool:
    """A line of units below the names: in brackets, or beginning with one of time.

    `t,V` alone could be names or tonnes and volts.
    """
    if len(cells) > len(names) or not cells:
        return False
    texts = [cell for cell in cells if cell]
    if all(cell[:1] in "([" and cell[-1:] in ")]" for cell in texts):
        return unit_like(_plain(texts[0].strip("()[] ")))
    if len(cells) < len(names):
        return False
    are_words = not any(map(NUMBER.fullmatch, names))
    is_time = cells[0].lower() in SECONDS and are_words
    is_time |= names[0].lower() in TIMES and unit_like(_plain(cells[0]), like="s")
    return is_time and all(not _unit(cell) or unit_like(_plain(cell)) for cell in cells)


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
    """Names that come more than once get numbers: x.0, x.1; none is taken for x itself.

    Raises ValueError where such a name is there already.
    """
    names = [name or str(k) for k, name in enumerate(names)]
    counts, met = Counter(names), Counter[str]()
    found = []
    for name in names:
        found.append(f"{name}.{met[name]}" if counts[name] > 1 else name)
        met[name] += 1
    if twice := [name for name, n in Counter(found).items() if n > 1]:
        raise ValueError(f"columns must have names of their own: {twice[0]!r} comes more than once")
    return tuple(found)
