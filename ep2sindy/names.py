"""Names of variables and terms: how they are read, and how they look in LaTeX."""

from __future__ import annotations

import re

# A factor is a variable, or the average of a product in < >, and maybe a whole power.
_FACTOR = r"(<[^<>]+>|[^\W\d]\w*)(?:\^(\d+))?"
_TERM = re.compile(rf"\s*{_FACTOR}(?:\s*\*\s*{_FACTOR})*\s*")


def split_factors(name: str) -> list[tuple[str, int]]:
    """Variables and powers of a term: `n_i^2*<n_n*R_ion>` -> (n_i, 2), (<n_n*R_ion>, 1)."""
    if not _TERM.fullmatch(name):
        raise ValueError(
            f"a term is variables joined by *, with whole powers: {name!r} came; write it like "
            "'n_i^2*n_n'"
        )
    return [(variable, int(power or 1)) for variable, power in re.findall(_FACTOR, name)]


def latex_name(variable: str) -> str:
    """`n_i` -> `n_{i}`, `T_e_eV` -> `T_{e,eV}`, `<n_i*n_n>` -> the average in angle brackets."""
    if variable.startswith("<"):
        return rf"\langle {latex_term_name(variable[1:-1])} \rangle"
    stem, _, index = variable.partition("_")
    return rf"{stem}_{{{index.replace('_', ',')}}}" if index else stem


def latex_derivative(state: str) -> str:
    r"""`n_i` -> `\dot{n}_{i}`: the dot belongs on the stem."""
    stem, index, rest = latex_name(state).partition("_")
    return rf"\dot{{{stem}}}{index}{rest}"


def latex_term_name(name: str) -> str:
    """`n_i^2*n_n` -> `n_{i}^{2} n_{n}`."""
    if name == "1":
        return name
    return " ".join(
        latex_name(variable) + (f"^{{{power}}}" if power > 1 else "")
        for variable, power in split_factors(name)
    )
