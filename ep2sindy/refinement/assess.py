"""Assessment of a fit: new integration, loss, covariance, error of the time step, and status."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.special import ndtri, stdtrit

from ep2sindy.estimation.noise import are_noise
from ep2sindy.refinement.kernels import condense, propagate
from ep2sindy.refinement.methods.multiple_shooting import least_change, step_maps
from ep2sindy.refinement.problem import Method, RefinementFit, RefinementProblem
from ep2sindy.refinement.steps import integrate
from ep2sindy.refinement.windows import WindowBatch

FLAT = 0.95  # a model with more than this fraction of a constant's loss does not follow the data

WIDE = 0.5  # relative standard error at which the 95 % interval of a coefficient reaches zero

CLOSED = 1e-9  # largest gap, in std, between the steps of one trajectory

CLOSING_STEPS = 10  # largest number of Newton steps to close the gaps

# A step counts as fine enough if the bias that it causes in a scaling is below the larger of these:
# a fraction of the standard error, and a fraction of the scaling.
BIAS_PER_ERROR, MIN_BIAS = 0.1, 1e-4

# A fit counts as stationary if one more Gauss-Newton step would reduce the loss by less than this
# fraction, or change no scaling by more.
STATIONARY = 1e-3

# Independent windows per scaling that a sandwich covariance needs.
CLUSTERS = 2.0


class RefinementStatus(StrEnum):
    """Status of a finished refinement; see `Refinement`."""

    CONVERGED = "converged"
    MAX_ITER = "max_iter"
    COARSE_STEP = "coarse_step"
    UNIDENTIFIABLE = "unidentifiable"
    FLAT = "flat"
    NON_FINITE = "non_finite"


def status_of(
    *, finite: bool, flat: bool, unidentifiable: bool, coarse: Callable[[], bool], settled: bool
) -> RefinementStatus:
    """The first status that applies, in the order of the arguments.

    A coarse time step comes before a fit that has not settled: it may be why, and shorter steps
    continue the fit. So max_iter says that the step is short enough.
    """
    if not finite:
        return RefinementStatus.NON_FINITE
    if flat:
        return RefinementStatus.FLAT
    if unidentifiable:
        return RefinementStatus.UNIDENTIFIABLE
    if coarse():
        return RefinementStatus.COARSE_STEP
    return RefinementStatus.CONVERGED if settled else RefinementStatus.MAX_ITER


def is_flat(
    loss: float, data: Float[np.ndarray, "*points windows samples n_states"], *, free_start: bool
) -> bool:
    """Return true if constants fit nearly as well: the means of windows, or their fixed starts."""
    level = data.mean(axis=-2, keepdims=True) if free_start else data[..., :1, :]
    return bool(loss > FLAT * np.square(data - level).mean())


@dataclass(frozen=True, eq=False)
class RefinementVerdict:
    """Assessment of one point of a fit.

    window_loss: mean square of (trajectory - data) / std in each window. covariance,
    covariance_naive: covariances of the scalings. explains: (n_states,), whether the residuals are
    noise; else intervals would tell how far another segment of the record moves a wrong model.
    """

    status: RefinementStatus
    window_loss: Float[np.ndarray, " windows"]
    covariance: Float[np.ndarray, "free free"]
    covariance_naive: Float[np.ndarray, "free free"]
    explains: Bool[np.ndarray, " n_states"]


def fit_and_assess(
    problem: RefinementProblem, method: Method
) -> tuple[RefinementFit, list[RefinementVerdict]]:
    """Fit, halving the time step as long as necessary, and assess the integrated trajectories.

    Returns the fit, and a verdict for each point.
    """
    fit, verdicts = assess(problem, method.fit(problem))
    while any(coarse := [v.status is RefinementStatus.COARSE_STEP for v in verdicts]):
        again = method.finer(problem, fit, np.flatnonzero(coarse))
        if again is None:
            break
        fit, verdicts = assess(problem, again)
    return fit, verdicts


def assess(
    problem: RefinementProblem, fit: RefinementFit
) -> tuple[RefinementFit, list[RefinementVerdict]]:
    """Integrate the fit again, and return it with a verdict on each point."""
    fit, maps = follow(problem, fit)
    sound = maps if fit.finite.all() else np.where(np.isfinite(maps), maps, 0.0)
    condensed = condense(sound, fit.nodes, problem.data, fit.weights, problem.n_start)
    triangles = condensed[:, :, problem.n_start :, problem.n_start :]
    overflown = ~np.isfinite(triangles).all(axis=(1, 2, 3))
    triangles[overflown] = 0.0
    fit = replace(fit, finite=fit.finite & ~overflown)
    bias = least_change(step_triangles(problem, fit, sound))
    change = least_change(triangles)
    verdicts = []
    for p, equations in enumerate(problem.equations):
        n_free = equations.n_free
        rows = triangles[p][..., np.append(np.arange(n_free), -1)]
        verdicts.append(_assess_point(problem, fit, p, rows, bias[p, :n_free], change[p, :n_free]))
    return fit, verdicts


def _assess_point(
    problem: RefinementProblem,
    fit: RefinementFit,
    point: int,
    rows: Float[np.ndarray, "windows size columns"],
    bias: Float[np.ndarray, " free"],
    change: Float[np.ndarray, " free"],
) -> RefinementVerdict:
    """Verdict on one point.

    rows: each window's condensed residuals by the scalings, right-hand side last.
    bias: change of the scalings that the error of the time step causes, to first order.
    change: change of the scalings in one more Gauss-Newton step.
    """
    data, batch, scaling = problem.data[point], problem.batches[point], fit.scaling[point]
    scaling = scaling[: len(change)]
    n_residuals = data.size - problem.n_start * len(rows) - len(change)
    robust, naive = covariances(rows, batch, n_residuals=max(n_residuals, 1))
    with np.errstate(invalid="ignore", over="ignore"):
        left = fit.nodes[point] - data
        window_loss = np.square(left).mean(axis=(1, 2))
        n = data.shape[0] * data.shape[1] / batch.multiplicity
        explains = are_noise(list(data), list(left), n)
    loss = float(window_loss.mean())
    error = np.sqrt(np.maximum(np.diag(robust), 0.0))
    status = status_of(
        finite=bool(fit.finite[point] and np.isfinite(loss)),
        flat=is_flat(loss, data, free_start=problem.free_start),
        unidentifiable=bool((~(error < WIDE * np.abs(scaling))).any()),
        coarse=lambda: is_coarse(bias, error, scaling),
        settled=bool(fit.finished[point]) and is_stationary(rows, change, scaling),
    )
    return RefinementVerdict(status, window_loss, robust, naive, explains)


def follow(problem: RefinementProblem, fit: RefinementFit) -> tuple[RefinementFit, np.ndarray]:
    """Integrate every window from its fitted start; also returns the one-step maps.

    Points whose gaps do not close are integrated step by step. Points that blow up are marked as
    not finite.
    """
    nodes, gaps, maps = close_gaps(problem, fit)
    finite = fit.finite.copy()
    open_points = np.flatnonzero(finite & ~(gaps < CLOSED).all(axis=1))
    if open_points.size:
        states = rollout(problem, fit)[open_points]
        sound = np.isfinite(states).all(axis=(1, 2, 3))
        finite[open_points] = sound
        nodes[open_points[sound]] = states[sound]
        maps = step_maps(problem, fit.step, fit.scaling, nodes, np.arange(len(nodes)))
    finite &= np.isfinite(maps).all(axis=(1, 2, 3, 4))
    return replace(fit, nodes=nodes, finite=finite, maps=None), maps


def close_gaps(
    problem: RefinementProblem, fit: RefinementFit
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes of the trajectories from the fitted starts, with starts and scalings held.

    All steps are integrated at once, and Newton's method closes the gaps between them. Returns the
    nodes, the largest gap of every window (points, windows), in std, and the one-step maps.
    """
    nodes, points = fit.nodes.copy(), np.arange(len(fit.nodes))
    start = np.zeros_like(nodes[:, :, 0])
    maps = fit.maps
    for _ in range(CLOSING_STEPS):
        if maps is None:
            maps = step_maps(problem, fit.step, fit.scaling, nodes, points)
        with np.errstate(invalid="ignore", over="ignore"):
            gaps = np.abs(maps[..., -1] - nodes[:, :, 1:]).max(axis=(2, 3))
        is_open = np.isfinite(gaps) & ~(gaps < CLOSED)
        if not is_open.any():
            break
        change = propagate(maps, nodes, start, np.zeros_like(fit.scaling))
        nodes[is_open] += change[is_open]
        maps = None
    if maps is None:
        maps = step_maps(problem, fit.step, fit.scaling, nodes, points)
    return nodes, gaps, maps


