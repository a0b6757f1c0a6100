"""How equations are written: text, LaTeX, HTML."""

from __future__ import annotations

import html
from collections.abc import Mapping

from ep2sindy.library.names import split_factors


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


def equation_text(state: str, terms: Mapping[str, float], *, digits: int = 3) -> str:
    """`n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n`."""
    parts = []
    for k, (name, coef) in enumerate(terms.items()):
        sign = "-" if coef < 0 else "+" if k else ""
        factors = "" if name == "1" else " " + name.replace("*", " ")
        parts.append(f"{sign}{' ' if k else ''}{abs(coef):.{digits}g}{factors}")
    return f"{state}' = {' '.join(parts) or '0'}"


def latex_term(name: str, coef: float, digits: int, *, first: bool) -> str:
    sign = "-" if coef < 0 else "" if first else "+"
    mantissa, _, exponent = f"{abs(coef):.{digits}g}".partition("e")
    number = mantissa + (rf" \cdot 10^{{{int(exponent)}}}" if exponent else "")
    if name == "1":
        return f"{sign} {number}".strip()
    return f"{sign} {number} \\, {latex_term_name(name)}".strip()


def equation_html(state: str, terms: Mapping[str, float], *, digits: int = 3) -> str:
    """One equation with sub- and superscripts: n<sub>i</sub>' = -2.62e5 ... in HTML."""
    parts = []
    for k, (name, coef) in enumerate(terms.items()):
        sign = "&minus;" if coef < 0 else "+" if k else ""
        mantissa, _, exponent = f"{abs(coef):.{digits}g}".partition("e")
        number = mantissa + (f"&times;10<sup>{int(exponent)}</sup>" if exponent else "")
        factors = [] if name == "1" else [_factor_html(v, p) for v, p in split_factors(name)]
        parts.append(" ".join([sign, number, *factors]).strip())
    left = f"d{_factor_html(state, 1)}/dt"
    return f"{left} = {' '.join(parts) or '0'}".replace("-", "&minus;")


def _factor_html(variable: str, power: int) -> str:
    if variable.startswith("<"):
        inner = " ".join(_factor_html(v, p) for v, p in split_factors(variable[1:-1]))
        text = f"&lang;{inner}&rang;"
    else:
        stem, _, index = variable.partition("_")
        text = f"<i>{html.escape(stem)}</i>" + (f"<sub>{html.escape(index)}</sub>" if index else "")
    return text + (f"<sup>{power}</sup>" if power > 1 else "")
