"""Equations as programs in Python, C, Julia and Modelica: a sympy printer and a template each."""

from __future__ import annotations

import keyword
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill, wrap
from types import MappingProxyType
from typing import Any

import numpy as np
import sympy
from jaxtyping import Float
from jinja2 import Environment, StrictUndefined
from sympy.core.function import AppliedUndef
from sympy.printing.c import C99CodePrinter
from sympy.printing.codeprinter import CodePrinter
from sympy.printing.cxx import CXX17CodePrinter
from sympy.printing.julia import JuliaCodePrinter
from sympy.printing.numpy import NumPyPrinter

from ep2sindy import __version__
from ep2sindy.library.equations import equation_text, factor_sympy
from ep2sindy.library.functions import REAL_LINE, Function, Kind, formula
from ep2sindy.library.library import Library
from ep2sindy.library.names import split_term
from ep2sindy.runtime.screen import in_line

WIDTH = 88  # of comments and equations, in characters
RENAMED = " in the model"  # how the note on a changed name ends


@dataclass(frozen=True)
class Language:
    """A language that equations can be written in.

    mark: what begins a comment. reserved: words that no variable can be called by, among them the
    names of functions and those that the template uses.
    """

    title: str
    mark: str
    printer: CodePrinter
    template: str
    reserved: frozenset[str]


@dataclass(frozen=True)
class Coef:
    """A named coefficient; the number in its shortest exact form, the term in words."""

    name: str
    number: str
    term: str


@dataclass(frozen=True)
class CodeVariable:
    """A state or an input under its name in the program.

    place: among the states or among the inputs. used: whether any equation holds it.
    """

    name: str
    place: int
    number: str  # initial value
    about: str
    used: bool


def program_text(
    language: str,
    library: Library,
    equations: Mapping[str, Mapping[str, float]],
    *,
    inputs: Sequence[str],
    units: Mapping[str, str],
    provenance: Mapping[str, str],
    start: Float[np.ndarray, " n_states"],
    duration_s: float,
) -> str:
    """Program text; see `SparseModel.to_code`. equations: state -> coefficients by term."""
    written = LANGUAGES.get(language)
    if written is None:
        raise ValueError(
            f"a model can be written as one of {list(LANGUAGES)}: language {language!r} came"
        )
    factors = [f for e in equations.values() for n in e for f in _factors_of(library, n)]
    names = identifiers([*equations, *inputs], written.reserved)
    starts, used = [*map(float, start), *([0.0] * len(inputs))], {v for v, _ in factors}
    places = [*range(len(equations)), *range(len(inputs))]
    variables = [
        CodeVariable(name, k, repr(number), _about(v, name, units[v]), v in used)
        for (v, name), k, number in zip(names.items(), places, starts, strict=True)
    ]
    functions = list(dict.fromkeys(f for _, f in factors if f is not None))
    bodies = {f.kind.name: f.kind for f in functions}
    coefs, sums = _coefs_and_sums(equations, written, names, bodies)
    environment = Environment(
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, undefined=StrictUndefined
    )
    environment.filters.update(quoted=_quoted, lines=_lines)
    return environment.from_string(written.template).render(
        head=_head(written, equations, variables, functions, provenance),
        states=variables[: len(equations)],
        inputs=variables[len(equations) :],
        coefs=coefs,
        sums=sums,
        duration=repr(float(duration_s)),
    )


def _factors_of(library: Library, name: str) -> list[tuple[str, Function | None]]:
    """Variable of each factor of a term, and the function of it, or None."""
    factors = [factor for factor, _ in library.terms[library.index(name)].factors]
    return [(f.variable, f if isinstance(f, Function) else None) for f in factors]


def _coefs_and_sums(
    equations: Mapping[str, Mapping[str, float]],
    language: Language,
    names: Mapping[str, str],
    kinds: Mapping[str, Kind],
) -> tuple[list[Coef], list[str]]:
    """All coefficients, and by equation the right-hand side as an expression."""
    coefs, sums = [], []
    for state, terms in equations.items():
        products = []
        for k, (term, value) in enumerate(terms.items()):
            coef = Coef(f"c_{names[state]}_{k + 1}", repr(value), in_line(f"{term} in {state}'"))
            factors = [sympy.Symbol(coef.name), *_factors_sympy(term, names, kinds)]
            # Unevaluated, so that factors stay in the order of the term.
            product = sympy.Mul(*factors, evaluate=False) if factors[1:] else factors[0]
            products.append(language.printer.doprint(product))
            coefs.append(coef)
        sums.append(_sum(products))
    return coefs, sums


