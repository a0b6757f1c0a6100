"""How a text file holds its table: separator, decimal sign, preamble, and a header.

The header stands above the rows and gives names and units of the columns.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from ep2sindy.data.readers.notation import PLAIN, decimals_shown, is_grouped, is_number
from ep2sindy.library.units import unit_like

SEPARATORS = (",", ";", "\t", "|", None)  # None: blanks
COMMENTS = ("#", "%", "//", "!")
PARTED = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", None: "blanks"}

# A missing sample, as programs write it.
MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--", "---", "inf", "-inf"})

# A line that is drawn under names.
RULE = re.compile(r"[\s|+,;]*[-=_]{2,}[-=_\s|+,;]*")

# Lines at the end of what is looked at, which say what a row is like: no more than a quarter of it,
# for a preamble may be longer than the rows.
N_JUDGED = 40


@dataclass(frozen=True)
class Layout:
    """separator: None for blanks. first: the line of the first row, from 0. columns: of numbers.

    has_marks: whether thousands are parted, as in 1,000.5. left_out: names of all other columns.
    """

    separator: str | None
    decimal: str
    first: int
    columns: tuple[int, ...]
    header: Header
    has_marks: bool = False
    left_out: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """What was taken for what, for those who look into the file."""
        n_columns = len(self.columns)
        parts = [f"{n_columns} column{'s' * (n_columns > 1)} of numbers"]
        parts[0] += f" between {PARTED[self.separator]}" if n_columns > 1 else ""
        parts += ["decimal commas"] if self.decimal == "," else []
        parts += ["marks between thousands"] if self.has_marks else []
        parts += [f"rows from line {self.first + 1}"]
        parts += [f"left out, with few numbers: {', '.join(self.left_out)}"] * bool(self.left_out)
        return ", ".join(parts)


def layout_of(lines: Sequence[str]) -> Layout:
    """The table in the first lines of a file.

    What a row is like is told by the last of them, for what stands above may be anything.
    Raises ValueError for lines without a row of numbers, for one among the rows that is none, for
    numbers that may be read in two ways, and for a header that does not name the columns.
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
    _check_width(above, below, separator)
    others = [j for j in range(n_columns) if j not in columns]
    for j in others:
        _check_text([row[j] for row in below if j < len(row)], header.names[j], decimal)
    has_marks = any(is_grouped(cell, decimal) for cell in cells)
    filled = [j for j in others if any("".join(row[j : j + 1]) for row in below)]
    left_out = tuple(header.names[j] for j in filled)
    return Layout(separator, decimal, first, columns, header, has_marks, left_out)


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
    """A line without the mark of a comment: headers of many programs stand in one."""
    return line.strip().lstrip("#%!/").strip() if is_comment(line) else line


def _trim(cells: list[str]) -> list[str]:
    """Without the empty cells at the end, which a separator there makes."""
    while cells and not cells[-1]:
        cells = cells[:-1]
    return cells


def _rate_separator(
    rows: Sequence[str], separator: str | None, decimal: str
) -> tuple[float, int, tuple[int, ...]]:
    """Share of the cells that are numbers, number of columns of numbers, and which they are."""
    table = [split(row, separator) for row in rows]
    width = max((len(cells) for cells in table), default=0)
    n_numbers, n_cells, columns = 0, 0, []
    for j in range(width):
        cells = [cells[j] for cells in table if j < len(cells) and not _is_missing(cells[j])]
        numbers = [is_number(cell, decimal) for cell in cells]
        n_numbers, n_cells = n_numbers + sum(numbers), n_cells + len(cells)
        # A cell or two that are no number are a fault of those lines, not another kind of column.
        if sum(numbers) > 0.5 * len(numbers) and len(numbers) > 0.25 * len(table):
            columns.append(j)
    return n_numbers / max(n_cells, 1) if columns else 0.0, len(columns), tuple(columns)


def _decimal(cells: Sequence[str], separator: str | None, judged: str) -> str:
    """The decimal sign; judged: that of the last rows, which decides where both are shown."""
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
    """The line of the first row; raises ValueError where rows stand above one that is none."""
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
    """Numbers, or words for missing ones; a word, where there are no numbers and columns beside."""
    at = [cells[j] if j < len(cells) else "" for j in columns]
    numbers = [is_number(cell, decimal) for cell in at]
    said = any(numbers) or (len(columns) > 1 and any(cell.strip("-") for cell in at))
    return said and all(n or _is_missing(c) for n, c in zip(numbers, at, strict=True))


def _check_width(
    above: Sequence[Line], below: Sequence[Sequence[str]], separator: str | None
) -> None:
    """Raise ValueError for one name above what may be one column of decimal commas, or two."""
    whole = all(len(row) == 2 and row[1].isdecimal() for row in below)
    if separator == "," and whole and above and above[-1].is_word:
        raise ValueError(
            f"the header must name every column: it is {above[-1].cells}, and rows such as "
            f"{','.join(below[0])!r} may be two numbers, or one with a decimal comma; name both, "
            "or write a decimal point"
        )


def _check_text(cells: Sequence[str], name: str, decimal: str) -> None:
    """Raise ValueError for a column of numbers that are written in another way than the others."""
    other = "," if decimal == "." else "."
    strange = [cell for cell in cells if is_number(cell, other) and not is_number(cell, decimal)]
    if len(strange) > 0.5 * sum(not _is_missing(cell) for cell in cells):
        raise ValueError(
            f"all numbers must have one decimal sign: column {name!r} holds {strange[0]!r}, and "
            f"in others it is {decimal!r}"
        )


# Names and units of a table's columns, from the lines above its rows.


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
        return bool(self.cells) and _split_name(self.cells[0])[0].lower() in TIMES


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
    parted = [_split_name(name) for name in names]
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


def _split_name(name: str) -> tuple[str, str]:
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


def _rigol_header(above: Sequence[Sequence[str]], n_columns: int) -> Header | None:
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
