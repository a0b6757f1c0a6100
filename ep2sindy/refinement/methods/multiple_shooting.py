"""Multiple shooting by condensed Gauss-Newton: one node per sample, all steps at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from ep2sindy.refinement.kernels import condense, propagate, starts
from ep2sindy.refinement.ode import ONE_RUNGE_KUTTA, Drive, Step
from ep2sindy.refinement.problem import (
    Iteration,
    LawMap,
    RefinementFit,
    RefinementProblem,
    residual_weights,
)

# Directions of the scalings weaker than this share of the strongest are dropped.
RANK = 1e-12


@dataclass(frozen=True)
class MultipleShooting:
    """Gauss-Newton on nodes and scalings together, in stages with growing blocks.

    Each iteration integrates every step of every window in one call, with tangents, and solves
    for the scalings, with each block's start eliminated by QR. A stage cuts the windows into
    blocks with their own starts: `first_block` samples, then `growth` times as many, up to
    the whole window. A stage that fails leaves the scalings unchanged.
    Each point has its own step length and leaves once it has converged. Points tied by a law
    move together: the point with the shortest allowed step sets the step of all. They have
    converged when every point has, and failed when any point has.
    limit: largest change of a scaling per iteration, relative to the scaling or to one, whichever
    is larger. tolerance: convergence requires the relative change of every scaling, and the
    defects, to be below it.
    Source: Bock 1983, doi:10.1007/978-1-4684-7324-7_7.
    """

    step: Step = ONE_RUNGE_KUTTA
    first_block: int = 5
    growth: float = 5.0
    tolerance: float = 1e-7
    max_iter: int = 50
    limit: float = 0.5

    def fit(self, problem: RefinementProblem) -> RefinementFit:
        n_points, law = len(problem.data), problem.law
        state = RefinementFit(
            scaling=np.ones((n_points, problem.n_free)) if law is None else law.scaling(law.start),
            nodes=problem.data.copy(),
            weights=np.ones((n_points, problem.data.shape[-1])),
            finished=np.zeros(n_points, dtype=np.bool_),
            finite=np.ones(n_points, dtype=np.bool_),
            step=self.step,
            theta=None if law is None else law.start,
        )
        window = problem.data.shape[2]
        for block in self.blocks(window):
            tried = self._stage(problem, state, block, tolerance=0.3, max_iter=10)
            state = _keep_finite(state, tried, problem.data)
        for _ in range(problem.n_reweights):
            tried = self._stage(problem, state, window, tolerance=1e-2, max_iter=self.max_iter)
            state = _keep_finite(state, tried, problem.data)
            state = replace(state, weights=residual_weights(state.nodes, problem.data))
        return self._stage(problem, state, window, tolerance=self.tolerance, max_iter=self.max_iter)

    def finer(
        self, problem: RefinementProblem, fit: RefinementFit, points: np.ndarray
    ) -> RefinementFit | None:
        """Continue some points of a fit from their present state, with half the time step."""
        step = fit.step.halved()
        if step is None:
            return None
        finished = np.ones_like(fit.finished)
        finished[points] = False
        again = replace(fit, step=step, finished=finished)
        return self._stage(
            problem,
            again,
            problem.data.shape[2],
            tolerance=self.tolerance,
            max_iter=self.max_iter,
        )

    def blocks(self, window: int) -> list[int]:
        """Block lengths, in samples, of the stages before the whole window."""
        blocks, size = [], float(self.first_block)
        while size < window:
            blocks.append(round(size))
            size *= self.growth
        return blocks

    def _stage(
        self,
        problem: RefinementProblem,
        state: RefinementFit,
        block: int,
        *,
        tolerance: float,
        max_iter: int,
    ) -> RefinementFit:
        """Iterate with one block length; points leave once they have converged or failed."""
        for _ in range(max_iter):
            active = np.flatnonzero(~state.finished & state.finite)
            if not active.size:
                break
            state = self._iterate(problem, state, active, block, tolerance)
        return state

    def _iterate(
        self,
        problem: RefinementProblem,
        state: RefinementFit,
        active: np.ndarray,
        block: int,
        tolerance: float,
    ) -> RefinementFit:
        """One Gauss-Newton step of the active points; points that fail stay unchanged."""
        theta, scaling, nodes = state.theta, state.scaling.copy(), state.nodes.copy()
        finished, finite = state.finished.copy(), state.finite.copy()
        maps = step_maps(problem, state.step, scaling, nodes, active)
        unknowns, change, moved = newton_step(problem, state, maps, active, block)
        sound = np.isfinite(change).all(axis=1) & np.isfinite(moved).all(axis=(1, 2, 3))
        sound = problem.agree(sound, np.all)
        if not sound.all():
            finite[active[~sound]] = False
            active, maps = active[sound], maps[sound]
            change, moved = change[sound], moved[sound]
            if not active.size:
                return replace(state, finite=finite)
        defect = largest_defect(maps, nodes[active], block)
        share = step_share(change, moved, scaling[active], problem.data[active], limit=self.limit)
        share = problem.agree(share, np.min)
        if problem.law is None:
            scaling[active] += share[:, None] * change
        else:
            theta = theta + share[0] * unknowns
            scaling = problem.law.scaling(theta)
        nodes[active] += share[:, None, None, None] * moved
        size = np.maximum(np.abs(scaling[active]), 1e-3)
        relative = np.abs(change / size).max(axis=1, initial=0.0)
        done = (share == 1.0) & (relative < tolerance) & (defect < tolerance)
        finished[active] = problem.agree(done, np.all)
        tell(problem, block, scaling, nodes, active, relative=relative, defect=defect)
        return replace(
            state, theta=theta, scaling=scaling, nodes=nodes, finished=finished, finite=finite
        )


def _keep_finite(before: RefinementFit, after: RefinementFit, data: np.ndarray) -> RefinementFit:
    """Result of a stage; points that did not stay finite get back their initial scalings."""
    lost = ~after.finite
    scaling, nodes = after.scaling.copy(), after.nodes.copy()
    scaling[lost], nodes[lost] = before.scaling[lost], data[lost]
    return replace(
        after,
        theta=before.theta if lost.any() else after.theta,
        scaling=scaling,
        nodes=nodes,
        finite=before.finite,
        finished=before.finished,
    )


def tell(
    problem: RefinementProblem,
    block: int,
    scaling: np.ndarray,
    nodes: np.ndarray,
    points: np.ndarray,
    *,
    relative: np.ndarray,
    defect: np.ndarray,
) -> None:
    """Report an iteration to the observer, point by point."""
    for i, point in enumerate(points):
        problem.observe(
            Iteration(
                point=int(point),
                block=block,
                loss=float(np.square(nodes[point] - problem.data[point]).mean()),
                scaling=scaling[point, : len(problem.odes[point].free0)].copy(),
                step=float(relative[i]),
                defect=float(defect[i]),
            )
        )


def step_maps(
    problem: RefinementProblem,
    step: Step,
    scaling: np.ndarray,
    nodes: np.ndarray,
    points: np.ndarray,
) -> np.ndarray:
    """One-step maps of the given points."""
    system, drive = problem.system, problem.one_step
    if len(points) < len(nodes):
        index = torch.tensor(points, device=problem.device)
        system = system.take(index)
        drive = Drive(drive.steps[:, index], drive.inputs[:, :, index])
    return step.maps(system, drive, scaling[points], nodes[points])


def newton_step(
    problem: RefinementProblem,
    state: RefinementFit,
    maps: np.ndarray,
    active: np.ndarray,
    block: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Change of the unknowns, of the scalings (points, free) and of the nodes, by least squares.

    The unknowns are theta if a law ties the points, otherwise the scalings.
    NaN at points whose tangents overflow.
    """
    nodes, data, n_start = state.nodes[active], problem.data[active], problem.n_start
    condensed = condense(maps, nodes, data, state.weights[active], block, n_start)
    unknowns = least_change(condensed[..., n_start:, n_start:], problem.law)
    change = unknowns if problem.law is None else problem.law.scaling(unknowns)
    if problem.free_start:
        first = starts(condensed, change, n_start)
    else:
        first = data[:, :, ::block] - nodes[:, :, ::block]
    return unknowns, change, propagate(maps, nodes, np.ascontiguousarray(first), change, block)


