"""The flow of a library's models over the steps of a record, and its derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.library.library import Library
from ep2sindy.model.flow_kernels import CLASSICAL, advance, sums_of_products

# Equation and term of each coefficient by which a flow is differentiated.
Coefficients = tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]


@dataclass(frozen=True, eq=False)
class Flow:
    """States at the end of each step of a model, and their derivatives.

    ends: (steps, d). slopes: (steps, d, d + coefficients), derivatives by the state, then by the
    coefficients.
    """

    ends: Float[np.ndarray, "steps d"]
    slopes: Float[np.ndarray, "steps d columns"]


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps of a record, each divided into substeps.

    h: (steps,), length of one substep. inputs: (2 substeps + 1, steps, inputs), at the ends and the
    middles of the substeps.
    """

    h: Float[np.ndarray, " steps"]
    inputs: Float[np.ndarray, "positions steps n_inputs"]

    @property
    def n_substeps(self) -> int:
        return len(self.inputs) // 2

    def inputs_at(self, substep: int, stage: int) -> Float[np.ndarray, "steps n_inputs"]:
        return self.inputs[2 * substep + (stage + 1) // 2]


@dataclass(frozen=True, eq=False)
class RightHandSides:
    """Models of d states whose terms are of one library: rates = terms' values @ coef (terms, d).

    library: of the states, then the inputs.
    """

    library: Library
    d: int

    def rates(
        self,
        coef: Float[np.ndarray, "terms d"],
        states: Float[np.ndarray, "n d"],
        inputs: Float[np.ndarray, "n n_inputs"],
    ) -> Float[np.ndarray, "n d"]:
        return self._products_of(states, inputs) @ (self._shares[:, 0].T @ coef)

    def ends(
        self,
        coef: Float[np.ndarray, "terms d"],
        states: Float[np.ndarray, "steps d"],
        steps: Steps,
    ) -> Float[np.ndarray, "steps d"]:
        """States at the end of each step, by classical Runge-Kutta substeps."""
        none = np.empty(0, dtype=np.int64)
        return self._route(coef, states, steps, (none, none), np.empty((*states.shape, 0)))

    def flow(
        self,
        coef: Float[np.ndarray, "terms d"],
        states: Float[np.ndarray, "steps d"],
        steps: Steps,
        by: Coefficients,
        *,
        n_more: int = 0,
    ) -> Flow:
        """`ends` with its derivatives by the states, and by some of the coefficients.

        n_more: columns of zeros behind them, for derivatives by something else.
        """
        slopes = np.zeros((len(states), self.d, self.d + len(by[0]) + n_more))
        return Flow(self._route(coef, states, steps, by, slopes), slopes)

    @property
    def _route(self) -> Callable[..., Float[np.ndarray, "steps d"]]:
        return self._in_arrays if self._products.functions else self._compiled

    def _compiled(
        self,
        coef: Float[np.ndarray, "terms d"],
        states: Float[np.ndarray, "steps d"],
        steps: Steps,
        by: Coefficients,
        slopes: Float[np.ndarray, "steps d columns"],
    ) -> Float[np.ndarray, "steps d"]:
        """Ends of the steps by the compiled kernel; derivatives go to slopes, if it has columns."""
        used, (equation, term) = coef.any(axis=1), by
        weights = np.tensordot(coef[used].T, self._shares[used], axes=1)
        if slopes.shape[2]:
            # A coefficient changes the rate of its equation by its own product.
            own = np.zeros((self.d, len(term), weights.shape[2]))
            own[equation, np.arange(len(term)), self._places[term]] = 1.0
            weights = np.concatenate([weights, own], axis=1)
        else:
            weights = weights[:, :1]
        equations = sums_of_products(self._products.table, weights)
        ends = np.empty_like(states)
        states = np.ascontiguousarray(states)
        advance(states, steps.inputs, steps.h, CLASSICAL, equations, ends, slopes)
        return ends

    def _in_arrays(
        self,
        coef: Float[np.ndarray, "terms d"],
        states: Float[np.ndarray, "steps d"],
        steps: Steps,
        by: Coefficients,
        slopes: Float[np.ndarray, "steps d columns"],
    ) -> Float[np.ndarray, "steps d"]:
        """`_compiled` for libraries with functions, which are evaluated at all samples at once."""
        (n, d), (equation, term), wanted = states.shape, by, slopes.shape[2] > 0
        rates = self._shares[:, 0].T @ coef
        columns = d + np.arange(len(equation))
        total = slopes[:, :, : d + len(equation)]
        if wanted:
            by_state = np.einsum("tjp,ti->pij", self._shares[:, 1:], coef)
            rates = np.column_stack([rates, by_state.reshape(-1, d * d)])
            total[:, np.arange(d), np.arange(d)] = 1.0
        leads = CLASSICAL.leads.sum(axis=1)  # each stage leads on from the one before alone
        for k in range(steps.n_substeps):
            start, slope, begun, change = states, np.zeros_like(states), total.copy(), 0.0
            for s, (lead, weight) in enumerate(zip(leads, CLASSICAL.weights, strict=True)):
                ahead, share = (lead * steps.h)[:, None], (weight * steps.h)[:, None]
                values = self._products_of(start + ahead * slope, steps.inputs_at(k, s))
                both = values @ rates
                slope = both[:, :d]
                states = states + share * slope
                if wanted:
                    change = both[:, d:].reshape(n, d, d) @ (begun + ahead[:, None] * change)
                    change[:, equation, columns] += values[:, self._places[term]]
                    total += share[:, None] * change
        return states

    def _products_of(
        self, states: Float[np.ndarray, "n d"], inputs: Float[np.ndarray, "n n_inputs"]
    ) -> Float[np.ndarray, "n products"]:
        return self._products.evaluate(np.concatenate([states, inputs], axis=1))

    @cached_property
    def _derived(self) -> tuple[Library, np.ndarray]:
        return self.library.with_derivatives(self.d)

    @property
    def _products(self) -> Library:
        return self._derived[0]

    @property
    def _shares(self) -> Float[np.ndarray, "terms columns products"]:
        return self._derived[1]

    @cached_property
    def _places(self) -> Int[np.ndarray, " terms"]:
        """Index of the product that equals each term."""
        return np.argmax(self._shares[:, 0] != 0.0, axis=1)