def rollout(problem: RefinementProblem, fit: RefinementFit, *, n_substeps: int = 4) -> np.ndarray:
    """Integrate every window step by step with torchdiffeq's rk4, from its fitted start."""
    problem.ode.set(fit.scaling, problem.whole)
    start = torch.tensor(fit.nodes[:, :, 0].transpose(0, 2, 1).copy(), device=problem.device)
    with torch.inference_mode():
        path = integrate(
            problem.ode, start[:, None], n_segments=fit.nodes.shape[2] - 1, n_substeps=n_substeps
        )
    return path[:, :, 0].permute(1, 3, 0, 2).cpu().numpy()


def failure(
    problem: RefinementProblem, fit: RefinementFit, point: int, verdict: RefinementVerdict
) -> str:
    """At which stage and in which window a refinement failed, in words; nothing if it did not."""
    failed = (RefinementStatus.NON_FINITE, RefinementStatus.FLAT, RefinementStatus.MAX_ITER)
    if verdict.status not in failed:
        return ""
    batch, window = problem.batches[point], fit.nodes.shape[2]
    where = int(np.argmax(np.nan_to_num(verdict.window_loss, nan=np.inf, posinf=np.inf)))
    how = f"deviates from its data most, with a loss of {verdict.window_loss[where]:.3g}"
    if verdict.status is RefinementStatus.NON_FINITE:
        alone, at = problem.take(point), [point]
        scaling, nodes = fit.scaling[at, : alone.n_free], fit.nodes[at]
        part = replace(fit, scaling=scaling, nodes=nodes)
        sound = np.isfinite(rollout(alone, part)[0]).all(axis=-1)
        where = int(np.argmin(sound.sum(axis=1)))
        how = f"follows no finite trajectory beyond sample {int(sound[where].sum())}"
    stage = ""
    if fit.memory is not None and fit.memory[point] < window:
        stage = f"the longest memory without gaps was {fit.memory[point]} of {window} samples, and "
    return (
        f"{stage}window {where} (from sample {batch.start[where]} of trajectory "
        f"{batch.trajectory[where]}, {window} samples of {batch.step_s:.3g} s) {how}"
    )


