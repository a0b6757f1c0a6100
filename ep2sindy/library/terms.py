"""Terms: products of factors, each a variable or a function of one, to whole powers.

And how many terms a library of some degree has, which is counted before it is built.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import comb, prod
from typing import Any

from ep2sindy.library.functions import Function, function_names, function_of
from ep2sindy.library.names import RECIPROCAL, Part, split_term
from ep2sindy.library.units import unit_product
from ep2sindy.trust.memory import check_memory


@dataclass(frozen=True)
class VariableFactor:
    """The factor that is the variable itself."""

    name: str

    @property
    def variable(self) -> str:
        return self.name

    def value(self, x: Any) -> Any:
        return x

    def derivative(self) -> tuple[float, Factor | None]:
        return 1.0, None

    def scaled(self, scale: float) -> tuple[float, Factor]:
        return scale, self

    def unit(self, unit: str) -> str:
        return unit


Factor = VariableFactor | Function


@dataclass(frozen=True)
class Term:
    """A product of powers of factors; of none, the constant.

    factors: as `product` orders them, so that equal terms are equal values.
    """

    factors: tuple[tuple[Factor, int], ...]

    @property
    def name(self) -> str:
        """`1`, `n_i`, `n_i*n_n`, `n_i^2`, `x*sin(y)/z`."""
        parts = [f.name if power == 1 else f"{f.name}^{power}" for f, power in self.factors]
        over = "*".join(part for part in parts if not part.startswith(RECIPROCAL)) or "1"
        return over + "".join(part[1:] for part in parts if part.startswith(RECIPROCAL))

    def derivative(self, variable: str) -> dict[Term, float]:
        """By one variable: the terms it is a sum of, and what each is multiplied by."""
        order = list(dict.fromkeys(factor.variable for factor, _ in self.factors))
        found: dict[Term, float] = {}
        for factor, power in self.factors:
            if factor.variable == variable:
                number, slope = factor.derivative()
                powers = dict(self.factors)
                powers[factor] -= 1
                if slope is not None:
                    powers[slope] = powers.get(slope, 0) + 1
                term = product(powers, order)
                found[term] = found.get(term, 0.0) + number * power
        return found

    def unit(self, units: Mapping[str, str]) -> str:
        """From the units of the variables."""
        return unit_product((f.unit(units[f.variable]), power) for f, power in self.factors)


def product(powers: Mapping[Factor, int], variables: Sequence[str]) -> Term:
    """The term of these powers: factors in the order of `variables`, functions behind theirs."""

    def place(factor: Factor) -> tuple[int, bool, str]:
        return variables.index(factor.variable), factor.name != factor.variable, factor.name

    return Term(tuple((f, powers[f]) for f in sorted(powers, key=place) if powers[f]))


def read_term(name: str, variables: Sequence[str]) -> Term:
    """Read a term name such as `n_i^2*n_n`; factors may come in any order."""
    return product(read_factors(name, variables), variables)


def read_factors(name: str, variables: Sequence[str]) -> dict[Factor, int]:
    """The factors of a term name, and their powers.

    Raises ValueError for a name that is no term, an unknown variable or an unknown function.
    """
    powers: dict[Factor, int] = {}
    for factor, power in _factors(name):
        if factor.variable not in variables:
            raise ValueError(
                f"unknown variable {factor.variable!r} in term {name!r}; there are "
                f"{list(variables)}"
            )
        powers[factor] = powers.get(factor, 0) + power
    if sum(powers.values()) > LARGEST_DEGREE:
        raise ValueError(
            f"a term may have up to {LARGEST_DEGREE} factors: {name!r:.60} has "
            f"{sum(powers.values())}, whose values no number holds"
        )
    return powers


def functions_named(names: Sequence[str], variables: Sequence[str]) -> list[Function]:
    """What a list of functions means: each of every variable, or of the one that it names.

    Raises ValueError for what is no function.
    """
    if isinstance(names, str):
        raise ValueError(f"functions must be a list: {names!r} came; write [{names!r}]")
    found: list[Function] = []
    for name in names:
        texts = [f"{name}({v})" for v in variables] if name in function_names() else [name]
        for text in texts:
            if [(bool(p.function), p.power) for p in split_term(text)] != [(True, 1)]:
                raise ValueError(
                    f"functions must be some of {function_names()}, for every variable, or one "
                    f"written out, such as 'sin(2*{variables[0]})': {name!r} came; products go "
                    "into products, or come with function_degree=2; a function of your own is "
                    "registered first, by ep.register_function"
                )
            found += [f for f in read_factors(text, variables) if isinstance(f, Function)]
    return list(dict.fromkeys(found))


def variables_of(name: str) -> list[str]:
    """The variables that a term name needs, in its own order."""
    return list(dict.fromkeys(factor.variable for factor, _ in _factors(name)))


def _factors(name: str) -> list[tuple[Factor, int]]:
    return [(factor_of(part), part.power) for part in split_term(name)]


def factor_of(part: Part) -> Factor:
    """A variable, or a function of one, as it is written."""
    return function_of(part) if part.function else VariableFactor(part.variable)


# How large a library may be: counted before it is made.


LARGEST_DEGREE = 100
MAX_TERMS = 20_000  # whose products with each other take 3 GB
MAX_EXPONENTS = 4_000_000  # all terms that there may be, of 200 variables


def check_degrees(degree: int, function_degree: int, n_variables: int, n_functions: int) -> None:
    """Raise ValueError for degrees that are none, or whose products are more than can be held."""
    if not isinstance(degree, int) or degree < 0:
        raise ValueError(f"degree must be a whole number, zero or more: {degree!r} came")
    if not isinstance(function_degree, int) or function_degree < 1:
        raise ValueError(f"function_degree must be one or more: {function_degree!r} came")
    if function_degree > 1 and not n_functions:
        raise ValueError(f"function_degree={function_degree} needs functions, such as ['sin']")
    _check_size("degree", degree, n_variables)
    _check_size("function_degree", function_degree, n_variables + n_functions)


def _check_size(name: str, degree: int, n_factors: int) -> None:
    if degree > LARGEST_DEGREE:
        raise ValueError(f"{name} must be {LARGEST_DEGREE} or less: {degree} came")
    if (n_terms := comb(n_factors + degree, degree)) <= MAX_TERMS:
        check_exponents(n_terms, n_factors)
        return
    fits = next(d for d in range(degree, -1, -1) if comb(n_factors + d, d) <= MAX_TERMS)
    raise ValueError(
        f"a library may have up to {MAX_TERMS} terms: {name}={degree} of {n_factors} variables "
        f"and functions makes {n_terms:.4g}; {name}={fits} makes {comb(n_factors + fits, fits)}"
    )


def check_exponents(n_terms: int, n_factors: int) -> None:
    """Raise ValueError for more terms than a library may hold of so many factors."""
    if n_terms * n_factors > MAX_EXPONENTS:
        raise ValueError(
            f"a library may have up to {MAX_EXPONENTS / 1e6:g} million exponents, one for every "
            f"term and variable or function: {n_terms} terms of {n_factors} came; leave out terms, "
            "or variables that no term has"
        )


def check_values(n_terms: int, shape: Sequence[int]) -> None:
    """Raise ValueError where the terms at so many samples, (..., variables), exceed memory."""
    n_samples = prod(shape[:-1])
    check_memory(
        24.0 * n_terms * n_samples,  # and what they are made of
        f"{n_terms} terms at {n_samples} samples",
        way_out="take every second sample (ep2sindy.prepare.decimate), or fewer terms",
        each=24.0 * n_terms,
    )
