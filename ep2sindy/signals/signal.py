"""Checks and preparation of one measured signal: oscillation, sampling, drift.

Long records become means over neighbouring samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ep2sindy.data.gaps import between_gaps, mean_step
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.units import Clock
from ep2sindy.runtime.values import Columns, Samples
from ep2sindy.signals.attractor import Cycle, find_cycle, white_variance
from ep2sindy.signals.spectrum import (
    crossing_frequency,
    dominant_frequency,
    is_uniform,
    lost_in_means,
    power_spectrum,
)

MIN_PERIODS = 6.0  # fewest periods in a record on which a free run can be assessed

# Fewest samples per period: three harmonics. A signal that is sampled more rarely is aliased.
MIN_SAMPLES = 6.0

# Least standard deviation of the waveform, as a fraction of the signal's, if there is a cycle. A
# cycle found in white noise also has some.
MIN_VISIBLE = 0.5

# Fraction of white noise in the variance from which a signal without a cycle is taken for noise.
ALL_NOISE = 0.7

# A drift counts if it is certain, in standard errors, and large: as a fraction of the level that
# nine of ten samples of a positive signal exceed, or of the standard deviation of any other.
CERTAIN, DRIFT = 5.0, 0.1

# Most digits of times that count as rounded, and how far off a rounded time may be, in units of its
# last digit: half of it, and a little for the fit of the even times.
MOST_DIGITS, ROUNDED = 9, 0.8

JITTER = 0.02  # largest deviation from even times, in steps, that changes nothing

# Limits for a signal that is positive apart from noise: how far a sample may lie below zero, in
# standard deviations of the noise, and the fraction of samples that may.
NOISE_BELOW, FRACTION_BELOW = 6.0, 0.05


@dataclass(frozen=True, eq=False)
class Signal:
    """An oscillating signal of at least six periods.

    run: the signal as a run of one state, with the inputs that drive it. frequency_Hz: of its
    cycle, or the mean rate at which it rises through its mean. cycle: None for a signal that
    oscillates without repeating itself, such as chaos. done: processing already applied to the
    samples, in words. advice: processing that is recommended.
    """

    run: Trajectory
    frequency_Hz: float
    cycle: Cycle | None = None
    done: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()

    @property
    def t(self) -> Samples:
        return self.run.t

    @property
    def x(self) -> Samples:
        """The samples, in `unit`."""
        return self.run.states[:, 0]

    @property
    def name(self) -> str:
        return self.run.state_names[0]

    @property
    def unit(self) -> str:
        return self.run.units[self.name]

    @property
    def clock(self) -> Clock:
        return self.run.clock

    @property
    def period_s(self) -> float:
        return 1.0 / self.frequency_Hz

    def window(self, start: int, stop: int) -> Signal:
        """Samples from `start` to `stop` (exclusive), with the frequency of the whole."""
        return replace(self, run=self.run.window(start, stop), done=(), advice=())

    @property
    def n_periods(self) -> float:
        return float(self.t[-1] - self.t[0]) * self.frequency_Hz

    @property
    def repeats(self) -> bool:
        """Whether it repeats one cycle, or else is chaos, or grows or decays."""
        return self.cycle is not None and self.cycle.repeats

    @property
    def per_period(self) -> float:
        """Mean number of samples in a period."""
        return self.period_s / mean_step(self.t)

    @property
    def is_positive(self) -> bool:
        return is_positive(self.t, self.x)


def prepare_signal(
    run: Run,
    signal: str | None = None,
    *,
    decimate: int | str | None = "auto",
    detrend: bool | str = "auto",
) -> Signal:
    """Make a trace of one variable of a run.

    Parameters
    ----------
    run : run
        A run as `discover` takes it. Its inputs stay next to the signal.
    signal : str, optional
        Name of the variable. None takes the only state.
    decimate : int, "auto" or None, default "auto"
        Number of samples that are replaced by their mean. "auto" leaves a hundred per period, None
        takes all samples.
    detrend : bool or "auto", default "auto"
        Whether the straight line that the signal follows next to its cycle is subtracted; the mean
        stays. "auto" does so if the line is certain, and large compared with the troughs of a
        positive signal or with the standard deviation of any other.

    Returns
    -------
    Signal
        The trace, with its period and noise.

    Raises
    ------
    ValueError
        If the signal does not oscillate, holds under six periods or under six samples a period, or
        a setting is wrong.

    Examples
    --------
    >>> t = np.linspace(0.0, 1e-3, 2001)
    >>> ep.signals.prepare_signal(ep.Trajectory(t, 3 + np.sin(6e4*t)[:, None], ["I"])).is_positive
    True
    """
    run = trajectory_of(run)
    name = run.state_names[0] if signal is None and len(run.state_names) == 1 else signal
    if name is None:
        raise ValueError(f"one signal must be named: this run has {list(run.names)}")
    if not (isinstance(detrend, bool) or detrend == "auto"):
        raise ValueError(f"detrend must be auto, true or false: got {detrend!r}")
    t, evened = _restore_even_times(run.t)
    x, names = run.columns([name]), (name,)
    own = replace(run, t=t, states=x, state_names=names, label=name, missing=None)
    (own,), averaged = average_alike([own], decimate)
    t, x = own.t, own.states[:, 0]
    cycle = find_cycle(t, x[:, None])
    x, straightened, drifting = _remove_drift(t, x, name, cycle, detrend)
    cycle = find_cycle(t, x[:, None]) if straightened else cycle
    if cycle is not None and cycle.std[0] < MIN_VISIBLE * x.std():
        cycle = None
    frequency_Hz = crossing_frequency(t, x) if cycle is None else cycle.frequency_Hz
    own = replace(own, states=x[:, None])
    done = (*evened, *straightened, *averaged)
    found = Signal(own, frequency_Hz, cycle, done, drifting)
    _check_oscillation(found)
    return found


def is_positive(t: Samples, x: Samples) -> bool:
    """Return true if the signal is positive at all times, apart from white noise in its samples."""
    lowest = float(x.min())
    if lowest > 0.0:
        return True
    noise = float(np.sqrt(white_variance(*power_spectrum(t, x))))
    explained = noise > 1e-3 * x.std() and lowest > -NOISE_BELOW * noise
    return bool(explained and x.mean() > 0.0 and (x <= 0.0).mean() <= FRACTION_BELOW)


def _restore_even_times(t: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Even times if the recorded ones are their rounding to a few digits, and what was done."""
    if is_uniform(t):
        return t, ()
    even = np.polynomial.Polynomial.fit(np.arange(len(t)), t, 1)(np.arange(len(t)))
    if np.abs(t - even).max() <= JITTER * (even[1] - even[0]):
        return even, ()
    with np.errstate(divide="ignore"):
        size = 10.0 ** np.floor(np.log10(np.where(t == 0.0, np.nan, np.abs(t))))
    for digits in range(2, MOST_DIGITS):
        quantum = np.nan_to_num(size * 10.0 ** (1 - digits), nan=np.nanmin(size) * 0.1)
        if (np.abs(np.round(t / quantum) * quantum - t) <= 1e-6 * quantum).all():
            is_even = (np.abs(t - even) <= ROUNDED * quantum).all()
            words = f"times rounded to {digits} digits taken as equal steps"
            return (even, (words,)) if is_even else (t, ())
    return t, ()


