"""Clipped and coarsely rounded samples, described by intervals in place of exact values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.runtime.values import Columns, Mask, Samples

# Number of samples at an end of the range that cannot be chance. FEWEST holds if hardly any value
# repeats. Rounded samples need more than TIMES the largest count among the NEXT nearest levels; at
# the crest of a sine that ratio is 2.5.
FEWEST, TIMES, NEXT = 3, 5, 3
REPEATS = 0.01  # samples count as rounded if a larger fraction of their values repeats
SAMPLES_PER_LEVEL = 3  # least number of samples per level for samples that count as rounded
EVEN = 0.01  # tolerance on distances between levels being whole steps, as a fraction of a step
DITHERED = 0.5  # noise in units of the step, above which rounding acts like ordinary noise
ORDER = 3  # order of the differences, high enough to suppress a signal that the samples resolve
ROUNDING = 1e-9  # fraction of the range below which differences are rounding of the number format
FINE = 3e-3  # fraction of the standard deviation; no model is accurate to a finer step


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits between which the true value of each sample lies, apart from noise.

    lower, upper: (samples, columns), infinite beyond a clipped end; both equal the sample where it
    is an exact value. words: one message per affected column. at: mask of the inexact samples.
    """

    lower: Columns
    upper: Columns
    words: tuple[str, ...]

    @cached_property
    def at(self) -> Bool[np.ndarray, "samples columns"]:
        return self.lower < self.upper


def bounds_of(values: Columns, names: Sequence[str]) -> Bounds | None:
    """Find the limits of clipped samples, and of samples rounded more coarsely than their noise.

    A column is clipped if an end of its range occurs again and again while neighbouring values do
    not. In a record without visible noise, samples that rest at the end of the range from the
    start, or until the end, do not count as clipped.
    Returns None if all samples are exact values.
    """
    # Most records repeat no value; to count the levels or to copy the samples takes far more.
    repeating = [j for j in range(len(names)) if _n_repeats(values[:, j]) >= FEWEST]
    if not repeating:
        return None
    lower, upper, words = values.copy(), values.copy(), []
    for j in repeating:
        name, x = names[j], np.ascontiguousarray(values[:, j])
        levels, counts = np.unique(x, return_counts=True)
        if step := _coarse_step(x, levels):
            lower[:, j] -= step / 2.0
            upper[:, j] += step / 2.0
            words.append(f"{name} is rounded to steps of {step:.3g}")
            continue  # a rounded signal that rests at its end would look clipped
        ends = []
        for limit, end, level, others in (
            (upper, np.inf, levels[-1], counts[-2::-1]),
            (lower, -np.inf, levels[0], counts[1:]),
        ):
            there = x == level
            if _is_clipped(x, there, others):
                limit[there, j] = end
                ends.append(f"{there.sum()} samples at {level:.4g}")
        if ends:
            words.append(f"{name} is clipped, {' and '.join(ends)}")
    return Bounds(lower, upper, tuple(words)) if words else None


def _n_repeats(x: Samples) -> int:
    ordered = np.sort(x)
    return int(np.count_nonzero(ordered[1:] == ordered[:-1]))


def _is_clipped(x: Samples, there: Mask, others: Int[np.ndarray, " levels"]) -> bool:
    """True if an end of the range occurs too often. others: counts of other levels, nearest first.

    there: mask of the samples at that end.
    """
    rounded = len(others) < 2 or (others[:-1] > 1).mean() > REPEATS
    most = TIMES * int(others[:NEXT].max(initial=1)) if rounded else FEWEST - 1
    if there.sum() <= most:
        return False
    counted = there.copy()
    if not _has_noise(x):
        for ends in (counted, counted[::-1]):
            ends[: int(np.argmin(ends))] = False
    return bool(counted.sum() > most)


def _has_noise(x: Samples) -> bool:
    """True if more than half of consecutive third differences change sign.

    For white noise about three in four do; for a signal that the samples resolve hardly any do,
    apart from rounding.
    """
    change = np.diff(x, ORDER)
    shown = np.abs(change) > ROUNDING * np.ptp(x)
    both = shown[1:] & shown[:-1]
    turns = change[1:] * change[:-1] < 0.0
    return bool(turns[both].sum() > 0.5 * both.sum())


def _coarse_step(x: Samples, levels: Float[np.ndarray, " levels"]) -> float:
    """Step that samples are rounded to; 0 if they are not rounded, or more finely than noise."""
    if len(levels) < 3 or SAMPLES_PER_LEVEL * len(levels) > len(x):
        return 0.0
    gaps = np.diff(levels)
    # Levels where a sensor is clipped need not be on its steps.
    inner = gaps[1:-1] if len(gaps) > 4 else gaps
    step = float(inner.min())
    ratio = inner / step
    noise = np.abs(np.diff(x, ORDER)).mean() / NORMAL
    coarse = step > max(noise / DITHERED, FINE * x.std())
    return step if coarse and np.abs(ratio - np.round(ratio)).max() < EVEN else 0.0


# Mean magnitude of third differences of normal white noise of unit variance: their standard
# deviation sqrt(1 + 9 + 9 + 1), times sqrt(2 / pi).
NORMAL = float(np.sqrt(20.0 * 2.0 / np.pi))
