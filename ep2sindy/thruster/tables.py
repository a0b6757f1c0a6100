"""Reading small CSV files strictly; errors name the place."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

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


def read_columns(
    path: Path, what: str, n_columns: int | None = None
) -> tuple[list[str], Float[np.ndarray, "columns rows"]]:
    """Names of the columns, none without a header, and their numbers.

    n_columns: None for as many as the first row has. Raises ValueError that names the row of a gap.
    """
    header, *rows = cells = read_cells(path, what)
    if any(number(cell) is not None for cell in header):
        header, rows = [], cells
    n = n_columns or len(cells[0])
    for k, row in enumerate(rows, start=1):
        if len(row) != n or None in map(number, row):
            raise ValueError(
                f"{path} must have {n} numbers in every row: row {k} below the header is "
                f"{','.join(row)!r}; fill the gap"
            )
    return header, np.array(rows, dtype=np.float64).T


def number(cell: str) -> float | None:
    """A cell as a finite number, or None."""
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