def _check_oscillation(signal: Signal) -> None:
    """Raise ValueError for a signal that does not oscillate, or not often or not finely enough."""
    name, clock = signal.name, signal.clock
    duration = clock.duration_text(float(signal.t[-1] - signal.t[0]), digits=4)
    n_periods = signal.n_periods
    if 0.5 < n_periods < MIN_PERIODS:
        doubt = " if it oscillates at all" if signal.cycle is None else ""
        raise ValueError(
            f"a trace must hold {MIN_PERIODS:g} periods or more: {name} holds about "
            f"{n_periods:.1f} in {duration}{doubt}; record longer, or crop less"
        )
    is_noise = white_variance(*power_spectrum(signal.t, signal.x)) > ALL_NOISE * signal.x.var()
    if n_periods < MIN_PERIODS or (signal.cycle is None and is_noise):
        raise ValueError(
            f"a trace must oscillate: no period explains a quarter of the variance of {name} over "
            f"its {duration} (strongest line: {clock.frequency_text(signal.frequency_Hz)}), and "
            "most of it is white noise; crop transients, prepare it with "
            "ep2sindy.data.low_pass, or take another signal"
        )
    if signal.per_period < MIN_SAMPLES:
        raise ValueError(
            f"a trace must be sampled {MIN_SAMPLES:g} times a period or more: {name} has "
            f"{signal.per_period:.1f} samples to a period of "
            f"{clock.duration_text(signal.period_s, digits=4)}, so that all above its harmonic "
            f"number {signal.per_period / 2.0:.1f} is aliased to lower frequencies; sample faster"
        )