def _factors_sympy(
    term: str, names: Mapping[str, str], kinds: Mapping[str, Kind]
) -> list[sympy.Expr]:
    """Factors of a term, of the variables by their names in the program."""
    symbols = {sympy.Symbol(v): sympy.Symbol(name) for v, name in names.items()}
    factors = []
    for part in split_term(term):
        factor = factor_sympy(part).xreplace(symbols)
        own = {f: formula(kinds[f.func.__name__], f.args[0]) for f in factor.atoms(AppliedUndef)}
        factors.append(factor.xreplace(own) ** part.power)
    return factors


def _sum(products: Sequence[str]) -> str:
    """Sum in one line, or with a line for each product, in brackets."""
    line = " + ".join(products) or "0.0"
    if len(line) <= WIDTH - 20:
        return line
    return "(\n        " + " +\n        ".join(products) + "\n    )"


# Comments and strings: whatever a text holds, it stays within its line.


def _head(
    language: Language,
    equations: Mapping[str, Mapping[str, float]],
    variables: Sequence[CodeVariable],
    functions: Sequence[Function],
    provenance: Mapping[str, str],
) -> str:
    """Comment at the top: equations, variables and their units, limits, and the origin."""
    n = len(equations)
    changed = any(v.about.endswith(RENAMED) for v in variables)
    blocks = [
        [f"Equations of a model of EP2-SINDy {__version__}, in SI units, t in s."],
        [equation_text(state, terms) for state, terms in equations.items()],
        _titled("states", [f"{v.name} {v.about}" for v in variables[:n]]),
        _titled("inputs", [f"{v.name} {v.about}" for v in variables[n:]]),
        [f"Names that {language.title}, or this program, cannot take are changed."]
        if changed
        else [],
        _titled(
            "domain", [f"{f.name} needs {f.need}" for f in functions if f.kind.domain != REAL_LINE]
        ),
        _titled("provenance", [f"{key}: {value}" for key, value in provenance.items()]),
    ]
    lines = ["", *(line for block in blocks if block for line in [*block, ""])][1:-1]
    return "\n".join(text for line in lines for text in _comment(line, language.mark))


def _titled(title: str, rows: Sequence[str]) -> list[str]:
    return [f"{title}:", *(f"  {row}" for row in rows)] if rows else []


def _comment(text: str, mark: str) -> list[str]:
    """Lines of a comment."""
    lines = wrap(in_line(text), WIDTH, subsequent_indent="    ", break_on_hyphens=False) or [""]
    # A backslash at the end of a line of C, or its trigraph, would draw the next into the comment.
    return [re.sub(r"(\\|[?][?]/)$", r"\1 .", f"{mark} {line}".rstrip()) for line in lines]


def _quoted(text: str) -> str:
    """Text as a string of Modelica."""
    text = in_line(text).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{text}"'


def _lines(names: Iterable[str]) -> str:
    """Names after each other, in as many lines as they take."""
    return fill(", ".join(names), WIDTH, subsequent_indent="        ")


def _about(variable: str, name: str, unit: str) -> str:
    return f"in {unit}" + ("" if name == variable else f", {variable}{RENAMED}")


# Names of variables.


def identifiers(variables: Sequence[str], reserved: frozenset[str]) -> dict[str, str]:
    """Variable -> its name in a program, an ASCII word that is not reserved and stands once.

    A name that is such a word is kept. Others lose what is not a letter or digit (`n_i@exit` is
    n_i_exit, a Greek letter its name), and a reserved one gets a `_`.
    """
    words = {variable: _word(variable) for variable in variables}
    kept = {v for v, word in words.items() if word == v and not _is_taken(word, reserved)}
    names, taken = {}, set(kept)
    for variable, word in words.items():
        while variable not in kept and (word in taken or _is_taken(word, reserved)):
            word += "_"
        names[variable] = word
        taken.add(word)
    return names


def _is_taken(word: str, reserved: frozenset[str]) -> bool:
    """True for reserved words, and for names such as coefficients and inputs have."""
    return word in reserved or re.fullmatch(r"c_\w+_\d+|input_\w+", word) is not None


