"""Integral least squares: refine a model's coefficients until its trajectories follow the data."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float

from ep2sindy.constraints.relations import Constraint
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.display import model_html, model_lines
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.judge import Verdict, closed, judge
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.ode import ODE, held, unconstrained
from ep2sindy.refinement.problem import Fit, Iteration, Method, Problem, recorder
from ep2sindy.refinement.windows import WindowBatch, cut_windows, dominant_window
from ep2sindy.runtime.progress import Advance, Progress, as_progress, counted, nothing
from ep2sindy.runtime.screen import N_LINES, one_screen
from ep2sindy.runtime.threads import one_thread


@dataclass(frozen=True, eq=False)
class Refinement:
    """A model fitted to trajectories, and how far to trust it.

    model: with the covariance of its coefficients, a sandwich with windows as clusters.
    covariance_naive: the same for residuals that are white and independent.
    window_loss: mean square of (trajectory - data) / std, integrated again from the fitted
    starts; loss: its mean, one being that of a constant.
    status: converged; max_iter; coarse_step: the error of the time step shows in a coefficient;
    unidentifiable: the 95 % interval of a free coefficient reaches zero; flat: no better than a
    constant; non_finite: the model given comes back, without covariance.
    history: one entry per iteration. trajectories: the fitted states in SI; data cut by `batch`.
    """

    model: SparseModel
    covariance_naive: Float[np.ndarray, "_ _"] | None
    loss: float
    window_loss: Float[np.ndarray, " windows"]
    status: str
    history: tuple[Iteration, ...]
    batch: WindowBatch
    trajectories: Float[np.ndarray, "windows samples n_states"]

    def __repr__(self) -> str:
        body = model_lines(self.model, n_lines=N_LINES - 1)
        return one_screen([self._headline(), *body])

    def _repr_html_(self) -> str:
        return f"<div>{html.escape(self._headline())}</div>{model_html(self.model)}"

    def _headline(self) -> str:
        n_windows, n_samples = self.trajectories.shape[:2]
        return (
            f"Refinement: {self.status}, loss {self.loss:.3g} of a constant's, "
            f"{n_windows} windows of {n_samples} samples, {len(self.history)} iterations"
        )


@one_thread()
def refine(
    model: SparseModel,
    trajectories: Sequence[Trajectory],
    *,
    n_windows: int = 30,
    window: int | None = None,
    method: Method | None = None,
    constraint: Constraint | None = None,
    free_start: bool = True,
    n_reweights: int = 1,
    rng: np.random.Generator | int,
    callback: Callable[[Iteration], None] | None = None,
    device: str = "cpu",
    progress: Progress | bool = False,
) -> Refinement:
    """Fit the free coefficients to windows spread over trajectories, by least squares.

    window: samples in each; None takes one and a half periods of the dominant frequency.
    method: None means MultipleShooting(). free_start: fit each window's initial state as well,
    without which noise in it biases the coefficients; False starts at the data, as the thesis.
    n_reweights: passes with each state weighted by 1/std of its residuals. progress: True shows
    a bar; see `Progress`.
    Raises ValueError for a window that fits no trajectory, a missing variable, a model without
    terms or a constraint that leaves out one of them. A failed fit is a result: see `status`.

    >>> run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    >>> refined = ep.refine(ep.discover(run).model, [run], rng=0)
    >>> str(refined.status)
    'converged'
    """
    rng = np.random.default_rng(rng)
    (found,) = refine_many(
        [model],
        [trajectories],
        n_windows=n_windows,
        window=dominant_window(trajectories, model.states) if window is None else window,
        method=method,
        constraint=constraint,
        free_start=free_start,
        n_reweights=n_reweights,
        rng=rng,
        callback=callback,
        device=device,
        progress=progress,
    )
    return found


@one_thread()
def refine_many(
    models: Sequence[SparseModel],
    trajectories: Sequence[Sequence[Trajectory]],
    *,
    window: int,
    n_windows: int = 30,
    method: Method | None = None,
    constraint: Constraint | None = None,
    free_start: bool = True,
    n_reweights: int = 1,
    points_per_batch: int = 8,
    rng: np.random.Generator | int,
    callback: Callable[[Iteration], None] | None = None,
    device: str = "cpu",
    progress: Progress | bool = False,
) -> list[Refinement]:
    """Refine models of the same states, each on trajectories of its own; as `refine` for the rest.

    points_per_batch: points integrated together, few enough to stay in the processor's cache;
    on a GPU, thousands. A point that has converged leaves its batch.
    Models may differ in their terms; those of a batch all cost what the largest does.
    Raises ValueError if the models differ in their variables or the windows in their number.
    """
    rng = np.random.default_rng(rng)
    cut = partial(cut_windows, n_windows=n_windows, window=window, rng=rng)
    found: list[Refinement] = []
    with as_progress(progress).stage(None, "iteration", "refinement") as advance:
        for first in range(0, len(models), points_per_batch):
            chunk = models[first : first + points_per_batch]
            batches = [
                cut(data, states=model.states, inputs=model.inputs)
                for model, data in zip(chunk, trajectories[first:], strict=False)
            ]
            found += _refined(
                chunk,
                batches,
                method=MultipleShooting() if method is None else method,
                constraint=constraint,
                free_start=free_start,
                n_reweights=n_reweights,
                callback=callback,
                device=device,
                advance=advance,
            )
    return found


def loss_against_window(
    model: SparseModel,
    trajectories: Sequence[Trajectory],
    windows: Sequence[int],
    *,
    n_windows: int = 30,
    method: Method | None = None,
    constraint: Constraint | None = None,
    free_start: bool = True,
    n_reweights: int = 1,
    rng: np.random.Generator | int,
    progress: Progress | bool = False,
) -> dict[int, Refinement]:
    """Refine once per window length; the loss of each says where the model ceases to follow."""
    rng, watch = np.random.default_rng(rng), as_progress(progress)
    return {
        window: refine(
            model,
            trajectories,
            n_windows=n_windows,
            window=window,
            method=method,
            constraint=constraint,
            free_start=free_start,
            n_reweights=n_reweights,
            rng=rng,
            progress=watch,
        )
        for window in counted(watch, windows, "window length")
    }


def _refined(
    models: Sequence[SparseModel],
    batches: Sequence[WindowBatch],
    *,
    method: Method,
    constraint: Constraint | None,
    free_start: bool,
    n_reweights: int,
    callback: Callable[[Iteration], None] | None,
    device: str,
    advance: Advance,
) -> list[Refinement]:
    """One batch of points, from windows to results."""
    odes = [
        ODE(model, scale=batch.scale, step_s=batch.step_s, constraint=constraint).to(device)
        for model, batch in zip(models, batches, strict=True)
    ]
    history, observe = recorder(callback, advance)
    problem = Problem(
        odes=tuple(odes),
        batches=tuple(batches),
        free_start=free_start,
        n_reweights=n_reweights,
        observe=observe,
    )
    fit, verdicts = judge(problem, method.fit(problem))
    while coarse := [p for p, verdict in enumerate(verdicts) if verdict.status == "coarse_step"]:
        again = method.finer(problem, fit, np.array(coarse))
        if again is None:
            break
        fit, verdicts = judge(problem, again)
    return [
        _result(model, problem, fit, p, verdict, constraint or unconstrained(model), history)
        for p, (model, verdict) in enumerate(zip(models, verdicts, strict=True))
    ]


def _result(
    model: SparseModel,
    problem: Problem,
    fit: Fit,
    point: int,
    verdict: Verdict,
    constraint: Constraint,
    history: Sequence[Iteration],
) -> Refinement:
    """Back to SI and to the model's own order of coefficients."""
    batch, ode = problem.batches[point], problem.odes[point]
    finite = verdict.status != "non_finite"
    robust = naive = None
    refined = replace(model, covariance=None)
    if finite:
        with torch.no_grad():
            ode.scaling.copy_(torch.tensor(fit.scaling[point, : len(ode.free0)]))
            values = ode.coef.cpu().numpy()
        refined, order = with_coef(model, constraint, values)
        by_scaling = (constraint.C * ode.free0.cpu().numpy())[order]
        robust, naive = (
            by_scaling @ each @ by_scaling.T
            for each in (verdict.covariance, verdict.covariance_naive)
        )
        refined = replace(refined, covariance=robust)
    with np.errstate(over="ignore"):  # of a fit that blew up
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
    )


