"""Integral least squares: refinement of coefficients until trajectories follow the data."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack, cast, overload

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.runs import Runs, is_run, trajectories_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.relations import Constraint
from ep2sindy.model.display import model_html, model_lines
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.assess import RefinementStatus, RefinementVerdict, failure, fit_and_assess
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.problem import (
    Iteration,
    RefinementChanges,
    RefinementFit,
    RefinementProblem,
    RefinementSettings,
    record,
)
from ep2sindy.refinement.windows import WindowBatch
from ep2sindy.regression.constrained import place_coefficients
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.screen import N_LINES, one_screen
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_kind

SETTINGS = RefinementSettings()


@dataclass(frozen=True, eq=False)
class Refinement:
    """A model fitted to trajectories, with its uncertainty and status.

    model: with the covariance of its coefficients, a sandwich with windows as clusters; `message`
    says if it leaves more than noise, so that this covariance says too little.
    covariance_naive: the same for white, independent residuals.
    window_loss: mean square of (trajectory - data) / std in each window, integrated again from
    the fitted starts. loss: its mean; a constant has a loss of one.
    status: converged; max_iter: not converged, though the time step is short enough; coarse_step:
    converged or not, the error of the time step biases a coefficient significantly, and the method
    cannot halve the step again; unidentifiable: the 95 % interval of a free coefficient reaches
    zero; flat: no better than a constant; non_finite: the given model is returned, without
    covariance.
    history: one entry per iteration. trajectories: the fitted states in SI, in windows of `batch`.
    message: for non_finite, flat and max_iter, at which stage (by its memory in samples, see
    `MultipleShooting`) and in which window the refinement failed; else why there are no intervals.
    """

    model: SparseModel
    covariance_naive: Float[np.ndarray, "_ _"] | None
    loss: float
    window_loss: Float[np.ndarray, " windows"]
    status: RefinementStatus
    history: tuple[Iteration, ...]
    batch: WindowBatch
    trajectories: Float[np.ndarray, "windows samples n_states"]
    message: str = ""

    def __repr__(self) -> str:
        body = model_lines(self.model, n_lines=N_LINES - 1)
        return one_screen([self._headline(), *filter(None, [self.message]), *body])

    def _repr_html_(self) -> str:
        return f"<div>{html.escape(self._headline())}</div>{model_html(self.model)}"

    def _headline(self) -> str:
        n_windows, n_samples = self.trajectories.shape[:2]
        return (
            f"Refinement: {self.status}, loss {self.loss:.3g} of a constant's, "
            f"{n_windows} windows of {n_samples} samples, {len(self.history)} iterations"
        )


@overload
def refine(
    model: SparseModel,
    trajectories: Runs,
    settings: RefinementSettings = SETTINGS,
    *,
    seed: int | np.random.Generator = 0,
    callback: Callable[[Iteration], None] | None = None,
    device: str = "cpu",
    progress: Progress | bool = False,
    **changes: Unpack[RefinementChanges],
) -> Refinement: ...


@overload
def refine(
    model: Sequence[SparseModel],
    trajectories: Sequence[Sequence[Trajectory]],
    settings: RefinementSettings = SETTINGS,
    *,
    constraints: Sequence[Constraint | None] | None = None,
    points_per_batch: int = 8,
    seed: int | np.random.Generator = 0,
    callback: Callable[[Iteration], None] | None = None,
    device: str = "cpu",
    progress: Progress | bool = False,
    **changes: Unpack[RefinementChanges],
) -> list[Refinement]: ...


@one_thread()
def refine(
    model: SparseModel | Sequence[SparseModel],
    trajectories: Runs | Sequence[Sequence[Trajectory]],
    settings: RefinementSettings = SETTINGS,
    *,
    constraints: Sequence[Constraint | None] | None = None,
    points_per_batch: int = 8,
    seed: int | np.random.Generator = 0,
    callback: Callable[[Iteration], None] | None = None,
    device: str = "cpu",
    progress: Progress | bool = False,
    **changes: Unpack[RefinementChanges],
) -> Refinement | list[Refinement]:
    """Fit the free coefficients to windows spread over trajectories, by least squares.

    The terms of the model stay; their coefficients change until the integrated model follows
    windows of the data. A failed fit is a result: see `status` and `message`.

    Parameters
    ----------
    model : SparseModel or list of SparseModel
        One model, or a list of models of the same states.
    trajectories : run, or list or dict of runs
        As `discover` takes them. For a list of models a list each.
    settings : RefinementSettings, default SETTINGS
        Windows and method.
    constraints : sequence of Constraint or None, optional
        For a list of models, the constraint of each, in place of `settings.constraint`.
    points_per_batch : int, default 8
        Number of models integrated together: few enough for the processor's cache, or thousands on
        a GPU.
    seed : int or Generator, default 0
        Of the random windows.
    callback : callable, optional
        Called after every iteration, with its `Iteration`.
    device : str, default 'cpu'
        Device of torch, such as "cpu" or "cuda".
    progress : Progress or bool, default False
        True shows bars.
    **changes : fields of RefinementSettings
        Any of the `settings`, such as window=50, which they replace.

    Returns
    -------
    Refinement or list of Refinement
        The refined model with the covariance of its coefficients, the loss, the status and the
        history.

    Raises
    ------
    ValueError
        If a window fits no trajectory, a variable is missing, a model has no terms or not those of
        its constraint, or models differ in their variables or the number of their windows.

    Notes
    -----
    Minimises over the free coefficients c and the initial states of the windows

        sum over windows w, samples k: |(x_w(t_k; c) - data_w,k) / std|^2

    where x_w is the integrated model. Each state is weighted by 1/std of its residuals in the last
    passes (`n_reweights`). Assumes residuals of constant variance in each state.

    Source: Bock 1983, doi:10.1007/978-1-4684-7324-7_7, for multiple shooting; the thesis, integral
    least squares.

    Examples
    --------
    >>> system = ep.lotka_volterra()
    >>> start = ep.lotka_volterra(a=0.6).model
    >>> refined = ep.refine(start, system.trajectory(noise=0.02, rng=0))
    >>> str(refined.status), round(refined.model.terms("x")["x"], 2)
    ('converged', 0.67)
    """
    settings = settings.override(changes)
    models, records = _by_model(model, trajectories)
    relations = _resolve_constraints(settings, models, constraints)
    batches = settings.cut(models, records, np.random.default_rng(seed))
    with as_progress(progress).stage(None, "iteration", "refinement") as advance:
        refinements: list[Refinement] = []
        for some in _chunks(len(models), points_per_batch):
            history, observe = record(callback, advance)
            problem = RefinementProblem.of(
                models[some], batches[some], relations[some], free_start=settings.free_start,
                n_reweights=settings.n_reweights, observe=observe, device=device,
            )  # fmt: skip
            fit, verdicts = fit_and_assess(problem, settings.method or MultipleShooting())
            refinements += [
                _result(one, problem, fit, p, verdict, history)
                for p, (one, verdict) in enumerate(zip(models[some], verdicts, strict=True))
            ]
    return refinements[0] if isinstance(model, SparseModel) else refinements


def _by_model(
    model: SparseModel | Sequence[SparseModel], trajectories: Runs | Sequence[Sequence[Trajectory]]
) -> tuple[Sequence[SparseModel], Sequence[Sequence[Trajectory]]]:
    """Arguments of `refine` as a list of models and the trajectories of each."""
    if isinstance(model, SparseModel):
        models, records = [model], [trajectories_of(cast("Runs", trajectories), partial=True)]
    else:
        for each in model if isinstance(model, Sequence) else [model]:
            check_kind("model", each, SparseModel, "found.model")
        models = list(model)
        if is_run(trajectories) or any(map(is_run, cast("Sequence[Any]", trajectories))):
            raise ValueError(
                "a list of models takes a list of trajectories for each, as in "
                f"refine(models, [[run] for run in runs]), got {len(models)} models with "
                f"{'one run' if is_run(trajectories) else 'a list of runs'}"
            )
        records = [list(runs) for runs in cast("Sequence[Sequence[Trajectory]]", trajectories)]
    return models, [[run.complete() for run in runs] for runs in records]


def _resolve_constraints(
    settings: RefinementSettings,
    models: Sequence[SparseModel],
    constraints: Sequence[Constraint | None] | None,
) -> Sequence[Constraint | None]:
    """Constraint of every model."""
    if constraints is None:
        return [settings.constraint] * len(models)
    if settings.constraint is not None or len(constraints) != len(models):
        raise ValueError(
            "constraints must hold one entry per model, and replace `constraint`, got "
            f"{len(constraints)} for {len(models)} models"
            f"{'' if settings.constraint is None else ', next to a common one; leave out one'}"
        )
    return constraints


def _chunks(n_models: int, points_per_batch: int) -> list[slice]:
    return [slice(k, k + points_per_batch) for k in range(0, n_models, points_per_batch)]


def _result(
    model: SparseModel,
    problem: RefinementProblem,
    fit: RefinementFit,
    point: int,
    verdict: RefinementVerdict,
    history: Sequence[Iteration],
) -> Refinement:
    """Result of one point, in SI and in the model's own order of coefficients."""
    batch, equations = problem.batches[point], problem.equations[point]
    finite = verdict.status is not RefinementStatus.NON_FINITE
    refined, naive = replace(model, covariance=None), None
    if finite:
        relations = equations.relations
        values = equations.coef(fit.scaling[point, : equations.n_free])
        refined, order = with_coef(model, relations, values)
        by_scaling = (relations.C * equations.free0)[order]
        robust, naive = (
            by_scaling @ covariance @ by_scaling.T
            for covariance in (verdict.covariance, verdict.covariance_naive)
        )
        refined = replace(refined, covariance=robust)
    with np.errstate(over="ignore"):  # a fit that blew up overflows
        trajectories = fit.nodes[point] * batch.scale[: fit.nodes.shape[-1]]
    return Refinement(
        model=refined,
        covariance_naive=naive,
        loss=float(verdict.window_loss.mean()) if finite else float("inf"),
        window_loss=verdict.window_loss,
        status=verdict.status,
        history=tuple(entry for entry in history if entry.point == point),
        batch=batch,
        trajectories=trajectories,
        message=failure(problem, fit, point, verdict) or _doubt(model, verdict),
    )


def _doubt(model: SparseModel, verdict: RefinementVerdict) -> str:
    more = [s for s, known in zip(model.states, verdict.explains, strict=True) if not known]
    return (
        f"intervals say too little: the model leaves more than noise of {', '.join(more)}"
        if more
        else ""
    )


def with_coef(
    model: SparseModel, constraint: Constraint, values: np.ndarray
) -> tuple[SparseModel, Int[np.ndarray, " used"]]:
    """Model with these coefficients, and their indices in `values` in the model's own order."""
    places = constraint.coefficients
    coef, used = place_coefficients(model.library, model.states, places, values)
    return replace(model, coef=coef, covariance=None), used
