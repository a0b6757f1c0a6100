"""Power spectrum and dominant frequency of a sampled signal, and whether it oscillates.

Two related questions have their own measures. `attractor.find_cycle` tests whether a record
repeats one waveform; chaos oscillates but does not repeat. `operating.map` classifies the run of a
model from a start, and can also use its fixed point and the stability of its cycle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float
from scipy import fft

from ep2sindy.data.gaps import between_gaps
from ep2sindy.data.numbers import rounding_s, zero_to_one
from ep2sindy.runtime.values import Samples

STEP_TOLERANCE = 1e-6  # largest relative spread of steps in uniform sampling

# Least mean, in standard deviations, by which an amplitude is divided. That of a growth rate or a
# derivative is zero but for noise; a train of pulses has a hundredth of its time at this mean.
LEAST_MEAN = 0.1

PEAK_WIDTH = 0.05  # half-width of a peak, as a fraction of its frequency; two bins at least

DECAYED = 0.1  # a run has decayed if its late spread is below this fraction of the data's

States = Float[np.ndarray, "samples n_states"]
ByState = Float[np.ndarray, " n_states"]
Bins = Float[np.ndarray, " bins"]
ByRecord = float | Sequence[float]  # of one record, or of several


def is_uniform(t: Samples) -> bool:
    """Return true if all time steps agree to the rounding of the recorded times."""
    steps = np.diff(t)
    return bool(np.ptp(steps) <= max(STEP_TOLERANCE * steps.mean(), 2 * rounding_s(t)))


def resample_evenly(t: Samples, x: Samples) -> Samples:
    """Samples at equal steps, the mean of the given ones, by cubic splines between gaps.

    A gap is bridged by a straight line: a spline would overshoot there.
    """
    from scipy.interpolate import make_interp_spline  # imported only for unequal steps

    even = np.linspace(t[0], t[-1], len(t))
    values = np.interp(even, t, x)
    for start, stop in between_gaps(t):
        own, degree = t[start:stop], min(3, stop - start - 1)
        inside = (even >= own[0]) & (even <= own[-1])
        if degree > 1:
            values[inside] = make_interp_spline(own, x[start:stop], k=degree)(even[inside])
    return values


def power_spectrum(t: Samples, x: Samples) -> tuple[Bins, Bins]:
    """One-sided power spectral density of x, with the mean removed and a Hann window.

    t: (samples,) in s. Samples at unequal steps are first resampled at the mean step: by cubic
    splines, and by straight lines across gaps.
    Returns frequencies in Hz and power density in u^2/Hz.
    """
    if not is_uniform(t):
        x = resample_evenly(t, x)
    rate_Hz = (len(t) - 1) / (t[-1] - t[0])
    # As scipy.signal.periodogram has it, whose import takes half a second.
    window = 0.5 + 0.5 * np.cos(np.linspace(-np.pi, np.pi, len(x) + 1)[:-1])
    strength = np.cumsum(window**2)[-1]  # summed in order, to match SciPy to the last digit
    transform = fft.rfft((x - x.mean()) * (window * (1.0 / np.sqrt(strength * rate_Hz))))
    power = transform.real**2 + transform.imag**2
    paired = len(power) - 1 + len(x) % 2
    power[1:paired] *= 2.0  # add the negative frequencies
    return fft.rfftfreq(len(x), 1.0 / rate_Hz), power


def dominant_frequency(t: Samples, x: Samples) -> float:
    """Frequency in Hz of the highest spectral peak, refined between bins.

    A parabola is fitted to the log power of the peak bin and its neighbours. For a Hann window
    and a pure tone the error is below 2 % of a bin. Zero for a constant signal.
    """
    return peak(*power_spectrum(t, x))


def steps_in(periods: float, *, frequency_Hz: ByRecord, dt_s: ByRecord) -> float:
    """Number of time steps in the given number of periods, not rounded; median over records."""
    return float(np.median(periods / (np.asarray(frequency_Hz) * np.asarray(dt_s))))


def samples_in_periods(periods: float, *, frequency_Hz: ByRecord, dt_s: ByRecord) -> int:
    """Number of samples in the given number of periods, both ends included; median over records."""
    return round(steps_in(periods, frequency_Hz=frequency_Hz, dt_s=dt_s)) + 1


def peak(frequency: Bins, power: Bins) -> float:
    """Frequency in Hz of the highest peak of a power spectrum; see `dominant_frequency`."""
    if len(power) < 4 or power.max() <= 0.0:
        return 0.0
    k = int(np.clip(np.argmax(power[1:]) + 1, 2, len(power) - 2))
    left, centre, right = np.log(np.maximum(power[k - 1 : k + 2], np.finfo(float).tiny))
    curvature = left - 2 * centre + right
    shift = 0.5 * (left - right) / curvature if curvature < 0 else 0.0
    return float(frequency[k] + np.clip(shift, -0.5, 0.5) * frequency[1])


def noise_floor(power: Bins) -> float:
    """Power density of white noise, from the upper half of a spectrum.

    It is the median there, which spectral lines of a signal hardly change.
    """
    upper = power[len(power) // 2 :]
    return float(np.median(upper) / np.log(2.0)) if upper.size else 0.0


def _above_noise(power: Bins) -> Bins:
    """Power density that stands out of the noise floor; zero where none does."""
    floor = noise_floor(power)
    # The largest of n exponential variables exceeds log n + 3 once in twenty records.
    stands_out = power > floor * (np.log(max(len(power), 2)) + 3.0)
    return np.where(stands_out, power - floor, 0.0)


def crossing_frequency(t: Samples, x: Samples) -> float:
    """Mean rate in Hz at which a signal rises through its mean, white noise left out.

    The frequency of a signal without a period, by the second moment of its spectrum. Zero for a
    signal that does not stand out of the noise.
    Source: Rice 1944, doi:10.1002/j.1538-7305.1944.tb00874.x.
    """
    return float(np.sqrt(_mean_above_noise(t, x, np.square)))


def lost_in_means(t: Samples, x: Samples, *, width_s: float) -> float:
    """Fraction of a signal's power above the noise that means over a width in s take from it."""
    return _mean_above_noise(t, x, lambda f_Hz: np.square(1.0 - np.sinc(f_Hz * width_s)))