def step_triangles(problem: RefinementProblem, fit: RefinementFit, maps: np.ndarray) -> np.ndarray:
    """Condensed residuals by scaling, with time-step errors in place of the defects.

    The error of a step is its difference from two steps of half its length.
    """
    problem.ode.set(fit.scaling, problem.one_step)
    error = fit.step.finer(problem.ode, fit.nodes) - maps[..., -1]
    shifted = maps.copy()
    shifted[..., -1] = fit.nodes[:, :, 1:] + error
    condensed = condense(shifted, fit.nodes, fit.nodes, fit.weights, problem.n_start)
    return condensed[..., problem.n_start :, problem.n_start :]


def is_stationary(
    rows: Float[np.ndarray, "windows size columns"],
    change: Float[np.ndarray, " free"],
    scaling: Float[np.ndarray, " free"],
) -> bool:
    """Return true if one more Gauss-Newton step changes the loss, or all scalings, by very little.

    rows: each window's condensed residuals by the scalings, right-hand side last. change: of the
    scalings in that step.
    """
    gain = np.square(rows[..., :-1] @ change).sum()
    fraction = gain / max(np.square(rows[..., -1]).sum(), 1e-300)
    relative = np.abs(change / scaling).max() if scaling.all() else np.inf
    return bool(min(fraction, relative) < STATIONARY)


def is_coarse(bias: np.ndarray, error: np.ndarray, scaling: np.ndarray) -> bool:
    """Return true if the error of the time step causes a significant bias in any scaling.

    error: standard errors of the scalings.
    """
    allowed = np.maximum(BIAS_PER_ERROR * error, MIN_BIAS * np.abs(scaling))
    return bool((~(np.abs(bias) <= allowed)).any())


def covariances(
    triangles: np.ndarray, batch: WindowBatch, *, n_residuals: int
) -> tuple[np.ndarray, np.ndarray]:
    """Covariances of the scalings: a sandwich with windows as clusters, and the naive s^2 H^-1.

    triangles: (windows, rows, free + 1), each window's R with its start eliminated; the last row
    holds the residual that no change of the scalings can reduce.
    The residuals of a cluster are those of a fit to the other clusters (CR3, the jackknife). The
    covariance is widened by the quantile of Student's t for their number. Overlapping windows
    share noise, so their scores are correlated, with weights that fall with distance. With too
    few windows for a sandwich, the naive covariance replaces it. n_residuals: number of residuals
    minus the number of starts and scalings. Source: Bell & McCaffrey 2002, Surv. Methodol. 28, 169;
    Newey & West 1987, doi:10.2307/1913610 for the weights.
    """
    jacobian, z = triangles[:, :-1, :-1], triangles[:, :-1, -1]
    n_windows, n_rows, n_free = jacobian.shape
    inverse = np.linalg.pinv(np.linalg.qr(jacobian.reshape(-1, n_free), mode="r"), rcond=1e-12)
    bread = inverse @ inverse.T
    naive = np.square(triangles[..., -1]).sum() / n_residuals * bread * batch.multiplicity
    if n_windows < CLUSTERS * n_free * batch.multiplicity:
        return naive, naive
    leverage = jacobian @ bread @ jacobian.transpose(0, 2, 1)
    # The factor prevents a division by zero if one window alone determines a direction.
    freed = np.linalg.solve((1.0 + 1e-6) * np.eye(n_rows) - leverage, z[..., None])
    scores = (jacobian.transpose(0, 2, 1) @ freed)[..., 0]
    window = batch.data.shape[1]
    apart = np.abs(batch.start[:, None] - batch.start) / (2.0 * window)
    overlap = batch.multiplicity > 1.0 and batch.trajectory[:, None] == batch.trajectory
    together = np.where(overlap, np.maximum(1.0 - apart, 0.0), np.eye(n_windows))
    n_clusters = n_windows / batch.multiplicity
    widening = (stdtrit(n_clusters - n_free, 0.975) / ndtri(0.975)) ** 2
    return widening * bread @ scores.T @ together @ scores @ bread, naive
