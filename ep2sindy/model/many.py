"""Many runs at once, of models with the same states, by classical Runge-Kutta steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.model.inputs import Curve, curve_through
from ep2sindy.model.runge_kutta import CLASSICAL, step
from ep2sindy.model.vector_field import VectorField

# Integration steps per sample. One step suffices for the true model of every noise-free system of
# `systems`: its error stays below 1e-9 variances. The second step is for sparser samples.
N_SUBSTEPS = 2

# A state that is farther from its mean than this many standard deviations has diverged.
BLOW_UP = 20.0


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
        if curve is None:
            return WindowSteps(h, np.empty((*h.shape, 0, 3)), n_substeps)
        shares = (np.arange(n_substeps)[:, None] + [0.0, 0.5, 1.0]) / n_substeps
        nodes = np.array([[curve.at(share)[places] for share in row] for row in shares.tolist()])
        inputs = nodes.transpose(2, 3, 0, 4, 1)  # windows, samples, substeps, inputs, nodes
        return WindowSteps(h, np.ascontiguousarray(inputs.reshape(*h.shape, -1, 3)), n_substeps)


def run_many(
    field: VectorField,
    starts: Float[np.ndarray, "models windows d"],
    steps: WindowSteps,
    *,
    centre: Float[np.ndarray, " d"],
    reach: Float[np.ndarray, " d"],
    pushes: Float[np.ndarray, "models windows segments d"] | None = None,
) -> Float[np.ndarray, "models windows samples d"]:
    """States of every model from every start, the start included, at the samples.

    field: of several models. pushes: added at every sample after the start. A run has diverged once
    a state is farther than `reach` from the centre, and is NaN from there on.
    """
    route = _in_arrays if field.library.functions else _compiled
    if pushes is None:
        pushes = np.empty((*starts.shape[:2], 0, starts.shape[2]))
    later = route(field, np.ascontiguousarray(starts), steps, centre, reach, pushes)
    return np.concatenate([starts[:, :, None], later], axis=2)


def _compiled(
    field: VectorField,
    starts: np.ndarray,
    steps: WindowSteps,
    centre: np.ndarray,
    reach: np.ndarray,
    pushes: np.ndarray,
) -> np.ndarray:
    from ep2sindy.model import kernels

    table, product, target, weight = field.entries
    by_model = np.count_nonzero(field.coef, axis=(1, 2))
    paths: np.ndarray = kernels.run_many(
        np.array(table), product, target, weight, np.append(0, by_model.cumsum()),
        CLASSICAL.leads, CLASSICAL.weights, starts, np.array(steps.h, order="C"), steps.inputs,
        pushes, steps.n_substeps, np.array(centre), np.array(reach),
    )  # fmt: skip
    return paths


def _in_arrays(
    field: VectorField,
    starts: np.ndarray,
    steps: WindowSteps,
    centre: np.ndarray,
    reach: np.ndarray,
    pushes: np.ndarray,
) -> np.ndarray:
    """`_compiled` for libraries with functions, which are evaluated for all runs at once."""

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
                if pushes.shape[2]:
                    x = x + pushes[:, :, len(found)]
                inside = (np.abs(x - centre) <= reach).all(axis=2, keepdims=True)
                x = np.where(inside, x, np.nan)
                found.append(x)
    return np.stack(found, axis=2)


@dataclass(frozen=True, eq=False)
class DrivenWindows:
    """Windows of one trajectory, to be run from their initial states (windows, n_states)."""

    steps: WindowSteps
    start: Float[np.ndarray, "windows n_states"]

    @staticmethod
    def of(
        run: Trajectory,
        smoothed: Float[np.ndarray, "_ n_states"],
        inputs: Sequence[str],
        starts: Int[np.ndarray, " windows"],
        n_steps: int,
    ) -> DrivenWindows:
        """Windows from these samples on, through n_steps samples more, from smoothed states."""
        curve = curve_through(run.t, run.columns(inputs), [None] * len(inputs))
        steps = WindowSteps.along(run.t, curve, starts, n_steps + 1, N_SUBSTEPS)
        return DrivenWindows(steps, smoothed[starts])

    @staticmethod
    def free(
        start: Float[np.ndarray, "n_states windows"], *, step_s: float, n_samples: int
    ) -> DrivenWindows:
        """Windows with equal steps from given starts, without inputs."""
        h = np.full((start.shape[1], N_SUBSTEPS * (n_samples - 1)), step_s / N_SUBSTEPS)
        return DrivenWindows(WindowSteps(h, np.empty((*h.shape, 0, 3)), N_SUBSTEPS), start.T)


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Models x' = library(states, inputs) coef that differ in their coefficients.

    coef: (terms, states, models), in SI. Terms that no model uses are not evaluated.
    """

    library: Library
    states: Sequence[str]
    coef: Float[np.ndarray, "terms n_states models"]

    @property
    def inputs(self) -> tuple[str, ...]:
        """Variables of the library that are not states."""
        return tuple(v for v in self.library.variables if v not in self.states)

    @cached_property
    def field(self) -> VectorField:
        """The right-hand sides of all models, with the terms that at least one of them uses."""
        used = np.abs(self.coef).max(axis=(1, 2)) > 0.0
        used[0] |= not used.any()  # a library needs a term
        library = self.library.take(used).over([*self.states, *self.inputs])
        return VectorField(library, self.coef[used].transpose(2, 0, 1))

    def paths(
        self,
        windows: DrivenWindows,
        *,
        centre: Float[np.ndarray, " n_states"],
        spread: Float[np.ndarray, " n_states"],
    ) -> Float[np.ndarray, "models windows samples n_states"]:
        """States of every model from every start, the start included; NaN after divergence.

        A run has diverged once a state is farther than BLOW_UP times spread from centre.
        """
        starts = np.repeat(windows.start[None], self.coef.shape[2], axis=0)
        return run_many(self.field, starts, windows.steps, centre=centre, reach=BLOW_UP * spread)