def with_coef(
    model: SparseModel, constraint: Constraint, values: np.ndarray
) -> tuple[SparseModel, list[int]]:
    """The model with these coefficients, and where its own order finds them among `values`."""
    coef = np.zeros_like(model.coef)
    places = {}
    for k, (state, term) in enumerate(constraint.coefficients):
        equation, row = model.states.index(state), model.library.index(term)
        coef[row, equation] = values[k]
        if values[k] != 0.0:
            places[equation, row] = k
    return replace(model, coef=coef, covariance=None), [places[at] for at in sorted(places)]


@dataclass(frozen=True, eq=False)
class Together:
    """Models refined on the same windows, judged by none.

    finished: which met the method's own test. loss: mean square of (trajectory - data) in the
    batch's scale; infinite for a model whose refinement did not stay finite, which comes back as
    it was.
    """

    models: Sequence[SparseModel]
    finished: Bool[np.ndarray, " models"]
    loss: Float[np.ndarray, " models"]


@one_thread()
def refine_together(
    models: Sequence[SparseModel],
    batch: WindowBatch,
    *,
    method: Method,
    constraints: Sequence[Constraint] | None = None,
    n_reweights: int = 1,
    points_per_batch: int = 8,
    advance: Advance = nothing,
) -> Together:
    """Refine models of the same states on the same windows, with free starts, and judge none.

    constraints: one per model; None leaves all coefficients free. points_per_batch: as for
    `refine_many`; models may differ in their terms as there. advance: told of finished models.
    Raises ValueError for a model without terms.
    """
    found: list[SparseModel] = []
    finished, losses = [], []
    for first in range(0, len(models), points_per_batch):
        chunk = models[first : first + points_per_batch]
        relations = (
            [unconstrained(model) for model in chunk]
            if constraints is None
            else list(constraints[first : first + points_per_batch])
        )
        odes = [_scaled(m, batch, relation) for m, relation in zip(chunk, relations, strict=True)]
        problem = _unobserved(odes, [batch] * len(chunk), n_reweights=n_reweights)
        fit = method.fit(problem)
        for p, (model, ode) in enumerate(zip(chunk, problem.odes, strict=True)):
            free = ode.free0.cpu().numpy() * fit.scaling[p, : len(ode.free0)]
            refined, _ = with_coef(model, relations[p], relations[p].coef(free))
            found.append(refined if fit.finite[p] else model)
        finished.append(fit.finished & fit.finite)
        with np.errstate(over="ignore", invalid="ignore"):
            loss = np.square(fit.nodes - problem.data).mean(axis=(1, 2, 3))
        losses.append(np.where(fit.finite, loss, np.inf))
        advance(len(chunk))
    return Together(found, np.concatenate(finished), np.concatenate(losses))


