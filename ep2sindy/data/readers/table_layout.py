"""Layout of a table in a text file: separator, decimal sign, preamble and header.

The header stands above the rows and gives the names and units of the columns.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, zip_longest

from ep2sindy.library.units import is_count, unit_like
from ep2sindy.trust.memory import check_width

Table = Sequence[Sequence[str]]  # cells of each line

SEPARATORS = (",", ";", "\t", "|", None)  # None: blanks
COMMENTS = ("#", "%", "//", "!")
PARTED = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", None: "blanks"}

# Notations for a missing sample, or one outside the range of the instrument.
MISSING = frozenset({
    "", "nan", "na", "n/a", "null", "none", "-", "--", "---", "inf", "-inf", "∞", "-∞", "***",
    "****", "*****", "ovld", "overload", "clipped", "#n/a",
})  # fmt: skip

# A ruled line below names.
RULE = re.compile(r"[\s|+,;]*[-=_]{2,}[-=_\s|+,;]*")

# Numbers for each decimal sign, perhaps with marks between thousands: `1,000.5`, `1.000,5`,
# `1 000`. None of those starts with zero: 0,123 is a decimal number.
_EXPONENT = r"([eEdD][+-]?\d+)?"
PLAIN = {".": rf"[+-]?(\d+\.?\d*|\.\d+){_EXPONENT}", ",": rf"[+-]?\d+(,\d+)?{_EXPONENT}"}
GROUPED = {
    decimal: rf"[+-]?[1-9]\d{{,2}}(?P<mark>[{other}'’ \u00a0\u202f])\d{{3}}"
    rf"(?:(?P=mark)\d{{3}})*(?:[{decimal}]\d*)?"
    for decimal, other in ((".", ","), (",", "."))
}
DIGIT = re.compile(r"\d")
NUMBERS = {decimal: re.compile(rf"{PLAIN[decimal]}|{GROUPED[decimal]}") for decimal in PLAIN}


@dataclass(frozen=True)
class Layout:
    """Layout of a table in a text file.

    separator: None for blanks. decimal: decimal sign. first: line of the first row, from 0.
    columns: indices of the columns that hold numbers. header: names and units of all columns.
    has_marks: True if numbers have marks between thousands, as in 1,000.5.
    """

    separator: str | None
    decimal: str
    first: int
    columns: tuple[int, ...]
    header: Header
    has_marks: bool


def layout_of(lines: Sequence[str]) -> Layout:
    """Find the layout of the table in the first lines of a file.

    The rows begin where a line holds numbers in all columns that mostly do.
    Raises ValueError if there is no row of numbers, if numbers can be read in two ways, or if the
    header does not name the columns.
    """
    lines = [line.strip("\r\n ") for line in lines]
    shown = ["" if line.startswith(COMMENTS) or RULE.fullmatch(line) else line for line in lines]
    separator, decimal, columns, table = _form(shown)
    first = _first_row(table, lines, columns, decimal)
    below = [row for row in table[first:] if row]
    columns = _numeric(below, decimal) or columns
    before = [line for line in lines[:first] if line and not RULE.fullmatch(line)]
    above = _split([line.lstrip("#%!/ ") for line in before], separator)
    n_columns = max(map(len, below))
    check_width(n_columns, "columns")
    if above and separator and len(above[-1]) == shown[first].count(separator) + 1:
        n_columns = max(n_columns, len(above[-1]))  # the last ones are empty in these lines
    is_comment = bool(before) and before[-1].startswith(COMMENTS)
    header = header_of(above, n_columns, strict=separator is not None, is_comment=is_comment)
    if columns[0] > 1 and not any(header.units):
        header = _labels_beside(header, below, columns)
    cells = (row[j] for row in below for j in columns if j < len(row))
    has_marks = any(re.fullmatch(GROUPED[decimal], cell) for cell in cells)
    return Layout(separator, decimal, first, columns, header, has_marks)


def _form(lines: Sequence[str]) -> tuple[str | None, str, tuple[int, ...], list[list[str]]]:
    """Separator, decimal sign, numeric columns, and the cells of all lines.

    Separator and decimal sign are those by which most cells are numbers, in most columns.
    """
    tables = {s: _split(lines, s) for s in SEPARATORS if s is None or any(s in t for t in lines)}
    filled = {s: [cells for cells, line in zip(table, lines, strict=True) if DIGIT.search(line)]
              for s, table in tables.items()}  # fmt: skip
    options = [(*_rate(table, d), s, d) for d in PLAIN for s, table in filled.items()]
    fraction, _, columns, separator, decimal = max(options, key=lambda option: option[:2])
    if not fraction:
        raise ValueError("it holds no rows of numbers")
    table = tables[separator]
    numbers = [row[j] for row in table for j in columns if j < len(row)]
    if any("," in cell for cell in numbers):
        decimal = _decimal(numbers, separator, decimal)
        columns = _rate(filled[separator], decimal)[2]
    return separator, decimal, columns, table


def _split(lines: Sequence[str], separator: str | None) -> list[list[str]]:
    """Cells of each line, without the empty ones at its end, which trailing separators cause."""
    table = []
    for line in lines:
        if '"' in line and separator is not None:
            cells = next(csv.reader([line], delimiter=separator))
        else:
            cells = line.split(separator)
        cells = [cell.strip(" \t\r\n\"'") for cell in cells]
        while cells and not cells[-1]:
            cells.pop()
        table.append(cells)
    return table


def _rate(table: Table, decimal: str) -> tuple[float, int, tuple[int, ...]]:
    """Mean fraction of numbers in a line, number of numeric columns, and their indices.

    table: cells of the lines that hold a digit; columns are distinguished from those of the usual
    width.
    """
    number = NUMBERS[decimal].fullmatch
    present = [[cell for cell in cells if cell.lower() not in MISSING] for cells in table]
    fractions = [sum(map(bool, map(number, cells))) / max(len(cells), 1) for cells in present]
    widths = Counter(map(len, table))
    usual = max(widths, key=lambda n: (widths[n], n), default=0)
    columns = _numeric([cells for cells in table if len(cells) == usual], decimal)
    return (sum(fractions) / len(fractions) if columns else 0.0), len(columns), columns


def _numeric(rows: Table, decimal: str) -> tuple[int, ...]:
    """Indices of the columns most of whose cells, but for missing samples, are numbers.

    Of a table with labels next to it, columns that few rows fill belong to these.
    """
    filled = {}
    for j, column in enumerate(zip_longest(*rows, fillvalue="")):
        cells = [cell for cell in column if cell.lower() not in MISSING]
        n_numbers = sum(map(bool, map(NUMBERS[decimal].fullmatch, cells)))
        if n_numbers > 0.5 * len(cells):
            filled[j] = n_numbers / len(rows)
    dense = [j for j, fraction in filled.items() if fraction > 0.25]
    return tuple(dense if dense and dense[0] > 1 else filled)


def _decimal(cells: Sequence[str], separator: str | None, rated: str) -> str:
    """Decimal sign of the table: that which some cell needs to be a number, or else the rated one.

    Raises ValueError for cells such as 1,234 only, which may be of either kind.
    """
    marked = [cell for cell in cells if "," in cell or "." in cell]
    readings = [{d for d in NUMBERS if NUMBERS[d].fullmatch(cell)} for cell in marked]
    shown = set[str]().union(*(reading for reading in readings if len(reading) == 1))
    if len(shown) == 1:
        return shown.pop()
    grouped = next((c for c in marked if "," in c and re.fullmatch(GROUPED["."], c)), None)
    if not shown and grouped and separator != ",":
        raise ValueError(
            f"{grouped!r} may be {grouped.replace(',', '.')} or {grouped.replace(',', '')}, and no "
            "number of the file tells which: write decimal points, and no marks between thousands"
        )
    return rated if shown else "."


def _is_row(cells: Sequence[str], columns: Sequence[int], decimal: str) -> bool:
    """True if all numeric columns hold numbers or notations for missing samples, and one at all."""
    at = [cells[j] if j < len(cells) else "" for j in columns]
    has_numbers = any(cell.strip("-") for cell in at)
    return has_numbers and all(NUMBERS[decimal].fullmatch(c) or c.lower() in MISSING for c in at)


def _first_row(table: Table, lines: Sequence[str], columns: Sequence[int], decimal: str) -> int:
    """Line of the first row; raises ValueError if the next one is no row, as after a false one."""
    filled = [k for k, cells in enumerate(table) if cells]
    first = next(k for k in filled if _is_row(table[k], columns, decimal))
    second = next((k for k in filled if k > first), first)
    if not _is_row(table[second], columns, decimal):
        raise ValueError(
            f"every row must hold numbers in its columns {list(columns)}, counted from 0: line "
            f"{second + 1} is {lines[second].strip()!r:.200}; put it right, leave a cell empty "
            "whose number is missing, or begin a line with # that is no row"
        )
    return first


# Names and units of a table's columns, from the lines above its rows.


# Names with a unit: `Time (s)`, `CH1 [V]`, `I/A`.
WITH_UNIT = (re.compile(r"(.*\S)\s*[\(\[](.+)[\)\]]"), re.compile(r"(.*\S)\s*/\s*(\S+)"))

TIMES = frozenset({"time", "t", "x-axis", "x"})

# Units of time that are unlikely to be names; `a,b` could be years and barns.
SECONDS = frozenset({"s", "ms", "us", "µs", "μs", "ns", "sec", "second", "seconds"})

# Entries for "no unit" in a line of units.
NO_UNIT = frozenset({"", "-", "--", "1", "a.u.", "arb", "arb.", "counts", "none", "n/a"})

NUMBER = re.compile(r"[+-]?[\d.,]+([eE][+-]?\d+)?")

# Labels of the units of the first column and of the others in a preamble.
UNITS_OF_TIME = re.compile(r"(horizontal|x|time)[ -]?(axis )?units?", re.I)
UNITS_OF_VALUES = re.compile(r"(vertical|y)[ -]?(axis )?units?", re.I)

# Labels of the time step in s in a preamble.
STEP = re.compile(
    r"(horizontal )?(sampl\w* (interval|period|time)|time (step|interval)|dt)\b.*", re.I
)


@dataclass(frozen=True)
class Header:
    """Names and units of a table's columns.

    names: column numbers if the file gives no names. units: "" for a column without one.
    step_s: time step in s, if a preamble gives it.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    step_s: float | None = None


