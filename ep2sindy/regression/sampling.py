"""Sampling at unequal steps: division into stretches without gaps, and even grids in them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from ep2sindy.data.gaps import LONGEST_STEP, between_gaps
from ep2sindy.data.numbers import rounding_s

# Largest deviation from an even grid, in steps, that is attributed to rounding of the recorded
# times. The error of such a sample is a twentieth of the signal's change in a step.
ROUNDED = 0.05

MIN_SAMPLES = 20  # fewest samples in a stretch between gaps; fewer do not determine their noise


def is_even(t: Float[np.ndarray, " samples"]) -> bool:
    """Return true if the times lie on an even grid, apart from rounding."""
    step = (t[-1] - t[0]) / (len(t) - 1)
    off = np.abs(t - t[0] - step * np.arange(len(t))).max()
    return bool(off <= max(ROUNDED * step, rounding_s(t)))


def stretches(t: Float[np.ndarray, " samples"]) -> list[tuple[int, int]]:
    """First and last sample (exclusive) of every stretch without gaps.

    A stretch of under 20 samples is left out, unless there is no gap.
    Raises ValueError if none is left.
    """
    pieces = between_gaps(t)
    long = [(a, b) for a, b in pieces if b - a >= MIN_SAMPLES]
    if len(pieces) > 1 and not long:
        raise ValueError(
            f"a trajectory must hold {MIN_SAMPLES} samples without a gap: {len(pieces) - 1} steps "
            f"are over {LONGEST_STEP:g} times the median step of {np.median(np.diff(t)):.4g} s; "
            "cut it at its pauses, or interpolate it first"
        )
    return long if len(pieces) > 1 else pieces


def even_grid(
    t: Float[np.ndarray, " samples"],
) -> tuple[Float[np.ndarray, " points"], csr_array]:
    """Even grid with about the median step, and the matrix (points, samples) that interpolates.

    Interpolation is linear: weights are not negative, so noise is never amplified.
    """
    n_steps = max(1, round(float((t[-1] - t[0]) / np.median(np.diff(t)))))
    grid = np.linspace(t[0], t[-1], n_steps + 1)
    left = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 2)
    share = (grid - t[left]) / (t[left + 1] - t[left])
    weights = np.stack([1.0 - share, share], axis=1)
    columns = np.stack([left, left + 1], axis=1)
    starts = np.arange(0, 2 * len(grid) + 1, 2)
    lines = csr_array((weights.ravel(), columns.ravel(), starts), shape=(len(grid), len(t)))
    lines.eliminate_zeros()
    return grid, lines


def one_about_each(
    t: Float[np.ndarray, " samples"], middle: Float[np.ndarray, " windows"]
) -> Int[np.ndarray, " kept"]:
    """Indices of windows to keep: the first of all windows nearest to the same sample.

    middle: increasing times of the middles of the windows.
    """
    nearest = np.searchsorted(0.5 * (t[1:] + t[:-1]), middle)
    return np.flatnonzero(np.diff(nearest, prepend=-1) > 0)
