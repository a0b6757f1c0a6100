"""Multiple shooting by condensed Gauss-Newton: one node per sample, all steps at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from ep2sindy.refinement.kernels import (
    condense,
    gap_sizes,
    propagate,
    squares,
    starts,
    triangles,
)
from ep2sindy.refinement.problem import (
    Iteration,
    LawMap,
    RefinementFit,
    RefinementProblem,
    ignore,
    residual_weights,
)
from ep2sindy.refinement.steps import ONE_RUNGE_KUTTA, Step

# Directions of the scalings weaker than this share of the strongest are dropped.
RANK = 1e-12

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

# Gaps below this share of the residuals do not stop a step that gains: they open where
# trajectories curve, and the next step closes them.
FINE = 1e-3


@dataclass(frozen=True)
class MultipleShooting:
    """Damped Gauss-Newton on nodes and scalings together, in stages of growing memory.

    Over the scalings s and a node x_k at every sample of every window it minimises
        sum_k |W (x_k - data_k)|^2   subject to   x_(k+1) = F_k(x_k, s),
    where F_k integrates the equations over one step, states in units of their standard deviation
    and W weighs them. It assumes residuals of constant variance in each state.

    Each iteration integrates every step of every window in one call, with tangents, and solves
    for the scalings, with each window's start eliminated by QR. In a stage, every step ends at
    (1 - 1/memory) times its own end plus 1/memory times the data, so that what happened more than
    `memory` samples ago is forgotten, and no trajectory runs away. The memory is `first_memory`
    samples, then `growth` times as many, up to the window's length; the last stages have no pull.
    If a stage does not close the gaps between steps, it is tried again by way of the geometric
    mean of its memory and the last one's.
    A step must lower the sum of squared residuals plus a price times the gaps; if it does not, it
    is undone and the next one is damped (Levenberg-Marquardt), in units of what each scaling
    does to the trajectories. So no iteration leaves the finite numbers.
    Each point has its own steps and leaves once it has converged. Points that share a law
    move together: the point with the shortest allowed step sets the step of all. They have
    converged when every point has, and failed when any point has.
    tolerance: convergence requires the relative change of every scaling, and the gaps, to be
    below it.
    Source: Bock 1983, doi:10.1007/978-1-4684-7324-7_7; Abarbanel et al. 2009,
    doi:10.1137/090749761 for the pull.

    >>> system = ep.lotka_volterra()
    >>> method = ep.refinement.MultipleShooting(tolerance=1e-9)
    >>> refined = ep.refine(system.model, system.trajectory(noise=0.02, rng=0), method=method)
    """

    step: Step = ONE_RUNGE_KUTTA
    first_memory: int = 5
    growth: float = 5.0
    tolerance: float = 1e-7
    max_iter: int = 50

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
        walk, points = _Walk.of(problem, state), np.arange(n_points)
        for memory in self.memories(window):
            walk = walk.remember(memory, points)
        for _ in range(problem.n_reweights):
            walk = walk.stage(window, points, tolerance=1e-2, max_iter=self.max_iter).reweighted()
        return self._finish(walk, points)

    def finer(
        self, problem: RefinementProblem, fit: RefinementFit, points: np.ndarray
    ) -> RefinementFit | None:
        """Continue some points of a fit from their present state, with half the time step."""
        step = fit.step.halved()
        if step is None:
            return None
        found = self._finish(_Walk.of(problem, replace(fit, step=step)), points)
        finished = fit.finished.copy()
        finished[points] = found.finished[points]
        return replace(found, finished=finished)

    def memories(self, window: int) -> list[int]:
        """Memories, in samples, of the stages before those without a pull."""
        memories, size = [], float(self.first_memory)
        while size < window:
            memories.append(round(size))
            size *= self.growth
        return [*memories, window] if memories else []

    def _finish(self, walk: _Walk, points: np.ndarray) -> RefinementFit:
        window = walk.problem.data.shape[2]
        walk = walk.stage(window, points, tolerance=self.tolerance, max_iter=self.max_iter)
        walk = walk.join(points).marked(window, points)
        return replace(walk.state, maps=walk.maps if walk.by_scaling else None)


@dataclass(frozen=True, eq=False)
class _Walk:
    """State of a fit between two iterations, with the one-step maps at its nodes.

    damping: (points,), zero for whole Gauss-Newton steps. price: (points,), of the gaps between
    steps, in the sum that an iteration must lower. by_scaling: whether the maps hold derivatives by
    the scalings.
    """

    problem: RefinementProblem
    state: RefinementFit
    maps: np.ndarray
    damping: np.ndarray
    price: np.ndarray
    by_scaling: bool = True

    @staticmethod
    def of(problem: RefinementProblem, state: RefinementFit) -> _Walk:
        points = np.arange(len(state.nodes))
        maps = step_maps(problem, state.step, state.scaling, state.nodes, points)
        sound = problem.agree(np.isfinite(maps).all(axis=(1, 2, 3, 4)), np.all)
        zeros, state = np.zeros(len(points)), replace(state, finite=state.finite & sound)
        return _Walk(problem, state, maps, zeros, zeros)

    @property
    def window(self) -> int:
        return self.problem.data.shape[2]

    @property
    def memories(self) -> np.ndarray:
        """The longest memory of a stage that left no gaps, (points,), at least one sample."""
        memory = self.state.memory
        return np.ones(len(self.maps), dtype=np.int64) if memory is None else memory

    def reweighted(self) -> _Walk:
        """The same with each state weighted by its residuals."""
        weights = residual_weights(self.state.nodes, self.problem.data)
        return replace(self, state=replace(self.state, weights=weights))

    def remember(self, memory: int, points: np.ndarray) -> _Walk:
        """A stage with this memory, by way of others at points where it leaves gaps."""
        walk = self.stage(memory, points, tolerance=ROUGH, max_iter=10).marked(memory, points)
        reached = walk.memories
        closed = reached[points] == memory
        for last in np.unique(reached[points[~closed]]):
            torn = points[~closed][reached[points[~closed]] == last]
            middle = round(float(np.sqrt(last * memory)))
            if walk.state.finite[torn].any() and memory > CLOSEST * middle > CLOSEST * last:
                walk = walk.back(self, torn).remember(middle, torn)
                arrived = torn[walk.memories[torn] == middle]
                if arrived.size:
                    walk = walk.remember(memory, arrived)
        return walk

    def marked(self, memory: int, points: np.ndarray) -> _Walk:
        """The same with this memory noted at points that it leaves without gaps."""
        ends, nodes = self.pulled(self.maps[points], points, memory), self.state.nodes[points]
        closed = (gap_sizes(ends, nodes)[1] < ROUGH) & self.state.finite[points]
        reached = self.memories.copy()
        reached[points[self.problem.agree(closed, np.all)]] = memory
        return replace(self, state=replace(self.state, memory=reached))

    def back(self, before: _Walk, points: np.ndarray) -> _Walk:
        """The same with some points as they were before."""
        maps, price = self.maps.copy(), self.price.copy()
        scaling, nodes = self.state.scaling.copy(), self.state.nodes.copy()
        scaling[points], nodes[points] = before.state.scaling[points], before.state.nodes[points]
        maps[points], price[points] = before.maps[points], before.price[points]
        state = replace(self.state, scaling=scaling, nodes=nodes, theta=before.state.theta)
        return replace(self, state=state, maps=maps, price=price)

    def stage(self, memory: int, points: np.ndarray, *, tolerance: float, max_iter: int) -> _Walk:
        """Iterate with one memory; points leave once they have converged or are stuck."""
        finished, damping = self.state.finished.copy(), self.damping.copy()
        finished[points], damping[points] = False, 0.0
        walk = replace(self, state=replace(self.state, finished=finished), damping=damping)
        for _ in range(max_iter):
            state = walk.state
            going = ~state.finished[points] & state.finite[points] & (walk.damping[points] < STUCK)
            if not going.any():
                break
            walk = walk.iterate(points[going], memory, tolerance)
        return walk

    def join(self, points: np.ndarray) -> _Walk:
        """Close the gaps that are left, by the nodes alone; where it fails, all stays as it was."""
        walk = replace(self, damping=np.zeros_like(self.damping))
        for _ in range(JOINING_STEPS):
            _, defect = gap_sizes(_part(walk.maps, points), _part(walk.state.nodes, points))
            is_open = self.state.finite[points] & ~self.state.finished[points] & (defect > JOINED)
            is_open = self.problem.agree(is_open, np.any)
            if not is_open.any():
                break
            if walk.by_scaling:
                walk = walk.held()
            walk = walk.iterate(points[is_open], self.window, 0.0, hold=True)
        return walk

    def held(self) -> _Walk:
        """The same with the scalings held, and without derivatives by them."""
        n = self.maps.shape[-2]
        maps = np.concatenate([self.maps[..., :n], self.maps[..., -1:]], axis=-1)
        return replace(self, maps=maps, by_scaling=False)

    def iterate(
        self, active: np.ndarray, memory: int, tolerance: float, *, hold: bool = False
    ) -> _Walk:
        """One damped step of the active points; where it gains nothing, more damping instead.

        hold: leave the scalings as they are, in a walk that holds them.
        """
        problem, state, damping = self.problem, self.state, self.damping[active]
        maps = self.pulled(_part(self.maps, active), active, memory)
        unknowns, change, moved = newton_step(
            problem, state, maps, active, None if hold else damping
        )
        share = step_share(moved, problem.ranges[active]) / (1.0 + damping)
        share = problem.agree(np.nan_to_num(share), np.min)
        change = share[:, None] * change
        scaling, nodes = state.scaling.copy(), state.nodes.copy()
        scaling[active] += change
        nodes[active] += share[:, None, None, None] * moved
        raw = step_maps(problem, state.step, scaling, nodes, active, by_scaling=self.by_scaling)
        ahead = self.pulled(raw, active, memory)
        size, defect = gap_sizes(maps, state.nodes[active])
        size_ahead, defect_ahead = gap_sizes(ahead, nodes[active])
        better, price = self._compare(active, moved, nodes[active], size, size_ahead)
        if hold:
            better = problem.agree(size_ahead < size, np.all)
        kept = active[~better]
        scaling[kept], nodes[kept] = state.scaling[kept], state.nodes[kept]
        size = np.maximum(np.abs(scaling[active]), 1e-3)
        relative = np.abs(change / size).max(axis=1, initial=0.0)
        defect = np.where(better, defect_ahead, defect)
        done = better & (share == 1.0) & (relative < tolerance) & (defect < tolerance)
        finished = _put(state.finished, active, problem.agree(done, np.all))
        tell(problem, memory, scaling, nodes, active, relative=relative, defect=defect)
        theta = state.theta
        if theta is not None and better.all():
            theta = theta + share[0] * unknowns
        return replace(
            self,
            state=replace(state, theta=theta, scaling=scaling, nodes=nodes, finished=finished),
            maps=_put(self.maps, active[better], raw[better])
            if not better.all()
            else _put(self.maps, active, raw),
            damping=_put(self.damping, active, _next_damping(damping, better, hold=hold)),
            price=_put(self.price, active, price),
        )

    def _compare(
        self,
        active: np.ndarray,
        moved: np.ndarray,
        nodes: np.ndarray,
        size: np.ndarray,
        size_ahead: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Whether the nodes lower residuals and gaps, and the price of gaps, (points,) each.

        size, size_ahead: norm of the gaps before and after. The price is never lowered, and at
        least twice what closing the gaps will cost.
        """
        problem, before = self.problem, self.state.nodes[active]
        data, weights = problem.data[active], self.state.weights[active]
        with np.errstate(over="ignore", invalid="ignore"):
            loss, aim, loss_ahead = (
                squares(x, data, weights) for x in (before, before + moved, nodes)
            )
            cost = np.where(size > 0.0, 2.0 * (aim - loss) / np.maximum(size, JOINED), 0.0)
            price = np.maximum(self.price[active], np.where(np.isfinite(cost), cost, 0.0))
            price = problem.agree(price, np.max)
            merit = problem.agree(loss + price * size, np.sum)
            merit_ahead = problem.agree(loss_ahead + price * size_ahead, np.sum)
            slack = SLACK * loss + ROUNDING * np.sqrt(loss * data[0].size)
            gains = problem.agree(loss_ahead - loss - slack, np.sum) <= 0.0
            fine = problem.agree(size_ahead - FINE * np.sqrt(loss), np.max) <= 0.0
            better = merit_ahead <= merit + problem.agree(slack, np.sum)
        return better | (gains & fine), price

    def pulled(self, maps: np.ndarray, points: np.ndarray, memory: int) -> np.ndarray:
        """One-step maps of the points, with every step's end pulled towards the data."""
        if memory >= self.window:
            return maps
        maps = (1.0 - 1.0 / memory) * maps
        maps[..., -1] += self.problem.data[points][:, :, 1:] / memory
        return maps


