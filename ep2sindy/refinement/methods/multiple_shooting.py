"""Multiple shooting: one node per sample, all steps at once, condensed Gauss-Newton."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ep2sindy.refinement.problem import Fit, Iteration, Problem, residual_weights
from ep2sindy.refinement.shots import largest_defect, newton_step, step_maps, step_share
from ep2sindy.refinement.steps import ONE_RUNGE_KUTTA, Step


@dataclass(frozen=True)
class MultipleShooting:
    """Gauss-Newton on nodes and scalings together, windows growing from stage to stage.

    Each iteration integrates every step of every window in one call, with tangents, and solves
    for the scalings with each block's start eliminated by QR. A stage cuts the windows into
    blocks with starts of their own: `first_block` samples, then `growth` times as many, up to
    the whole window. A stage that fails leaves the scalings as they were.
    limit: largest change of a scaling per iteration, relative to it or to one.
    Converged: the relative change of every scaling is below `tolerance`, the defects too.
    Source: Bock 1983, doi:10.1007/978-1-4684-7324-7_7.
    """

    step: Step = ONE_RUNGE_KUTTA
    first_block: int = 5
    growth: float = 5.0
    tolerance: float = 1e-7
    max_iter: int = 50
    limit: float = 0.5

    def fit(self, problem: Problem) -> Fit:
        n_points = len(problem.data)
        state = Fit(
            scaling=np.ones((n_points, problem.n_free)),
            nodes=problem.data.copy(),
            weights=np.ones((n_points, problem.data.shape[-1])),
            finished=np.zeros(n_points, dtype=np.bool_),
            finite=np.ones(n_points, dtype=np.bool_),
            step=self.step,
        )
        window = problem.data.shape[2]
        for block in self.blocks(window):
            tried = self._stage(problem, state, block, tolerance=0.3, max_iter=10)
            state = _kept(state, tried, problem.data)
        for _ in range(problem.n_reweights):
            tried = self._stage(problem, state, window, tolerance=1e-2, max_iter=self.max_iter)
            state = _kept(state, tried, problem.data)
            state = replace(state, weights=residual_weights(state.nodes, problem.data))
        return self._stage(problem, state, window, tolerance=self.tolerance, max_iter=self.max_iter)

    def finer(self, problem: Problem, fit: Fit, points: np.ndarray) -> Fit | None:
        """Some points of a fit again from where they are, with half the time step."""
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
        """Of the stages before the whole window, in samples."""
        blocks, size = [], float(self.first_block)
        while size < window:
            blocks.append(round(size))
            size *= self.growth
        return blocks

    def _stage(
        self, problem: Problem, state: Fit, block: int, *, tolerance: float, max_iter: int
    ) -> Fit:
        """Iterate at one block size; points leave once they have converged or failed."""
        scaling, nodes = state.scaling.copy(), state.nodes.copy()
        finished, finite = state.finished.copy(), state.finite.copy()
        for _ in range(max_iter):
            active = np.flatnonzero(~finished & finite)
            if not active.size:
                break
            maps = step_maps(problem, state.step, scaling, nodes, active)
            change, moved = newton_step(
                maps,
                nodes[active],
                problem.data[active],
                state.weights[active],
                block,
                free_start=problem.free_start,
            )
            sound = np.isfinite(change).all(axis=1) & np.isfinite(moved).all(axis=(1, 2, 3))
            if not sound.all():
                finite[active[~sound]] = False
                active, maps = active[sound], maps[sound]
                change, moved = change[sound], moved[sound]
                if not active.size:
                    break
            defect = largest_defect(maps, nodes[active], block)
            share = step_share(
                change, moved, scaling[active], problem.data[active], limit=self.limit
            )
            scaling[active] += share[:, None] * change
            nodes[active] += share[:, None, None, None] * moved
            size = np.maximum(np.abs(scaling[active]), 1e-3)
            relative = np.abs(change / size).max(axis=1, initial=0.0)
            finished[active] = (share == 1.0) & (relative < tolerance) & (defect < tolerance)
            for i, point in enumerate(active):
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
        return replace(state, scaling=scaling, nodes=nodes, finished=finished, finite=finite)


def _kept(before: Fit, after: Fit, data: np.ndarray) -> Fit:
    """What a stage gave where it stayed finite; elsewhere the scalings it began with."""
    lost = ~after.finite
    scaling, nodes = after.scaling.copy(), after.nodes.copy()
    scaling[lost], nodes[lost] = before.scaling[lost], data[lost]
    return replace(
        after, scaling=scaling, nodes=nodes, finite=before.finite, finished=before.finished
    )
