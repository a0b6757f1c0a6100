"""Layout of a table in a text file: separator, decimal sign, preamble and header.

The header stands above the rows and gives the names and units of the columns.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ep2sindy.data.readers.notation import PLAIN, decimals_shown, is_grouped, is_number
from ep2sindy.library.units import is_count, unit_like

SEPARATORS = (",", ";", "\t", "|", None)  # None: blanks
COMMENTS = ("#", "%", "//", "!")
PARTED = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", None: "blanks"}

# Notations for a missing sample.
MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--", "---", "inf", "-inf"})

# A date of ISO 8601, perhaps with a time of day; other notations may be read in two ways.
DATE = re.compile(r"\d{4}-\d\d-\d\d([ T]\d\d:\d\d(:\d\d([.,]\d+)?)?\s?(Z|[+-]\d\d:?\d\d)?)?", re.I)

# A ruled line below names.
RULE = re.compile(r"[\s|+,;]*[-=_]{2,}[-=_\s|+,;]*")

# Number of lines, at the end of those examined, from which the form of a row is found. No more than
# a quarter of the lines is used, since a preamble may be longer than the rows.
N_JUDGED = 40


@dataclass(frozen=True)
class Layout:
    """Layout of a table in a text file.

    separator: None for blanks. decimal: decimal sign. first: line of the first row, from 0.
    columns: indices of the columns that hold numbers or dates. dates: of those that hold dates.
    has_marks: True if numbers have thousands separators, as in 1,000.5. left_out: names of the
    other columns, unless these are empty.
    """

    separator: str | None
    decimal: str
    first: int
    columns: tuple[int, ...]
    header: Header
    dates: tuple[int, ...] = ()
    has_marks: bool = False
    left_out: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Description of the layout, shown when the file is inspected."""
        n_columns = len(self.columns) - len(self.dates)
        parts = [f"{n_columns} column{'s' * (n_columns > 1)} of numbers"]
        parts[0] += f", {len(self.dates)} of dates" if self.dates else ""
        parts[0] += f" between {PARTED[self.separator]}" if len(self.columns) > 1 else ""
        parts += ["decimal commas"] if self.decimal == "," else []
        parts += ["marks between thousands"] if self.has_marks else []
        parts += [f"rows from line {self.first + 1}"]
        parts += [f"left out, with few numbers: {', '.join(self.left_out)}"] * bool(self.left_out)
        return ", ".join(parts)


