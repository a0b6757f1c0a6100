"""Multiple shooting by condensed Gauss-Newton: one node per sample, all steps at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from ep2sindy.refinement.kernels import condense, propagate, starts
from ep2sindy.refinement.problem import (
    Iteration,
    RefinementFit,
    RefinementProblem,
    ignore,
    residual_weights,
)
from ep2sindy.refinement.steps import ONE_RUNGE_KUTTA, Step, halved

# Directions of the scalings weaker than this fraction of the strongest are dropped.
RANK = 1e-12

OVERFLOWING = 1e150  # tangents of this size overflow when they are squared

# A stage with a pull has done its work once gaps, in std, and relative changes are below this.
ROUGH = 0.3

# A stage that fails is reached in two, unless its memory is less than this times the last one's.
CLOSEST = 1.2

# Damping after the first step without gain, the factors after further ones and after a gain, the
# damping that counts as none, and the one that counts as stuck.
FIRST_DAMPING, MORE, LESS, NONE, STUCK = 1e-3, 10.0, 0.125, 1e-6, 1e6

SLACK, ROUNDING = 1e-9, 1e-12  # increase by rounding, of the sum and of every residual

JOINING_STEPS = 20  # most steps that close the gaps with the scalings held

JOINED = 1e-10  # largest gap, in std, that need not be closed further

# Gaps below this fraction of the residuals do not stop a step that gains: they open where
# trajectories curve, and the next step closes them.
FINE = 1e-3


@dataclass(frozen=True)
class MultipleShooting:
    """Damped Gauss-Newton on nodes and scalings together, in stages of growing memory.

    Each iteration integrates every step of every window in one call, with tangents, and solves for
    the scalings, with each window's start eliminated by QR. In a stage, every step ends at (1 -
    1/memory) times its own end plus 1/memory times the data, so that what happened more than
    `memory` samples ago is forgotten, and no trajectory diverges. The last stages follow the model
    only. If a stage does not close the gaps between steps, it is tried again by way of the
    geometric mean of its memory and the last one's. A step must lower the sum of squared residuals
    plus a penalty times the gaps; if it does not, it is undone and the next one is damped
    (Levenberg-Marquardt), in units of what each scaling does to the trajectories. So no iteration
    leaves the finite numbers. Each point has its own steps and leaves once it has converged.

    Parameters
    ----------
    step : Step, default ONE_RUNGE_KUTTA
        How one step from sample to sample is integrated: `RungeKutta` or `FusedRungeKutta`.
    first_memory : int, default 5
        Memory of the first stage, in samples.
    growth : float, default 5.0
        Factor by which the memory grows from stage to stage, up to the window's length.
    tolerance : float, default 1e-07
        Convergence requires the relative change of every scaling, and the gaps, to be below it.
    max_iter : int, default 50
        Most iterations.

    Notes
    -----
    Over the scalings s and a node x_k at every sample of every window,

        minimise sum_k |W (x_k - data_k)|^2   subject to   x_(k+1) = F_k(x_k, s)

    where F_k integrates the equations over one step, states are in units of their standard
    deviation, and W weights them. Assumes residuals of constant variance in each state.

    Source: Bock 1983, doi:10.1007/978-1-4684-7324-7_7; Abarbanel et al. 2009,
    doi:10.1137/090749761, for the attraction to the data.

    Examples
    --------
    >>> system = ep.lotka_volterra()
    >>> method = ep.refinement.MultipleShooting(tolerance=1e-9)
    >>> refined = ep.refine(system.model, system.trajectory(noise=0.02, rng=0), method=method)
    >>> str(refined.status)
    'converged'
    """

    step: Step = ONE_RUNGE_KUTTA
    first_memory: int = 5
    growth: float = 5.0
    tolerance: float = 1e-7
    max_iter: int = 50

    def fit(self, problem: RefinementProblem) -> RefinementFit:
        n_points = len(problem.data)
        start = RefinementFit(
            scaling=np.ones((n_points, problem.n_free)),
            nodes=problem.data,
            weights=np.ones((n_points, problem.data.shape[-1])),
            finished=np.zeros(n_points, dtype=np.bool_),
            finite=np.ones(n_points, dtype=np.bool_),
            step=self.step,
        )
        iterate, points = _Path(problem, start), np.arange(n_points)
        for memory in self.memories(iterate.window):
            iterate.remember(memory, points)
        for _ in range(problem.n_reweights):
            iterate.stage(iterate.window, points, tolerance=1e-2, max_iter=self.max_iter)
            iterate.weights = residual_weights(iterate.nodes, problem.data)
        return self._finish(iterate, points)

    def finer(
        self, problem: RefinementProblem, fit: RefinementFit, points: np.ndarray
    ) -> RefinementFit | None:
        """Continue some points of a fit from their present state, with half the time step."""
        step = halved(fit.step)
        if step is None:
            return None
        return self._finish(_Path(problem, replace(fit, step=step)), points)

    def memories(self, window: int) -> list[int]:
        """Memories, in samples, of the stages before those without a pull."""
        memories, size = [], float(self.first_memory)
        while size < window:
            memories.append(round(size))
            size *= self.growth
        return [*memories, window] if memories else []

    def _finish(self, iterate: _Path, points: np.ndarray) -> RefinementFit:
        iterate.stage(iterate.window, points, tolerance=self.tolerance, max_iter=self.max_iter)
        iterate.join(points)
        iterate.note_memory(iterate.window, points)
        return iterate.result()


class _Path:
    """A fit on its way, whose arrays change in place, with the one-step maps at its nodes.

    memory: (points,), the longest one of a stage that left no gaps, at least one sample. damping:
    (points,), zero for whole Gauss-Newton steps. penalty: (points,), of the gaps between steps, in
    the sum that an iteration must lower.
    """

    def __init__(self, problem: RefinementProblem, start: RefinementFit) -> None:
        points = np.arange(len(start.nodes))
        self.problem, self.step, self.window = problem, start.step, problem.data.shape[2]
        self.scaling, self.nodes = start.scaling.copy(), start.nodes.copy()
        self.weights, self.finished = start.weights, start.finished.copy()
        self.memory = np.ones_like(points) if start.memory is None else start.memory.copy()
        self.damping, self.penalty = np.zeros((2, len(points)))
        self.maps = step_maps(problem, start.step, self.scaling, self.nodes, points)
        self.finite = start.finite & np.isfinite(self.maps).all(axis=(1, 2, 3, 4))

    def result(self) -> RefinementFit:
        """The fit as it stands; with its maps, unless the scalings were held at last."""
        is_whole = self.maps.shape[-1] == self.problem.ode.n_columns
        return RefinementFit(
            scaling=self.scaling,
            nodes=self.nodes,
            weights=self.weights,
            finished=self.finished,
            finite=self.finite,
            step=self.step,
            memory=self.memory,
            maps=self.maps if is_whole else None,
        )

    def remember(self, memory: int, points: np.ndarray) -> None:
        """A stage with this memory, by way of others at points where it leaves gaps."""
        before = [each.copy() for each in self._by_point()]
        self.stage(memory, points, tolerance=ROUGH, max_iter=10)
        self.note_memory(memory, points)
        reached = self.memory[points]
        for last in np.unique(reached[reached != memory]):
            torn = points[reached == last]
            middle = round(float(np.sqrt(last * memory)))
            if self.finite[torn].any() and memory > CLOSEST * middle > CLOSEST * last:
                for own, former in zip(self._by_point(), before, strict=True):
                    own[torn] = former[torn]
                self.remember(middle, torn)
                arrived = torn[self.memory[torn] == middle]
                if arrived.size:
                    self.remember(memory, arrived)

    def _by_point(self) -> tuple[np.ndarray, ...]:
        return self.scaling, self.nodes, self.maps, self.penalty

    def note_memory(self, memory: int, points: np.ndarray) -> None:
        """Note this memory at the points that it leaves without gaps."""
        ends = self.pull(self._maps_of(points), points, memory)
        closed = (gap_sizes(ends, self.nodes[points])[1] < ROUGH) & self.finite[points]
        self.memory[points[closed]] = memory

    def stage(self, memory: int, points: np.ndarray, *, tolerance: float, max_iter: int) -> None:
        """Iterate with one memory; points leave once they have converged or are stuck."""
        self.finished[points], self.damping[points] = False, 0.0
        for _ in range(max_iter):
            going = ~self.finished[points] & self.finite[points] & (self.damping[points] < STUCK)
            if not going.any():
                break
            self.iterate(points[going], memory, tolerance)

    def join(self, points: np.ndarray) -> None:
        """Close the gaps that are left, by the nodes alone; where it fails, all stays as it was."""
        self.damping[:] = 0.0
        n, width = self.maps.shape[-2:]
        for _ in range(JOINING_STEPS):
            _, defect = gap_sizes(self._maps_of(points), self.nodes[points])
            is_open = self.finite[points] & ~self.finished[points] & (defect > JOINED)
            if not is_open.any():
                break
            if self.maps.shape[-1] == width:  # derivatives by the scalings are not needed any more
                self.maps = np.concatenate([self.maps[..., :n], self.maps[..., -1:]], axis=-1)
            self.iterate(points[is_open], self.window, 0.0, hold=True)

    def iterate(
        self, active: np.ndarray, memory: int, tolerance: float, *, hold: bool = False
    ) -> None:
        """One damped step of the active points; where it gains nothing, more damping instead.

        hold: leave the scalings as they are, by which the maps then hold no derivatives.
        """
        problem, damping = self.problem, self.damping[active]
        maps = self.pull(self._maps_of(active), active, memory)
        scaling, nodes = self.scaling[active], self.nodes[active]
        change, moved = self._newton_step(maps, active, None if hold else damping)
        fraction = step_fraction(moved, problem.ranges[active]) / (1.0 + damping)
        fraction = np.nan_to_num(fraction)
        change = fraction[:, None] * change
        self.scaling[active] += change
        with np.errstate(invalid="ignore"):  # a step without bounds is undone
            self.nodes[active] += fraction[:, None, None, None] * moved
        raw = step_maps(problem, self.step, self.scaling, self.nodes, active, by_scaling=not hold)
        ahead = self.pull(raw, active, memory)
        size, defect = gap_sizes(maps, nodes)
        size_ahead, defect_ahead = gap_sizes(ahead, self.nodes[active])
        better = (
            size_ahead < size if hold else self._is_better(active, nodes, moved, size, size_ahead)
        )
        self.scaling[active[~better]], self.nodes[active[~better]] = (
            scaling[~better],
            nodes[~better],
        )
        size = np.maximum(np.abs(self.scaling[active]), 1e-3)
        relative = np.abs(change / size).max(axis=1, initial=0.0)
        defect = np.where(better, defect_ahead, defect)
        small = (relative < tolerance) & (defect < tolerance)
        self.finished[active] = better & (fraction == 1.0) & small
        self._tell(memory, active, relative, defect)
        if better.all() and len(active) == len(self.maps):
            self.maps = raw
        else:
            self.maps[active[better]] = raw[better]
        self.damping[active] = _next_damping(damping, better, hold=hold)

    def _newton_step(
        self, maps: np.ndarray, active: np.ndarray, damping: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Change of the scalings (points, free) and of the nodes.

        damping: by point; None holds the scalings and moves the nodes alone.
        NaN at points whose tangents overflow.
        """
        problem, n_start = self.problem, self.problem.n_start
        nodes, data = self.nodes[active], problem.data[active]
        condensed = condense(maps, nodes, data, self.weights[active], n_start)
        if damping is None:
            change = np.zeros_like(self.scaling[active])
        else:
            change = least_change(condensed[..., n_start:, n_start:], damping)
        if problem.free_start:
            first = starts(condensed, change, n_start)
        else:
            first = data[:, :, 0] - nodes[:, :, 0]
        return change, propagate(maps, nodes, first, change)

    def _is_better(
        self,
        active: np.ndarray,
        before: np.ndarray,
        moved: np.ndarray,
        size: np.ndarray,
        size_ahead: np.ndarray,
    ) -> np.ndarray:
        """Whether the nodes lower residuals and gaps, (points,), at the present penalty of gaps.

        size, size_ahead: norm of the gaps before and after. The penalty is never lowered, and at
        least twice what closing the gaps will cost.
        """
        problem = self.problem
        data, weights = problem.data[active], self.weights[active]
        with np.errstate(over="ignore", invalid="ignore"):
            loss, aim, loss_ahead = (
                squares(x, data, weights) for x in (before, before + moved, self.nodes[active])
            )
            cost = np.where(size > 0.0, 2.0 * (aim - loss) / np.maximum(size, JOINED), 0.0)
            penalty = np.maximum(self.penalty[active], np.where(np.isfinite(cost), cost, 0.0))
            self.penalty[active] = penalty
            slack = SLACK * loss + ROUNDING * np.sqrt(loss * data[0].size)
            gains = loss_ahead - loss - slack <= 0.0
            fine = size_ahead - FINE * np.sqrt(loss) <= 0.0
            better: np.ndarray = loss_ahead + penalty * size_ahead <= loss + penalty * size + slack
        return better | (gains & fine)

    def _maps_of(self, points: np.ndarray) -> np.ndarray:
        """Maps of some points, without a copy if these are all: they are large."""
        return self.maps if len(points) == len(self.maps) else self.maps[points]

    def pull(self, maps: np.ndarray, points: np.ndarray, memory: int) -> np.ndarray:
        """One-step maps of the points, with every step's end pulled towards the data."""
        if memory >= self.window:
            return maps
        maps = (1.0 - 1.0 / memory) * maps
        maps[..., -1] += self.problem.data[points][:, :, 1:] / memory
        return maps

    def _tell(
        self, memory: int, points: np.ndarray, relative: np.ndarray, defect: np.ndarray
    ) -> None:
        """Report an iteration to the observer, if there is one, point by point."""
        problem = self.problem
        if problem.observe is ignore:
            return
        for i, p in enumerate(points.tolist()):
            loss = float(np.square(self.nodes[p] - problem.data[p]).mean())
            scaling = self.scaling[p, : problem.equations[p].n_free].copy()
            step, gap = float(relative[i]), float(defect[i])
            problem.observe(Iteration(p, memory, loss, scaling, step, gap))


