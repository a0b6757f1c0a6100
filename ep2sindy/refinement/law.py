"""One refinement of all operating points, whose coefficients are tied by a law."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.constraints.relations import Constraint
from ep2sindy.data.scales import zero_to_one
from ep2sindy.data.trajectory import Trajectory, read_only
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.judge import (
    FLAT,
    STATIONARY,
    WIDE,
    covariances,
    integrated,
    is_coarse,
    step_triangles,
)
from ep2sindy.refinement.kernels import condense, propagate, starts
from ep2sindy.refinement.methods.multiple_shooting import (
    MultipleShooting,
    largest_defect,
    least_squares,
    step_maps,
    step_share,
)
from ep2sindy.refinement.ode import ODE, unconstrained
from ep2sindy.refinement.problem import Fit, Iteration, Problem, recorder, residual_weights
from ep2sindy.refinement.refine import with_coef
from ep2sindy.refinement.weighted_law import Basis, weighted_law
from ep2sindy.refinement.windows import WindowBatch, cut_windows
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.threads import one_thread


@dataclass(frozen=True, eq=False)
class TiedRefinement:
    """A law fitted to the trajectories of all points, and how far to trust it.

    coefficients: (state, term) of each free one; law: coefficient at a point = law @ basis there,
    in SI. covariance: of law.ravel(), a sandwich with the windows of all points as clusters: how
    far other windows would move it, not how far a law of this form is from the truth;
    covariance_naive: for residuals that are white and independent. None where nothing finite came.
    models: by point, with the covariance that the law gives. loss: by point, mean square of
    (trajectory - data) / std, integrated again from the fitted starts.
    status: converged; max_iter; coarse_step; unidentifiable: the interval of a coefficient
    reaches zero at every point; flat: no better than constants; non_finite: the start comes back.
    """

    coefficients: tuple[tuple[str, str], ...]
    law: Float[np.ndarray, "free terms"]
    covariance: Float[np.ndarray, "_ _"] | None
    covariance_naive: Float[np.ndarray, "_ _"] | None
    models: tuple[SparseModel, ...]
    loss: Float[np.ndarray, " points"]
    status: str
    history: tuple[Iteration, ...]


@one_thread()
def refine_tied(
    models: Sequence[SparseModel],
    trajectories: Sequence[Sequence[Trajectory]],
    basis: Float[np.ndarray, "points terms"],
    *,
    window: int,
    n_windows: int = 20,
    start: Float[np.ndarray, "free terms"] | None = None,
    method: MultipleShooting | None = None,
    constraint: Constraint | None = None,
    free_start: bool = True,
    n_reweights: int = 0,
    rng: np.random.Generator | int,
    callback: Callable[[Iteration], None] | None = None,
    progress: Progress | bool = False,
) -> TiedRefinement:
    """Fit one law to windows of all points, by least squares: coef_p = law @ basis[p].

    One Gauss-Newton on the law, with every point's windows condensed as in `refine`; residuals
    count in each point's own standard deviations. Separate refinements are sloppy in some
    directions; here a point gives the law only what its data fix.
    models: one per point, of one structure, as they are refined or found; they size the
    coefficients. start: the law to start from; None takes one through the models' coefficients.
    window: samples in each. n_reweights: passes with each state of a point weighted by 1/std of
    its residuals. Raises ValueError for models of different structure, a basis that the points do
    not tell apart, a window that fits no trajectory, or records of unlike numbers of windows.
    """
    known = Basis(basis)
    relations = _one_structure(models, constraint, len(basis), len(trajectories))
    batches = _batches(models, trajectories, n_windows, window, np.random.default_rng(rng))
    odes = [
        ODE(model, scale=batch.scale, step_s=batch.step_s, constraint=relations)
        for model, batch in zip(models, batches, strict=True)
    ]
    free0 = np.stack([ode.free0.numpy() for ode in odes])
    tie = Tie.of(free0, known)
    begin = tie.theta(weighted_law(free0, None, basis) if start is None else start)
    method = MultipleShooting() if method is None else method
    with as_progress(progress).stage(None, "iteration", "refinement of a law") as advance:
        history, observe = recorder(callback, advance)
        problem = Problem(tuple(odes), tuple(batches), free_start, n_reweights, observe)
        state, verdict = _fitted(problem, tie, begin, method)
    return _result(models, relations, tie, state, verdict, known, tuple(history))


def _batches(
    models: Sequence[SparseModel],
    trajectories: Sequence[Sequence[Trajectory]],
    n_windows: int,
    window: int,
    rng: np.random.Generator,
) -> list[WindowBatch]:
    batches = [
        cut_windows(
            runs,
            states=model.states,
            inputs=model.inputs,
            n_windows=n_windows,
            window=window,
            rng=rng,
        )
        for model, runs in zip(models, trajectories, strict=True)
    ]
    if len(counts := {len(batch.start) for batch in batches}) > 1:
        raise ValueError(
            f"all points must hold as many windows: {sorted(counts)} came; shorten the window or "
            "ask for fewer"
        )
    return batches


def _fitted(
    problem: Problem, tie: Tie, begin: Float[np.ndarray, " theta"], method: MultipleShooting
) -> tuple[TiedState, _Verdict]:
    """With steps as short as they must be; where nothing finite came, theta as it began."""
    state = fit_tied(problem, tie, begin, method)
    verdict = _judged(problem, tie, state)
    while verdict.status == "coarse_step":
        again = finer_tied(problem, tie, state, method)
        if again is None:
            break
        state, verdict = again, _judged(problem, tie, again)
    if verdict.status == "non_finite":
        state = replace(state, theta=begin)
    return state, verdict


def _one_structure(
    models: Sequence[SparseModel], constraint: Constraint | None, n_basis: int, n_runs: int
) -> Constraint:
    """The relations that all models share."""
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
            f"models that a law ties must have the same terms: {len(structures)} structures came"
        )
    return unconstrained(models[0]) if constraint is None else constraint


@dataclass(frozen=True, eq=False)
class _Verdict:
    """A tied fit, judged; covariances are those of theta."""

    status: str
    loss: Float[np.ndarray, " points"]
    covariance: Float[np.ndarray, "theta theta"]
    covariance_naive: Float[np.ndarray, "theta theta"]


def _judged(problem: Problem, tie: Tie, state: TiedState) -> _Verdict:
    """From trajectories integrated again; a point that blows up makes all of it not finite."""
    n_theta = len(state.theta)
    nothing = np.full((n_theta, n_theta), np.nan)
    lost = _Verdict("non_finite", np.full(len(problem.data), np.inf), nothing, nothing)
    if not state.fit.finite.all():
        return lost
    fit, maps = integrated(problem, state.fit)
    if not fit.finite.all():
        return lost
    n_start = fit.nodes.shape[-1] if problem.free_start else 0
    window = fit.nodes.shape[2]
    condensed = condense(maps, fit.nodes, problem.data, fit.weights, window, n_start)
    triangles = condensed[..., n_start:, n_start:]
    if not np.isfinite(triangles).all():
        return lost
    rows = tie.rows(triangles[:, :, 0]).reshape(-1, triangles.shape[-1], n_theta + 1)
    with np.errstate(over="ignore", invalid="ignore"):
        residual = np.square(fit.nodes - problem.data)
    n_residuals = max(residual.size - n_start * len(rows) - n_theta, 1)
    robust, naive = covariances(rows, _as_one(problem.batches), n_residuals=n_residuals)
    verdict = _Verdict("converged", residual.mean(axis=(1, 2, 3)), robust, naive)
    bias = tie.scaling(tie.change(step_triangles(problem, fit, maps)))
    gain = np.square(rows[..., :-1] @ tie.change(triangles)).sum()
    stationary = gain < STATIONARY * max(np.square(rows[..., -1]).sum(), 1e-300)
    return replace(verdict, status=_status(problem, tie, state, verdict, bias, bool(stationary)))


def _status(
    problem: Problem,
    tie: Tie,
    state: TiedState,
    verdict: _Verdict,
    bias: np.ndarray,
    stationary: bool,
) -> str:
    """The gravest that applies."""
    if not np.isfinite(verdict.loss).all():
        return "non_finite"
    data = problem.data
    level = data.mean(axis=2, keepdims=True) if problem.free_start else data[:, :, :1]
    if verdict.loss.mean() > FLAT * np.square(data - level).mean():
        return "flat"
    of_scaling = tie.spread @ verdict.covariance @ tie.spread.transpose(0, 2, 1)
    scaling = tie.scaling(state.theta)
    error = np.sqrt(np.maximum(np.diagonal(of_scaling, axis1=1, axis2=2), 0.0))
    if (~(error < WIDE * np.abs(scaling))).all(axis=0).any():
        return "unidentifiable"
    if not (state.fit.finished.all() and stationary):
        return "max_iter"
    each = zip(bias, of_scaling, scaling, strict=True)
    return "coarse_step" if any(is_coarse(*point) for point in each) else "converged"


def _as_one(batches: Sequence[WindowBatch]) -> WindowBatch:
    """Windows of all points as if of one set: which ones overlap. The first's scale stands."""
    offset = np.cumsum([0, *(batch.trajectory.max() + 1 for batch in batches)])
    numbers = [b.trajectory + int(k) for b, k in zip(batches, offset[:-1], strict=True)]
    return replace(
        batches[0],
        steps=np.concatenate([batch.steps for batch in batches]),
        data=np.concatenate([batch.data for batch in batches]),
        inputs=np.concatenate([batch.inputs for batch in batches]),
        trajectory=np.concatenate(numbers),
        start=np.concatenate([batch.start for batch in batches]),
    )