def layout_of(lines: Sequence[str]) -> Layout:
    """Find the layout of the table in the first lines of a file.

    The form of a row is found from the last of these lines, since the lines above may be anything.
    Raises ValueError if there is no row of numbers, if a line among the rows is not a row, if
    numbers can be read in two ways, or if the header does not name the columns.
    """
    rows = [line for line in lines if line.strip() and not is_comment(line)]
    last = rows[-max(2, min(N_JUDGED, len(rows) // 4)) :]
    judged = [(*_rate_separator(last, s, d), s, d) for d in PLAIN for s in SEPARATORS]
    share, _, columns, separator, decimal = max(judged, key=lambda option: option[:2])
    if not share:
        raise ValueError("it holds no rows of numbers")
    table = [split(line, separator) for line in rows]
    cells = [row[j] for row in table for j in columns if j < len(row)]
    decimal = _decimal(cells, separator, decimal)
    columns = _rate_separator(last, separator, decimal)[2]
    first = _first_row(lines, columns, separator, decimal)
    below = [_trim(split(line, separator)) for line in lines[first:] if not is_comment(line)]
    n_columns = max(map(len, below))
    above = [
        Line(k + 1, _trim(split(without_mark(line), separator)), is_comment(line))
        for k, line in enumerate(lines[:first])
        if line.strip() and not _is_rule(line)
    ]
    header = header_of(above, n_columns, strict=separator is not None)
    if columns[0] > 1 and not any(header.units):
        header = _labels_beside(header, below, columns)
    _check_width(above, below, separator)
    dates = tuple(j for j in range(n_columns) if j not in columns and _are_dates(below, j))
    columns = tuple(sorted((*columns, *dates)))
    others = [j for j in range(n_columns) if j not in columns]
    for j in others:
        _check_text([row[j] for row in below if j < len(row)], header.names[j], decimal)
    has_marks = any(is_grouped(cell, decimal) for cell in cells)
    filled = [j for j in others if any("".join(row[j : j + 1]) for row in below)]
    left_out = tuple(header.names[j] for j in filled)
    return Layout(separator, decimal, first, columns, header, dates, has_marks, left_out)


def split(line: str, separator: str | None) -> list[str]:
    line = line.strip("\r\n ")
    if '"' in line and separator is not None:
        cells = next(csv.reader([line], delimiter=separator))
    else:
        cells = line.split(separator)
    return [cell.strip().strip("\"'").strip() for cell in cells]


def is_comment(line: str) -> bool:
    return line.lstrip().startswith(COMMENTS)


def _is_rule(line: str) -> bool:
    return bool(RULE.fullmatch(line))


def without_mark(line: str) -> str:
    """Remove the comment mark from a line: many programs write their header as a comment."""
    return line.strip().lstrip("#%!/").strip() if is_comment(line) else line


def _trim(cells: list[str]) -> list[str]:
    """Remove the empty cells at the end, which trailing separators cause."""
    while cells and not cells[-1]:
        cells = cells[:-1]
    return cells


def _rate_separator(
    rows: Sequence[str], separator: str | None, decimal: str
) -> tuple[float, int, tuple[int, ...]]:
    """Share of cells that are numbers, number of numeric columns, and their indices.

    The share is 0 if there is no numeric column. Missing samples are not counted as cells.
    """
    table = [split(row, separator) for row in rows]
    width = max((len(cells) for cells in table), default=0)
    n_numbers, n_cells, columns = 0, 0, []
    for j in range(width):
        cells = [cells[j] for cells in table if j < len(cells) and not _is_missing(cells[j])]
        numbers = [is_number(cell, decimal) for cell in cells]
        n_numbers, n_cells = n_numbers + sum(numbers), n_cells + len(cells)
        # A few cells that are not numbers are faults in those lines; the column is still numeric.
        if sum(numbers) > 0.5 * len(numbers) and len(numbers) > 0.25 * len(table):
            columns.append(j)
    return n_numbers / max(n_cells, 1) if columns else 0.0, len(columns), tuple(columns)


def _decimal(cells: Sequence[str], separator: str | None, judged: str) -> str:
    """Decimal sign of the table.

    judged: sign found from the last rows, which decides if the cells show both signs.
    """
    shown = decimals_shown(cells)
    if len(shown) == 1:
        return shown.pop()
    open_ = next((cell for cell in cells if "," in cell and is_grouped(cell, ".")), None)
    if not shown and open_ and separator != ",":
        raise ValueError(
            f"{open_!r} may be {open_.replace(',', '.')} or {open_.replace(',', '')}, and no "
            "number of the file tells which: write decimal points, and no marks between thousands"
        )
    return judged if shown else "."


def _is_missing(cell: str) -> bool:
    return cell.lower() in MISSING


def _first_row(
    lines: Sequence[str], columns: Sequence[int], separator: str | None, decimal: str
) -> int:
    """Line of the first row; raises ValueError if a line among the rows is not a row."""
    table = [split(line, separator) for line in lines]
    is_row = [_is_row(cells, columns, decimal) for cells in table]
    is_blank = [not line.strip() or is_comment(line) or _is_rule(line) for line in lines]
    others = [k for k in range(len(lines)) if not is_row[k] and not is_blank[k]]
    last_other = others[-1] if others else -1
    first = next((k for k in range(last_other + 1, len(lines)) if is_row[k]), None)
    whole = [
        k for k in range(last_other)
        if is_row[k] and not is_blank[k] and len(_trim(table[k])) > max(columns)
    ]  # fmt: skip
    if first is None or whole:
        wrong = next(k for k in others if k > whole[0]) if whole else last_other
        raise ValueError(
            f"every row must hold numbers in its columns {list(columns)}, counted from 0: line "
            f"{wrong + 1} is {lines[wrong].strip()!r:.200}; put it right, leave a cell empty whose "
            "number is missing, or begin a line with # that is no row"
        )
    return first


def _is_row(cells: Sequence[str], columns: Sequence[int], decimal: str) -> bool:
    """True if all numeric columns hold numbers or notations for missing samples.

    At least one cell must be a number, or, in a table of several columns, a word such as `nan`.
    """
    at = [cells[j] if j < len(cells) else "" for j in columns]
    numbers = [is_number(cell, decimal) for cell in at]
    said = any(numbers) or (len(columns) > 1 and any(cell.strip("-") for cell in at))
    return said and all(n or _is_missing(c) for n, c in zip(numbers, at, strict=True))


def _check_width(
    above: Sequence[Line], below: Sequence[Sequence[str]], separator: str | None
) -> None:
    """Raise ValueError for a single name above rows such as `1,5`.

    Such rows may be one column with decimal commas, or two columns.
    """
    whole = all(len(row) == 2 and row[1].isdecimal() for row in below)
    if separator == "," and whole and above and above[-1].is_word:
        raise ValueError(
            f"the header must name every column: it is {above[-1].cells}, and rows such as "
            f"{','.join(below[0])!r} may be two numbers, or one with a decimal comma; name both, "
            "or write a decimal point"
        )


def _are_dates(rows: Sequence[Sequence[str]], column: int) -> bool:
    """True if a column holds ISO dates in every row that fills it."""
    cells = [row[column] for row in rows if column < len(row) and not _is_missing(row[column])]
    return bool(cells) and all(map(DATE.fullmatch, cells))


def _check_text(cells: Sequence[str], name: str, decimal: str) -> None:
    """Raise ValueError for a column whose numbers use another decimal sign than the table."""
    other = "," if decimal == "." else "."
    strange = [cell for cell in cells if is_number(cell, other) and not is_number(cell, decimal)]
    if len(strange) > 0.5 * sum(not _is_missing(cell) for cell in cells):
        raise ValueError(
            f"all numbers must have one decimal sign: column {name!r} holds {strange[0]!r}, and "
            f"in others it is {decimal!r}"
        )


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


@dataclass(frozen=True)
class Line:
    """Cells of a line above the rows. number: line number in the file, from 1."""

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
        """True if the line has as many words as there are columns, and no numbers.

        A line of several words does not count as the name of a single column.
        """
        fits = len(self.cells) == n_columns and (n_columns > 1 or self.is_word)
        return fits and not self.is_comment and not self.has_numbers

    @property
    def begins_with_time(self) -> bool:
        return bool(self.cells) and _split_name(self.cells[0])[0].lower() in TIMES


def header_of(above: Sequence[Line], n_columns: int, *, strict: bool) -> Header:
    """Find the header in the lines above the rows.

    strict: a last line of several cells is taken as a header, so it must name every column.
    Raises ValueError if it does not, or if the last line could be a row with a word in it.
    """
    cells = [line.cells for line in above]
    step_s = _step_s(cells)
    numbered = Header(tuple(map(str, range(n_columns))), ("",) * n_columns, step_s)
    if not above:
        return numbered
    if (counted := _rigol_header(cells, n_columns)) is not None:
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
    said = [_unit(cell) for cell in units]
    header = split_names(names, [*said, *[""] * n_columns][:n_columns])
    if header.names[0].lower() in TIMES and not any(header.units):
        header = replace(header, units=_units_said(cells, n_columns))
    return replace(header, step_s=step_s)


def _labels_beside(header: Header, rows: Sequence[Sequence[str]], columns: Sequence[int]) -> Header:
    """Header with units and step from a preamble in the columns before the numbers.

    Older oscilloscopes of Tektronix write it there, one line in each row.
    """
    labels = [_trim(list(row[: columns[0]])) for row in rows]
    units = dict(zip(columns, _units_said(labels, len(columns)), strict=True))
    said = tuple(units.get(j, "") for j in range(len(header.units)))
    return replace(header, units=said, step_s=header.step_s or _step_s(labels))


def _units_said(above: Sequence[Sequence[str]], n_columns: int) -> tuple[str, ...]:
    """Units of the columns, time first, as lines of a preamble give them; "" where none does."""
    time, values = "", [""]
    for label, *cells in filter(None, above):
        units = _trim([_unit(cell) for cell in cells])
        if units and UNITS_OF_TIME.fullmatch(label):
            time = units[0].lower() if unit_like(units[0].lower(), like="s") else units[0]
        elif units and UNITS_OF_VALUES.fullmatch(label):
            values = units
    values = values * (n_columns - 1) if len(values) == 1 else [*values, *[""] * n_columns]
    return tuple(unit if unit_like(unit) else "" for unit in map(_plain, [time, *values]))[
        :n_columns
    ]


def split_names(names: Sequence[str], units: Sequence[str] = ()) -> Header:
    """Header of columns whose names may hold units, as `Time (s)`; units: those said elsewhere."""
    parted = [_split_name(name) for name in names]
    units = units if any(units) else [unit for _, unit in parted]
    return Header(_unique([name for name, _ in parted]), tuple(map(_plain, units)))


def _check_names(above: Sequence[Line], n_columns: int) -> None:
    """Raise ValueError if the last line above the rows might not be the column names.

    It may be a faulty row, or follow a line that looks like names as well. A line that begins with
    a name for time, or is a comment, is accepted. A line of a longer preamble may happen to have as
    many cells as there are columns, and is no reason for doubt.
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
    """Time step in s from a preamble, or None."""
    for cells in above:
        if len(cells) > 1 and STEP.fullmatch(cells[0]) and NUMBER.fullmatch(cells[1]):
            return float(cells[1].replace(",", "."))
    return None


def _split_name(name: str) -> tuple[str, str]:
    """Split a name and its unit; a text in brackets that is not a unit stays in the name."""
    for pattern in WITH_UNIT:
        found = pattern.fullmatch(name)
        if found and unit_like(_plain(found[2])):
            return found[1].strip(), found[2].strip()
    found = WITH_UNIT[0].fullmatch(name)
    return (found[1].strip(), found[2].strip()) if found and is_count(found[2]) else (name, "")


def unit_in_brackets(name: str) -> str:
    """Unit at the end of a name, as in `Time (ms)` or `I_d [mA]`; "" if no unit stands there."""
    return _plain(_split_name(name)[1]) if WITH_UNIT[0].fullmatch(name) else ""


def _plain(unit: str) -> str:
    """Normalise a unit: `Volt` and `μs` become `volt` and `us`."""
    unit = unit.strip().replace("µ", "u").replace("μ", "u")
    return unit if unit_like(unit) or not unit_like(unit.lower()) else unit.lower()


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


def _rigol_header(above: Sequence[Sequence[str]], n_columns: int) -> Header | None:
    """Header of a Rigol oscilloscope, or None.

    Its first column numbers the samples. The last cells of its two header lines give the start and
    the increment of time.
    """
    for k, cells in enumerate(above):
        words = [cell.lower() for cell in cells]
        if "increment" in words and k + 1 < len(above) and len(words) > n_columns:
            step_s = float(above[k + 1][words.index("increment")])
            units = [unit if unit_like(unit) else "" for unit in map(_plain, above[k + 1])]
            return Header(_unique(cells[:n_columns]), tuple(units[:n_columns]), step_s)
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