def _next_damping(damping: np.ndarray, better: np.ndarray, *, hold: bool) -> np.ndarray:
    """Less after a gain, more without; with the scalings held, only the share of a step counts."""
    eased = np.where(damping < NONE, 0.0, LESS * damping)
    return np.where(better, eased, np.maximum(MORE * damping, 1.0 if hold else FIRST_DAMPING))


def _part(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values of some points, without a copy if these are all."""
    return values if len(points) == len(values) else values[points]


def _put(values: np.ndarray, points: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Copy of the values with those of some points replaced."""
    if len(points) == len(values):
        return new
    values = values.copy()
    values[points] = new
    return values


def tell(
    problem: RefinementProblem,
    memory: int,
    scaling: np.ndarray,
    nodes: np.ndarray,
    points: np.ndarray,
    *,
    relative: np.ndarray,
    defect: np.ndarray,
) -> None:
    """Report an iteration to the observer, if there is one, point by point."""
    if problem.observe is ignore:
        return
    for i, point in enumerate(points):
        problem.observe(
            Iteration(
                point=int(point),
                memory=memory,
                loss=float(np.square(nodes[point] - problem.data[point]).mean()),
                scaling=scaling[point, : problem.equations[point].n_free].copy(),
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


def newton_step(
    problem: RefinementProblem,
    state: RefinementFit,
    maps: np.ndarray,
    active: np.ndarray,
    damping: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Change of the unknowns, of the scalings (points, free) and of the nodes, by least squares.

    The unknowns are theta if the points share a law, otherwise the scalings. damping: by point;
    None holds the unknowns and moves the nodes alone.
    NaN at points whose tangents overflow.
    """
    nodes, data, n_start = state.nodes[active], problem.data[active], problem.n_start
    window = nodes.shape[2]
    condensed = condense(maps, nodes, data, state.weights[active], window, n_start)
    if damping is None:
        unknowns = np.zeros_like(state.scaling[active] if state.theta is None else state.theta)
    else:
        unknowns = least_change(condensed[..., n_start:, n_start:], problem.law, damping)
    change = unknowns if problem.law is None else problem.law.scaling(unknowns)
    if problem.free_start:
        first = starts(condensed, change, n_start)
    else:
        first = data[:, :, :1] - nodes[:, :, :1]
    return unknowns, change, propagate(maps, nodes, np.ascontiguousarray(first), change, window)


def least_change(
    by_block: np.ndarray, law: LawMap | None = None, damping: np.ndarray | None = None
) -> np.ndarray:
    """Change of the unknowns that minimises the condensed residuals of all blocks, or NaN.

    by_block: triangles, (points, windows, blocks, size, size), by scaling. Without a law the
    unknowns are the scalings, (points, free), and each point is solved separately. With a law they
    are theta, common to all points: H = sum_p spread_p^T R_p^T R_p spread_p, by QR of each R_p,
    then of all.
    """
    size = by_block.shape[-1]
    # Of a single block this would be a view, and the kernel compiled again for its strides.
    rows = np.ascontiguousarray(by_block[..., :-1, :].reshape(len(by_block), -1, size))
    if law is None:
        return least_squares(rows, damping)
    if not np.isfinite(rows).all():
        return np.full(law.n_theta, np.nan)
    rows = law.rows(triangles(rows)[:, None]).reshape(1, -1, law.n_theta + 1)
    return least_squares(rows, None if damping is None else damping[:1])[0]


def least_squares(rows: np.ndarray, damping: np.ndarray | None = None) -> np.ndarray:
    """Minimisers of |A x + b|, (problems, unknowns), for rows [A | b], or NaN.

    damping: by problem; adds the squares of sqrt(damping) * x, in units of the columns' lengths.

    The solution has the least norm if the rows do not determine a direction.
    """
    size = rows.shape[-1]
    joined = triangles(rows)
    lost = ~np.isfinite(joined).all(axis=(1, 2))
    joined = np.where(lost[:, None, None], 0.0, joined)
    if damping is not None and damping.any():
        length = np.sqrt(np.square(joined[..., :-1]).sum(axis=1))
        extra = np.zeros((len(joined), size - 1, size))
        each = np.arange(size - 1)
        extra[:, each, each] = np.sqrt(damping)[:, None] * length
        joined = triangles(np.concatenate([joined, extra], axis=1))
    u, strength, vt = np.linalg.svd(joined[:, : size - 1, : size - 1])
    inverse = np.where(strength > RANK * strength[:, :1], 1.0, 0.0) / np.maximum(strength, 1e-300)
    seen = inverse * (u.transpose(0, 2, 1) @ joined[:, : size - 1, size - 1 :])[..., 0]
    change = -(vt.transpose(0, 2, 1) @ seen[..., None])[..., 0]
    return np.where(lost[:, None], np.nan, change)


def step_share(moved: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """Largest fraction of a step that moves no node by more than the data's range, (points,)."""
    by_node = (np.abs(moved).max(axis=(1, 2)) / ranges).max(axis=1)
    return 1.0 / np.maximum(1.0, by_node)