def _result(
    models: Sequence[SparseModel],
    relations: Constraint,
    tie: Tie,
    state: TiedState,
    verdict: _Verdict,
    basis: Basis,
    history: tuple[Iteration, ...],
) -> TiedRefinement:
    """Back to SI, and to the basis that was given."""
    n_free, n_terms = tie.spread.shape[1], basis.values.shape[1]
    law = (tie.to_law @ state.theta).reshape(n_free, n_terms)
    finite = verdict.status != "non_finite"
    robust, naive = (
        tie.to_law @ each @ tie.to_law.T if finite else None
        for each in (verdict.covariance, verdict.covariance_naive)
    )
    refined = []
    for model, row in zip(models, basis.values, strict=True):
        at_point, order = with_coef(model, relations, relations.coef(law @ row))
        if robust is not None:
            spread = (relations.C @ np.kron(np.eye(n_free), row))[order]
            at_point = replace(at_point, covariance=spread @ robust @ spread.T)
        refined.append(at_point)
    free = [relations.coefficients[int(k)] for k in relations.free]
    return TiedRefinement(
        coefficients=tuple(free),
        law=law,
        covariance=robust,
        covariance_naive=naive,
        models=tuple(refined),
        loss=verdict.loss,
        status=verdict.status,
        history=history,
    )


