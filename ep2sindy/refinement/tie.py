"""Gauss-Newton on a law: scalings of all points tied to a few unknowns, all windows at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.scales import zero_to_one
from ep2sindy.refinement.kernels import condense, propagate, starts
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.problem import Fit, Iteration, Problem, residual_weights
from ep2sindy.refinement.shots import largest_defect, least_squares, step_maps, step_share
from ep2sindy.refinement.weighted_law import Basis
from ep2sindy.runtime.arrays import read_only


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
