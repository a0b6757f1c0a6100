"""Single shooting: whole windows with forward sensitivities, and scipy's least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares
from torchdiffeq import odeint

from ep2sindy.refinement.problem import (
    Iteration,
    RefinementFit,
    RefinementProblem,
    join,
    residual_weights,
)
from ep2sindy.refinement.steps import RungeKutta


@dataclass(frozen=True)
class SingleShooting:
    """scipy `least_squares` on scalings and starts, torchdiffeq's `rk4` with tangents.

    Exact where it starts close; from afar a long window misleads it, multiple shooting less so.
    """

    n_substeps: int = 1
    tolerance: float = 1e-10
    max_iter: int = 100

    def fit(self, problem: RefinementProblem) -> RefinementFit:
        return join([self._fit_point(problem.take(p), p) for p in range(len(problem.equations))])

    def finer(self, problem: RefinementProblem, fit: RefinementFit, points: np.ndarray) -> None:
        """Set `n_substeps` instead."""
        return

    def _fit_point(self, problem: RefinementProblem, point: int) -> RefinementFit:
        data = problem.data[0]
        n = data.shape[-1]
        weights = np.ones(n)
        unknown = np.ones(problem.n_free)
        if problem.free_start:
            unknown = np.append(unknown, data[:, 0].ravel())
        finite, finished = True, False
        path = self._path(problem, unknown)
        for _ in range(problem.n_reweights + 1):
            finite = bool(np.isfinite(path).all())
            if not finite:
                break
            unknown, finished = self._least_squares(problem, unknown, weights, point)
            path = self._path(problem, unknown)
            before = weights
            weights = residual_weights(path[None, :, :, :, 0], data[None])[0]
        return RefinementFit(
            scaling=unknown[None, : problem.n_free],
            nodes=path[None, ..., 0],
            weights=before[None] if finite else np.ones((1, n)),
            finished=np.array([finished]),
            finite=np.array([finite]),
            step=RungeKutta(self.n_substeps),
        )

    def _least_squares(
        self, problem: RefinementProblem, unknown: np.ndarray, weights: np.ndarray, point: int
    ) -> tuple[np.ndarray, bool]:
        """One weighted fit: the unknowns, and whether scipy's own tests were met."""
        data, n_free = problem.data[0], problem.n_free
        n_windows, window, n = data.shape
        kept: dict[bytes, np.ndarray] = {}

        def path(values: np.ndarray) -> np.ndarray:
            if values.tobytes() not in kept:
                kept.clear()
                kept[values.tobytes()] = self._path(problem, values)
            return kept[values.tobytes()]

        def residuals(values: np.ndarray) -> np.ndarray:
            return (weights * (path(values)[..., 0] - data)).ravel()

        def jacobian(values: np.ndarray) -> np.ndarray:
            states = path(values)
            tangents = states[..., 1:] * weights[:, None]
            loss = float(np.square(states[..., 0] - data).mean())
            problem.observe(Iteration(point, window, loss, values[:n_free].copy(), 0.0, 0.0))
            by_scaling = tangents[..., n:].reshape(-1, n_free)
            if not problem.free_start:
                return by_scaling
            by_start = np.zeros((n_windows, window, n, n_windows, n))
            index = np.arange(n_windows)
            by_start[index, :, :, index] = tangents[..., :n]
            return np.hstack([by_scaling, by_start.reshape(len(by_scaling), -1)])

        found = least_squares(
            residuals,
            unknown,
            jac=jacobian,
            max_nfev=self.max_iter,
            xtol=self.tolerance,
            ftol=self.tolerance,
            gtol=self.tolerance,
        )
        return found.x, bool(found.status > 0)

    def _path(self, problem: RefinementProblem, unknown: np.ndarray) -> np.ndarray:
        """(windows, samples, n_states, columns): trajectories and their derivatives."""
        ode, data = problem.ode, problem.data[0]
        n, n_free, n_steps = ode.n_states, ode.n_free, data.shape[1] - 1
        start = unknown[n_free:].reshape(-1, n) if problem.free_start else data[:, 0]
        z = torch.zeros((1, ode.n_columns, n, len(data)), dtype=torch.float64)
        z[0, 0] = torch.tensor(start.T.copy())
        for j in range(n):
            z[0, 1 + j, j] = 1.0
        t = torch.arange(n_steps + 1, dtype=torch.float64)
        fine = self.n_substeps * n_steps + 1
        grid = torch.linspace(0.0, float(n_steps), fine, dtype=torch.float64)
        ode.set(unknown[None, :n_free], problem.whole)
        with torch.inference_mode():
            path = odeint(
                ode, z.to(problem.device), t, method="rk4",
                options={"grid_constructor": lambda func, y0, t: grid, "perturb": True},
            )  # fmt: skip
        return path[:, 0].permute(3, 0, 2, 1).cpu().numpy()
