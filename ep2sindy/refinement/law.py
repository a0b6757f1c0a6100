"""Joint refinement of all operating points, whose coefficients follow one law."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.judge import RefinementStatus, RefinementVerdict, fit_and_judge
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.ode import unconstrained
from ep2sindy.refinement.problem import (
    Iteration,
    LawMap,
    RefinementFit,
    RefinementProblem,
    RefinementSettings,
    record,
)
from ep2sindy.refinement.refine import resolve_constraints, with_coef
from ep2sindy.refinement.windows import WindowBatch
from ep2sindy.regression.pooled import Basis, pool_coefficients
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.threads import one_thread

# Default settings; states are weighted by their standard deviation at every point.
SETTINGS = RefinementSettings(n_windows=20, n_reweights=0)


@dataclass(frozen=True, eq=False)
class LawRefinement:
    """A law fitted to the trajectories of all points, with its uncertainty.

    The law W minimises the sum over the points p and their windows w of |(x_w(t) - data) / std_p|^2
    with x_w(t) integrated from a start that is fitted too, under c_p = C W f(p) + d_p: a constraint
    whose matrix depends on the point, through its basis f(p). In separate refinements some
    directions of the coefficients are poorly determined; here a point influences the law only in
    the directions that its data determine.
    coefficients: (state, term) of each free coefficient. law: the coefficients at a point are
    law @ basis at this point, in SI.
    covariance: covariance of law.ravel(), a sandwich with the windows of all points as clusters.
    It states how far other windows would change the law, not how far a law of this form is from
    the truth. covariance_naive: the same for white, independent residuals. Both are None if the
    fit is not finite.
    models: by point, with the covariance that follows from the law. loss: by point, mean square
    of (trajectory - data) / std, integrated again from the fitted starts.
    status: converged; max_iter; coarse_step; unidentifiable: the interval of a coefficient
    reaches zero at every point; flat: no better than constants; non_finite: the start is returned.
    """

    coefficients: tuple[tuple[str, str], ...]
    law: Float[np.ndarray, "free terms"]
    covariance: Float[np.ndarray, "_ _"] | None
    covariance_naive: Float[np.ndarray, "_ _"] | None
    models: tuple[SparseModel, ...]
    loss: Float[np.ndarray, " points"]
    status: RefinementStatus
    history: tuple[Iteration, ...]


@one_thread()
def refine_law(
    models: Sequence[SparseModel],
    trajectories: Sequence[Sequence[Trajectory]],
    basis: Float[np.ndarray, "points terms"],
    settings: RefinementSettings = SETTINGS,
    *,
    constraints: Sequence[Constraint] | None = None,
    start: Float[np.ndarray, "free terms"] | None = None,
    seed: int | np.random.Generator = 0,
    callback: Callable[[Iteration], None] | None = None,
    progress: Progress | bool = False,
) -> LawRefinement:
    """Fit one law to windows of all points, by least squares: z_p = law @ basis[p].

    See `LawRefinement` for the objective. Assumes white noise of the states, and a law that holds.
    models: one per point, all with the same terms, refined or discovered; they set the scales of
    the coefficients. settings: as for `refine`, with MultipleShooting only; n_windows is the number
    at every point. constraints: one per point, of the same relations, in which known coefficients
    have the point's own values; None takes that of the settings for all. start: initial law; None
    takes one through the coefficients of the models.
    Raises ValueError for models with different terms, constraints with different ones, a basis
    whose terms the points cannot tell apart, a window that fits no trajectory, or points with
    different numbers of windows.
    Source: Bock 1983, doi:10.1007/978-1-4684-7324-7_7, for multiple shooting.

    >>> systems = [ep.lotka_volterra(a=a) for a in (0.5, 0.7, 0.9)]
    >>> runs = [[system.trajectory(noise=0.01, rng=0)] for system in systems]
    >>> basis = np.array([[1.0, 0.5], [1.0, 0.7], [1.0, 0.9]])  # 1 and a
    >>> law = ep.refinement.refine_law([s.model for s in systems], runs, basis).law
    """
    known = Basis(basis)
    _check_structure(models, len(basis), len(trajectories))
    own = resolve_constraints(settings, models, constraints)
    relations = [each or unconstrained(models[0]) for each in own]
    method = MultipleShooting() if settings.method is None else settings.method
    if not isinstance(method, MultipleShooting):
        raise ValueError(f"a law is refined by MultipleShooting alone: {method} came")
    batches = settings.cut(models, trajectories, np.random.default_rng(seed))
    _check_alike(relations, batches)
    with as_progress(progress).stage(None, "iteration", "refinement of a law") as advance:
        history, observe = record(callback, advance)
        problem = RefinementProblem.of(
            models, batches, relations, observe=observe,
            free_start=settings.free_start, n_reweights=settings.n_reweights,
        )  # fmt: skip
        free0 = np.stack([each.free0 for each in problem.equations])
        begin = pool_coefficients(free0, None, known) if start is None else start
        law = LawMap.of(free0, known, begin)
        fit, (verdict,) = fit_and_judge(replace(problem, law=law), method)
    return _result(models, relations, law, fit, verdict, known, tuple(history))


def _check_structure(models: Sequence[SparseModel], n_basis: int, n_runs: int) -> None:
    if not len(models) == n_basis == n_runs or not models:
        raise ValueError(
            "models, trajectories and rows of the basis must be one per point: "
            f"{len(models)}, {n_runs} and {n_basis} came"
        )
    structures = {
        (m.states, m.inputs, tuple((s, t) for s in m.states for t in m.terms(s))) for m in models
    }
    if len(structures) > 1:
        raise ValueError(
            f"models that share a law must have the same terms: {len(structures)} structures came"
        )


def _check_alike(relations: Sequence[Constraint], batches: Sequence[WindowBatch]) -> None:
    """Relations must differ in the values of known coefficients alone, points in no numbers."""
    first = relations[0]
    if not all(
        own.coefficients == first.coefficients and np.array_equal(own.C, first.C)
        for own in relations
    ):
        raise ValueError(
            "the constraints of a law's points must be alike but for the values of known "
            "coefficients: those that came are not alike"
        )
    if len(counts := {len(batch.start) for batch in batches}) > 1:
        raise ValueError(
            f"all points must hold as many windows: {sorted(counts)} came; shorten the window or "
            "ask for fewer"
        )


def _result(
    models: Sequence[SparseModel],
    relations: Sequence[Constraint],
    law_map: LawMap,
    fit: RefinementFit,
    verdict: RefinementVerdict,
    basis: Basis,
    history: tuple[Iteration, ...],
) -> LawRefinement:
    """Result in SI and in the given basis; holds the start if the fit is not finite."""
    n_free, finite = law_map.n_free, verdict.status is not RefinementStatus.NON_FINITE
    assert fit.theta is not None
    theta = fit.theta if finite else law_map.start
    law = (law_map.to_law @ theta).reshape(n_free, -1)
    robust, naive = (
        law_map.to_law @ covariance @ law_map.to_law.T if finite else None
        for covariance in (verdict.covariance, verdict.covariance_naive)
    )
    refined = []
    for model, own, row in zip(models, relations, basis.values, strict=True):
        at_point, order = with_coef(model, own, own.coef(law @ row))
        if robust is not None:
            spread = (own.C @ np.kron(np.eye(n_free), row))[order]
            at_point = replace(at_point, covariance=spread @ robust @ spread.T)
        refined.append(at_point)
    loss = verdict.window_loss.reshape(len(models), -1).mean(axis=1)
    return LawRefinement(
        coefficients=tuple(relations[0].coefficients[int(k)] for k in relations[0].free),
        law=law,
        covariance=robust,
        covariance_naive=naive,
        models=tuple(refined),
        loss=loss if finite else np.full(len(models), np.inf),
        status=verdict.status,
        history=history,
    )
