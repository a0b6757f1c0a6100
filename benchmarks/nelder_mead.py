"""Integral least squares as in the thesis, to compare with: Nelder-Mead and scipy's odeint."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.integrate import odeint as lsoda
from scipy.optimize import minimize

from ep2sindy.refinement.problem import (
    Iteration,
    RefinementFit,
    RefinementProblem,
    join,
    residual_weights,
)

CUBIC = np.arange(3, -1, -1)  # powers of a cubic, in the order of a window batch


@dataclass(frozen=True)
class NelderMead:
    """Method of `ep.refine` as in the thesis: Nelder-Mead on the scalings, odeint per window.

    Initial states must come from the data; they are too many for a simplex.
    Source: thesis II-F.
    """

    tolerance: float = 1e-6
    max_iter: int = 2000

    def fit(self, problem: RefinementProblem) -> RefinementFit:
        if problem.free_start:
            raise ValueError(
                "NelderMead cannot fit initial states: pass free_start=False, or use "
                "MultipleShooting"
            )
        return join([self._fit_point(problem.take(p), p) for p in range(len(problem.equations))])

    def finer(self, problem: RefinementProblem, fit: RefinementFit, points: np.ndarray) -> None:
        """Return None: odeint chooses its own steps."""
        return

    def _fit_point(self, problem: RefinementProblem, point: int) -> RefinementFit:
        data, n_free = problem.data[0], problem.n_free
        weights, used = np.ones((1, data.shape[-1])), np.ones((1, data.shape[-1]))
        scaling, finished = np.ones(n_free), False
        path = window_paths(problem, scaling)
        for _ in range(problem.n_reweights + 1):
            if not np.isfinite(path).all():
                break
            used = weights
            objective = partial(_weighted_loss, problem, used[0])
            found = minimize(
                objective,
                scaling,
                method="Nelder-Mead",
                callback=partial(_observe, problem, point),
                options={"xatol": self.tolerance, "fatol": np.inf, "maxiter": self.max_iter},
            )
            scaling, finished = found.x, bool(found.success)
            path = window_paths(problem, scaling)
            weights = residual_weights(path[None], problem.data)
        return RefinementFit(
            scaling=scaling[None],
            nodes=path[None],
            weights=used,
            finished=np.array([finished]),
            finite=np.array([bool(np.isfinite(path).all())]),
        )


def window_paths(problem: RefinementProblem, scaling: np.ndarray) -> np.ndarray:
    """Trajectories by scipy's odeint, window by window, from the data; NaN where it fails."""
    equations, batch = problem.equations[0], problem.batches[0]
    matrix = equations.matrix(scaling)
    path = np.full(batch.data.shape, np.nan)
    values, terms = equations.library.at_points(equations.variables)
    n = equations.n_states
    for w, data in enumerate(batch.data):
        t = np.append(0.0, np.cumsum(batch.steps[w]))

        def rhs(x: np.ndarray, now: float, t: np.ndarray = t, w: int = w) -> np.ndarray:
            values[:n] = x
            if len(values) > n:
                k = min(max(int(np.searchsorted(t, now, side="right")) - 1, 0), len(t) - 2)
                fraction = (now - t[k]) / (t[k + 1] - t[k])
                values[n:] = fraction**CUBIC @ batch.inputs[w, k]
            return terms() @ matrix

        with np.errstate(over="ignore", invalid="ignore"):
            states, info = lsoda(rhs, data[0], t, full_output=True)
        if info["message"] == "Integration successful.":
            path[w] = states
    return path


def _weighted_loss(problem: RefinementProblem, weights: np.ndarray, scaling: np.ndarray) -> float:
    loss = np.square(weights * (window_paths(problem, scaling) - problem.data[0])).mean()
    return float(loss) if np.isfinite(loss) else np.inf


def _observe(problem: RefinementProblem, point: int, scaling: np.ndarray) -> None:
    loss = _weighted_loss(problem, np.ones(problem.data.shape[-1]), scaling)
    window = problem.data.shape[2]
    problem.observe(Iteration(point, window, loss, scaling.copy(), 0.0, 0.0))
