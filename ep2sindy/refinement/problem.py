"""What every way of integral least squares starts from, and what it hands back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float

from ep2sindy.refinement.ode import ODE, ONE_RUNGE_KUTTA, Augmented, Drive, Step, augmented
from ep2sindy.refinement.windows import WindowBatch
from ep2sindy.runtime.progress import Advance, nothing


@dataclass(frozen=True, eq=False)
class Iteration:
    """One step of a fit, for whoever watches.

    block: samples in one piece of trajectory at this stage. loss: mean square of (trajectory -
    data) / std. step: largest relative change of a scaling. defect: largest gap between the end
    of a step and the next node, in std; zero where there are no nodes.
    """

    point: int
    block: int
    loss: float
    scaling: Float[np.ndarray, " free"]
    step: float
    defect: float


def recorder(
    callback: Callable[[Iteration], None] | None, advance: Advance = nothing
) -> tuple[list[Iteration], Callable[[Iteration], None]]:
    """A list that fills as a fit goes, and who fills it; `callback` and `advance` are told."""
    history: list[Iteration] = []

    def observe(iteration: Iteration) -> None:
        history.append(iteration)
        advance(1)
        if callback is not None:
            callback(iteration)

    return history, observe


@dataclass(frozen=True, eq=False)
class Problem:
    """Models of the same states, a batch of windows for each, on one device.

    free_start: each window's initial state is fitted too; else it is the data's.
    n_reweights: passes of weights 1/std of the residuals, after weights 1/std of the data.
    """

    odes: tuple[ODE, ...]
    batches: tuple[WindowBatch, ...]
    free_start: bool
    n_reweights: int
    observe: Callable[[Iteration], None]

    @cached_property
    def system(self) -> Augmented:
        return augmented(self.odes)

    @cached_property
    def data(self) -> Float[np.ndarray, "points windows samples n_states"]:
        return np.stack([batch.data for batch in self.batches])

    @property
    def n_free(self) -> int:
        """Of the model that has the most; scalings beyond a model's own move nothing."""
        return max(len(ode.free0) for ode in self.odes)

    @property
    def device(self) -> torch.device:
        return self.odes[0].free0.device

    @cached_property
    def one_step(self) -> Drive:
        """Every step of every window as a batch element of its own, over one segment."""
        return self._drive(one=True)

    @cached_property
    def whole(self) -> Drive:
        """Windows as batch elements, one segment per step."""
        return self._drive(one=False)

    def _drive(self, *, one: bool) -> Drive:
        steps = np.stack([batch.steps for batch in self.batches])
        inputs = np.stack([batch.inputs for batch in self.batches])
        n_points, n_windows, n_segments, _, n_inputs = inputs.shape
        inputs = inputs.transpose(2, 3, 0, 4, 1)
        steps = steps.transpose(2, 0, 1)
        if one:
            inputs = inputs.transpose(1, 2, 3, 4, 0)
            inputs = inputs.reshape(1, 4, n_points, n_inputs, n_windows * n_segments)
            steps = steps.transpose(1, 2, 0).reshape(1, n_points, -1)
        return Drive(
            torch.tensor(np.ascontiguousarray(steps), device=self.device),
            torch.tensor(np.ascontiguousarray(inputs), device=self.device),
        )


@dataclass(frozen=True, eq=False)
class Fit:
    """Where a method ended, point by point, before anybody judges it.

    scaling: ones beyond a model's own. nodes: the fitted trajectories at the samples, in std.
    weights: last used. finished: the method's own test was met. finite: False where it never was.
    step: the map of nodes to nodes.
    """

    scaling: Float[np.ndarray, "points free"]
    nodes: Float[np.ndarray, "points windows samples n_states"]
    weights: Float[np.ndarray, "points n_states"]
    finished: np.ndarray
    finite: np.ndarray
    step: Step = ONE_RUNGE_KUTTA


@runtime_checkable
class Method(Protocol):
    """What the alternatives share: a fit of all points of a problem."""

    def fit(self, problem: Problem) -> Fit: ...

    def finer(self, problem: Problem, fit: Fit, points: np.ndarray) -> Fit | None:
        """Some points again with half the time step; None where the method has no way to."""
        ...


def residual_weights(
    nodes: Float[np.ndarray, "points windows samples n_states"],
    data: Float[np.ndarray, "points windows samples n_states"],
) -> Float[np.ndarray, "points n_states"]:
    """1/std of each state's residuals, the geometric mean of a point's weights being one.

    A state fitted exactly gets at most 1000 times the weight of the worst.
    """
    spread = np.sqrt(np.square(nodes - data).mean(axis=(1, 2)))
    floor = np.maximum(1e-3 * spread.max(axis=1, keepdims=True), 1e-300)
    logs = -np.log(np.maximum(spread, floor))
    return np.exp(logs - logs.mean(axis=1, keepdims=True))


def single(problem: Problem, point: int) -> Problem:
    """One point of a problem."""
    return replace(problem, odes=(problem.odes[point],), batches=(problem.batches[point],))


def joined(fits: Sequence[Fit]) -> Fit:
    """Fits of single points, by one step, as one."""
    n_free = max(fit.scaling.shape[1] for fit in fits)
    scaling = np.ones((len(fits), n_free))
    for fit, row in zip(fits, scaling, strict=True):
        row[: fit.scaling.shape[1]] = fit.scaling[0]
    return Fit(
        scaling=scaling,
        nodes=np.concatenate([fit.nodes for fit in fits]),
        weights=np.concatenate([fit.weights for fit in fits]),
        finished=np.concatenate([fit.finished for fit in fits]),
        finite=np.concatenate([fit.finite for fit in fits]),
        step=fits[0].step,
    )
