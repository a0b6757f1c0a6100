"""Notation of equations: text, LaTeX, the MathML that HTML shows, sympy."""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html.entities import name2codepoint
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeAlias
from xml.etree import ElementTree

from ep2sindy.library.names import RECIPROCAL, Part, split_term
from ep2sindy.library.roles import Group

if TYPE_CHECKING:
    import sympy

Reach: TypeAlias = Mapping[str, float]  # term -> half-width of the interval of its coefficient
NOTHING: Reach = MappingProxyType({})


def latex_name(variable: str) -> str:
    """LaTeX of a variable: `n_i` -> `n_{i}`, `T_e_eV` -> `T_{e,eV}`.

    An average `<n_i*n_n>` stands in angle brackets. Words are set upright: in italics they would
    read as products of their letters. A zone is an index: `n_i@exit` -> `n_{i,exit}`.
    """
    variable, _, zone = variable.partition("@")
    if variable.startswith("<"):
        place = f"_{{{zone}}}" if zone else ""
        return rf"\langle {latex_term_name(variable[1:-1])} \rangle{place}"
    stem, _, index = re.sub(r"([#$%&{}])", r"\\\1", re.sub(r"[\\^~]", " ", variable)).partition("_")
    index = "_".join(filter(None, (index, zone)))
    if _is_greek(stem):
        stem = rf"\{stem}"
    elif len(stem) > 1:
        stem = rf"\mathrm{{{stem}}}"
    return rf"{stem}_{{{index.replace('_', ',')}}}" if index else stem


def latex_derivative(state: str) -> str:
    r"""LaTeX of a time derivative: `n_i` -> `\dot{n}_{i}`, with the dot on the stem.

    A stem of several letters gets a prime, since a dot over a word would be overlooked.
    """
    stem, index, rest = latex_name(state).partition("_")
    if stem.startswith(r"\mathrm"):
        return f"{latex_name(state)}'"
    return rf"\dot{{{stem}}}{index}{rest}"


def latex_term_name(name: str) -> str:
    r"""LaTeX of a term: `n_i^2*n_n` -> `n_{i}^{2} \, n_{n}`.

    Quotients become fractions: `x*sin(y)/z` -> `\frac{x \, \sin(y)}{z}`.
    """
    over, under = (r" \, ".join(map(_latex_part, side)) for side in _sides(name))
    return rf"\frac{{{over or 1}}}{{{under}}}" if under else over or name


def _latex_part(part: Part) -> str:
    return _latex_factor(part) + (f"^{{{part.power}}}" if part.power > 1 else "")


def _latex_factor(part: Part) -> str:
    argument = part.argument_of(latex_name(part.variable), times=r" \, ")
    if part.function in ("", RECIPROCAL):
        return argument if part.is_bare else f"({argument})"
    if part.function == "sqrt":
        root = rf"\sqrt{{{argument}}}"
        return root if part.power == 1 else f"({root})"
    if part.function == "abs":
        return rf"|{argument}|"
    if part.function == "sign":  # a smooth one
        return rf"\tanh({argument})"
    known = part.function in ("sin", "cos", "exp", "log")
    return (rf"\{part.function}" if known else rf"\mathrm{{{part.function}}}") + f"({argument})"


Sum: TypeAlias = Mapping[str, float] | Sequence[Group]  # terms, or an equation by process


def equation_text(state: str, terms: Sum, *, digits: int = 3) -> str:
    """Equation as text: `n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n`."""
    return f"{state}' = {' '.join(equation_parts(terms, digits=digits)) or '0'}"


def equation_parts(terms: Sum, *, digits: int = 3, reach: Reach = NOTHING) -> list[str]:
    """Terms of an equation as texts such as `+ 5.48e-14 n_i n_n`.

    terms: or groups of them, which become `+ n_i n_n (1.6e-32 n_i + 3.1e-33 n_n)`. reach:
    half-width of the confidence interval by term name; adds it as `(±2e-16)`, except for a known
    coefficient, whose half-width is zero. A known factor of one is not written.
    """
    return _parts_in(TEXT, terms, digits, reach)


@dataclass(frozen=True)
class Notation:
    """How the parts of an equation are written.

    term: product of a number, perhaps with the half-width of its interval, and a term. factor: of a
    group of terms. first_gap: between the sign of the first term and the term.
    """

    term: Callable[[str, float, float | None, int], str]
    factor: Callable[[str], str]
    first_gap: str


def _parts_in(notation: Notation, terms: Sum, digits: int, reach: Reach = NOTHING) -> list[str]:
    """Every term, or group of terms, with its sign."""
    if not isinstance(terms, Mapping):
        return [_group_in(notation, group, digits, first=k == 0) for k, group in enumerate(terms)]
    parts = []
    for k, (name, coef) in enumerate(terms.items()):
        body = notation.term(name, abs(coef), reach.get(name), digits)
        parts.append(_signed(body, coef, notation.first_gap, first=k == 0))
    return parts


def _group_in(notation: Notation, group: Group, digits: int, *, first: bool) -> str:
    inner, sign = _parts_in(notation, group.terms, digits, group.reach), group.sign
    if len(inner) > 1:
        factor = f"{notation.factor(group.factor)} " if group.factor != "1" else ""
        return _signed(f"{factor}({' '.join(inner)})", sign, "", first=first)
    # The sign of a single term and that of the group make one.
    sign *= 1 if next(iter(group.terms.values())) > 0.0 else -1
    return _signed(inner[0].removeprefix("-").strip(), sign, "", first=first)


