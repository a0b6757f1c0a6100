"""Judge a fit: integrate it again, then loss, covariance, error of the step, and status."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.special import ndtri, stdtrit
from torchdiffeq import odeint

from ep2sindy.refinement.kernels import condense, propagate
from ep2sindy.refinement.methods.multiple_shooting import least_change, step_maps
from ep2sindy.refinement.problem import Fit, Problem
from ep2sindy.refinement.windows import WindowBatch

FLAT = 0.95  # share of the loss of a constant from which on a model follows nothing

WIDE = 0.5  # standard error, relative to the coefficient: its 95 % interval reaches zero

CLOSED = 1e-9  # largest gap, in std, between the steps of one trajectory

CLOSING_STEPS = 10  # of Newton's method, until the gaps are

# A step counts as fine enough when the bias it leaves in a scaling is below either of these.
BIAS_PER_ERROR, LEAST_BIAS = 0.1, 1e-4

# A fit counts as stationary when one more Gauss-Newton step would gain less than this share of
# the loss, or move no scaling by more.
STATIONARY = 1e-3

# Independent windows that a sandwich needs, per scaling.
CLUSTERS = 2.0

STATUSES = ("converged", "max_iter", "coarse_step", "unidentifiable", "flat", "non_finite")


@dataclass(frozen=True, eq=False)
class Verdict:
    """One point of a fit, judged. Covariances are those of the scalings.

    window_loss: mean square of (trajectory - data) / std in each window.
    bias: change of the scalings that the error of the time step causes, to first order.
    """

    status: str
    window_loss: Float[np.ndarray, " windows"]
    covariance: Float[np.ndarray, "free free"]
    covariance_naive: Float[np.ndarray, "free free"]
    bias: Float[np.ndarray, " free"]


def integrated(problem: Problem, fit: Fit) -> tuple[Fit, np.ndarray]:
    """Integrate every window from its fitted start; also the one-step maps along the way.

    All steps at once: Newton's method closes the gaps between them with starts and scalings
    held, which converges to the trajectory itself. Where it does not, step after step.
    Points that blow up come back as not finite.
    """
    nodes, finite = fit.nodes.copy(), fit.finite.copy()
    points = np.arange(len(nodes))
    window = nodes.shape[2]
    start = np.zeros((*nodes.shape[:2], 1, nodes.shape[-1]))
    still = np.zeros_like(fit.scaling)
    open_points = points
    for _ in range(CLOSING_STEPS):
        maps = step_maps(problem, fit.step, fit.scaling, nodes, points)
        with np.errstate(invalid="ignore", over="ignore"):
            gaps = np.abs(maps[:, :, 0] - nodes[:, :, 1:].transpose(0, 3, 1, 2)).max(axis=(1, 2, 3))
        open_points = np.flatnonzero(finite & ~(gaps < CLOSED))
        if not open_points.size or not np.isfinite(gaps[open_points]).all():
            break
        change = propagate(maps, nodes, start, still, window)
        nodes[open_points] += change[open_points]
    if open_points.size:
        states = rollout(problem, fit)
        sound = np.isfinite(states[open_points]).all(axis=(1, 2, 3))
        finite[open_points] = sound
        nodes[open_points[sound]] = states[open_points[sound]]
        maps = step_maps(problem, fit.step, fit.scaling, nodes, points)
    finite &= np.isfinite(maps).all(axis=(1, 2, 3, 4))
    return replace(fit, nodes=nodes, finite=finite), maps


def closed(problem: Problem, fit: Fit) -> np.ndarray:
    """Trajectories from the fitted starts, as `integrated` closes them, window by window.

    Returns (points, windows, samples, n_states), NaN in windows that do not close.
    """
    nodes, points = fit.nodes.copy(), np.arange(len(fit.nodes))
    start = np.zeros((*nodes.shape[:2], 1, nodes.shape[-1]))
    for _ in range(CLOSING_STEPS):
        maps = step_maps(problem, fit.step, fit.scaling, nodes, points)
        with np.errstate(invalid="ignore", over="ignore"):
            gaps = np.abs(maps[:, :, 0] - nodes[:, :, 1:].transpose(0, 3, 1, 2)).max(axis=(1, 3))
        is_open = np.isfinite(gaps) & ~(gaps < CLOSED)
        if not is_open.any():
            break
        change = propagate(maps, nodes, start, np.zeros_like(fit.scaling), nodes.shape[2])
        nodes[is_open] += change[is_open]
    nodes[~(gaps < CLOSED)] = np.nan
    return nodes


def rollout(problem: Problem, fit: Fit, *, n_substeps: int = 4) -> np.ndarray:
    """Integrate every window step after step by torchdiffeq's rk4, from its fitted start."""
    system, n_steps = problem.system, fit.nodes.shape[2] - 1
    start = torch.tensor(fit.nodes[:, :, 0].transpose(0, 2, 1).copy(), device=problem.device)
    scaling = torch.tensor(fit.scaling, device=problem.device)
    t = torch.arange(n_steps + 1, dtype=torch.float64)
    grid = torch.linspace(0.0, float(n_steps), n_substeps * n_steps + 1, dtype=torch.float64)
    with torch.inference_mode():
        path = odeint(
            system.value_rhs(scaling, problem.whole), start, t, method="rk4",
            options={"grid_constructor": lambda func, y0, t: grid, "perturb": True},
        )  # fmt: skip
    return path.permute(1, 3, 0, 2).cpu().numpy()


