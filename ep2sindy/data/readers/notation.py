"""Notation of numbers in a table: decimal sign and thousands separators."""

from __future__ import annotations

import re
from collections.abc import Iterable

_EXPONENT = r"([eEdD][+-]?\d+)?"

# Pattern of a number for each decimal sign.
PLAIN = {
    ".": re.compile(rf"[+-]?(\d+\.?\d*|\.\d+){_EXPONENT}"),
    ",": re.compile(rf"[+-]?\d+(,\d+)?{_EXPONENT}"),
}
# Grouped numbers: `1,000.5`, `1.000,5`, `1 000`. None starts with zero: 0,123 is a decimal number.
GROUPED = {
    decimal: re.compile(
        rf"[+-]?[1-9]\d{{,2}}(?P<mark>[{other}'’ \u00a0\u202f])\d{{3}}(?:(?P=mark)\d{{3}})*"
        rf"(?:[{decimal}]\d*)?"
    )
    for decimal, other in ((".", ","), (",", "."))
}


def is_number(cell: str, decimal: str) -> bool:
    return bool(PLAIN[decimal].fullmatch(cell)) or is_grouped(cell, decimal)


def is_grouped(cell: str, decimal: str) -> bool:
    """True if a number has thousands separators."""
    return bool(GROUPED[decimal].fullmatch(cell))


def remove_grouping(cell: str, decimal: str) -> str:
    """Remove the thousands separators from a number."""
    found = GROUPED[decimal].fullmatch(cell)
    return cell.replace(found["mark"], "") if found else cell


def decimals_shown(cells: Iterable[str]) -> set[str]:
    """Decimal signs that some cell requires to be a number; `1,234` and `1.234` require neither."""
    shown = set()
    for cell in cells:
        if "," in cell or "." in cell:
            readings = [decimal for decimal in PLAIN if is_number(cell, decimal)]
            shown |= set(readings) if len(readings) == 1 else set()
    return shown
