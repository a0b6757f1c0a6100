"""Names of terms: how they are read."""

from __future__ import annotations

import re

# The grammar of terms, for expressions without groups of their own.
VARIABLE = r"(?:<[^<>]+>|[^\W\d]\w*)"  # or the average of a product, in < >

_FACTOR = rf"{VARIABLE}(?:\^\d+)?"

PRODUCT = rf"{_FACTOR}(?:\s*\*\s*{_FACTOR})*"

_TERM = re.compile(rf"\s*{PRODUCT}\s*")

_PARTS = re.compile(rf"({VARIABLE})(?:\^(\d+))?")


def split_factors(name: str) -> list[tuple[str, int]]:
    """Variables and powers of a term: `n_i^2*<n_n*R_ion>` -> (n_i, 2), (<n_n*R_ion>, 1)."""
    if not _TERM.fullmatch(name):
        raise ValueError(
            f"a term is variables joined by *, with whole powers: {name!r} came; write it like "
            "'n_i^2*n_n'"
        )
    return [(variable, int(power or 1)) for variable, power in _PARTS.findall(name)]
