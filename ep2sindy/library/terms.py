"""Terms: products of variables, and of functions of one variable, raised to whole powers.

Also checks the size of a library before it is built.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import comb, prod
from typing import Protocol, runtime_checkable

from ep2sindy.library.functions import Function, function_names, function_of
from ep2sindy.library.names import RECIPROCAL, split_term
from ep2sindy.library.units import unit_product
from ep2sindy.runtime.values import check_count, check_list
from ep2sindy.trust.memory import check_memory


@runtime_checkable
class NamedTerms(Protocol):
    """Protocol of a list of terms, as relations and roles need it: a `Library`."""

    @property
    def variables(self) -> Sequence[str]: ...

    @property
    def names(self) -> Sequence[str]: ...

    def index(self, name: str) -> int: ...


@dataclass(frozen=True)
class Term:
    """A product of powers of factors; without factors, the constant.

    factors: (factor, power) in the order of `product`, so that equal terms compare equal.
    """

    factors: tuple[tuple[Function, int], ...]

    @property
    def name(self) -> str:
        """Name such as `1`, `n_i`, `n_i*n_n`, `n_i^2`, `x*sin(y)/z`."""
        parts = [f.name if power == 1 else f"{f.name}^{power}" for f, power in self.factors]
        over = "*".join(part for part in parts if not part.startswith(RECIPROCAL)) or "1"
        return over + "".join(part[1:] for part in parts if part.startswith(RECIPROCAL))

    def derivative(self, variable: str) -> dict[Term, float]:
        """Derivative by one variable, as a sum of terms: term -> factor."""
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
        """Unit of the term, from the units of the variables."""
        return unit_product((f.unit(units[f.variable]), power) for f, power in self.factors)


def product(powers: Mapping[Function, int], variables: Sequence[str]) -> Term:
    """Term with these powers; each function follows its variable, in the order of `variables`."""

    def place(factor: Function) -> tuple[int, bool, str]:
        return variables.index(factor.variable), not factor.is_variable, factor.name

    return Term(tuple((f, powers[f]) for f in sorted(powers, key=place) if powers[f]))


def read_term(name: str, variables: Sequence[str]) -> Term:
    """Read a term name such as `n_i^2*n_n`; factors may come in any order."""
    return product(read_factors(name, variables), variables)


def read_factors(name: str, variables: Sequence[str]) -> dict[Function, int]:
    """Read the factors of a term name, and their powers.

    Raises ValueError for a name that is not a term, an unknown variable or function, or a degree
    beyond 100.
    """
    powers: dict[Function, int] = {}
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
    """Functions that a list of names stands for.

    A bare name such as `sin` gives one function of every variable; `sin(2*x)` gives that function.
    Raises ValueError for a name that is not a function.
    """
    check_list("functions", names)
    found: list[Function] = []
    for name in names:
        texts = [f"{name}({v})" for v in variables] if name in function_names() else [name]
        for text in texts:
            if [(bool(p.function), p.power) for p in split_term(text)] != [(True, 1)]:
                raise ValueError(
                    f"functions must be some of {function_names()}, for every variable, or one "
                    f"written out, such as 'sin(2*{variables[0]})', got {name!r}; products go "
                    "into products, or come with function_degree=2; a function of your own is "
                    "registered first, by ep.register_function"
                )
            found += read_factors(text, variables)
    return list(dict.fromkeys(found))


def variables_of(name: str) -> list[str]:
    """Variables that a term needs, in the order of its name."""
    return list(dict.fromkeys(factor.variable for factor, _ in _factors(name)))


def _factors(name: str) -> list[tuple[Function, int]]:
    return [(function_of(part), part.power) for part in split_term(name)]


# Limits on the size of a library, checked before it is built.


LARGEST_DEGREE = 100
MAX_TERMS = 20_000  # the Gram matrix of so many terms takes 3 GB
MAX_EXPONENTS = 4_000_000  # MAX_TERMS terms of 200 variables


def check_degrees(degree: int, function_degree: int, n_variables: int, n_functions: int) -> None:
    """Raise ValueError for invalid degrees, or for degrees that give too many terms."""
    degree = check_count("degree", degree, 0)
    function_degree = check_count("function_degree", function_degree)
    if function_degree > 1 and not n_functions:
        raise ValueError(f"function_degree={function_degree} needs functions, such as ['sin']")
    _check_size("degree", degree, n_variables)
    _check_size("function_degree", function_degree, n_variables + n_functions)


def _check_size(name: str, degree: int, n_factors: int) -> None:
    if degree > LARGEST_DEGREE:
        raise ValueError(f"{name} must be {LARGEST_DEGREE} or less, got {degree}")
    if (n_terms := comb(n_factors + degree, degree)) <= MAX_TERMS:
        check_exponents(n_terms, n_factors)
        return
    fits = next(d for d in range(degree, -1, -1) if comb(n_factors + d, d) <= MAX_TERMS)
    raise ValueError(
        f"a library may have up to {MAX_TERMS} terms: {name}={degree} of {n_factors} variables "
        f"and functions makes {n_terms:.4g}; {name}={fits} makes {comb(n_factors + fits, fits)}"
    )


def check_exponents(n_terms: int, n_factors: int) -> None:
    """Raise ValueError if terms times factors exceed the number of exponents a library may have."""
    if n_terms * n_factors > MAX_EXPONENTS:
        raise ValueError(
            f"a library may have up to {MAX_EXPONENTS / 1e6:g} million exponents, one for every "
            f"term and variable or function, got {n_terms} terms of {n_factors}; leave out terms, "
            "or variables that no term has"
        )


def check_values(n_terms: int, shape: Sequence[int]) -> None:
    """Raise ValueError if the values of all terms do not fit in memory.

    shape: (..., variables), the shape of the samples.
    """
    n_samples = prod(shape[:-1])
    check_memory(
        24.0 * n_terms * n_samples,  # 8 bytes per value, and temporary arrays
        f"{n_terms} terms at {n_samples} samples",
        hint="take every second sample (ep2sindy.data.decimate), or fewer terms",
        each=24.0 * n_terms,
    )
