"""Known right-hand side plus a learned term: a torch module trained along with a sparse model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.assess import RefinementStatus, is_flat, rollout, status_of
from ep2sindy.refinement.methods.gradient_descent import GradientDescent
from ep2sindy.refinement.ode import ScaledEquations
from ep2sindy.refinement.problem import (
    Iteration,
    RefinementChanges,
    RefinementFit,
    RefinementProblem,
    RefinementSettings,
    record,
)
from ep2sindy.refinement.refine import with_coef
from ep2sindy.refinement.windows import WindowBatch
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.threads import one_thread

# Default settings and method.
SETTINGS = RefinementSettings(n_reweights=0)
DESCENT = GradientDescent(max_iter=60, tolerance=1e-3, patience=5)

# A step is fine enough if halving it changes the trajectories (rms, in std) by less than the larger
# of these: a fraction of the rms residual, and an absolute value.
ERROR_PER_RESIDUAL, MIN_ERROR = 0.1, 1e-3


@dataclass(frozen=True, eq=False)
class Corrected:
    """A model and a learned term whose sum follows the data, x' = model + learned.

    model: the known part with trained coefficients, without covariance: a flexible term can
    imitate the known ones, so the data determine the sum and not its parts. For coefficients with
    errors, identify the learned term, add it to the model and `refine` the result.
    correction: a trained copy, in float64 on the CPU. It takes states, then inputs, in units of
    `scale`, and returns the learned derivative in units of `rate`; scale and rate are in SI.
    loss_before: loss of the known part alone, as given, from the data's own initial states;
    infinite if it blows up. loss: mean of window_loss, the mean square of (trajectory - data) / std
    in each window.
    status: converged; max_iter; coarse_step: the learned term compensates the error of the time
    step; flat: no better than a constant; non_finite: the model and term given are returned.
    history: one entry per iteration. trajectories: the fitted states in SI, in windows of `batch`.
    """

    model: SparseModel
    correction: nn.Module
    scale: Float[np.ndarray, " variables"]
    rate: Float[np.ndarray, " n_states"]
    loss_before: float
    loss: float
    window_loss: Float[np.ndarray, " windows"]
    status: RefinementStatus
    history: tuple[Iteration, ...]
    batch: WindowBatch
    trajectories: Float[np.ndarray, "windows samples n_states"]

    def learned(
        self,
        states: Float[np.ndarray, "... n_states"],
        inputs: Float[np.ndarray, "... n_inputs"] | None = None,
    ) -> Float[np.ndarray, "... n_states"]:
        """Learned part of the derivative, in SI; inputs are in the order of the model's.

        It is meaningless far from the samples on which it was trained.
        Raises ValueError if the columns are not the model's states and inputs.
        """
        values = states if inputs is None else np.concatenate([states, inputs], axis=-1)
        if values.shape[-1] != len(self.scale):
            raise ValueError(
                f"the learned term takes {list(self.model.states)} and inputs "
                f"{list(self.model.inputs)}, got {values.shape[-1]} columns"
            )
        flat = torch.tensor((values / self.scale).reshape(-1, len(self.scale)))
        with torch.no_grad():
            rate = self.correction(flat).numpy()
        return rate.reshape(states.shape) * self.rate


@one_thread()
def refine_with_correction(
    model: SparseModel,
    trajectories: Sequence[Trajectory],
    correction: nn.Module,
    settings: RefinementSettings = SETTINGS,
    *,
    seed: int | np.random.Generator = 0,
    callback: Callable[[Iteration], None] | None = None,
    device: str = "cpu",
    progress: Progress | bool = False,
    **changes: Unpack[RefinementChanges],
) -> Corrected:
    """Train x' = model + correction(states, inputs) to follow windows of the trajectories.

    Begin with a short `window`, since a model that lacks a term can hardly follow long ones. A
    failed fit is a result: see `status`.

    Parameters
    ----------
    model : SparseModel
        The known part of the equations.
    trajectories : sequence of Trajectory
        The records.
    correction : Module
        Torch module that maps (rows, states + inputs) to (rows, states). Each state is in units of
        its standard deviation, each input of its rms; the derivative is in units of the known
        part's rms over the data. It is best zero initially (last layer of zeros), so that training
        starts from the known part. It is copied. Its initial weights come from you and are the only
        randomness besides the windows: seed them by torch.manual_seed.
    settings : RefinementSettings, default SETTINGS
        Windows and method. Without reweighting, and with GradientDescent(max_iter=60,
        tolerance=1e-3, patience=5), if left out.
    seed : int or Generator, default 0
        Of the random windows.
    callback : callable, optional
        Called after every iteration, with its `Iteration`.
    device : str, default 'cpu'
        Device of torch, such as "cpu" or "cuda".
    progress : Progress or bool, default False
        True shows bars.
    **changes : fields of RefinementSettings
        Any of the `settings`, which they replace, as in `refine`.

    Returns
    -------
    Corrected
        The model with its trained correction, the loss and the status.

    Raises
    ------
    ValueError
        As `refine`, for a correction of the wrong shape, and for another method.

    Notes
    -----
    Over the free coefficients c, the weights p of the correction g and the starts of the windows,

        minimise sum over windows w, samples k: |(x_w(t_k; c, p) - data_w,k) / std|^2
        with x' = Theta(x, u) c + g(x, u; p)

    Source: Rackauckas et al. 2020, arXiv:2001.04385.
    """
    settings = settings.override(changes)
    method = settings.method or DESCENT
    if not isinstance(method, GradientDescent):
        raise ValueError(f"a learned correction is trained by GradientDescent alone, got {method}")
    (batch,) = settings.cut([model], [trajectories], np.random.default_rng(seed))
    with as_progress(progress).stage(None, "iteration", "refinement") as advance:
        history, observe = record(callback, advance)
        known = RefinementProblem.of(
            [model], [batch], [settings.constraint], free_start=settings.free_start,
            n_reweights=settings.n_reweights, observe=observe, device=device,
        )  # fmt: skip
        (equations,) = known.equations
        term = _Scaled(deepcopy(correction), _typical_rate(equations, batch))
        _check_shape(term.to(device, torch.float64), equations, device)
        problem = replace(known, correction=term)
        fit = method.fit(problem)
    return _result(model, correction, known, problem, fit, history, method.n_substeps)


def _result(
    model: SparseModel,
    correction: nn.Module,
    known: RefinementProblem,
    problem: RefinementProblem,
    fit: RefinementFit,
    history: Sequence[Iteration],
    n_substeps: int,
) -> Corrected:
    """Result in SI; holds the model and term given if the fit did not stay finite."""
    (equations,), (batch,), term = problem.equations, problem.batches, problem.correction
    assert isinstance(term, _Scaled)
    window_loss, status = _assess(problem, fit, n_substeps)
    unchanged = replace(fit, scaling=np.ones_like(fit.scaling), nodes=known.data)
    trained = status is not RefinementStatus.NON_FINITE
    scaling = (fit if trained else unchanged).scaling[0]
    path = rollout(known, unchanged, n_substeps=n_substeps)
    with np.errstate(over="ignore", invalid="ignore"):
        loss_before = float(np.square(path - known.data).mean())
    size = batch.scale[: len(model.states)]
    return Corrected(
        model=with_coef(model, equations.relations, equations.coef(scaling))[0],
        correction=(term.inner if trained else deepcopy(correction)).to("cpu", torch.float64),
        scale=batch.scale,
        rate=term.rate * size / batch.step_s,
        loss_before=loss_before if np.isfinite(loss_before) else float("inf"),
        loss=float(window_loss.mean()) if trained else float("inf"),
        window_loss=window_loss,
        status=status,
        history=tuple(history),
        batch=batch,
        trajectories=fit.nodes[0] * size,
    )


class _Scaled(nn.Module):
    """Correction times a typical rate, so that its output and weights are of order one."""

    def __init__(self, inner: nn.Module, rate: float) -> None:
        super().__init__()
        self.inner, self.rate = inner, rate

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        scaled: torch.Tensor = self.rate * self.inner(values)
        return scaled


def _typical_rate(known: ScaledEquations, batch: WindowBatch) -> float:
    """Rms of the known part over the windows, in std per sample; one if it vanishes."""
    values = np.concatenate([batch.data[:, :-1], batch.inputs[:, :, -1]], axis=-1)
    rates = known.library.evaluate(values) @ known.matrix(np.ones(known.n_free))
    rate = float(np.sqrt(np.square(rates).mean()))
    return rate if rate > 0.0 else 1.0


def _check_shape(term: nn.Module, known: ScaledEquations, device: str) -> None:
    rows = torch.zeros((3, len(known.variables)), dtype=torch.float64, device=device)
    with torch.no_grad():
        out = term(rows)
    if out.shape != (3, known.n_states):
        raise ValueError(
            f"a correction must map (rows, {len(known.variables)}) to (rows, {known.n_states}), "
            f"one column per state {list(known.variables[: known.n_states])}, got "
            f"{tuple(out.shape)} from {tuple(rows.shape)}"
        )


def _assess(
    problem: RefinementProblem, fit: RefinementFit, n_substeps: int
) -> tuple[Float[np.ndarray, " windows"], RefinementStatus]:
    """The loss of each window, and the most severe status that applies."""
    with np.errstate(over="ignore", invalid="ignore"):  # a blow-up is a status
        window_loss = np.square(fit.nodes - problem.data)[0].mean(axis=(1, 2))
    loss = float(window_loss.mean())

    def is_coarse() -> bool:
        """True if half the time step changes the trajectories by much, rms in std."""
        finer = rollout(problem, fit, n_substeps=2 * n_substeps)
        error = np.sqrt(np.square(finer - fit.nodes).mean())
        return not error < max(ERROR_PER_RESIDUAL * np.sqrt(loss), MIN_ERROR)

    status = status_of(
        finite=bool(fit.finite[0] and np.isfinite(loss)),
        flat=is_flat(loss, problem.data, free_start=problem.free_start),
        unidentifiable=False,  # the coefficients have no covariance
        settled=bool(fit.finished[0]),
        coarse=is_coarse,
    )
    return window_loss, status
