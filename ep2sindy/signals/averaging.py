"""Long records as means over neighbouring samples: over how many, and the means themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ep2sindy.data.gaps import between_gaps, mean_step
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.runtime.values import Columns, Samples
from ep2sindy.signals.attractor import find_cycle
from ep2sindy.signals.spectrum import crossing_frequency, lost_in_means

# Samples per period that resolve a breathing mode; more samples cost time and follow the noise.
ENOUGH_SAMPLES = 100

# Fewest samples per period that a look at means must show: with fewer, they may be aliased.
LEAST_SHOWN = 24

# Samples of the first look at a long record, which finds out how many may be averaged.
FIRST_LOOK = 50_000

# Samples of all records together from which a search by `discover` takes minutes.
LONG = 20_000

# Largest fraction of the power above the noise that means may take from a variable of a long
# record. At a hundred samples to a period they take 3e-8 of a sine, and 2e-6 of its third harmonic.
LOST = 1e-6


def average_alike(
    runs: Sequence[Trajectory], decimate: int | str | None
) -> tuple[list[Trajectory], tuple[str, ...]]:
    """Runs with their samples replaced by means over neighbours, and what was done, in words.

    decimate: number of samples that a mean is over; "auto" leaves a hundred to a period of the
    fastest state, None leaves all. States and inputs are averaged alike: the mean of a state
    follows the mean of what drives it. No mean crosses a gap, and an incomplete group at the end of
    a segment is dropped. Runs with missing samples stay as they are, since those of a slower
    channel would be averaged over other times.
    Raises ValueError for another `decimate`.
    """
    if not (decimate is None or decimate == "auto" or (type(decimate) is int and decimate >= 1)):
        raise ValueError(
            f"decimate must be auto, null or a whole number, one or more: got {decimate!r}"
        )
    if any(run.missing is not None for run in runs):
        return list(runs), ()
    factor = min(map(count_spare, runs)) if decimate == "auto" else int(decimate or 1)
    return _in_means(runs, factor)


def average_long(
    runs: Sequence[Trajectory], decimate: int | str | None
) -> tuple[list[Trajectory], tuple[str, ...]]:
    """`average_alike`; "auto" leaves short records, and keeps what is fast next to the period.

    Records are long if they hold over twenty thousand samples together. Means may take a millionth
    of the power of a state that stands out of the noise, and no more.
    """
    if decimate != "auto":
        return average_alike(runs, decimate)
    if sum(run.n_samples for run in runs) <= LONG or any(r.missing is not None for r in runs):
        return list(runs), ()
    factor = min(map(count_spare, runs))
    while factor > 1 and max(_lost(run, factor) for run in runs) > LOST:
        factor = 3 * factor // 4
    fewer, words = _in_means(runs, factor)
    return fewer, tuple(f"{each}; decimate=None takes all samples" for each in words)


def count_spare(run: Trajectory) -> int:
    """Number of samples to average, so that a hundred are left in a period of the fastest state.

    A state without a cycle counts by the rate at which it rises through its mean. A long record is
    looked at in means first. If they show too few samples to a period to decide, all samples are
    taken.
    """
    for coarse in dict.fromkeys((max(1, run.n_samples // FIRST_LOOK), 1)):
        rough = _means(run, coarse)
        per_period = min(_samples_in_period(rough.t, x) for x in rough.states.T)
        if per_period > LEAST_SHOWN:
            return max(1, round(coarse * per_period) // ENOUGH_SAMPLES)
    return 1


def _samples_in_period(t: Samples, x: Samples) -> float:
    """Mean number of samples in a period, or from one rise to the next; zero without a rise."""
    cycle = find_cycle(t, x[:, None])
    frequency_Hz = crossing_frequency(t, x) if cycle is None else cycle.frequency_Hz
    return 1.0 / (frequency_Hz * mean_step(t)) if frequency_Hz > 0.0 else 0.0


def _lost(run: Trajectory, factor: int) -> float:
    """Largest fraction of a state's power that means over so many samples take from it."""
    return max(lost_in_means(run.t, x, width_s=factor * run.dt_s) for x in run.states.T)


def _in_means(runs: Sequence[Trajectory], factor: int) -> tuple[list[Trajectory], tuple[str, ...]]:
    if factor < 2:
        return list(runs), ()
    fewer = [_means(run, factor) for run in runs]
    n_left = sum(run.n_samples for run in fewer)
    return fewer, (f"means over {factor} samples: {n_left} are left",)


def _means(run: Trajectory, factor: int) -> Trajectory:
    """Means over `factor` consecutive samples of every segment between gaps."""

    def mean(values: np.ndarray) -> np.ndarray:
        parts = []
        for start, stop in between_gaps(run.t):
            n = (stop - start) // factor
            part = values[start : start + n * factor]
            parts.append(part.reshape(n, factor, *values.shape[1:]).mean(axis=1))
        return np.concatenate(parts)

    inputs = mean(_centred(run.inputs))
    return replace(run, t=mean(run.t), states=mean(run.states), inputs=inputs)


def _centred(inputs: Columns) -> Columns:
    """Inputs as they are on average over a step about every sample.

    One that most samples repeat is held from each to the next, so half of that step lies before.
    """
    steps = np.diff(inputs, axis=0, prepend=inputs[:1])
    held = (steps == 0.0).mean(axis=0) > 0.5
    return inputs - 0.5 * np.where(held, steps, 0.0)
