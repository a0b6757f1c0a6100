"""Where an autonomous model rests, and what becomes of a small perturbation from there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import root

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.model.model import SparseModel

RESTING = 1e-8  # rates at a fixed point, relative to those half a standard deviation away


@dataclass(frozen=True, eq=False)
class RestPoint:
    """A fixed point of an autonomous model, in SI.

    growth_per_s: largest real part of the eigenvalues of the Jacobian there, in 1/s; positive if
    perturbations grow. frequency_Hz: with which that perturbation turns; zero if it does not.
    """

    state: Float[np.ndarray, " n_states"]
    growth_per_s: float
    frequency_Hz: float


def rest_point(
    model: SparseModel,
    near: Float[np.ndarray, " n_states"],
    scale: Float[np.ndarray, " n_states"],
    positive: Bool[np.ndarray, " n_states"],
) -> RestPoint | None:
    """Fixed point of an autonomous model, by Newton's method from a nearby state; None if none.

    scale: of the states. positive: mask of the states that must be positive, such as densities.
    """
    scale = zero_to_one(scale)
    rates = model.derivative(near + 0.5 * np.diag(scale), np.empty((len(near), 0)))
    size = zero_to_one(np.abs(rates).max(axis=0))
    found = root(lambda y: model.derivative(y * scale, np.empty(0)) / size, near / scale)
    # What is this close to zero is zero but for rounding.
    state: np.ndarray = np.where(np.abs(found.x) < RESTING, 0.0, found.x) * scale
    if not np.abs(found.fun).max() < RESTING or (state[positive] <= 0.0).any():
        return None
    values = np.linalg.eigvals(model.field.jacobian(state))
    leading = values[int(values.real.argmax())]
    return RestPoint(state, float(leading.real), abs(float(leading.imag)) / (2.0 * np.pi))
