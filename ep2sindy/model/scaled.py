"""A model without inputs in variables of order one, with its Jacobian, for use in solvers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float

from ep2sindy.library.library import Library
from ep2sindy.model.kernels import approach
from ep2sindy.model.model import SparseModel


@dataclass(frozen=True, eq=False)
class ScaledModel:
    """Scaled equations y' = f(y) with the Jacobian of f; contains only the terms in use.

    States are in units of `scale`, time in units of `time_s`.
    terms, coef: (terms, n_states), represent f. products, weights: (products, (1 + n_states)
    n_states), represent f, then its derivatives by the first state, by the second, and so on.
    """

    terms: Library
    coef: Float[np.ndarray, "terms n_states"]
    products: Library
    weights: Float[np.ndarray, "products f_and_jacobian"]

    @staticmethod
    def of(model: SparseModel, scale: Float[np.ndarray, " n_states"], time_s: float) -> ScaledModel:
        """Scale a model that has no inputs."""
        used = np.flatnonzero(model.coef.any(axis=1))
        if not len(used):
            used = np.array([0])  # a library needs a term
        library, numbers = model.library.take(used).over(model.states).scaled(scale)
        coef = model.coef[used] * numbers[:, None] * (time_s / scale)
        products, shares = library.with_derivatives(len(scale))
        weights = np.einsum("tcp,te->pce", shares, coef).reshape(len(products), -1)
        return ScaledModel(library, coef, products, weights)

    @property
    def n_states(self) -> int:
        return self.coef.shape[1]

    def with_departures(self) -> Callable[[float, np.ndarray], np.ndarray]:
        """Right-hand side of the state followed by n_states linearised departures, one per row."""
        n = self.n_states
        values, products = self.products.at_points(self.products.variables)
        weights = self.weights

        def slope(_: float, y: np.ndarray) -> np.ndarray:
            values[:] = y[:n]
            rates = products() @ weights
            departures = y[n:].reshape(n, n) @ rates[n:].reshape(n, n)
            return np.concatenate([rates[:n], departures.ravel()])

        return slope

    def slope(
        self, y: Float[np.ndarray, "n_states points"]
    ) -> Float[np.ndarray, "n_states points"]:
        """Evaluate f at many states."""
        return self.coef.T @ _evaluate(self.terms, y)

    def rate(self, y: Float[np.ndarray, "states points"]) -> Float[np.ndarray, " points"]:
        """Frobenius norm of the Jacobian at many states: no smaller than its largest eigenvalue."""
        jacobian = self.weights[:, len(y) :].T @ _evaluate(self.products, y)
        return np.sqrt(np.einsum("jp,jp->p", jacobian, jacobian))

    def approach(
        self,
        y: Float[np.ndarray, "n_states starts"],
        centre: Float[np.ndarray, " n_states"],
        bound: float,
        until: float,
        n_steps: int,
        *,
        times_rate: float,
        floor: float,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Starts that stay within the bound about the centre, run until a time.

        Each takes Runge-Kutta steps of its own, times_rate / max(rate, floor) long, at most
        n_steps. Returns the states, their times and the steps left. With functions in the library,
        which no kernel evaluates, nothing has been run yet.
        """
        t, left = np.zeros(y.shape[1]), np.full(y.shape[1], n_steps)
        if self.terms.functions:
            return y, t, left
        points, copied = np.array(y.T, order="C"), partial(np.array, order="C")
        kept = approach(
            self.terms.table, copied(self.coef),
            self.products.table, copied(self.weights[:, len(y) :]),
            centre, bound, until, times_rate, floor, points, t, left,
        )  # fmt: skip
        return points[kept].T, t[kept], left[kept]


def _evaluate(library: Library, y: np.ndarray) -> np.ndarray:
    """Library at many points, (products, points); contiguous in points, unlike Library.evaluate."""
    columns = np.ones((len(y) + 1, y.shape[1]))
    columns[:-1] = y
    columns = library.with_functions(columns, axis=0)
    theta = columns[library.table[:, 0]]
    for factors in library.table.T[1:]:
        theta *= columns[factors]
    return theta
