"""Reading small CSV files strictly; errors name the place."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ep2sindy.data.readers.source import damage_named


def read_columns(
    path: Path, what: str, n_columns: int | None = None
) -> tuple[list[str], Float[np.ndarray, "columns rows"]]:
    """Names of the columns of a CSV file, none without a header, and their numbers.

    Rows that are empty or begin with # are left out. what: name of the contents, for errors.
    n_columns: None for as many as the first row has. Raises ValueError that names the row of a gap.
    """
    if not path.is_file():
        raise ValueError(f"no such {what}: {path.absolute()}")
    with damage_named(path), path.open(newline="", encoding="utf-8-sig") as file:
        cells = [[cell.strip() for cell in row] for row in csv.reader(file)]
    cells = [row for row in cells if any(row) and not row[0].startswith("#")]
    if len(cells) < 2:
        raise ValueError(f"{path} must have two rows or more: it has {len(cells)}")
    header, *rows = cells
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
