"""Reading small files strictly: cells of a CSV file, keys of a mapping; errors name the place."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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


NEEDED: Any = object()


class Node:
    """A mapping and its place in the file. `end()` refuses the keys that were not taken."""

    def __init__(self, values: Any, place: str) -> None:
        if not isinstance(values, Mapping):
            raise ValueError(f"{place} must be a mapping: {values!r} came")
        self.place = place
        self._left = dict(values)

    def take(self, key: str, default: Any = NEEDED) -> Any:
        """The value of a key, or the default; raises ValueError if a required key is missing."""
        if key in self._left:
            return self._left.pop(key)
        if default is NEEDED:
            raise ValueError(f"{self.place} must have the key {key!r}: it is not there")
        return default

    def number(self, key: str, default: Any = NEEDED) -> float:
        """Take a number."""
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{self.place}.{key} must be a number: {value!r} came")
        return float(value)

    def node(self, key: str, default: Any = NEEDED) -> Node:
        """Take a nested mapping."""
        return Node(self.take(key, default), f"{self.place}.{key}")

    def at_rest(self, values: Mapping[str, Any]) -> None:
        """Take keys that are supported at a single value only."""
        for key, value in values.items():
            if (came := self.take(key, value)) != value:
                raise ValueError(
                    f"{self.place}.{key} is not supported here but at {value!r}: {came!r} came"
                )

    def idle(self, *keys: str) -> None:
        """Take keys that have no effect here."""
        for key in keys:
            self.take(key, None)

    def end(self) -> None:
        """Raise ValueError for the remaining keys."""
        if self._left:
            raise ValueError(f"{self.place} has keys that are not supported: {sorted(self._left)}")