def follow_together(
    models: Sequence[SparseModel],
    batch: WindowBatch,
    *,
    method: Method,
    points_per_batch: int = 8,
    advance: Advance = nothing,
) -> Float[np.ndarray, "models windows samples n_states"]:
    """Trajectories that follow the windows best: starts fitted, coefficients held.

    In units of the batch's scale; NaN in windows where a model blows up. points_per_batch: as
    for `refine_many`; models may differ in their terms as there. advance: told of those followed.
    Raises ValueError for a model without terms.
    """
    # Every window is a point of its own: one that blows up stops no other.
    windows = [
        replace(
            batch,
            steps=batch.steps[[w]],
            data=batch.data[[w]],
            inputs=batch.inputs[[w]],
            trajectory=batch.trajectory[[w]],
            start=batch.start[[w]],
        )
        for w in range(len(batch.start))
    ]
    found = []
    for first in range(0, len(models), points_per_batch):
        chunk = models[first : first + points_per_batch]
        odes = [_scaled(model, batch, held(model)) for model in chunk]
        problem = _unobserved(
            [ode for ode in odes for _ in windows], windows * len(chunk), n_reweights=0
        )
        found.append(closed(problem, method.fit(problem)))
        advance(len(chunk))
    return np.concatenate(found).reshape(len(models), *batch.data.shape)


def _scaled(model: SparseModel, batch: WindowBatch, relations: Constraint) -> ODE:
    return ODE(model, scale=batch.scale, step_s=batch.step_s, constraint=relations)


def _unobserved(
    odes: Sequence[ODE], batches: Sequence[WindowBatch], *, n_reweights: int
) -> Problem:
    """With free starts, and nobody watching."""
    return Problem(
        odes=tuple(odes),
        batches=tuple(batches),
        free_start=True,
        n_reweights=n_reweights,
        observe=lambda iteration: None,
    )