def _remove_drift(
    t: np.ndarray, x: np.ndarray, name: str, cycle: Cycle | None, detrend: bool | str
) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """The signal without its drift, what was done, and what is advised, in words."""
    rise, error = _fit_drift(t, x, cycle)
    fraction = abs(rise) / _measure_level(t, x)
    counts = abs(rise) > CERTAIN * error and fraction > DRIFT
    if detrend is True or (detrend == "auto" and counts and cycle is not None):
        line = rise * ((t - t[0]) / (t[-1] - t[0]) - 0.5)
        return x - line, (f"a straight line taken out, which rises by {rise:.3g}",), ()
    if not counts:
        return x, (), ()
    advice = (
        f"{name} drifts by {rise:.3g} over the record, {100.0 * fraction:.0f} % of its "
        f"{'troughs' if is_positive(t, x) else 'standard deviation'}: detrend=true takes a "
        "straight line out"
    )
    return x, (), (advice,)


def _fit_drift(t: np.ndarray, x: np.ndarray, cycle: Cycle | None) -> tuple[float, float]:
    """Rise over the record of the line that x follows next to its cycle, and its standard error.

    What remains lasts over many samples, so its means over periods are the independent data.
    """
    along = (t - t[0]) / (t[-1] - t[0]) - 0.5
    rest, n = x - x.mean(), 0.0
    if cycle is not None:
        rest, n = x - cycle.waveform(cycle.phase)[:, 0], cycle.n_periods
    n = n or max(dominant_frequency(t, x) * float(t[-1] - t[0]), 1.0)
    parts = max(4, min(int(n), len(t) // 2))
    place = np.minimum((parts * (along + 0.5)).astype(np.int64), parts - 1)
    counts = np.bincount(place, minlength=parts)
    kept = counts > 0
    mean_along, mean_rest = (
        np.bincount(place, weights=each, minlength=parts)[kept] / counts[kept]
        for each in (along, rest)
    )
    away = mean_along - mean_along.mean()
    rise = float(away @ mean_rest / (away @ away))
    left = mean_rest - mean_rest.mean() - rise * away
    return rise, float(np.sqrt(left @ left / max(kept.sum() - 2, 1) / (away @ away)))


def _measure_level(t: np.ndarray, x: np.ndarray) -> float:
    """Troughs of a positive signal, or the standard deviation of any other."""
    spread = float(x.std())
    return max(float(np.quantile(x, 0.1)), 1e-3 * spread) if is_positive(t, x) else spread


# Long records as means over neighbouring samples: over how many, and the means themselves.


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

Averaged = tuple[list[Trajectory], tuple[str, ...]]  # runs, and what was done, in words


def average_alike(runs: Sequence[Trajectory], decimate: int | str | None) -> Averaged:
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
    if factor < 2:
        return list(runs), ()
    fewer = [_means(run, factor) for run in runs]
    n_left = sum(run.n_samples for run in fewer)
    return fewer, (f"means over {factor} samples: {n_left} are left",)


def average_long(runs: Sequence[Trajectory], decimate: int | str | None) -> Averaged:
    """`average_alike`; "auto" leaves short records, and keeps what is fast next to the period.

    Records are long if they hold over twenty thousand samples together. Means may take a millionth
    of the power of a state that stands out of the noise, and no more.
    """
    if decimate != "auto" or any(run.missing is not None for run in runs):
        return average_alike(runs, decimate)
    if sum(run.n_samples for run in runs) <= LONG:
        return list(runs), ()
    factor = min(map(count_spare, runs))
    while factor > 1 and max(_lost(run, factor) for run in runs) > LOST:
        factor = 3 * factor // 4
    fewer, words = average_alike(runs, factor)
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