def header_of(above: Table, n_columns: int, *, strict: bool, is_comment: bool) -> Header:
    """Find the header in the cells of the lines above the rows.

    strict: a last line of several cells, or of one word, is taken as a header, so it must name
    every column. is_comment: the last line is a comment, as programs write their header.
    Raises ValueError if it does not, or if the last line could be a row with a word in it.
    """
    units_above, step_s = _preamble(above, n_columns) if len(above) > 1 else ((), None)
    numbered = Header(tuple(map(str, range(n_columns))), ("",) * n_columns, step_s)
    if not above:
        return numbered
    if (counted := _rigol_header(above, n_columns)) is not None:
        return counted
    has_units = len(above) > 1 and _are_units(above[-1], above[-2])
    names, units = (above[-2], above[-1]) if has_units else (above[-1], [])
    if len(names) != n_columns or all(NUMBER.fullmatch(name) for name in names):
        if strict and (len(names) > 1 or not re.search(r"\s", "".join(names))):
            raise ValueError(
                f"the header must name every column: it has {len(names)} names, {list(names)}, and "
                f"the rows have {n_columns} columns; add the names, or take the header away and "
                "name columns by their numbers, from 0; write numbers with decimal points"
            )
        return numbered
    if not has_units and not is_comment:
        _check_names(above)
    parted = [split_name(name) for name in names]
    below = [*map(_unit, units), *[""] * n_columns][:n_columns]
    units = [_plain(unit) for unit in (below if any(below) else (unit for _, unit in parted))]
    plain_names = _unique([name for name, _ in parted])
    if plain_names[0].lower() in TIMES and not any(units):
        units = units_above or [""] * n_columns
    return Header(plain_names, tuple(units), step_s)


