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

AtSteps = Float[np.ndarray, "steps d"]
Slopes = Float[np.ndarray, "steps d columns"]


@dataclass(frozen=True, eq=False)
class Flow:
    """States at the end of each step of a model, and their derivatives.

    ends: (steps, d). slopes: (steps, d, d + coefficients), derivatives by the state, then by the
    coefficients.
    """

    ends: AtSteps
    slopes: Slopes


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps of a record, each divided into substeps.

    h: (steps,), length of one substep. inputs: (2 substeps + 1, steps, inputs), at the ends and the
    middles of the substeps.
    """

    h: Float[np.ndarray, " steps"]
    inputs: Float[np.ndarray, "positions steps n_inputs"]


def ends(field: VectorField, states: AtSteps, steps: Steps) -> AtSteps:
    """States at the end of each step, by classical Runge-Kutta substeps."""
    return _route(field)(field, states, steps, NONE, np.empty((*states.shape, 0)))


def flow(
    field: VectorField, states: AtSteps, steps: Steps, by: Coefficients = NONE, *, n_more: int = 0
) -> Flow:
    """`ends` with its derivatives by the states, and by some of the coefficients.

    n_more: columns of zeros behind them, for derivatives by something else.
    """
    slopes = np.zeros((*states.shape, field.n_states + len(by[0]) + n_more))
    return Flow(_route(field)(field, states, steps, by, slopes), slopes)


def _compiled(
    field: VectorField, states: AtSteps, steps: Steps, by: Coefficients, slopes: Slopes
) -> AtSteps:
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
    field: VectorField, states: AtSteps, steps: Steps, by: Coefficients, slopes: Slopes
) -> AtSteps:
    """`_compiled` for libraries with functions, which are evaluated at all samples at once."""
    (n, d), (equation, term) = states.shape, by
    weights, own = field.weights.reshape(d * (1 + d), -1).T, field.places[term]
    n_tangents = min(d + len(term), slopes.shape[2])
    whole = np.eye(d, 1 + n_tangents, 1) + np.zeros((n, 1, 1))
    whole[:, :, 0] = states

    def rates(whole: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Of the states, and of the tangents T behind them, T' = (df/dx) T + df/dc."""
        products = field.products.evaluate(np.concatenate([whole[:, :, 0], inputs], axis=1))
        both = (products @ weights).reshape(n, d, 1 + d)
        tangents = both[:, :, 1:] @ whole[:, :, 1:]
        tangents[:, equation, d + np.arange(len(term))] += products[:, own]
        return np.concatenate([both[:, :, :1], tangents], axis=2)

    for k in range(0, len(steps.inputs) - 1, CLASSICAL.stride):
        whole = step(rates, whole, [*steps.inputs[k : k + 3]], steps.h[:, None, None])
    slopes[:, :, :n_tangents] = whole[:, :, 1:]
    return whole[:, :, 0]


def _route(field: VectorField) -> Callable[..., AtSteps]:
    return _in_arrays if field.library.functions else _compiled
