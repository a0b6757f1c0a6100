"""Integral least squares by torch optimisers, with gradients from autograd."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from ep2sindy.refinement.ode import ODE, Drive
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

    optimizer: function from parameters to an optimiser, such as
    `partial(torch.optim.Adam, lr=1e-2)`.
    The fit has converged when the last `patience` steps reduced the loss by less than a share
    `tolerance`.
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
        ode, data = problem.ode, torch.tensor(problem.data[0], device=problem.device)
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
        scaling = ode.scaling.detach().cpu().numpy().copy()
        return RefinementFit(
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
        """Train every parameter of a module, and the starts if they require a gradient.

        data: (windows, samples, n_states). Returns true if the loss has converged.
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


def trajectories(
    ode: ODE, drive: Drive, start: torch.Tensor, n_samples: int, n_substeps: int = 1
) -> torch.Tensor:
    """Trajectories (windows, samples, n_states) from starts (windows, n_states), differentiable."""
    ode.drive = drive
    column = start.T[None, None]
    path = integrate(ode, column, n_segments=n_samples - 1, n_substeps=n_substeps)
    return path[:, 0, 0].permute(2, 0, 1)


def _iteration(point: int, data: torch.Tensor, ode: ODE, loss: float) -> Iteration:
    scaling = ode.scaling.detach().cpu().numpy()[0].copy()
    return Iteration(point, data.shape[1], loss, scaling, 0.0, 0.0)