def step_triangles(problem: Problem, fit: Fit, maps: np.ndarray) -> np.ndarray:
    """Condensed residuals by scaling, with the error of the time step in the defects' place.

    That is the error of each step against two steps of half its length.
    """
    error = fit.step.finer(problem.system, problem.one_step, fit.scaling, fit.nodes) - maps[:, :, 0]
    shifted = maps.copy()
    shifted[:, :, 0] = fit.nodes[:, :, 1:].transpose(0, 3, 1, 2) + error
    n_start = fit.nodes.shape[-1] if problem.free_start else 0
    window = fit.nodes.shape[2]
    condensed = condense(shifted, fit.nodes, fit.nodes, fit.weights, window, n_start)
    return condensed[..., n_start:, n_start:]


def step_bias(problem: Problem, fit: Fit, maps: np.ndarray) -> np.ndarray:
    """Change of the scalings, (points, free), that the error of the time step causes."""
    return least_change(step_triangles(problem, fit, maps))


def is_coarse(bias: np.ndarray, covariance: np.ndarray, scaling: np.ndarray) -> bool:
    """Whether the error of the time step shows in any scaling."""
    error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    allowed = np.maximum(BIAS_PER_ERROR * error, LEAST_BIAS * np.abs(scaling))
    return bool((~(np.abs(bias) <= allowed)).any())


