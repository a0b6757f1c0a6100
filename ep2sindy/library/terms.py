"""Terms: products of factors, each a variable or a function of one, to whole powers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from ep2sindy.library.names import split_factors
from ep2sindy.library.units import unit_product


@runtime_checkable
class Factor(Protocol):
    """What terms multiply: a variable, or a function of one. Equal by value, and hashable."""

    @property
    def name(self) -> str:
        """As the names of terms write it."""
        ...

    @property
    def variable(self) -> str: ...

    def value(self, x: Any) -> Any:
        """At any values of the variable, in a NumPy array or a torch tensor."""
        ...

    def derivative(self) -> tuple[float, Factor | None]:
        """By the variable: a number times a factor, or times one where it is None."""
        ...

    def scaled(self, scale: float) -> tuple[float, Factor]:
        """The factor of `scale` times the variable: a number times a factor of the variable."""
        ...

    def unit(self, unit: str) -> str:
        """From the unit of the variable."""
        ...


@dataclass(frozen=True)
class Variable:
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


@dataclass(frozen=True)
class Term:
    """A product of powers of factors; of none, the constant.

    factors: as `product` orders them, so that equal terms are equal values.
    """

    factors: tuple[tuple[Factor, int], ...]

    @property
    def name(self) -> str:
        """`1`, `n_i`, `n_i*n_n`, `n_i^2`."""
        parts = (f.name if power == 1 else f"{f.name}^{power}" for f, power in self.factors)
        return "*".join(parts) or "1"

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
    powers: dict[Factor, int] = {}
    for factor, power in _factors(name):
        if factor.variable not in variables:
            raise ValueError(
                f"unknown variable {factor.variable!r} in term {name!r}; there are "
                f"{list(variables)}"
            )
        powers[factor] = powers.get(factor, 0) + power
    return product(powers, variables)


def variables_of(name: str) -> list[str]:
    """The variables that a term name needs, in its own order."""
    return list(dict.fromkeys(factor.variable for factor, _ in _factors(name)))


def _factors(name: str) -> list[tuple[Factor, int]]:
    if name.strip() == "1":
        return []
    return [(Variable(text), power) for text, power in split_factors(name)]