def _word(variable: str) -> str:
    """ASCII word that is like a variable's name."""
    letters = unicodedata.normalize("NFKD", variable)
    letters = "".join(c if c.isascii() else _letter_name(c) for c in letters)
    word = re.sub(r"\W+", "_", letters).strip("_" if re.search(r"\W", letters) else "")
    return word if word[:1].isalpha() else f"v{word}"


def _letter_name(letter: str) -> str:
    """`alpha` for the Greek letter; nothing for an accent, `_` for what has no such name."""
    if unicodedata.combining(letter):
        return ""
    name = unicodedata.name(letter, "").lower().rpartition(" ")[2]
    return name if name.isalpha() and name.isascii() else "_"


# Printers: those of sympy, but that every number is read back as it was.


class _Exact(CodePrinter):
    """What the printers below share: numbers in their shortest exact form."""

    def _print_Float(self, number: sympy.Float) -> str:
        return repr(float(number))

    _print_Rational = _print_Float

    def _print_Integer(self, number: sympy.Integer) -> str:
        return str(int(number)) if abs(number) < 2**31 else repr(float(number))  # C's int


class PythonPrinter(_Exact, NumPyPrinter):
    """NumPy's functions as np.sin."""

    def _module_format(self, fqn: str, register: bool = True) -> str:
        return super()._module_format(fqn, register).replace("numpy.", "np.")


class CPrinter(_Exact, C99CodePrinter):
    """C99 with the functions of math.h."""


class CaretPrinter(_Exact, JuliaCodePrinter):
    """Powers as x^2, of numbers and not of arrays: this serves Julia and Modelica."""

    _print_Mul = CodePrinter._print_Mul

    def _print_Pow(self, power: sympy.Pow, **settings: Any) -> str:
        return CodePrinter._print_Pow(self, power, **settings).replace("**", "^")


# Templates. The arguments have long names, so that states may be called x, u and p.


PYTHON = '''\
{{ head }}

import numpy as np

{% for c in coefs %}
{{ c.name }} = {{ c.number }}  # {{ c.term }}
{% endfor %}


def rhs(t, states, inputs=()):
    """Rates of the states, in SI per second.

    t: in s. states: ({{ states|length }},) or ({{ states|length }}, points), in the order above.
    inputs: their values at t, in the order above; () where there are none.
    """
    [{{ states|map(attribute="name")|lines }}] = states
{% if inputs %}
    [{{ inputs|map(attribute="name")|lines }}] = inputs
{% endif %}
    rates = np.empty(np.shape(states))
{% for sum in sums %}
    rates[{{ loop.index0 }}] = {{ sum }}
{% endfor %}
    return rates


if __name__ == "__main__":
    from scipy.integrate import solve_ivp

    start = np.array(
        [
{% for v in states %}
            {{ v.number }},  # {{ v.name }}
{% endfor %}
        ]
    )
    duration_s = {{ duration }}

{% if inputs %}
    def rates_at(t, states):
        inputs = [
{% for v in inputs %}
            {{ v.number }},  # {{ v.name }}: put in its value at t
{% endfor %}
        ]
        return rhs(t, states, inputs)

{% endif %}
    solution = solve_ivp(
        {{ "rates_at" if inputs else "rhs" }},
        (0.0, duration_s),
        start,
        method="LSODA",
        rtol=1e-8,
        atol=1e-8 * np.where(start == 0.0, 1.0, np.abs(start)),
    )
    print(solution.message)
    print("at", solution.t[-1], "s:", solution.y[:, -1])
'''

C = """\
{{ head }}

#include <math.h>

{% for c in coefs %}
static const double {{ c.name }} = {{ c.number }};  // {{ c.term }}
{% endfor %}

// Rates of the states, in SI per second. t: in s. states, inputs, rates: in the order above;
// inputs may be NULL where there are none.
void rhs(double t, const double *states, const double *inputs, double *rates)
{
{% for v in states if v.used %}
    const double {{ v.name }} = states[{{ v.place }}];
{% endfor %}
{% for v in inputs if v.used %}
    const double {{ v.name }} = inputs[{{ v.place }}];
{% endfor %}
    (void)t;
    (void)states;
    (void)inputs;
{% for sum in sums %}
    rates[{{ loop.index0 }}] = {{ sum }};
{% endfor %}
}
"""