def covariances(
    triangles: np.ndarray, batch: WindowBatch, *, n_residuals: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sandwich with windows as clusters, and the naive s^2 H^-1, of the scalings.

    triangles: (windows, rows, free + 1), each window's R with its start eliminated, the residual
    that nothing can mend in the last row.
    Residuals of a cluster are those that the other clusters leave (CR3, the jackknife), and the
    quantile of Student's t for their number is put into the covariance. Overlapping windows share
    noise: their scores count together, the less the farther apart. With too few windows for
    a sandwich, the naive one stands for it.
    n_residuals: less what starts and scalings take.
    Source: Bell & McCaffrey 2002, Surv. Methodol. 28, 169; Newey & West 1987,
    doi:10.2307/1913610 for the weights.
    """
    jacobian, z = triangles[:, :-1, :-1], triangles[:, :-1, -1]
    n_windows, n_rows, n_free = jacobian.shape
    inverse = np.linalg.pinv(np.linalg.qr(jacobian.reshape(-1, n_free), mode="r"), rcond=1e-12)
    bread = inverse @ inverse.T
    naive = np.square(triangles[..., -1]).sum() / n_residuals * bread * batch.multiplicity
    if n_windows < CLUSTERS * n_free * batch.multiplicity:
        return naive, naive
    leverage = jacobian @ bread @ jacobian.transpose(0, 2, 1)
    # The share keeps a window that alone fixes a direction from dividing by zero.
    freed = np.linalg.solve((1.0 + 1e-6) * np.eye(n_rows) - leverage, z[..., None])
    scores = (jacobian.transpose(0, 2, 1) @ freed)[..., 0]
    window = batch.data.shape[1]
    apart = np.abs(batch.start[:, None] - batch.start) / (2.0 * window)
    overlap = batch.multiplicity > 1.0 and batch.trajectory[:, None] == batch.trajectory
    together = np.where(overlap, np.maximum(1.0 - apart, 0.0), np.eye(n_windows))
    n_clusters = n_windows / batch.multiplicity
    widening = (stdtrit(n_clusters - n_free, 0.975) / ndtri(0.975)) ** 2
    return widening * bread @ scores.T @ together @ scores @ bread, naive


def judge(problem: Problem, fit: Fit) -> tuple[Fit, list[Verdict]]:
    """Verdicts on every point, from trajectories integrated again; also those trajectories."""
    fit, maps = integrated(problem, fit)
    n_start = fit.nodes.shape[-1] if problem.free_start else 0
    sound = maps if fit.finite.all() else np.where(np.isfinite(maps), maps, 0.0)
    condensed = condense(sound, fit.nodes, problem.data, fit.weights, fit.nodes.shape[2], n_start)[
        :, :, 0, n_start:, n_start:
    ]
    overflown = ~np.isfinite(condensed).all(axis=(1, 2, 3))
    condensed[overflown] = 0.0
    fit = replace(fit, finite=fit.finite & ~overflown)
    bias = step_bias(problem, fit, sound)
    step = least_change(condensed[:, :, None])
    verdicts = []
    for p, (ode, batch) in enumerate(zip(problem.odes, problem.batches, strict=True)):
        n_free = len(ode.free0)
        scaling, own = fit.scaling[p, :n_free], np.append(np.arange(n_free), -1)
        with np.errstate(invalid="ignore", over="ignore"):
            residual = np.square(fit.nodes[p] - problem.data[p])
        n_residuals = residual.size - n_start * len(residual) - n_free
        triangles = condensed[p][..., own]
        robust, naive = covariances(triangles, batch, n_residuals=max(n_residuals, 1))
        losses = residual.mean(axis=(1, 2))
        verdict = Verdict("converged", losses, robust, naive, bias[p, :n_free])
        gain = np.square(triangles[..., :-1] @ step[p, :n_free]).sum()
        share = gain / max(np.square(triangles[..., -1]).sum(), 1e-300)
        relative = np.abs(step[p, :n_free] / scaling).max() if scaling.all() else np.inf
        stationary = bool(min(share, relative) < STATIONARY)
        verdicts.append(replace(verdict, status=_status(problem, fit, p, verdict, stationary)))
    return fit, verdicts


def _status(problem: Problem, fit: Fit, p: int, verdict: Verdict, stationary: bool) -> str:
    """The gravest that applies."""
    loss = float(verdict.window_loss.mean())
    if not (fit.finite[p] and np.isfinite(loss)):
        return "non_finite"
    data = problem.data[p]
    level = data.mean(axis=1, keepdims=True) if problem.free_start else data[:, :1]
    if loss > FLAT * np.square(data - level).mean():
        return "flat"
    error = np.sqrt(np.maximum(np.diag(verdict.covariance), 0.0))
    scaling = fit.scaling[p, : len(error)]
    if (~(error < WIDE * np.abs(scaling))).any():
        return "unidentifiable"
    if not (fit.finished[p] and stationary):
        return "max_iter"
    if is_coarse(verdict.bias, verdict.covariance, scaling):
        return "coarse_step"
    return "converged"
