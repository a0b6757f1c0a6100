"""How a text file holds its table: separator, decimal sign, preamble, names and units."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from ep2sindy.data.readers.header import Header, header_of

SEPARATORS = (",", ";", "\t", "|", None)  # None: blanks
COMMENTS = ("#", "%", "//", "!")

# A missing sample, as programs write it.
MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--", "---", "inf", "-inf"})

NUMBERS = {
    ".": re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?"),
    ",": re.compile(r"[+-]?\d+(,\d+)?([eEdD][+-]?\d+)?"),
}

# Lines at the end of what is looked at, which say what a row is like: no more than a quarter of it,
# for a preamble may be longer than the rows.
N_JUDGED = 40


@dataclass(frozen=True)
class Layout:
    """separator: None for blanks. first: the line of the first row, from 0. columns: of numbers."""

    separator: str | None
    decimal: str
    first: int
    columns: tuple[int, ...]
    header: Header

    @property
    def words(self) -> str:
        """What was taken for what, for those who look into the file."""
        parted = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", None: "blanks"}
        n_columns = len(self.columns)
        parts = [f"{n_columns} column{'s' * (n_columns > 1)} of numbers"]
        parts[0] += f" between {parted[self.separator]}" if n_columns > 1 else ""
        parts += ["decimal commas"] if self.decimal == "," else []
        parts += [f"rows from line {self.first + 1}"]
        return ", ".join(parts)


def layout_of(lines: Sequence[str]) -> Layout:
    """The table in the first lines of a file.

    What a row is like is told by the last of them, for what stands above may be anything.
    Raises ValueError for lines without a row of numbers, for one among the rows that is none, and
    for a header that names more or fewer columns than the rows have.
    """
    rows = [line for line in lines if line.strip() and not is_comment(line)]
    rows = rows[-max(2, min(N_JUDGED, len(rows) // 4)) :]
    options = [(s, d) for s in SEPARATORS for d in NUMBERS if s != d]
    judged = [(*_judged(rows, s, d), s, d) for s, d in options]
    share, _, columns, separator, decimal = max(judged, key=lambda option: option[:2])
    if not share:
        raise ValueError("it holds no rows of numbers")
    first = _first_row(lines, columns, separator, decimal)
    below = [_trimmed(split(line, separator)) for line in lines[first:] if not is_comment(line)]
    n_columns = max(map(len, below))
    above = [
        _trimmed(split(without_mark(line), separator)) for line in lines[:first] if line.strip()
    ]
    header = header_of(above, n_columns, strict=separator is not None)
    return Layout(separator, decimal, first, columns, header)


def split(line: str, separator: str | None) -> list[str]:
    return [cell.strip().strip("\"'").strip() for cell in line.strip("\r\n ").split(separator)]


def is_comment(line: str) -> bool:
    return line.lstrip().startswith(COMMENTS)


def without_mark(line: str) -> str:
    """A line without the mark of a comment: headers of many programs stand in one."""
    return line.strip().lstrip("#%!/").strip() if is_comment(line) else line


def _trimmed(cells: list[str]) -> list[str]:
    """Without the empty cells at the end, which a separator there makes."""
    while cells and not cells[-1]:
        cells = cells[:-1]
    return cells


def _judged(
    rows: Sequence[str], separator: str | None, decimal: str
) -> tuple[float, int, tuple[int, ...]]:
    """Share of the cells that are numbers, number of columns of numbers, and which they are."""
    table = [split(row, separator) for row in rows]
    width = max((len(cells) for cells in table), default=0)
    n_numbers, n_cells, columns = 0, 0, []
    for j in range(width):
        cells = [cells[j] for cells in table if j < len(cells) and not _is_missing(cells[j])]
        numbers = [bool(NUMBERS[decimal].fullmatch(cell)) for cell in cells]
        n_numbers, n_cells = n_numbers + sum(numbers), n_cells + len(cells)
        # A cell or two that are no number are a fault of those lines, not another kind of column.
        if sum(numbers) > 0.5 * len(numbers) and len(numbers) > 0.25 * len(table):
            columns.append(j)
    return n_numbers / max(n_cells, 1) if columns else 0.0, len(columns), tuple(columns)


def _is_missing(cell: str) -> bool:
    return cell.lower() in MISSING


def _first_row(
    lines: Sequence[str], columns: Sequence[int], separator: str | None, decimal: str
) -> int:
    """The line of the first row; raises ValueError where rows stand above one that is none."""
    is_row = [_is_row(split(line, separator), columns, decimal) for line in lines]
    blank = [not line.strip() or is_comment(line) for line in lines]
    last_other = max((k for k in range(len(lines)) if not is_row[k] and not blank[k]), default=-1)
    first = next((k for k in range(last_other + 1, len(lines)) if is_row[k]), None)
    n_above = sum(row and not b for row, b in zip(is_row[: last_other + 1], blank, strict=False))
    if first is None or n_above > 1:
        raise ValueError(
            f"every row must hold numbers in its columns {list(columns)}, counted from 0: line "
            f"{last_other + 1} is {lines[last_other].strip()!r}"
        )
    return first


def _is_row(cells: Sequence[str], columns: Sequence[int], decimal: str) -> bool:
    at = [cells[j] if j < len(cells) else "" for j in columns]
    numbers = [bool(NUMBERS[decimal].fullmatch(cell)) for cell in at]
    return any(numbers) and all(n or _is_missing(c) for n, c in zip(numbers, at, strict=True))