def _mean_above_noise(t: Samples, x: Samples, function: Callable[[Bins], Bins]) -> float:
    """Mean of a function of the frequency over the power above the noise; zero without any."""
    frequency, power = power_spectrum(t, x)
    excess = _above_noise(power)
    whole = float(excess.sum())
    return float((function(frequency) * excess).sum()) / whole if whole else 0.0


# Least fraction of what stands out of the noise floor that a smoother must follow.
KEPT = 0.99


def signal_memory_s(t: Samples, x: Samples) -> float:
    """Longest memory, in s, of a twice integrated Wiener process that still follows the signal.

    A smoother of memory tau passes the fraction 1 / (1 + (2 pi f tau)^6) of a component of
    frequency f. What it changes may hold no more than 1 - KEPT of the power that stands out of the
    noise floor.
    """
    frequency, power = power_spectrum(t, x)
    excess = _above_noise(power)[1:]
    if not excess.any():
        return float(t[-1] - t[0])

    def too_long(log_tau: float) -> float:
        passed = 1.0 / (1.0 + (2.0 * np.pi * frequency[1:] * np.exp(log_tau)) ** 6)
        return float((excess * np.square(1.0 - passed)).sum() / excess.sum() - (1.0 - KEPT))

    from scipy.optimize import brentq  # imported only where a smoother is bounded

    step_s = (t[-1] - t[0]) / (len(t) - 1)
    low, high = np.log(1e-3 * step_s), np.log(t[-1] - t[0])
    return float(np.exp(brentq(too_long, low, high) if too_long(high) > 0.0 else high))


