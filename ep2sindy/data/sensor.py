"""What the range and the resolution of a sensor make of samples: intervals in place of values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

# Samples at an end of the range that are no chance: where hardly a value comes twice, and, of
# rounded samples, in multiples of how often the next values come. Of a sine they come 2.5 times as
# often.
FEWEST, TIMES, NEXT = 3, 5, 3
REPEATS = 0.01  # share of the values that come more than once
SAMPLES_PER_LEVEL = 3  # of rounded samples; the least
EVEN = 0.01  # of a step, by which distances between levels may differ from whole steps
DITHERED = 0.5  # noise in steps, from which on rounding is noise like any other
ORDER = 3  # of differences: they leave little of a signal that the samples resolve
ROUNDING = 1e-9  # of the range, below which differences are those of the number format
FINE = 3e-3  # of the spread: no model is as exact


@dataclass(frozen=True, eq=False)
class Bounds:
    """Between what limits the truth of every sample lies, but for its noise.

    lower, upper: (samples, columns); both are the sample where it is a value. words: what was
    found, by column. at: which samples are no values.
    """

    lower: Float[np.ndarray, "samples columns"]
    upper: Float[np.ndarray, "samples columns"]
    words: tuple[str, ...]

    @cached_property
    def at(self) -> Bool[np.ndarray, "samples columns"]:
        return self.lower < self.upper


def bounds_of(values: Float[np.ndarray, "samples columns"], names: Sequence[str]) -> Bounds | None:
    """Limits of clipped samples, and of those that are rounded more coarsely than they scatter.

    Clipped is an end of the range that comes again and again, where the values beside it do not.
    What rests there from the start, or to the end, is not, if the record has no noise that would
    show. None where all are values.
    """
    lower, upper, words = values.copy(), values.copy(), []
    for j, name in enumerate(names):
        x = np.ascontiguousarray(values[:, j])
        levels, counts = np.unique(x, return_counts=True)
        if len(levels) + FEWEST > len(x):
            continue
        if step := _coarse_step(x, levels):
            lower[:, j] -= step / 2.0
            upper[:, j] += step / 2.0
            words.append(f"{name} is rounded to steps of {step:.3g}")
            continue  # a signal that rests at its end looks clipped then
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


def _is_clipped(
    x: Float[np.ndarray, " samples"],
    there: Bool[np.ndarray, " samples"],
    others: Int[np.ndarray, " levels"],
) -> bool:
    """Whether an end of the range comes too often. others: how often other levels do, nearest
    first."""
    rounded = len(others) < 2 or (others[:-1] > 1).mean() > REPEATS
    most = TIMES * int(others[:NEXT].max(initial=1)) if rounded else FEWEST - 1
    if there.sum() <= most:
        return False
    counted = there.copy()
    if not _has_noise(x):
        for ends in (counted, counted[::-1]):
            ends[: int(np.argmin(ends))] = False
    return bool(counted.sum() > most)


def _has_noise(x: Float[np.ndarray, " samples"]) -> bool:
    """Whether differences change their sign from one to the next: of white noise three in four do,
    of a signal that the samples resolve hardly one, but for rounding."""
    change = np.diff(x, ORDER)
    shown = np.abs(change) > ROUNDING * np.ptp(x)
    both = shown[1:] & shown[:-1]
    turns = change[1:] * change[:-1] < 0.0
    return bool(turns[both].sum() > 0.5 * both.sum())


def _coarse_step(x: Float[np.ndarray, " samples"], levels: Float[np.ndarray, " levels"]) -> float:
    """The step that samples are rounded to; 0 where it is finer than their noise, or none."""
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


# Mean size of third differences of white noise of unit variance: sqrt(1 + 9 + 9 + 1), of a normal
# variable times sqrt(2 / pi).
NORMAL = float(np.sqrt(20.0 * 2.0 / np.pi))
