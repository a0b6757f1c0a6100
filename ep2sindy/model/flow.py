"""The flow of a vector field over the steps of a record, and its derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.model.flow_kernels import advance, sums_of_products
from ep2sindy.model.runge_kutta import CLASSICAL, step
from ep2sindy.model.vector_field import VectorField

# Equation and term of each coefficient by which a flow is differentiated.
Coefficients = tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]

NONE = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)


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


def ends(
    field: VectorField, states: Float[np.ndarray, "steps d"], steps: Steps
) -> Float[np.ndarray, "steps d"]:
    """States at the end of each step, by classical Runge-Kutta substeps."""
    return _route(field)(field, states, steps, NONE, np.empty((*states.shape, 0)))


def flow(
    field: VectorField,
    states: Float[np.ndarray, "steps d"],
    steps: Steps,
    by: Coefficients = NONE,
    *,
    n_more: int = 0,
) -> Flow:
    """`ends` with its derivatives by the states, and by some of the coefficients.

    n_more: columns of zeros behind them, for derivatives by something else.
    """
    slopes = np.zeros((*states.shape, field.n_states + len(by[0]) + n_more))
    return Flow(_route(field)(field, states, steps, by, slopes), slopes)


def _compiled(
    field: VectorField,
    states: Float[np.ndarray, "steps d"],
    steps: Steps,
    by: Coefficients,
    slopes: Float[np.ndarray, "steps d columns"],
) -> Float[np.ndarray, "steps d"]:
    """Ends of the steps by the compiled kernel; derivatives go to slopes, if it has columns."""
    weights, (equation, term) = field.weights, by
    if slopes.shape[2]:
        # A coefficient changes the rate of its equation by its term.
        own = np.zeros((field.n_states, len(term), weights.shape[2]))
        own[equation, np.arange(len(term)), field.places[term]] = 1.0
        weights = np.concatenate([weights, own], axis=1)
    else:
        weights = weights[:, :1]
    sums = sums_of_products(field.products.table, weights)
    found, states = np.empty_like(states), np.ascontiguousarray(states)
    advance(states, steps.inputs, steps.h, CLASSICAL, sums, found, slopes)
    return found


def _in_arrays(
    field: VectorField,
    states: Float[np.ndarray, "steps d"],
    steps: Steps,
    by: Coefficients,
    slopes: Float[np.ndarray, "steps d columns"],
) -> Float[np.ndarray, "steps d"]:
    """`_compiled` for libraries with functions, which are evaluated at all samples at once.

    The tangents T of a state follow T' = (df/dx) T, and those by a coefficient gain its term.
    """
    d, (equation, term) = states.shape[1], by
    weights, own = field.weights.reshape(d * (1 + d), -1).T, field.places[term]
    tangents = slopes[:, :, : d + len(term)]
    tangents[:] = np.eye(d, tangents.shape[2])  # of no columns, if none are wanted

    def rates(x: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Of a state and its tangents, side by side in the columns of x."""
        products = field.products.evaluate(np.concatenate([x[:, :, 0], inputs], axis=1))
        both = (products @ weights).reshape(len(x), d, 1 + d)
        change = both[:, :, 1:] @ x[:, :, 1:]
        change[:, equation, d + np.arange(len(term))] += products[:, own]
        return np.concatenate([both[:, :, :1], change], axis=2)

    x = np.concatenate([states[:, :, None], tangents], axis=2)
    for k in range(0, len(steps.inputs) - 1, CLASSICAL.stride):
        x = step(rates, x, steps.inputs[k : k + CLASSICAL.stride + 1], steps.h[:, None, None])
    tangents[:] = x[:, :, 1:]
    return np.ascontiguousarray(x[:, :, 0])


def _route(field: VectorField) -> Callable[..., Float[np.ndarray, "steps d"]]:
    return _in_arrays if field.library.functions else _compiled
