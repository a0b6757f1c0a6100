"""Where an autonomous model rests, and what becomes of a small departure from there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.optimize import root

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.model.model import SparseModel

RESTING = 1e-8  # rates at a fixed point, relative to those half a standard deviation away


@dataclass(frozen=True, eq=False)
class RestPoint:
    """A fixed point of an autonomous model, in SI.

    growth_per_s: largest real part of the eigenvalues of the Jacobian there, in 1/s; positive if
    departures grow. frequency_Hz: with which that departure turns; zero if it does not.
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
    """The fixed point near a state, as `fixed_point` finds it, and its leading eigenvalue."""
    state = fixed_point(model, near, scale=zero_to_one(scale), positive=positive)
    if state is None:
        return None
    values = eigenvalues(model, state)
    leading = values[int(values.real.argmax())]
    return RestPoint(state, float(leading.real), abs(float(leading.imag)) / (2.0 * np.pi))


def fixed_point(
    model: SparseModel,
    near: Float[np.ndarray, " n_states"],
    *,
    scale: Float[np.ndarray, " n_states"],
    positive: Bool[np.ndarray, " n_states"],
) -> Float[np.ndarray, " n_states"] | None:
    """Fixed point of an autonomous model, by Newton's method from a nearby state; None if none.

    scale: of the states. positive: mask of the states that must be positive, such as densities.
    """
    rates = model.derivative(near + 0.5 * np.diag(scale), np.empty((len(near), 0)))
    size = zero_to_one(np.abs(rates).max(axis=0))
    found = root(lambda y: model.derivative(y * scale, np.empty(0)) / size, near / scale)
    state: np.ndarray = found.x * scale
    wrong_sign = bool((state[positive] <= 0.0).any())
    return None if not np.abs(found.fun).max() < RESTING or wrong_sign else state


def eigenvalues(
    model: SparseModel, state: Float[np.ndarray, " n_states"]
) -> Complex[np.ndarray, " n_states"]:
    """Eigenvalues of the Jacobian of an autonomous model, in 1/s."""
    found: np.ndarray = np.linalg.eigvals(model.field.jacobian(state)).astype(np.complex128)
    return found
