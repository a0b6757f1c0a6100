"""Right-hand sides of sparse models and their derivatives, as sums of products of variables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.library.library import Library
from ep2sindy.library.units import Clock


@runtime_checkable
class Equations(Protocol):
    """Interface of equations x' = library(states, inputs) coef, such as a SparseModel."""

    @property
    def library(self) -> Library: ...

    @property
    def states(self) -> Sequence[str]: ...

    @property
    def inputs(self) -> Sequence[str]: ...

    @property
    def coef(self) -> np.ndarray: ...

    @property
    def units(self) -> Mapping[str, str]: ...

    @property
    def courses(self) -> Mapping[str, str]: ...

    @property
    def field(self) -> VectorField: ...

    @property
    def covariance(self) -> np.ndarray | None: ...

    @property
    def clock(self) -> Clock: ...

    def terms(self, state: str) -> dict[str, float]: ...

    def intervals(self, state: str) -> dict[str, tuple[float, float]]: ...


@dataclass(frozen=True, eq=False)
class VectorField:
    """The right-hand side f of x' = f(x, u) = terms(x, u) coef, and its derivatives.

    f and its Jacobian are sums of the same products of variables and functions of them:
    f_j = sum_p W[j, 0, p] m_p(x, u), and df_j/dx_v = sum_p W[j, 1 + v, p] m_p(x, u).
    library: terms over d states, then the inputs. coef: (terms, d), or (models, terms, d) for
    models that differ in their coefficients alone.

    >>> field = VectorField(ep.named_terms(["x", "v"], ["x", "v"]), np.array([[0, -4.0], [1, 0]]))
    >>> field.rates(np.array([1.0, 3.0]))
    array([ 3., -4.])
    >>> field.jacobian(np.array([1.0, 3.0]))
    array([[ 0.,  1.],
           [-4.,  0.]])
    """

    library: Library
    coef: Float[np.ndarray, "*models terms d"]

    @staticmethod
    def of(
        library: Library, variables: Sequence[str], coef: Float[np.ndarray, "*models terms d"]
    ) -> VectorField:
        """Equations over their variables (states, then inputs), with the terms in use alone.

        Functions of other terms may be undefined at the states of the model.
        """
        used = np.asarray(coef.reshape(-1, *coef.shape[-2:]).any(axis=(0, 2)))
        used[0] |= not used.any()  # a library needs a term
        return VectorField(library.take(used).over(variables), coef[..., used, :])

    @property
    def n_states(self) -> int:
        return self.coef.shape[-1]

    def scaled(self, scale: Float[np.ndarray, " d"], time_s: float = 1.0) -> VectorField:
        """The same with states in units of `scale` and time in units of `time_s`; inputs in SI."""
        n_inputs = len(self.library.variables) - len(scale)
        library, numbers = self.library.scaled(np.append(scale, np.ones(n_inputs)))
        with np.errstate(over="ignore"):  # rates are then infinite, which is a verdict
            return VectorField(library, self.coef * numbers[:, None] * (time_s / scale))

    def rates(self, values: Float[np.ndarray, "... variables"]) -> Float[np.ndarray, "... d"]:
        """f at any number of points; NaN outside the domain of a function.

        values: states, then inputs; of several models, (models, points, variables).
        """
        rates: np.ndarray = self.library.evaluate(values) @ self.coef
        return rates

    def jacobian(self, values: Float[np.ndarray, "... variables"]) -> Float[np.ndarray, "... d d"]:
        """df_j/dx_v at any number of points, (..., j, v)."""
        d = self.n_states
        found: np.ndarray = (
            self.products.evaluate(values) @ self.weights[:, 1:].reshape(d * d, -1).T
        )
        return found.reshape(*values.shape[:-1], d, d)

    @property
    def products(self) -> Library:
        """The distinct products m of which the terms and their derivatives are sums."""
        return self.library.with_derivatives(self.n_states)[0]

    @cached_property
    def weights(self) -> Float[np.ndarray, "d columns products"]:
        """Weights W of the products in the rates, then in their derivatives by each state."""
        weights, used = self.library.with_derivatives(self.n_states)[1], self.coef.any(axis=1)
        found: np.ndarray = np.tensordot(self.coef[used].T, weights[used], axes=1)
        return found

    @property
    def places(self) -> Int[np.ndarray, " terms"]:
        """Index of the product that equals each term."""
        return np.argmax(self.library.with_derivatives(self.n_states)[1][:, 0] != 0.0, axis=1)

    @cached_property
    def entries(self) -> tuple[np.ndarray, ...]:
        """The rates as compiled code takes them (`model.kernels`): table, product, target, weight.

        With several models, those of one after the other.
        """
        return entries_of(self.library.table, self.coef)

    def at_point(self) -> tuple[np.ndarray, Callable[[], np.ndarray]]:
        """For solvers: an array for the values of one point, and a function for f at them."""
        values, terms = self.library.at_points()
        return values, lambda: terms() @ self.coef

    def with_perturbations(self) -> VectorField:
        """The states of a model without inputs, then d perturbations y of d states each.

        A perturbation follows the linearised equations y_j' = sum_v df_j/dx_v y_v, whose terms are
        the products of the Jacobian times a component of the perturbation.
        """
        d, factors = self.n_states, self.products.exponents
        names = [f"{state}_{r}" for r in range(d) for state in self.library.variables]
        used = np.asarray(self.weights.any(axis=0))
        used[0, 0] |= not used.any()  # a library needs a term
        exponents = [np.insert(factors[used[0]], d, np.zeros((d * d, 1)), axis=1)]
        targets = [np.pad(self.weights[:, 0, used[0]], ((0, d * d), (0, 0)))]
        for r, v in np.ndindex(d, d):
            terms = np.insert(factors[used[1 + v]], d, np.zeros((d * d, 1)), axis=1)
            terms[:, d + d * r + v] = 1
            exponents.append(terms)
            above, below = d + d * r, d * (d - 1 - r)
            targets.append(np.pad(self.weights[:, 1 + v, used[1 + v]], ((above, below), (0, 0))))
        variables = [*self.library.variables, *names]
        library = Library(variables, np.concatenate(exponents), self.products.functions)
        return VectorField(library, np.concatenate(targets, axis=1).T)


def entries_of(
    table: Int[np.ndarray, "products degree"], weights: Float[np.ndarray, "*models products sums"]
) -> tuple[np.ndarray, ...]:
    """Sums of products without the weights that are zero, in ascending order of the products."""
    *_, product, target = (np.ascontiguousarray(each) for each in np.nonzero(weights))
    return table, product, target, weights[weights != 0.0]
