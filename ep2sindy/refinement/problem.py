"""Settings, problem and result of integral least squares, common to all methods."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, TypedDict, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import nn

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.ode import ODE, Drive, ScaledEquations
from ep2sindy.refinement.steps import ONE_RUNGE_KUTTA, Step
from ep2sindy.refinement.windows import (
    PERIODS,
    WindowBatch,
    check_windows,
    cut_windows,
    dominant_window,
)
from ep2sindy.runtime.progress import Advance, nothing
from ep2sindy.runtime.values import set_counts


class RefinementChanges(TypedDict, total=False):
    """Fields of `RefinementSettings` as keywords of a function; None changes nothing."""

    n_windows: int | None
    window: int | None
    periods: float | None
    method: Method | None
    constraint: Constraint | None
    free_start: bool | None
    n_reweights: int | None


@dataclass(frozen=True)
class RefinementSettings:
    """Settings of a refinement: the windows to be followed, and the method.

    Parameters
    ----------
    n_windows : int, default 30
        Number of windows, spread over the trajectories; fewer if the data are too short.
    window : int, optional
        Number of samples in each window. None takes `periods`.
    periods : float, optional
        Periods of the dominant frequency in each window, as far as the data allow. None takes one
        and a half, unless `window` is given.
    method : MultipleShooting or GradientDescent, optional
        None means MultipleShooting(), unless a function states its own default.
    constraint : Constraint, optional
        Relations between coefficients, or known coefficients that stay fixed. None leaves every
        coefficient free.
    free_start : bool, default True
        True also fits the initial state of each window, whose noise would otherwise bias the
        coefficients. False starts at the data, as in the thesis.
    n_reweights : int, default 1
        Number of passes with each state weighted by 1/std of its residuals.

    Raises
    ------
    ValueError
        If there is no window, a window has too few samples, windows are set by both samples and
        periods, or the number of passes is negative.

    Examples
    --------
    >>> ep.refinement.RefinementSettings(n_windows=20, periods=2.0).free_start
    True
    """

    n_windows: int = 30
    window: int | None = None
    periods: float | None = None
    method: Method | None = None
    constraint: Constraint | None = None
    free_start: bool = True
    n_reweights: int = 1

    def __post_init__(self) -> None:
        set_counts(self, {"n_windows": 1, "n_reweights": 0})
        check_windows(self.n_windows, self.window)
        if self.periods is not None:
            if self.window is not None:
                raise ValueError(
                    "a window is set by its samples or by its periods, got "
                    f"window={self.window} and periods={self.periods}; leave out one"
                )
            if not self.periods > 0.0:
                raise ValueError(
                    f"periods must be positive, got {self.periods}; leave it out for one and a half"
                )

    def override(self, given: RefinementChanges) -> RefinementSettings:
        """Copy of the settings, with the given values that are not None replaced."""
        changes: dict[str, Any] = {k: value for k, value in given.items() if value is not None}
        if changes.keys() & {"window", "periods"}:  # both set the length of a window
            changes = {"window": None, "periods": None} | changes
        return replace(self, **changes)

    def cut(
        self,
        models: Sequence[SparseModel],
        trajectories: Sequence[Sequence[Trajectory]],
        rng: np.random.Generator,
    ) -> list[WindowBatch]:
        """Cut windows for every model from its own trajectories.

        All windows have one length: `window`, or else the shortest that any model would choose.
        Raises ValueError unless there is a list of trajectories for each model.
        """
        if len(models) != len(trajectories):
            raise ValueError(
                "every model needs a list of trajectories of its own, got "
                f"{len(models)} models and {len(trajectories)} lists"
            )
        window = self.window
        if window is None:
            lengths = [
                dominant_window(runs, model.states, periods=self.periods or PERIODS)
                for model, runs in zip(models, trajectories, strict=True)
            ]
            window = min(lengths, default=0)
        return [
            cut_windows(runs, model, n_windows=self.n_windows, window=window, rng=rng)
            for model, runs in zip(models, trajectories, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class Iteration:
    """One iteration of a fit, as reported to observers.

    memory: samples after which a stage forgets what happened; the window's if it forgets nothing.
    loss: mean square of (trajectory - data) / std. step: largest relative change of a scaling.
    defect: largest gap between the end of a step and the next node, in std; zero for methods
    without nodes.
    """

    point: int
    memory: int
    loss: float
    scaling: Float[np.ndarray, " free"]
    step: float
    defect: float


def record(
    callback: Callable[[Iteration], None] | None, advance: Advance = nothing
) -> tuple[list[Iteration], Callable[[Iteration], None]]:
    """List of the iterations of a fit, and the observer that fills it.

    The observer also calls `advance` and `callback`.
    """
    history: list[Iteration] = []

    def observe(iteration: Iteration) -> None:
        history.append(iteration)
        advance(1)
        if callback is not None:
            callback(iteration)

    return history, observe


def ignore(iteration: Iteration) -> None:
    """Observer that ignores all iterations."""


@dataclass(frozen=True, eq=False)
class RefinementProblem:
    """Models of the same states, with a batch of windows for each, on one device.

    equations: of each model in the units of its windows; `ode` is their module. free_start: true if
    the initial state of each window is fitted; otherwise it is the data's. n_reweights: number of
    passes with weights 1/std of the residuals, after weights 1/std of the data. correction: a term
    that is trained along, of the only point.
    """

    equations: tuple[ScaledEquations, ...]
    batches: tuple[WindowBatch, ...]
    free_start: bool
    n_reweights: int
    observe: Callable[[Iteration], None]
    device: str = "cpu"
    correction: nn.Module | None = None

    @staticmethod
    def of(
        models: Sequence[SparseModel],
        batches: Sequence[WindowBatch],
        constraints: Sequence[Constraint | None],
        *,
        free_start: bool = True,
        n_reweights: int = 0,
        observe: Callable[[Iteration], None] = ignore,
        device: str = "cpu",
    ) -> RefinementProblem:
        """Problem with models scaled like their windows; a constraint of None frees all terms."""
        equations = tuple(
            ScaledEquations.of(model, scale=batch.scale, step_s=batch.step_s, constraint=relations)
            for model, batch, relations in zip(models, batches, constraints, strict=True)
        )
        return RefinementProblem(
            equations, tuple(batches), free_start, n_reweights, observe, device=device
        )

    @cached_property
    def ode(self) -> ODE:
        """The module that is fitted, of all points, with scalings of one."""
        return ODE.of(self.equations, self.correction).to(self.device)

    @cached_property
    def data(self) -> Float[np.ndarray, "points windows samples n_states"]:
        return np.stack([batch.data for batch in self.batches])

    @cached_property
    def ranges(self) -> Float[np.ndarray, "points n_states"]:
        return np.ptp(self.data, axis=(1, 2))

    @property
    def n_free(self) -> int:
        """Largest number of scalings of a model; other models ignore the excess ones."""
        return max(each.n_free for each in self.equations)

    @property
    def n_start(self) -> int:
        """Number of unknowns in the initial state of a window."""
        return self.data.shape[-1] if self.free_start else 0

    @cached_property
    def one_step(self) -> Drive:
        """Drive with every step of every window as a separate batch element, over one segment."""
        return self._drive(one=True)

    @cached_property
    def whole(self) -> Drive:
        """Drive with windows as batch elements, and one segment per step."""
        return self._drive(one=False)

    def take(self, point: int) -> RefinementProblem:
        """Problem of a single point."""
        return replace(self, equations=(self.equations[point],), batches=(self.batches[point],))

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
class RefinementFit:
    """Result of a method, point by point, before it is assessed.

    scaling: padded with ones beyond a model's own scalings. nodes: the fitted trajectories at the
    samples, in std. weights: the last ones used. finished: true if the method's own convergence
    test was met. finite: False for points that did not stay finite. step: time-step scheme from
    node to node. memory: samples, the longest memory of a stage that left no gaps, if the method
    has stages. maps: one-step maps at the nodes, if they are known.
    """

    scaling: Float[np.ndarray, "points free"]
    nodes: Float[np.ndarray, "points windows samples n_states"]
    weights: Float[np.ndarray, "points n_states"]
    finished: np.ndarray
    finite: np.ndarray
    step: Step = ONE_RUNGE_KUTTA
    memory: Int[np.ndarray, " points"] | None = None
    maps: np.ndarray | None = None


@runtime_checkable
class Method(Protocol):
    """Interface of the methods: a fit of all points of a problem."""

    def fit(self, problem: RefinementProblem) -> RefinementFit: ...

    def finer(
        self, problem: RefinementProblem, fit: RefinementFit, points: np.ndarray
    ) -> RefinementFit | None:
        """Refit some points with half the time step; None if the method cannot do so."""
        ...


def residual_weights(
    nodes: Float[np.ndarray, "points windows samples n_states"],
    data: Float[np.ndarray, "points windows samples n_states"],
) -> Float[np.ndarray, "points n_states"]:
    """Weights 1/std of each state's residuals, with geometric mean one at every point.

    A state that is fitted exactly gets at most 1000 times the weight of the worst.
    """
    spread = np.sqrt(np.square(nodes - data).mean(axis=(1, 2)))
    floor = np.maximum(1e-3 * spread.max(axis=1, keepdims=True), 1e-300)
    logs = -np.log(np.maximum(spread, floor))
    return np.exp(logs - logs.mean(axis=1, keepdims=True))


def join(fits: Sequence[RefinementFit]) -> RefinementFit:
    """Join fits of single points with the same step scheme into one."""
    n_free = max(fit.scaling.shape[1] for fit in fits)
    scaling = np.ones((len(fits), n_free))
    for fit, row in zip(fits, scaling, strict=True):
        row[: fit.scaling.shape[1]] = fit.scaling[0]
    return RefinementFit(
        scaling=scaling,
        nodes=np.concatenate([fit.nodes for fit in fits]),
        weights=np.concatenate([fit.weights for fit in fits]),
        finished=np.concatenate([fit.finished for fit in fits]),
        finite=np.concatenate([fit.finite for fit in fits]),
        step=fits[0].step,
    )