@dataclass(frozen=True, eq=False)
class Tie:
    """Scalings of point p = spread[p] @ theta; the law in SI = to_law @ theta.

    theta: coefficient by coefficient, what multiplies an orthonormal basis, in units of the
    coefficient's RMS over the points. The law: the same order, what multiplies the basis given.
    """

    spread: Float[np.ndarray, "points free theta"]
    to_law: Float[np.ndarray, "theta theta"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "spread", read_only(self.spread))
        object.__setattr__(self, "to_law", read_only(self.to_law))

    @staticmethod
    def of(free0: Float[np.ndarray, "points free"], basis: Basis) -> Tie:
        """free0: values of the free coefficients that a scaling of one stands for, in SI."""
        n_points, n_free = free0.shape
        n_terms = basis.values.shape[1]
        size = zero_to_one(np.sqrt(np.square(free0).mean(axis=0)))
        spread = np.zeros((n_points, n_free, n_free, n_terms))
        each = np.arange(n_free)
        by_point = (size / free0)[..., None] * basis.orthonormal[:, None]
        spread[:, each, each] = by_point
        to_law = np.kron(np.diag(size), basis.back)
        return Tie(spread.reshape(n_points, n_free, -1), to_law)

    def scaling(self, theta: Float[np.ndarray, " theta"]) -> Float[np.ndarray, "points free"]:
        return self.spread @ theta

    def theta(self, law: Float[np.ndarray, "free terms"]) -> Float[np.ndarray, " theta"]:
        """Of a law in SI."""
        found: np.ndarray = np.linalg.solve(self.to_law, law.ravel())
        return found

    def rows(
        self, triangles: Float[np.ndarray, "points windows size size"]
    ) -> Float[np.ndarray, "points windows size columns"]:
        """Triangles of condensed residuals by scaling as rows by theta, right-hand side last."""
        by_theta = triangles[..., :-1] @ self.spread[:, None]
        return np.concatenate([by_theta, triangles[..., -1:]], axis=-1)

    def change(
        self, triangles: Float[np.ndarray, "points windows blocks size size"]
    ) -> Float[np.ndarray, " theta"]:
        """Theta that minimises the condensed residuals of all points, or NaN.

        H = sum_p spread_p^T R_p^T R_p spread_p, by QR of each R_p and then of all.
        """
        n_points, size = len(triangles), triangles.shape[-1]
        rows = triangles[..., :-1, :].reshape(n_points, -1, size)
        if not np.isfinite(rows).all():
            return np.full(self.spread.shape[-1], np.nan)
        joined: np.ndarray = np.linalg.qr(rows, mode="r")  # type: ignore[assignment]
        columns = self.spread.shape[-1] + 1
        return least_squares(self.rows(joined[:, None]).reshape(1, -1, columns))[0]


