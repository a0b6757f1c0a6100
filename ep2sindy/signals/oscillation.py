"""Test whether a record oscillates, with bounds that depend on the use.

Two related questions have their own measures. `attractor.find_cycle` tests whether a record
repeats one waveform; chaos oscillates but does not repeat. `operating.map` classifies the run of a
model from a start, and can also use its fixed point and the stability of its cycle.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.signals.spectrum import peak, power_spectrum

PEAK_WIDTH = 0.05  # half-width of a peak, as a share of its frequency; two bins at least

DIED_OUT = 0.1  # a run has died out if its late spread is below this share of the data's


class Oscillation(StrEnum):
    """Behaviour of a record, as tables and summaries name it.

    Either `oscillating`, or the reason why the record does not count as such. steady: it hardly
    varies. decaying: it varied much more before. no dominant frequency: its spectrum has no peak,
    or it is too short. transit: it oscillates faster than the mode of interest. no period: it
    oscillates without repeating a waveform. diverged: the run ended early.
    """

    OSCILLATING = "oscillating"
    STEADY = "steady"
    DECAYING = "decaying"
    NO_FREQUENCY = "no dominant frequency"
    TRANSIT = "transit"
    NO_PERIOD = "no period"
    DIVERGED = "diverged"


@dataclass(frozen=True)
class OscillationBounds:
    """Bounds that a record must satisfy to count as oscillating.

    The record is cut into `n_blocks` of time, and the last one is tested. spread: least standard
    deviation of every state, in units of its mean. lasting: least ratio of the last block's
    standard deviation to the first block's. min_periods: least number of periods in the whole
    record. min_peak: least share of the first state's power at its dominant frequency. max_Hz:
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


def oscillation(
    t: Float[np.ndarray, " samples"],
    states: Float[np.ndarray, "samples n_states"],
    bounds: OscillationBounds = RECORDED,
) -> Oscillation:
    """Classify a record by the first bound that it violates; `oscillating` if it violates none."""
    blocks = np.array_split(states, bounds.n_blocks)
    if (relative_spread(blocks[-1]) < bounds.spread).any():
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


def relative_spread(
    states: Float[np.ndarray, "samples n_states"],
) -> Float[np.ndarray, " n_states"]:
    """Standard deviation of every state divided by the absolute value of its mean."""
    return states.std(axis=0) / np.maximum(np.abs(states.mean(axis=0)), np.finfo(float).tiny)


def has_decayed(
    states: Float[np.ndarray, "samples n_states"],
    earlier: Float[np.ndarray, "_ n_states"],
    share: float,
) -> Bool[np.ndarray, " n_states"]:
    """True for each state whose standard deviation is below `share` times that of `earlier`."""
    below: np.ndarray = states.std(axis=0) < share * earlier.std(axis=0)
    return below


def relative_amplitude(
    mean: Float[np.ndarray, " n_states"], std: Float[np.ndarray, " n_states"]
) -> float:
    """Root mean square over the states of standard deviation divided by absolute mean."""
    return float(np.sqrt(np.square(std / zero_to_one(np.abs(mean))).mean()))
