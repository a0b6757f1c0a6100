"""Names of terms: how they are read."""

from __future__ import annotations

import re

# A factor is a variable, or the average of a product in < >, and maybe a whole power.
_FACTOR = r"(<[^<>]+>|[^\W\d]\w*)(?:\^(\d+))?"


_TERM = re.compile(rf"\s*{_FACTOR}(?:\s*\*\s*{_FACTOR})*\s*")


def split_factors(name: str) -> list[tuple[str, int]]:
    """Factors and powers of a term: `n_i^2*<n_n*R_ion>` -> (n_i, 2), (<n_n*R_ion>, 1)."""
    if not _TERM.fullmatch(name):
        raise ValueError(
            f"a term is variables joined by *, with whole powers: {name!r} came; write it like "
            "'n_i^2*n_n'"
        )
    return [(factor, int(power or 1)) for factor, power in re.findall(_FACTOR, name)]
