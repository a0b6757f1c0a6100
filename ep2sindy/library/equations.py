"""How equations are written: text, LaTeX, HTML, sympy."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from ep2sindy.library.names import split_factors

if TYPE_CHECKING:
    import sympy

NOTHING: Mapping[str, float] = MappingProxyType({})


def latex_name(variable: str) -> str:
    """`n_i` -> `n_{i}`, `T_e_eV` -> `T_{e,eV}`, `<n_i*n_n>` -> the average in angle brackets.

    Words stand upright: in italics they would read as products of their letters.
    """
    if variable.startswith("<"):
        return rf"\langle {latex_term_name(variable[1:-1])} \rangle"
    stem, _, index = re.sub(r"([#$%&{}])", r"\\\1", re.sub(r"[\\^~]", " ", variable)).partition("_")
    stem = stem if len(stem) < 2 else rf"\mathrm{{{stem}}}"
    return rf"{stem}_{{{index.replace('_', ',')}}}" if index else stem


def latex_derivative(state: str) -> str:
    r"""`n_i` -> `\dot{n}_{i}`: the dot belongs on the stem; over a word it would be lost: `x'`."""
    stem, index, rest = latex_name(state).partition("_")
    if stem.startswith(r"\mathrm"):
        return f"{latex_name(state)}'"
    return rf"\dot{{{stem}}}{index}{rest}"


def latex_term_name(name: str) -> str:
    r"""`n_i^2*n_n` -> `n_{i}^{2} \, n_{n}`."""
    return (
        r" \, ".join(
            latex_name(factor) + (f"^{{{power}}}" if power > 1 else "")
            for factor, power in _factors(name)
        )
        or name
    )


def equation_text(state: str, terms: Mapping[str, float], *, digits: int = 3) -> str:
    """`n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n`."""
    return f"{state}' = {' '.join(equation_parts(terms, digits=digits)) or '0'}"


def equation_parts(
    terms: Mapping[str, float], *, digits: int = 3, reach: Mapping[str, float] = NOTHING
) -> list[str]:
    """Term by term, as `+ 5.48e-14 n_i n_n`; reach: `+ 5.48e-14 (±2e-16) n_i n_n`, by name."""
    parts = []
    for k, (name, coef) in enumerate(terms.items()):
        sign = "-" if coef < 0 else "+" if k else ""
        error = f" (±{reach[name]:.2g})" if name in reach else ""
        factors = "" if name == "1" else " " + name.replace("*", " ")
        parts.append(f"{sign}{' ' if k else ''}{abs(coef):.{digits}g}{error}{factors}")
    return parts


def sum_latex(terms: Mapping[str, float], *, digits: int = 3) -> str:
    r"""The right-hand side of an equation: `- 2.62 \cdot 10^{5} \, n_{i} + ...`."""
    parts = []
    for k, (name, coef) in enumerate(terms.items()):
        sign = "-" if coef < 0 else "+" if k else ""
        mantissa, exponent = _number(coef, digits)
        number = mantissa + ("" if exponent is None else rf" \cdot 10^{{{exponent}}}")
        factors = "" if name == "1" else rf" \, {latex_term_name(name)}"
        parts.append(f"{sign} {number}{factors}".strip())
    return " ".join(parts) or "0"


def equations_latex(equations: Mapping[str, Mapping[str, float]], *, digits: int = 3) -> str:
    """An `aligned` block with one equation per line, from terms by state."""
    lines = (
        f"{latex_derivative(state)} &= {sum_latex(terms, digits=digits)}"
        for state, terms in equations.items()
    )
    return "\\begin{aligned}\n" + " \\\\\n".join(lines) + "\n\\end{aligned}"


def equation_html(
    state: str,
    terms: Mapping[str, float],
    *,
    digits: int = 3,
    reach: Mapping[str, float] = NOTHING,
) -> str:
    """One equation with sub- and superscripts, in HTML; reach: half an interval, by name."""
    parts = []
    for k, (name, coef) in enumerate(terms.items()):
        sign = "&minus;" if coef < 0 else "+" if k else ""
        number = _number_html(coef, digits)
        if name in reach:
            number += f" (&plusmn;{_number_html(reach[name], 2)})"
        factors = [_factor_html(factor, power) for factor, power in _factors(name)]
        parts.append(" ".join([sign, number, *factors]).strip())
    left = f"d{_factor_html(state, 1)}/dt"
    return f"{left} = {' '.join(parts) or '0'}".replace("-", "&minus;")


def sum_sympy(terms: Mapping[str, float]) -> sympy.Expr:
    """The right-hand side of an equation as a sympy expression, coefficients as floats."""
    import sympy  # half a second that most runs do not need

    return sympy.Add(
        *(
            sympy.Float(coef) * sympy.Mul(*(sympy.Symbol(v) ** p for v, p in _factors(name)))
            for name, coef in terms.items()
        )
    )


def _number(coef: float, digits: int) -> tuple[str, int | None]:
    """Mantissa without its sign, and the power of ten where one is written."""
    mantissa, _, exponent = f"{abs(coef):.{digits}g}".partition("e")
    return mantissa, int(exponent) if exponent else None


def _number_html(coef: float, digits: int) -> str:
    mantissa, exponent = _number(coef, digits)
    return mantissa + ("" if exponent is None else f"&times;10<sup>{exponent}</sup>")


def _factors(name: str) -> list[tuple[str, int]]:
    """Factors and powers; a name that is no product stands as it is."""
    try:
        return [] if name == "1" else split_factors(name)
    except ValueError:
        return [(name, 1)]


def _factor_html(factor: str, power: int) -> str:
    if factor.startswith("<") and factor.endswith(">"):
        inner = " ".join(_factor_html(f, p) for f, p in _factors(factor[1:-1]))
        text = f"&lang;{inner}&rang;"
    else:
        stem, _, index = factor.partition("_")
        text = f"<i>{html.escape(stem)}</i>" + (f"<sub>{html.escape(index)}</sub>" if index else "")
    return text + (f"<sup>{power}</sup>" if power > 1 else "")
