"""Runge-Kutta integration of many models with the same states over the same windows at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.model import kernels
from ep2sindy.model.inputs import curve_through

# Integration steps per sample. One step suffices for the true model of every noise-free system of
# `systems`: its error stays below 1e-9 variances. The second step is for sparser samples.
N_SUBSTEPS = 2

# A state that is farther from its mean than this many standard deviations has diverged.
BLOW_UP = 20.0


@dataclass(frozen=True, eq=False)
class DrivenWindows:
    """Windows of one trajectory: initial states, inputs and time steps.

    steps_s: (steps, windows), integration steps, N_SUBSTEPS from one sample to the next. drive:
    inputs at the start, middle and end of every step. start: smoothed initial states.
    """

    steps_s: Float[np.ndarray, "steps windows"]
    drive: Float[np.ndarray, "n_inputs steps 3 windows"]
    start: Float[np.ndarray, "n_states windows"]

    @staticmethod
    def of(
        run: Trajectory,
        smoothed: Float[np.ndarray, "_ n_states"],
        inputs: Sequence[str],
        starts: Int[np.ndarray, " windows"],
        n_steps: int,
    ) -> DrivenWindows:
        samples = starts + np.arange(n_steps + 1)[:, None]
        t = run.t[samples]
        steps_s = np.repeat(np.diff(t, axis=0) / N_SUBSTEPS, N_SUBSTEPS, axis=0)
        curve = curve_through(run.t, run.columns(inputs), [None] * len(inputs))
        shares = (np.arange(N_SUBSTEPS)[:, None] + [0.0, 0.5, 1.0]) / N_SUBSTEPS
        nodes = [[curve.at(share)[samples[:-1]] for share in row] for row in shares.tolist()]
        drive = np.array(nodes).transpose(4, 2, 0, 1, 3).reshape(-1, len(steps_s), 3, len(starts))
        return DrivenWindows(steps_s, drive, smoothed[starts].T)

    @staticmethod
    def free(
        start: Float[np.ndarray, "n_states windows"], *, step_s: float, n_samples: int
    ) -> DrivenWindows:
        """Windows with equal steps from given starts, without inputs."""
        n_steps = N_SUBSTEPS * (n_samples - 1)
        return DrivenWindows(
            np.full((n_steps, start.shape[1]), step_s / N_SUBSTEPS),
            np.empty((0, n_steps, 3, start.shape[1])),
            start,
        )


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
    def _gather(self) -> np.ndarray:
        """Position of each variable of the library in the list of states, then inputs."""
        known = [*self.states, *self.inputs]
        return np.array([known.index(v) for v in self.library.variables], dtype=np.int64)

    @cached_property
    def _used(self) -> tuple[Library, np.ndarray]:
        """Terms that at least one model uses, and their coefficients."""
        used = np.abs(self.coef).max(axis=(1, 2)) > 0.0
        used[0] |= not used.any()  # a library needs a term
        return self.library.take(used), self.coef[used]

    def paths(
        self, windows: DrivenWindows, *, centre: np.ndarray, spread: np.ndarray
    ) -> Float[np.ndarray, "models windows samples n_states"]:
        """States of every model from every start, the start included; NaN after divergence.

        Fourth-order Runge-Kutta, over all samples that the steps of the windows cover. A run
        has diverged, and stops, once a state is farther than BLOW_UP times spread from centre.
        """
        start = np.repeat(windows.start[:, None], self.coef.shape[2], axis=1)
        found = [start]
        for x, bounded in self._run(windows, centre[:, None, None], spread[:, None, None]):
            found.append(np.where(bounded, x, np.nan))
        return np.stack(found).transpose(2, 3, 0, 1)

    def _run(
        self, windows: DrivenWindows, centre: np.ndarray, spread: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """States (states, models, windows) at every sample after the start, and bounded runs.

        A run that left its bounds stays at its last state inside.
        """
        library, coef = self._used
        if not library.functions:
            # Copied in C order: kernels would be compiled again for each other memory order.
            copied = partial(np.array, order="C")
            paths, inside = kernels.run_many(
                library.columns_of([*self.states, *self.inputs]),
                copied(coef.transpose(2, 0, 1)),
                copied(windows.start.T),
                copied(windows.steps_s.T),
                copied(windows.drive.transpose(3, 1, 0, 2)),
                N_SUBSTEPS,
                copied(centre[:, 0, 0]),
                BLOW_UP * spread[:, 0, 0],
            )
            yield from zip(paths, inside, strict=True)
            return
        # States are the first axis, so each operation runs along models and windows contiguously.
        x = np.repeat(windows.start[:, None], self.coef.shape[2], axis=1)
        bounded = np.ones(x.shape[1:], dtype=np.bool_)
        for k in range(len(windows.steps_s) // N_SUBSTEPS):
            moved = x
            # A state that overflows has left the bounds.
            with np.errstate(over="ignore", invalid="ignore"):
                for step in range(k * N_SUBSTEPS, (k + 1) * N_SUBSTEPS):
                    drive = windows.drive[:, step]
                    at = (drive[:, 0], drive[:, 1], drive[:, 2])
                    moved = rk4_step(self._derivative, moved, at, windows.steps_s[step])
                bounded = bounded & (np.abs(moved - centre) <= BLOW_UP * spread).all(axis=0)
            x = np.where(bounded, moved, x)
            yield x, bounded

    def _derivative(self, x: np.ndarray, drive: np.ndarray) -> np.ndarray:
        """x and the result: (states, models, windows). drive: (inputs, windows)."""
        driven = np.broadcast_to(drive[:, None], (len(drive), *x.shape[1:]))
        values = np.moveaxis(np.concatenate([x, driven])[self._gather], 0, -1)
        library, coefs = self._used
        slope = np.zeros(x.shape)
        for term, coef in zip(np.moveaxis(library.evaluate(values), -1, 0), coefs, strict=True):
            slope += coef[..., None] * term
        return slope


# The classical Runge-Kutta scheme, for many states at once.


def rk4_step(
    slope: Callable[[np.ndarray, Any], np.ndarray],
    x: np.ndarray,
    inputs: tuple[Any, Any, Any],
    step_s: float | np.ndarray,
) -> np.ndarray:
    """One fourth-order Runge-Kutta step of x' = slope(x, inputs).

    inputs: at the start, middle and end of the step, or the times of these. step_s: one number, or
    an array that broadcasts.
    Source: Hairer, Norsett & Wanner 1993, Solving Ordinary Differential Equations I, II.1.
    """
    start, middle, end = inputs
    k1 = slope(x, start)
    k2 = slope(x + 0.5 * step_s * k1, middle)
    k3 = slope(x + 0.5 * step_s * k2, middle)
    k4 = slope(x + step_s * k3, end)
    return x + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