# Tests whether a record oscillates, with bounds that depend on the use.


class Oscillation(StrEnum):
    """Behaviour of a record, as tables and summaries name it.

    Either `oscillating`, or the reason why the record does not count as such. steady: it hardly
    varies. decaying: it varied much more before. no dominant frequency: its spectrum has no peak,
    or it is too short. transit: it oscillates faster than the mode of interest. no period: it
    oscillates without repeating a waveform. diverged: the run ended early. out: a discharge that
    has gone out.
    """

    OSCILLATING = "oscillating"
    STEADY = "steady"
    DECAYING = "decaying"
    NO_FREQUENCY = "no dominant frequency"
    TRANSIT = "transit"
    NO_PERIOD = "no period"
    DIVERGED = "diverged"
    OUT = "out"


@dataclass(frozen=True)
class OscillationBounds:
    """Bounds that a record must satisfy to count as oscillating.

    The record is cut into `n_blocks` of time, and the last one is tested. spread: least standard
    deviation of every state, in units of its mean. lasting: least ratio of the last block's
    standard deviation to the first block's. min_periods: least number of periods in the whole
    record. min_peak: least fraction of the first state's power at its dominant frequency. max_Hz:
    highest dominant frequency.
    """

    spread: float
    lasting: float
    n_blocks: int = 2
    min_periods: float = 0.0
    min_peak: float = 0.0
    max_Hz: float = np.inf


# Bounds for any record. Fewer than four periods may be a drift. White noise has at most a tenth of
# its power near the highest peak, the thruster's breathing mode two thirds.
RECORDED = OscillationBounds(spread=0.01, lasting=0.5, min_periods=4.0, min_peak=0.2)
# Bounds for a simulated current after its transient. It has no noise, so no peak is required, but
# with some parameters it oscillates for a long time and finally decays.
SIMULATED = OscillationBounds(spread=0.02, lasting=0.7, n_blocks=4)


def oscillation(t: Samples, states: States, bounds: OscillationBounds = RECORDED) -> Oscillation:
    """Classify a record by the first bound that it violates; `oscillating` if it violates none."""
    blocks = np.array_split(states, bounds.n_blocks)
    if (over_mean(blocks[-1].mean(axis=0), blocks[-1].std(axis=0)) < bounds.spread).any():
        return Oscillation.STEADY
    if has_decayed(blocks[-1], blocks[0], bounds.lasting).any():
        return Oscillation.DECAYING
    frequency, power = power_spectrum(t, states[:, 0])
    peak_Hz = peak(frequency, power)
    if peak_Hz * (t[-1] - t[0]) < bounds.min_periods:
        return Oscillation.NO_FREQUENCY
    if bounds.min_peak > 0.0:
        near = np.abs(frequency - peak_Hz) <= max(PEAK_WIDTH * peak_Hz, 2.0 * frequency[1])
        if power[near].sum() < bounds.min_peak * power.sum():
            return Oscillation.NO_FREQUENCY
    return Oscillation.TRANSIT if peak_Hz > bounds.max_Hz else Oscillation.OSCILLATING


def has_decayed(
    states: States, earlier: Float[np.ndarray, "_ n_states"], fraction: float
) -> Bool[np.ndarray, " n_states"]:
    """True for each state whose standard deviation is below `fraction` times that of `earlier`."""
    return np.less(states.std(axis=0), fraction * earlier.std(axis=0))


def over_mean(mean: ByState, std: ByState) -> ByState:
    """Standard deviation over absolute mean of every state; NaN of one that swings around zero."""
    size = np.abs(mean)
    return np.where(size < LEAST_MEAN * std, np.nan, std / zero_to_one(size))


def relative_amplitude(mean: ByState, std: ByState) -> float:
    """Root mean square of `over_mean` over the states that have it; NaN if none has."""
    ratio = over_mean(mean, std)
    known = ratio[~np.isnan(ratio)]
    return float(np.sqrt(np.square(known).mean())) if known.size else float("nan")
