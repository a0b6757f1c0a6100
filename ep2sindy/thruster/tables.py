"""Reading small CSV files strictly; errors name the place."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from ep2sindy.data.readers.source import damage_named


def read_cells(path: Path, what: str, *, may_be_short: bool = False) -> list[list[str]]:
    """Rows of a CSV file, without empty ones and those that begin with #.

    what: name of the file's contents, for errors.
    """
    if not path.is_file():
        raise ValueError(f"no such {what}: {path.absolute()}")
    with damage_named(path), path.open(newline="", encoding="utf-8-sig") as file:
        rows = [[cell.strip() for cell in row] for row in csv.reader(file)]
    rows = [row for row in rows if any(row) and not row[0].startswith("#")]
    if len(rows) < 2 and not may_be_short:
        raise ValueError(f"{path} must have two rows or more: it has {len(rows)}")
    return rows


def number(cell: str) -> float | None:
    """A cell as a finite number, or None."""
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def numbers(path: Path, rows: Sequence[Sequence[str]], n_columns: int) -> list[list[float]]:
    """Every cell as a number; raises ValueError that names the row of a gap."""
    found = []
    for k, row in enumerate(rows, start=1):
        values = [value for cell in row if (value := number(cell)) is not None]
        if len(values) != n_columns or len(row) != n_columns:
            raise ValueError(
                f"{path} must have {n_columns} numbers in every row: row {k} below the header is "
                f"{','.join(row)!r}; fill the gap"
            )
        found.append(values)
    return found
