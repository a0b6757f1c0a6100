"""Integral least squares by torch optimisers, with gradients from autograd."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from ep2sindy.refinement.problem import (
    Iteration,
    RefinementFit,
    RefinementProblem,
    join,
    residual_weights,
)
from ep2sindy.refinement.steps import RungeKutta, integrate

Optimizer = Callable[[list[nn.Parameter]], torch.optim.Optimizer]

LBFGS: Optimizer = partial(torch.optim.LBFGS, line_search_fn="strong_wolfe")


@dataclass(frozen=True)
class GradientDescent:
    """Minimise by a torch optimiser, with reverse-mode gradients through torchdiffeq's `rk4`.

    Parameters
    ----------
    optimizer : callable, default LBFGS
        Function from parameters to an optimiser, such as `partial(torch.optim.Adam, lr=1e-2)`.
    max_iter : int, default 200
        Most steps of the optimiser.
    tolerance : float, default 1e-08
        The fit has converged when the last `patience` steps reduced the loss by less than this
        fraction.
    patience : int, default 10
        Number of those steps.
    n_substeps : int, default 1
        Runge-Kutta steps per sample.

    Notes
    -----
    Over the scalings s and the starts x_0 of the windows,

        minimise sum_k |W (x(t_k; x_0, s) - data_k)|^2

    where x is integrated through the whole window, states are in units of their standard deviation,
    and W weights them. Long windows of chaotic systems have many local minima; `MultipleShooting`
    avoids them.
    """

    optimizer: Optimizer = LBFGS
    max_iter: int = 200
    tolerance: float = 1e-8
    patience: int = 10
    n_substeps: int = 1

    def fit(self, problem: RefinementProblem) -> RefinementFit:
        return join([self._fit_point(problem.take(p), p) for p in range(len(problem.equations))])

    def finer(self, problem: RefinementProblem, fit: RefinementFit, points: np.ndarray) -> None:
        """Return None: the step is not halved automatically; set `n_substeps` instead."""
        return

    def _fit_point(self, problem: RefinementProblem, point: int) -> RefinementFit:
        data = torch.tensor(problem.data[0], device=problem.device)
        start = nn.Parameter(data[:, 0].clone(), requires_grad=problem.free_start)
        nodes, weights = problem.data, np.ones((1, data.shape[-1]))
        for k in range(problem.n_reweights + 1):
            if k:
                weights = residual_weights(nodes, problem.data)
            finished = self._descend(problem, point, start, weights[0])
            with torch.no_grad():
                nodes = self._integrate(problem, start)[None].cpu().numpy()
            if not np.isfinite(nodes).all():
                break
        scaling = problem.ode.scaling.detach().cpu().numpy().copy()
        return RefinementFit(
            scaling=scaling,
            nodes=nodes,
            weights=weights,
            finished=np.array([finished]),
            finite=np.array([bool(np.isfinite(nodes).all() and np.isfinite(scaling).all())]),
            step=RungeKutta(self.n_substeps),
        )

    def _descend(
        self, problem: RefinementProblem, point: int, start: nn.Parameter, weights: np.ndarray
    ) -> bool:
        """Train every parameter of the module, and the starts if they require a gradient.

        point: number by which it is reported. Returns true if the loss has converged.
        """
        ode, data = problem.ode, torch.tensor(problem.data[0], device=problem.device)
        optimizer = self.optimizer([*ode.parameters(), *([start] if start.requires_grad else [])])
        factor = torch.tensor(weights, device=problem.device)
        losses: list[float] = []

        def closure() -> torch.Tensor:
            optimizer.zero_grad()
            loss = (factor * (self._integrate(problem, start) - data)).square().mean()
            loss.backward()
            return loss

        for _ in range(self.max_iter):
            loss: Any = optimizer.step(closure)  # type: ignore[arg-type]
            losses.append(float(loss.detach()))
            scaling = ode.scaling.detach().cpu().numpy()[0].copy()
            problem.observe(Iteration(point, data.shape[1], losses[-1], scaling, 0.0, 0.0))
            if not np.isfinite(losses[-1]):
                return False
            recent = losses[-self.patience - 1 :]
            gained = recent[0] - min(recent)
            if len(recent) > self.patience and gained <= self.tolerance * recent[0]:
                return True
        return False

    def _integrate(self, problem: RefinementProblem, start: torch.Tensor) -> torch.Tensor:
        """Trajectories (windows, samples, n_states) from starts (windows, n_states)."""
        ode, n_segments = problem.ode, problem.data.shape[2] - 1
        ode.drive = problem.whole
        path = integrate(
            ode, start.T[None, None], n_segments=n_segments, n_substeps=self.n_substeps
        )
        return path[:, 0, 0].permute(2, 0, 1)