@dataclass(frozen=True, eq=False)
class TiedState:
    """Where a tied fit stands; the scalings of `fit` are those of theta."""

    theta: Float[np.ndarray, " theta"]
    fit: Fit


def fit_tied(
    problem: Problem, tie: Tie, theta: Float[np.ndarray, " theta"], method: MultipleShooting
) -> TiedState:
    """The stages of `MultipleShooting`, all points moving together.

    A step is as long as the point that bears least lets it be. A stage that fails leaves theta as
    it was.
    """
    n_points = len(problem.data)
    state = TiedState(
        theta,
        Fit(
            scaling=tie.scaling(theta),
            nodes=problem.data.copy(),
            weights=np.ones((n_points, problem.data.shape[-1])),
            finished=np.zeros(n_points, dtype=np.bool_),
            finite=np.ones(n_points, dtype=np.bool_),
            step=method.step,
        ),
    )
    window = problem.data.shape[2]
    for block in method.blocks(window):
        tried = _stage(problem, tie, state, method, block, tolerance=0.3, max_iter=10)
        state = _kept(state, tried, problem)
    for _ in range(problem.n_reweights):
        tried = _stage(problem, tie, state, method, window, tolerance=1e-2)
        state = _kept(state, tried, problem)
        weights = residual_weights(state.fit.nodes, problem.data)
        state = replace(state, fit=replace(state.fit, weights=weights))
    return _stage(problem, tie, state, method, window, tolerance=method.tolerance)


def finer_tied(
    problem: Problem, tie: Tie, state: TiedState, method: MultipleShooting
) -> TiedState | None:
    """Again from where it is with half the time step; None where there is no such step."""
    step = state.fit.step.halved()
    if step is None:
        return None
    again = replace(state.fit, step=step, finished=np.zeros_like(state.fit.finished))
    window = problem.data.shape[2]
    return _stage(
        problem, tie, replace(state, fit=again), method, window, tolerance=method.tolerance
    )


def _stage(
    problem: Problem,
    tie: Tie,
    state: TiedState,
    method: MultipleShooting,
    block: int,
    *,
    tolerance: float,
    max_iter: int | None = None,
) -> TiedState:
    """Iterate at one block size until all points have converged, or one has failed."""
    theta, fit = state.theta, state.fit
    nodes, points = fit.nodes, np.arange(len(fit.nodes))
    n_start = nodes.shape[-1] if problem.free_start else 0
    finished = finite = False
    for _ in range(max_iter or method.max_iter):
        scaling = tie.scaling(theta)
        maps = step_maps(problem, fit.step, scaling, nodes, points)
        condensed = condense(maps, nodes, problem.data, fit.weights, block, n_start)
        d_theta = tie.change(condensed[..., n_start:, n_start:])
        change = tie.scaling(d_theta)
        if problem.free_start:
            first = starts(condensed, change, n_start)
        else:
            first = problem.data[:, :, ::block] - nodes[:, :, ::block]
        moved = propagate(maps, nodes, np.ascontiguousarray(first), change, block)
        finite = bool(np.isfinite(change).all() and np.isfinite(moved).all())
        if not finite:
            break
        defect = largest_defect(maps, nodes, block)
        share = step_share(change, moved, scaling, problem.data, limit=method.limit).min()
        theta, nodes = theta + share * d_theta, nodes + share * moved
        scaling = tie.scaling(theta)
        relative = np.abs(change / np.maximum(np.abs(scaling), 1e-3)).max(axis=1, initial=0.0)
        _tell(problem, block, scaling, nodes, relative, defect)
        finished = bool(share == 1.0 and max(relative.max(), defect.max()) < tolerance)
        if finished:
            break
    return TiedState(
        theta,
        replace(
            fit,
            scaling=tie.scaling(theta),
            nodes=nodes,
            finished=np.full(len(points), finished),
            finite=np.full(len(points), finite),
        ),
    )


def _tell(
    problem: Problem,
    block: int,
    scaling: np.ndarray,
    nodes: np.ndarray,
    relative: np.ndarray,
    defect: np.ndarray,
) -> None:
    for p, row in enumerate(scaling):
        loss = float(np.square(nodes[p] - problem.data[p]).mean())
        problem.observe(
            Iteration(
                point=p,
                block=block,
                loss=loss,
                scaling=row.copy(),
                step=float(relative[p]),
                defect=float(defect[p]),
            )
        )


def _kept(before: TiedState, after: TiedState, problem: Problem) -> TiedState:
    """What a stage gave, or theta as it was and the data where the stage did not stay finite."""
    if after.fit.finite.all():
        return replace(after, fit=replace(after.fit, finished=before.fit.finished))
    return replace(before, fit=replace(before.fit, nodes=problem.data.copy()))