JULIA = """\
{{ head }}

parameters = (;
{% for c in coefs %}
    {{ c.name }} = {{ c.number }},  # {{ c.term }}
{% endfor %}
)

{% for v in inputs %}
input_{{ v.name }}(t) = {{ v.number }}  # put in a function of t in s
{{ "\n" if loop.last }}
{%- endfor %}
# Rates of the states, in SI per second. t: in s. rates, states: in the order above.
# For Julia 1.7 and newer.
function rhs!(rates, states, parameters, t)
{% if coefs %}
    (; {{ coefs|map(attribute="name")|lines }}) = parameters
{% endif %}
{% for v in states if v.used %}
    {{ v.name }} = states[{{ v.place + 1 }}]
{% endfor %}
{% for v in inputs if v.used %}
    {{ v.name }} = input_{{ v.name }}(t)
{% endfor %}
{% for sum in sums %}
    rates[{{ loop.index }}] = {{ sum }}
{% endfor %}
    return nothing
end

if abspath(PROGRAM_FILE) == @__FILE__
    using DifferentialEquations

    start = [
{% for v in states %}
        {{ v.number }},  # {{ v.name }}
{% endfor %}
    ]
    problem = ODEProblem(rhs!, start, (0.0, {{ duration }}), parameters)
    scales = ifelse.(start .== 0.0, 1.0, abs.(start))
    solution = solve(problem; reltol = 1e-8, abstol = 1e-8 * scales)
    println(solution.retcode, " at ", solution.t[end], " s: ", solution.u[end])
end
"""

MODELICA = """\
{{ head }}

model Equations
{% for c in coefs %}
    parameter Real {{ c.name }} = {{ c.number }} {{ c.term|quoted }};
{% endfor %}
{% for v in inputs %}
    input Real {{ v.name }} {{ v.about|quoted }};
{% endfor %}
{% for v in states %}
    Real {{ v.name }}(start = {{ v.number }}, fixed = true) {{ v.about|quoted }};
{% endfor %}
equation
{% for sum in sums %}
    der({{ states[loop.index0].name }}) = {{ sum }};
{% endfor %}
    annotation(experiment(StopTime = {{ duration }}, Tolerance = 1e-8));
end Equations;
"""


# Words that no variable can be called by: those that the template uses, those of the language, and
# functions.
FUNCTIONS = "abs acos asin atan cos cosh exp fabs log pow sin sinh sqrt tan tanh"
PYTHON_WORDS = "np t states inputs rates rhs"
C_WORDS = """
    t states inputs rates rhs HUGE_VAL INFINITY M_1_PI M_2_PI M_2_SQRTPI M_E M_LN10 M_LN2 M_LOG10E
    M_LOG2E M_PI M_PI_2 M_PI_4 M_SQRT1_2 M_SQRT2 NAN NULL linux unix
"""
C99_WORDS, CXX_WORDS = C99CodePrinter.reserved_words, CXX17CodePrinter.reserved_words
JULIA_WORDS = """
    t states parameters rates
    abstract baremodule begin break catch const continue do else elseif end export false finally for
    function global if import in isa let local macro module mutable outer primitive public quote
    return struct true try type using where while
"""
MODELICA_WORDS = """
    Equations
    Boolean Integer Real String acos algorithm and annotation asin assert atan atan2 block break
    cardinality ceil change class connect connector constant constrainedby delay der discrete div
    each edge else elseif elsewhen encapsulated end enumeration equation expandable extends external
    false final floor flow for function homotopy if import impure in initial inner input inStream
    integer log10 loop max min mod model noEvent not operator or outer output package parameter
    partial pre previous protected public pure record redeclare reinit rem replaceable return sample
    semiLinear sign smooth stream sum terminal terminate then time true type when while within
"""


def _reserved(own: str, *others: Iterable[str]) -> frozenset[str]:
    return frozenset([*FUNCTIONS.split(), *own.split(), *(word for o in others for word in o)])


IN_ORDER = {"order": "none"}  # of factors, as they are given
LANGUAGES: Mapping[str, Language] = MappingProxyType(
    {
        "python": Language(
            "Python", "#", PythonPrinter(IN_ORDER), PYTHON, _reserved(PYTHON_WORDS, keyword.kwlist)
        ),
        # Compilers of C++ take C as well.
        "c": Language("C", "//", CPrinter(IN_ORDER), C, _reserved(C_WORDS, C99_WORDS, CXX_WORDS)),
        "julia": Language("Julia", "#", CaretPrinter(IN_ORDER), JULIA, _reserved(JULIA_WORDS)),
        "modelica": Language(
            "Modelica", "//", CaretPrinter(IN_ORDER), MODELICA, _reserved(MODELICA_WORDS)
        ),
    }
)
