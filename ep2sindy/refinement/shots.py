"""Linear algebra of multiple shooting: one condensed Gauss-Newton step from one-step maps."""

from __future__ import annotations

import numpy as np
import torch

from ep2sindy.refinement.kernels import condense, propagate, starts
from ep2sindy.refinement.ode import Drive
from ep2sindy.refinement.problem import Problem
from ep2sindy.refinement.steps import Step

# A direction of the scalings counts as absent below this share of the strongest.
RANK = 1e-12


def step_maps(
    problem: Problem, step: Step, scaling: np.ndarray, nodes: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """The one-step maps of some points."""
    system, drive = problem.system, problem.one_step
    if len(points) < len(nodes):
        index = torch.tensor(points, device=problem.device)
        system = system.take(index)
        drive = Drive(drive.steps[:, index], drive.inputs[:, :, index])
    return step.maps(system, drive, scaling[points], nodes[points])


def newton_step(
    maps: np.ndarray,
    nodes: np.ndarray,
    data: np.ndarray,
    weights: np.ndarray,
    block: int,
    *,
    free_start: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Change of the scalings (points, free) and of the nodes, by linear least squares.

    NaN at points whose tangents overflow.
    """
    n = nodes.shape[-1]
    n_start = n if free_start else 0
    condensed = condense(maps, nodes, data, weights, block, n_start)
    change = least_change(condensed[..., n_start:, n_start:])
    if free_start:
        first = starts(condensed, change, n)
    else:
        first = data[:, :, ::block] - nodes[:, :, ::block]
    return change, propagate(maps, nodes, np.ascontiguousarray(first), change, block)


def least_change(triangles: np.ndarray) -> np.ndarray:
    """Scalings that minimise the condensed residuals of all blocks, (points, free), or NaN."""
    return least_squares(triangles[..., :-1, :].reshape(len(triangles), -1, triangles.shape[-1]))


def least_squares(rows: np.ndarray) -> np.ndarray:
    """The minimisers of |A x + b|, (problems, unknowns), of rows [A | b], or NaN.

    Of least norm, where rows leave a direction free.
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
    """Largest gap between a step's end and the next node inside any block, (points,)."""
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
    """Share of a step, (points,), that moves no scaling by more than `limit` of it or of one.

    Nor a node by more than a range of the data.
    """
    by_scaling = np.abs(change) / (limit * np.maximum(np.abs(scaling), 1.0))
    reach = np.ptp(data, axis=(1, 2))
    by_node = np.abs(moved).max(axis=(1, 2)) / reach
    largest = np.maximum(by_scaling.max(axis=1, initial=0.0), by_node.max(axis=1))
    return 1.0 / np.maximum(1.0, largest)
