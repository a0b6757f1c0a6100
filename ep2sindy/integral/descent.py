"""Integral least squares by general optimisers: gradients from autograd, or none at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.integrate import odeint as lsoda
from scipy.optimize import minimize
from torch import nn
from torchdiffeq import odeint

from ep2sindy.integral.problem import Fit, Iteration, Problem, joined, residual_weights, single
from ep2sindy.integral.steps import RungeKutta
from ep2sindy.ode import ODE, Drive

CUBIC = np.arange(3, -1, -1)  # powers, as a window batch stores them
Optimizer = Callable[[list[nn.Parameter]], torch.optim.Optimizer]
LBFGS: Optimizer = partial(torch.optim.LBFGS, line_search_fn="strong_wolfe")


@dataclass(frozen=True)
class GradientDescent:
    """A torch optimiser through torchdiffeq's `rk4`, by plain reverse mode.

    optimizer: makes one from parameters, such as `partial(torch.optim.Adam, lr=1e-2)`.
    It has converged when the last `patience` steps gained less than `tolerance` of the loss.
    """

    optimizer: Optimizer = LBFGS
    max_iter: int = 200
    tolerance: float = 1e-8
    patience: int = 10
    n_substeps: int = 1

    def fit(self, problem: Problem) -> Fit:
        return joined([self._fit_point(single(problem, p), p) for p in range(len(problem.odes))])

    def finer(self, problem: Problem, fit: Fit, points: np.ndarray) -> None:
        """Set `n_substeps` instead."""
        return

    def _fit_point(self, problem: Problem, point: int) -> Fit:
        ode, data = problem.odes[0], torch.tensor(problem.data[0], device=problem.device)
        start = nn.Parameter(data[:, 0].clone(), requires_grad=problem.free_start)
        weights, used = np.ones((1, data.shape[-1])), np.ones((1, data.shape[-1]))
        finished, path = False, data
        for _ in range(problem.n_reweights + 1):
            used = weights
            finished = self.descend(
                ode,
                problem.whole,
                data,
                start,
                weights[0],
                observe=lambda loss: problem.observe(_iteration(point, data, ode, loss)),
            )
            with torch.no_grad():
                path = trajectories(ode, problem.whole, start, data.shape[1], self.n_substeps)
            if not torch.isfinite(path).all():
                break
            weights = residual_weights(path[None].cpu().numpy(), problem.data)
        scaling = ode.scaling.detach().cpu().numpy()[None].copy()
        return Fit(
            scaling=scaling,
            nodes=path[None].cpu().numpy(),
            weights=used,
            finished=np.array([finished]),
            finite=np.array(
                [bool(torch.isfinite(path).all()) and bool(np.isfinite(scaling).all())]
            ),
            step=RungeKutta(self.n_substeps),
        )

    def descend(
        self,
        ode: ODE,
        drive: Drive,
        data: torch.Tensor,
        start: nn.Parameter,
        weights: np.ndarray,
        *,
        observe: Callable[[float], None],
    ) -> bool:
        """Train every parameter of a module, and the starts where they ask for a gradient.

        data: (windows, samples, n_states). Returns whether the loss has settled.
        """
        parameters = [*ode.parameters(), *([start] if start.requires_grad else [])]
        optimizer = self.optimizer(parameters)
        factor = torch.tensor(weights, device=data.device)
        losses: list[float] = []

        def closure() -> torch.Tensor:
            optimizer.zero_grad()
            path = trajectories(ode, drive, start, data.shape[1], self.n_substeps)
            loss = (factor * (path - data)).square().mean()
            loss.backward()
            return loss

        for _ in range(self.max_iter):
            loss: Any = optimizer.step(closure)  # type: ignore[arg-type]
            losses.append(float(loss.detach()))
            observe(losses[-1])
            if not np.isfinite(losses[-1]):
                return False
            recent = losses[-self.patience - 1 :]
            if (
                len(recent) > self.patience
                and recent[0] - min(recent) <= self.tolerance * recent[0]
            ):
                return True
        return False


@dataclass(frozen=True)
class NelderMead:
    """The thesis's way, for comparison: a simplex on the scalings, scipy's odeint per window.

    Starts must come from the data: their number is beyond a simplex.
    Source: thesis II-F.
    """

    tolerance: float = 1e-6
    max_iter: int = 2000

    def fit(self, problem: Problem) -> Fit:
        if problem.free_start:
            raise ValueError(
                "NelderMead cannot fit initial states: pass free_start=False, or use "
                "MultipleShooting"
            )
        return joined([self._fit_point(single(problem, p), p) for p in range(len(problem.odes))])

    def finer(self, problem: Problem, fit: Fit, points: np.ndarray) -> None:
        """odeint chooses its own steps."""
        return

    def _fit_point(self, problem: Problem, point: int) -> Fit:
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
        return Fit(
            scaling=scaling[None],
            nodes=path[None],
            weights=used,
            finished=np.array([finished]),
            finite=np.array([bool(np.isfinite(path).all())]),
        )


def trajectories(
    ode: ODE, drive: Drive, start: torch.Tensor, n_samples: int, n_substeps: int = 1
) -> torch.Tensor:
    """(windows, samples, n_states) from starts (windows, n_states), differentiable."""
    ode.drive = drive
    last = n_samples - 1
    t = torch.arange(n_samples, dtype=torch.float64, device=start.device)
    grid = torch.linspace(0.0, float(last), n_substeps * last + 1, dtype=torch.float64)
    options = {"grid_constructor": lambda func, y0, t: grid, "perturb": True}
    return odeint(ode, start, t, method="rk4", options=options).transpose(0, 1)


def window_paths(problem: Problem, scaling: np.ndarray) -> np.ndarray:
    """Trajectories by scipy's odeint, window after window, from the data: NaN where it fails."""
    ode, batch = problem.odes[0], problem.batches[0]
    basis, offset = (part.detach().cpu().numpy() for part in ode.linear_parts())
    matrix = basis @ scaling + offset
    path = np.full(batch.data.shape, np.nan)
    factors, n = ode.library.factors, ode.n_states
    padded = np.ones(len(ode.variables) + 1)
    for w, data in enumerate(batch.data):
        t = np.append(0.0, np.cumsum(batch.steps[w]))

        def rhs(x: np.ndarray, now: float, t: np.ndarray = t, w: int = w) -> np.ndarray:
            padded[:n] = x
            if len(padded) > n + 1:
                k = min(max(int(np.searchsorted(t, now, side="right")) - 1, 0), len(t) - 2)
                share = (now - t[k]) / (t[k + 1] - t[k])
                padded[n:-1] = share**CUBIC @ batch.inputs[w, k]
            return padded[factors].prod(axis=1) @ matrix

        with np.errstate(over="ignore", invalid="ignore"):
            states, info = lsoda(rhs, data[0], t, full_output=True)
        if info["message"] == "Integration successful.":
            path[w] = states
    return path


def _weighted_loss(problem: Problem, weights: np.ndarray, scaling: np.ndarray) -> float:
    loss = np.square(weights * (window_paths(problem, scaling) - problem.data[0])).mean()
    return float(loss) if np.isfinite(loss) else np.inf


def _observe(problem: Problem, point: int, scaling: np.ndarray) -> None:
    loss = _weighted_loss(problem, np.ones(problem.data.shape[-1]), scaling)
    window = problem.data.shape[2]
    problem.observe(Iteration(point, window, loss, scaling.copy(), 0.0, 0.0))


def _iteration(point: int, data: torch.Tensor, ode: ODE, loss: float) -> Iteration:
    scaling = ode.scaling.detach().cpu().numpy().copy()
    return Iteration(point, data.shape[1], loss, scaling, 0.0, 0.0)