def least_change(triangles: np.ndarray, law: LawMap | None = None) -> np.ndarray:
    """Change of the unknowns that minimises the condensed residuals of all blocks, or NaN.

    triangles: (points, windows, blocks, size, size), by scaling. Without a law the unknowns are
    the scalings, (points, free), and each point is solved separately. With a law they are theta,
    common to all points: H = sum_p spread_p^T R_p^T R_p spread_p, by QR of each R_p, then of all.
    """
    size = triangles.shape[-1]
    rows = triangles[..., :-1, :].reshape(len(triangles), -1, size)
    if law is None:
        return least_squares(rows)
    if not np.isfinite(rows).all():
        return np.full(law.n_theta, np.nan)
    joined: np.ndarray = np.linalg.qr(rows, mode="r")  # type: ignore[assignment]
    return least_squares(law.rows(joined[:, None]).reshape(1, -1, law.n_theta + 1))[0]


def least_squares(rows: np.ndarray) -> np.ndarray:
    """Minimisers of |A x + b|, (problems, unknowns), for rows [A | b], or NaN.

    The solution has the least norm if the rows do not determine a direction.
    """
    size = rows.shape[-1]
    joined: np.ndarray = np.linalg.qr(rows, mode="r")  # type: ignore[assignment]
    lost = ~np.isfinite(joined).all(axis=(1, 2))
    joined = np.where(lost[:, None, None], 0.0, joined)
    u, strength, vt = np.linalg.svd(joined[:, : size - 1, : size - 1])
    inverse = np.where(strength > RANK * strength[:, :1], 1.0, 0.0) / np.maximum(strength, 1e-300)
    seen = inverse * (u.transpose(0, 2, 1) @ joined[:, : size - 1, size - 1 :])[..., 0]
    change = -(vt.transpose(0, 2, 1) @ seen[..., None])[..., 0]
    return np.where(lost[:, None], np.nan, change)


def largest_defect(maps: np.ndarray, nodes: np.ndarray, block: int) -> np.ndarray:
    """Largest gap, inside any block, between the end of a step and the next node, (points,)."""
    gaps = np.abs(maps[:, :, 0] - nodes[:, :, 1:].transpose(0, 3, 1, 2))
    inside = np.arange(1, nodes.shape[2]) % block != 0
    return gaps[..., inside].max(axis=(1, 2, 3))


def step_share(
    change: np.ndarray,
    moved: np.ndarray,
    scaling: np.ndarray,
    data: np.ndarray,
    *,
    limit: float,
) -> np.ndarray:
    """Largest allowed fraction of a step, (points,).

    It changes no scaling by more than `limit` times the larger of the scaling and one, and no
    node by more than the range of the data.
    """
    by_scaling = np.abs(change) / (limit * np.maximum(np.abs(scaling), 1.0))
    reach = np.ptp(data, axis=(1, 2))
    by_node = np.abs(moved).max(axis=(1, 2)) / reach
    largest = np.maximum(by_scaling.max(axis=1, initial=0.0), by_node.max(axis=1))
    return 1.0 / np.maximum(1.0, largest)
