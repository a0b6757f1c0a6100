"""Many runs at once, of models with the same states, by classical Runge-Kutta steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.model.inputs import Curve
from ep2sindy.model.runge_kutta import CLASSICAL, step
from ep2sindy.model.vector_field import VectorField


@dataclass(frozen=True, eq=False)
class WindowSteps:
    """Steps through windows of equally many samples, with the inputs on the way.

    h: (windows, steps), lengths in s, n_substeps from one sample to the next. inputs: (windows,
    steps, n_inputs, 3), at the start, middle and end of every step.
    """

    h: Float[np.ndarray, "windows steps"]
    inputs: Float[np.ndarray, "windows steps n_inputs 3"]
    n_substeps: int

    @staticmethod
    def along(
        t: Float[np.ndarray, " samples"],
        curve: Curve | None,
        first: Int[np.ndarray, " windows"],
        n_samples: int,
        n_substeps: int,
    ) -> WindowSteps:
        """Steps from some samples of a record, through as many samples as each window has.

        curve: the inputs over the record; None for none.
        """
        places = first[:, None] + np.arange(n_samples - 1)
        h = np.repeat((t[places + 1] - t[places]) / n_substeps, n_substeps, axis=1)
        if curve is None or not curve.pieces.shape[2]:
            return WindowSteps(h, np.empty((*h.shape, 0, 3)), n_substeps)
        fractions = (np.arange(n_substeps)[:, None] + [0.0, 0.5, 1.0]) / n_substeps
        nodes = np.array(
            [[curve.at(fraction)[places] for fraction in row] for row in fractions.tolist()]
        )
        inputs = nodes.transpose(2, 3, 0, 4, 1)  # windows, samples, substeps, inputs, nodes
        return WindowSteps(h, np.ascontiguousarray(inputs.reshape(*h.shape, -1, 3)), n_substeps)


def run_many(
    field: VectorField,
    starts: Float[np.ndarray, "... windows d"],
    steps: WindowSteps,
    *,
    centre: Float[np.ndarray, " d"],
    reach: Float[np.ndarray, " d"],
    moves: Float[np.ndarray, "models windows segments d"] | None = None,
) -> Float[np.ndarray, "models windows samples d"]:
    """States of every model from every start, the start included, at the samples.

    field: of several models. starts: of the windows, (windows, d), or for each model its own.
    moves: of process noise, added at every sample after the start. A run has diverged once a state
    is farther than `reach` from the centre, and is NaN from there on.
    """
    starts = np.array(np.broadcast_to(starts, (len(field.coef), *starts.shape[-2:])), order="C")
    if moves is None:
        moves = np.empty((*starts.shape[:2], 0, starts.shape[2]))
    if field.library.functions:
        later = _in_arrays(field, starts, steps, centre, reach, moves)
    else:
        from ep2sindy.model import kernels

        table, product, target, weight = field.entries
        by_model = np.count_nonzero(field.coef, axis=(1, 2))
        later = kernels.run_many(
            np.array(table), product, target, weight, np.append(0, by_model.cumsum()),
            CLASSICAL.leads, CLASSICAL.weights, starts, np.array(steps.h, order="C"), steps.inputs,
            moves, steps.n_substeps, np.array(centre), np.array(reach),
        )  # fmt: skip
    return np.concatenate([starts[:, :, None], later], axis=2)


def _in_arrays(
    field: VectorField,
    starts: np.ndarray,
    steps: WindowSteps,
    centre: np.ndarray,
    reach: np.ndarray,
    moves: np.ndarray,
) -> np.ndarray:
    """Later states by a library with functions, which are evaluated for all runs at once."""

    def rates(x: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        driven = np.broadcast_to(inputs, (*x.shape[:2], inputs.shape[1]))
        return field.rates(np.concatenate([x, driven], axis=2))

    x = starts
    found: list[np.ndarray] = []
    with np.errstate(over="ignore", invalid="ignore"):  # a state that overflows has diverged
        for k in range(steps.h.shape[1]):
            h = steps.h[:, k, None]
            x = step(rates, x, tuple(np.moveaxis(steps.inputs[:, k], 2, 0)), h)
            if (k + 1) % steps.n_substeps == 0:
                if moves.shape[2]:
                    x = x + moves[:, :, len(found)]
                inside = (np.abs(x - centre) <= reach).all(axis=2, keepdims=True)
                x = np.where(inside, x, np.nan)
                found.append(x)
    return np.stack(found, axis=2)
