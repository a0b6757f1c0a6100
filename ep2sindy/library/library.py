"""The library: candidate terms for the right-hand side, as products of powers of variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from array_api_compat import array_namespace
from jaxtyping import Int

from ep2sindy.library.names import split_factors
from ep2sindy.library.units import unit_product


@dataclass(frozen=True, eq=False)
class Library:
    """Ordered candidate terms, each a product of powers of `variables`.

    exponents: (terms, variables), non-negative integers; a row of zeros is the constant.
    Term names read `1`, `n_i`, `n_i*n_n`, `n_i^2`, factors in the order of `variables`.
    Raises ValueError for repeated variables or terms, or no term at all.
    """

    variables: Sequence[str]
    exponents: Int[np.ndarray, "terms variables"]

    def __post_init__(self) -> None:
        exponents = np.array(self.exponents, dtype=np.int64)
        exponents.flags.writeable = False
        object.__setattr__(self, "variables", tuple(self.variables))
        object.__setattr__(self, "exponents", exponents)
        if len(set(self.variables)) < len(self.variables):
            raise ValueError(f"variables must be unique: {list(self.variables)}")
        if not len(exponents):
            raise ValueError("a library needs at least one term: none came")
        if len(np.unique(exponents, axis=0)) < len(exponents):
            raise ValueError(f"terms must be unique: {list(self.names)}")

    def __len__(self) -> int:
        return len(self.exponents)

    def __add__(self, other: Library) -> Library:
        """Terms of both libraries over the same variables, each once, in order."""
        if other.variables != self.variables:
            raise ValueError(
                f"libraries to be joined must share their variables: {list(self.variables)} "
                f"against {list(other.variables)}"
            )
        new = [row for row in other.exponents if not (self.exponents == row).all(axis=1).any()]
        return Library(self.variables, np.array([*self.exponents, *new]))

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple("*".join(self._factors_of(row)) or "1" for row in self.exponents)

    @cached_property
    def factors(self) -> Int[np.ndarray, "terms degree"]:
        """Indices of the variables multiplied in each term, padded with n_variables, meaning 1."""
        return _factor_table(self.exponents)

    def evaluate(self, values: Any) -> Any:
        """Evaluate every term at every sample.

        values: (..., variables), a NumPy array or a torch tensor, in the order of `variables`.
        Returns (..., terms), of the same kind.
        """
        return _products(values, self.factors)

    def jacobian(self, values: Any) -> Any:
        """Derivative of every term by every variable, at every sample.

        values: as for `evaluate`. Returns (variables, ..., terms), of the same kind.
        """
        xp = array_namespace(values)
        derivatives = []
        for v in range(len(self.variables)):
            powers = self.exponents[:, v]
            lowered = self.exponents.copy()
            lowered[:, v] = np.maximum(powers - 1, 0)
            derivatives.append(_products(values, _factor_table(lowered)) * xp.asarray(1.0 * powers))
        return xp.stack(derivatives)

    def index(self, name: str) -> int:
        """Position of a term; factors may come in any order. Raises ValueError if absent."""
        row = term_exponents(name, self.variables)
        found = np.flatnonzero((self.exponents == row).all(axis=1))
        if not found.size:
            raise ValueError(f"unknown term {name!r}; this library has {list(self.names)}")
        return int(found[0])

    def units(self, units: Mapping[str, str]) -> tuple[str, ...]:
        """Unit of every term, from the units of the variables."""
        return tuple(
            unit_product((units[v], int(p)) for v, p in zip(self.variables, row, strict=True))
            for row in self.exponents
        )

    def _factors_of(self, row: np.ndarray) -> list[str]:
        return [v if p == 1 else f"{v}^{p}" for v, p in zip(self.variables, row, strict=True) if p]


def _factor_table(exponents: np.ndarray) -> np.ndarray:
    """For every row of powers, the indices of its factors, padded with the number of variables."""
    n_variables = exponents.shape[1]
    degree = max(1, int(exponents.sum(axis=1).max()))
    table = np.full((len(exponents), degree), n_variables)
    for row, powers in zip(table, exponents, strict=True):
        indices = np.repeat(np.arange(n_variables), powers)
        row[: len(indices)] = indices
    return table


def _products(values: Any, factors: np.ndarray) -> Any:
    """Multiply columns of `values` as a factor table says."""
    xp = array_namespace(values)
    padded = xp.concat([values, xp.ones_like(values[..., :1])], axis=-1)
    theta = padded[..., factors[:, 0]]
    for indices in factors.T[1:]:
        theta = theta * padded[..., indices]
    return theta


def term_exponents(name: str, variables: Sequence[str]) -> Int[np.ndarray, " variables"]:
    """Read a term name such as `n_i^2*n_n` into one exponent per variable."""
    exponents = np.zeros(len(variables), dtype=np.int64)
    if name.strip() == "1":
        return exponents
    for variable, power in split_factors(name):
        if variable not in variables:
            raise ValueError(
                f"unknown variable {variable!r} in term {name!r}; there are {list(variables)}"
            )
        exponents[list(variables).index(variable)] += power
    return exponents


def named_terms(variables: Sequence[str], names: Sequence[str]) -> Library:
    """A library of exactly these terms, in this order."""
    exponents = [term_exponents(name, variables) for name in names]
    return Library(variables, np.array(exponents, dtype=np.int64).reshape(-1, len(variables)))


def polynomial(variables: Sequence[str], *, degree: int, products: Sequence[str] = ()) -> Library:
    """All products of `variables` up to `degree`, the constant included, then named products.

    Ordered by degree, then by the order of the variables: 1, x, y, x^2, x*y, y^2, ...
    Raises ValueError for a negative degree or an unknown variable in a product.
    """
    if not isinstance(degree, int) or degree < 0:
        raise ValueError(f"degree must be a whole number, zero or more: {degree!r} came")
    rows = [
        np.bincount(combination, minlength=len(variables))
        for n in range(degree + 1)
        for combination in map(list, combinations_with_replacement(range(len(variables)), n))
    ]
    full = Library(variables, np.array(rows, dtype=np.int64))
    return full + named_terms(variables, products) if products else full
