"""The flow of a vector field over the steps of a record, and its derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.model.flow_kernels import advance, sums_of_products
from ep2sindy.model.runge_kutta import CLASSICAL
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
    """`_compiled` for libraries with functions, which are evaluated at all samples at once.

    The tangents T of a state follow T' = (df/dx) T, and those by a coefficient gain its term.
    """
    (n, d), (equation, term), wanted = states.shape, by, slopes.shape[2] > 0
    weights, own = field.weights.reshape(d * (1 + d), -1).T, field.places[term]
    columns = d + np.arange(len(term))
    total = slopes[:, :, : d + len(term)]
    if wanted:
        total[:, np.arange(d), np.arange(d)] = 1.0
    leads = CLASSICAL.leads.sum(axis=1)  # each stage leads on from the one before alone
    for k in range(0, len(steps.inputs) - 1, CLASSICAL.stride):
        start, slope, begun, change = states, np.zeros_like(states), total.copy(), 0.0
        for lead, weight, place in zip(leads, CLASSICAL.weights, CLASSICAL.places, strict=True):
            ahead, own_step = (lead * steps.h)[:, None], (weight * steps.h)[:, None]
            values = np.concatenate([start + ahead * slope, steps.inputs[k + place]], axis=1)
            products = field.products.evaluate(values)
            both = (products @ weights).reshape(n, d, 1 + d)
            slope = both[:, :, 0]
            states = states + own_step * slope
            if wanted:
                change = both[:, :, 1:] @ (begun + ahead[:, None] * change)
                change[:, equation, columns] += products[:, own]
                total += own_step[:, None] * change
    return states


def _route(field: VectorField) -> Callable[..., AtSteps]:
    return _in_arrays if field.library.functions else _compiled