def _check_names(above: Table) -> None:
    """Raise ValueError if the last line above the rows might not be the column names.

    It may be a faulty row, or follow a line that begins with a name for time. One that begins so
    itself is accepted.
    """
    *_, before, last = [], *above
    if split_name(last[0])[0].lower() in TIMES:
        return
    if any(NUMBER.fullmatch(cell) for cell in last):
        raise ValueError(
            f"the line {list(last)} is neither names nor a row of numbers: leave a cell empty "
            "whose number is missing, and begin names with one for time, such as 't'"
        )
    if len(before) == len(last) > 1 and split_name(before[0])[0].lower() in TIMES:
        raise ValueError(
            f"both {list(before)} and {list(last)} may be names: leave one of these lines, or "
            "begin it with #; a line of units stands in brackets, such as (s),(V)"
        )


def _labels_beside(header: Header, rows: Table, columns: Sequence[int]) -> Header:
    """Header with units and step from a preamble in the columns before the numbers.

    Older oscilloscopes of Tektronix write it there, one line in each row.
    """
    found, step_s = _preamble([row[: columns[0]] for row in rows], len(columns))
    by_column = dict(zip(columns, found, strict=True))
    units = tuple(by_column.get(j, "") for j in range(len(header.units)))
    return replace(header, units=units, step_s=header.step_s or step_s)