def _signed(body: str, value: float, first_gap: str, *, first: bool) -> str:
    if value < 0.0:
        return f"-{first_gap if first else ' '}{body}"
    return body if first else f"+ {body}"


def _text_term(name: str, size: float, half_width: float | None, digits: int) -> str:
    factors = name.replace("*", " ")
    if size == 1.0 and not half_width:
        return factors
    error = f" (±{half_width:.2g})" if half_width else ""
    factors = "" if name == "1" else f" {factors}"
    factors = factors.replace(" 1/", "/", 1) if name.startswith(RECIPROCAL) else factors
    return f"{size:.{digits}g}{error}{factors}"


def _latex_term(name: str, size: float, half_width: float | None, digits: int) -> str:
    error = [rf"(\pm {_latex_number(half_width, 2)})"] if half_width else []
    factors = [] if name == "1" else [latex_term_name(name)]
    number = [] if factors and size == 1.0 and not error else [_latex_number(size, digits)]
    return r" \, ".join([*number, *error, *factors])


def _latex_number(value: float, digits: int) -> str:
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    return mantissa + (rf" \cdot 10^{{{int(exponent)}}}" if exponent else "")


def terms_latex(terms: Sum, *, digits: int = 3, reach: Reach = NOTHING) -> list[str]:
    r"""LaTeX of every term, or group of terms, with its sign: `- 2.62 \cdot 10^{5} \, n_{i}`.

    reach: half-width of the confidence interval by term name. A factor of one is not written.
    """
    return _parts_in(LATEX, terms, digits, reach)


def equations_latex(equations: Mapping[str, Sum], *, digits: int = 3) -> str:
    """LaTeX `aligned` block with one equation per line. equations: state -> terms."""
    lines = (
        f"{latex_derivative(state)} &= {' '.join(terms_latex(terms, digits=digits)) or 0}"
        for state, terms in equations.items()
    )
    return "\\begin{aligned}\n" + " \\\\\n".join(lines) + "\n\\end{aligned}"


def equation_html(state: str, terms: Sum, *, rate: bool = True, reach: Reach = NOTHING) -> str:
    """MathML of one equation, to three digits, with an element per term: lines break between them.

    terms: or groups of them. rate: of the state's rate. reach: half-width of the confidence
    interval by term name.
    """
    left = latex_name(state)
    if rate:
        left = rf"\mathrm{{d}} {left} / \mathrm{{d}} t"
    first, *others = terms_latex(terms, reach=reach) or ["0"]
    begin = f"{left} = {{{first}}}"  # in a group of its own a minus is a sign, not an operation
    return " ".join(map(mathml, (begin, *(f"{t[0]} \\,{t[1:]}" for t in others))))


def mathml(latex: str) -> str:
    """LaTeX as a `math` element; names in it end as text, never as markup."""
    from latex2mathml.converter import convert_to_element  # only when a page is written

    element = convert_to_element(latex)
    for each in element.iter():
        if each.text:
            each.text = html.unescape(each.text)  # signs come as entities, as in `&#x02212;`
    return ElementTree.tostring(element, encoding="unicode")


def sum_sympy(terms: Mapping[str, float]) -> sympy.Expr:
    """Right-hand side of an equation as a sympy expression, with coefficients as floats.

    A user's own function becomes an undefined sympy function of the same name.
    """
    import sympy  # imported here because it takes half a second and most runs do not need it

    return sympy.Add(
        *(
            sympy.Float(coef) * sympy.Mul(*(factor_sympy(p) ** p.power for p in _parts(name)))
            for name, coef in terms.items()
        )
    )


def _number_sympy(value: float) -> sympy.Expr:
    """A number as sympy keeps it: whole ones as integers, so that x^2 stays a square."""
    import sympy

    return sympy.Integer(int(value)) if value.is_integer() else sympy.Float(value)


def factor_sympy(part: Part) -> sympy.Expr:
    """One factor of a term, without its power, as a sympy expression."""
    import sympy

    argument = sympy.Symbol(part.variable)
    if not part.is_bare:
        argument = _number_sympy(part.scale) * argument + _number_sympy(part.shift)
    if not part.function:
        return argument
    if part.function == RECIPROCAL:
        return 1 / argument
    known = {"sin": sympy.sin, "cos": sympy.cos, "exp": sympy.exp, "log": sympy.log}
    known |= {"sqrt": sympy.sqrt, "abs": sympy.Abs, "sign": sympy.tanh}
    return known.get(part.function, sympy.Function(part.function))(argument)


def _parts(name: str) -> list[Part]:
    """Factors and powers of a term; a name that cannot be read as a term is kept as it is."""
    try:
        return split_term(name)
    except ValueError:
        return [Part("", name)]


def _sides(name: str) -> tuple[list[Part], list[Part]]:
    """Factors above and below the fraction line."""
    parts = _parts(name)
    below = [part for part in parts if part.function == RECIPROCAL]
    return [part for part in parts if part.function != RECIPROCAL], below


def _is_greek(stem: str) -> bool:
    """True for small Greek letters that LaTeX and matplotlib call by the same name."""
    alpha_to_omega = 0x3B1 <= name2codepoint.get(stem, 0) <= 0x3C9
    return alpha_to_omega and stem not in ("omicron", "sigmaf")


TEXT = Notation(_text_term, lambda factor: factor.replace("*", " "), "")
LATEX = Notation(_latex_term, lambda factor: rf"{latex_term_name(factor)} \,", " ")
