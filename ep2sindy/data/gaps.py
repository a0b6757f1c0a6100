"""Missing samples: rows that hold a NaN, a message that says how many, and gaps in time."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.library.units import Clock
from ep2sindy.runtime.values import Mask, Samples

if TYPE_CHECKING:
    import xarray as xr


# Longest step, in median steps, that is interpolated; a longer one is a gap. Random times have
# such a gap once in 1000 samples, random losses of 30 % never. With a limit of 5, random times are
# divided into segments of about 30 samples, and Lorenz was never found.
LONGEST_STEP = 10.0

MIN_SEGMENT = 20  # samples between gaps: fewer determine neither their noise nor a derivative


class MissingSamples(UserWarning):
    """Warns that samples are NaN and were left out."""


def present_rows(columns: Mapping[str, Float[np.ndarray, " _"]]) -> Bool[np.ndarray, " _"]:
    """Mask of the samples that are present in every column; NaN marks a missing sample.

    Raises ValueError for a column without any number, or if fewer than two samples are left.
    """
    lacking = {name: np.isnan(values) for name, values in columns.items()}
    for name, absent in lacking.items():
        if absent.all():
            raise ValueError(
                f"{name} must hold numbers: all its {len(absent)} samples are NaN; leave it out, "
                "or look at the file's column and its unit"
            )
    present = ~np.any([*lacking.values()], axis=0)
    if present.sum() < 2:
        counts = ", ".join(f"{name} lacks {int(a.sum())}" for name, a in lacking.items() if a.any())
        raise ValueError(
            f"two samples or more must hold all of {list(columns)}: of {len(present)} samples "
            f"{counts}, and {int(present.sum())} are left; fill them first "
            "(ep2sindy.data.interpolate)"
        )
    return present


def without_gaps(field: xr.Dataset) -> xr.Dataset:
    """Drop the samples at which a variable that depends on time alone is NaN.

    Variables on a grid play no part in this; `check_samples` refuses their gaps later.
    """
    alone = {
        str(name): array.values.astype(np.float64)
        for name, array in field.data_vars.items()
        if array.dims == ("time",)
    }
    if not any(np.isnan(values).any() for values in alone.values()):
        return field
    return field.isel(time=np.flatnonzero(present_rows(alone)))


def usual_step(t: Samples) -> float:
    """Median step of times, in their unit, which gaps leave as it is."""
    return float(np.median(np.diff(t)))


def between_gaps(t: Samples) -> list[tuple[int, int]]:
    """First and last sample (exclusive) of every segment of times without a gap.

    A gap is a step that is long next to the median step, and next to a step next to it: times that
    grow by a factor from one to the next have long steps, and no gap.
    """
    steps = np.diff(t)
    gaps = steps > LONGEST_STEP * np.median(steps)
    if not gaps.any():
        return [(0, len(t))]
    beside = np.minimum(np.append(np.inf, steps[:-1]), np.append(steps[1:], np.inf))
    cuts = np.flatnonzero(gaps & (steps > LONGEST_STEP * beside)) + 1
    return list(pairwise([0, *cuts.tolist(), len(t)]))


def mean_step(*times: Float[np.ndarray, " _"]) -> float:
    """Mean step of the times of one record or several, in their unit, gaps left out."""
    spans = [(t[b - 1] - t[a], b - 1 - a) for t in times for a, b in between_gaps(t)]
    duration, n_steps = np.sum(spans, axis=0)
    return float(duration / n_steps)


def describe_gaps(t: Float[np.ndarray, " kept"], n_samples: int, clock: Clock) -> str:
    """Message with the number of missing samples and the longest gap.

    t: times of the samples that are left, in s. n_samples: number of samples before.
    """
    longest, usual = float(np.diff(t).max()), usual_step(t)
    return (
        f"{n_samples - len(t)} of {n_samples} samples are missing (NaN) and left out; the longest "
        f"gap is {clock.duration_text(longest, digits=4)}, {longest / usual:.0f} times the usual "
        "step: crop the record if that is long next to its period, or fill it with "
        "ep2sindy.data.interpolate"
    )


def describe_breaks(t: Samples, clock: Clock) -> str:
    """Message with the number of gaps in the times of a record, and the longest; "" for none."""
    n_gaps, steps = len(between_gaps(t)) - 1, np.diff(t)
    if not n_gaps:
        return ""
    k = int(steps.argmax())
    longest, at, usual = (
        clock.duration_text(time, digits=4) for time in (steps[k], t[k], usual_step(t))
    )
    return (
        f"the record has {n_gaps} gap{'s' * (n_gaps > 1)}: {longest} pass after sample {k + 1}, at "
        f"{at}, where steps are {usual}; nothing is filled in"
    )


def describe_missing(t: Samples, absent: Mapping[str, Mask], clock: Clock) -> str:
    """Message with the number of missing samples of every column, and its longest gap.

    t: times in s. absent: column -> true where it holds a NaN.
    """
    parts = []
    for name, lacks in absent.items():
        if lacks.any():
            longest = float(np.diff(t[~lacks]).max(initial=0.0))
            gap = clock.duration_text(longest, digits=4)
            parts.append(f"{name} {int(lacks.sum())}, its longest gap is {gap}")
    return (
        f"of {len(t)} samples are missing (NaN): {'; '.join(parts)}. A search of trajectories does "
        "without them, others leave the samples out: fill them with ep2sindy.data.interpolate"
    )