def _preamble(lines: Table, n_columns: int) -> tuple[tuple[str, ...], float | None]:
    """Units of the columns, time first, "" for none, and time step in s, as a preamble gives them.

    lines: of the preamble, each a label and what it labels.
    """
    time, values, step_s = "", [""], None
    for label, *cells in filter(None, lines):
        units = [_unit(cell) for cell in cells]
        while units and not units[-1]:
            units.pop()
        step = cells[0].replace(",", ".") if cells and STEP.fullmatch(label) else ""
        if step_s is None and re.fullmatch(PLAIN["."], step):
            step_s = float(step)
        elif units and UNITS_OF_TIME.fullmatch(label):
            time = units[0].lower() if unit_like(units[0].lower(), like="s") else units[0]
        elif units and UNITS_OF_VALUES.fullmatch(label):
            values = units
    values = values * (n_columns - 1) if len(values) == 1 else values
    return _known_units([time, *values], n_columns), step_s


def _known_units(cells: Sequence[str], n_columns: int) -> tuple[str, ...]:
    """A unit for each column; "" for a cell that is none, and where there is no cell."""
    units = [unit if unit_like(unit) else "" for unit in map(_plain, cells)]
    return tuple([*units, *[""] * n_columns][:n_columns])


def split_name(name: str) -> tuple[str, str]:
    """Split a name and its unit; a text in brackets that is not a unit stays in the name."""
    for pattern in WITH_UNIT:
        if found := pattern.fullmatch(name):
            unit = _plain(found[2])
            if unit_like(unit) or (pattern is WITH_UNIT[0] and is_count(unit)):
                return found[1].strip(), unit
    return name, ""


def unit_in_brackets(name: str) -> str:
    """Unit at the end of a name, as in `Time (ms)` or `I_d [mA]`; "" if no unit stands there."""
    return split_name(name)[1] if WITH_UNIT[0].fullmatch(name) else ""


def _plain(unit: str) -> str:
    """Normalise a unit: `Volt` and `μs` become `volt` and `us`."""
    unit = unit.strip().replace("µ", "u").replace("μ", "u")
    return unit if not unit or unit_like(unit) or not unit_like(unit.lower()) else unit.lower()


def _unit(cell: str) -> str:
    """Unit in a cell of a line of units; "" for no unit."""
    unit = cell.strip("()[] ")
    return "" if unit.lower() in NO_UNIT else unit


def _are_units(cells: Sequence[str], names: Sequence[str]) -> bool:
    """True if cells are a line of units below the names.

    The units must stand in brackets, or begin with a unit of time; `t,V` alone could be names or
    tonnes and volts.
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


def _rigol_header(above: Table, n_columns: int) -> Header | None:
    """Header of a Rigol oscilloscope, or None.

    Its first column numbers the samples. The last cells of its two header lines give the start and
    the increment of time.
    """
    for cells, below in pairwise(above):
        step = dict(zip(map(str.lower, cells), below, strict=False)).get("increment", "")
        if len(cells) > n_columns and re.fullmatch(PLAIN["."], step):
            return Header(_unique(cells[:n_columns]), _known_units(below, n_columns), float(step))
    return None


def _unique(names: Sequence[str]) -> tuple[str, ...]:
    """Number names that occur more than once: x.0, x.1; no column keeps the name x.

    Raises ValueError if a numbered name already exists.
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