def _next_damping(damping: np.ndarray, better: np.ndarray, *, hold: bool) -> np.ndarray:
    """Less after a gain, more without; with the scalings held, only the step length counts."""
    eased = np.where(damping < NONE, 0.0, LESS * damping)
    return np.where(better, eased, np.maximum(MORE * damping, 1.0 if hold else FIRST_DAMPING))


def step_maps(
    problem: RefinementProblem,
    step: Step,
    scaling: np.ndarray,
    nodes: np.ndarray,
    points: np.ndarray,
    *,
    by_scaling: bool = True,
) -> np.ndarray:
    """One-step maps of the given points, with their derivatives by the scalings unless held."""
    ode, drive = problem.ode, problem.one_step
    if len(points) < len(nodes):
        index = torch.tensor(points, device=problem.device)
        ode, drive = ode.take(index), drive.take(index)
    ode.set(scaling[points], drive)
    return step.maps(ode, nodes[points], by_scaling=by_scaling)


def least_change(by_window: np.ndarray, damping: np.ndarray | None = None) -> np.ndarray:
    """Change of the scalings that minimises the condensed residuals of all windows, or NaN.

    by_window: triangles, (points, windows, size, size). Returns (points, free), of each point
    separately: the minimisers of |A x + b| for its rows [A | b], of least norm if the rows do not
    determine a direction.
    damping: by point; adds the squares of sqrt(damping) * x, in units of the columns' lengths.
    """
    size = by_window.shape[-1]
    rows = by_window[..., :-1, :].reshape(len(by_window), -1, size)
    lost: np.ndarray = ~(np.abs(rows) < OVERFLOWING).all(axis=(1, 2))
    rows = np.where(lost[:, None, None], 0.0, rows)
    if damping is not None and damping.any():
        length = np.sqrt(np.square(rows[..., :-1]).sum(axis=1))
        extra = np.zeros((len(rows), size - 1, size))
        each = np.arange(size - 1)
        extra[:, each, each] = np.sqrt(damping)[:, None] * length
        rows = np.concatenate([rows, extra], axis=1)
    u, strength, vt = np.linalg.svd(rows[..., :-1], full_matrices=False)
    inverse = np.where(strength > RANK * strength[:, :1], 1.0, 0.0) / np.maximum(strength, 1e-300)
    seen = inverse * (u.transpose(0, 2, 1) @ rows[..., -1:])[..., 0]
    change = -(vt.transpose(0, 2, 1) @ seen[..., None])[..., 0]
    return np.where(lost[:, None], np.nan, change)


def squares(nodes: np.ndarray, data: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sum of squares of weights (points, n) * (nodes - data), by point."""
    return np.square(weights[:, None, None] * (nodes - data)).sum(axis=(1, 2, 3))


def gap_sizes(maps: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Norm of the gaps between ends of steps and nodes, and the largest gap, (points,) each."""
    with np.errstate(over="ignore", invalid="ignore"):
        gaps = np.abs(maps[..., -1] - nodes[:, :, 1:])
        return np.sqrt(np.square(gaps).sum(axis=(1, 2, 3))), gaps.max(axis=(1, 2, 3))


def step_fraction(moved: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """Largest fraction of a step that moves no node by more than the data's range, (points,)."""
    by_node = (np.abs(moved).max(axis=(1, 2)) / ranges).max(axis=1)
    return 1.0 / np.maximum(1.0, by_node)
