"""Whether a record oscillates: one measure, and the bounds that each use sets.

Two related questions have measures of their own. `attractor.find_cycle` asks whether a record
repeats one waveform, which chaos does not though it oscillates; `operating.map` asks what a model
does that runs from a start, and has a fixed point and the stability of its cycle to judge by.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.signals.spectrum import peak, power_spectrum

PEAK_WIDTH = 0.05  # of the frequency, or two bins if these are more, to either side of a peak

DIED_OUT = 0.1  # of a record's spread: what varies less in the second half has died out


class Oscillation(StrEnum):
    """What a record does, as tables and summaries have it; `oscillating`, or why it says nothing.

    steady: it hardly varies. decaying: it varied much more before. no dominant frequency: its
    spectrum has no peak, or it is too short. transit: it oscillates, faster than what is looked
    for. no period: it oscillates without repeating a waveform. diverged: it broke off.
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
    """What counts as an oscillation.

    The record is cut into `n_blocks` of time, and the last is looked at. spread: least standard
    deviation of every state, in means. lasting: least share of the first block's standard deviation
    that is left. min_periods: of the whole record. min_peak: share of the first state's power at
    its dominant frequency. max_Hz: highest dominant frequency.
    """

    spread: float
    lasting: float
    n_blocks: int = 2
    min_periods: float = 0.0
    min_peak: float = 0.0
    max_Hz: float = np.inf


# Any record. Fewer than four periods may be a drift. White noise has a tenth of its power near the
# highest peak at most, the thruster's breathing two thirds.
RECORDED = OscillationBounds(spread=0.01, lasting=0.5, min_periods=4.0, min_peak=0.2)
# A simulated current after its transient: without noise, so that a peak needs no proof, but some
# sets of parameters oscillate for long and die in the end.
SIMULATED = OscillationBounds(spread=0.02, lasting=0.7, n_blocks=4)


def oscillation(
    t: Float[np.ndarray, " samples"],
    states: Float[np.ndarray, "samples n_states"],
    bounds: OscillationBounds = RECORDED,
) -> Oscillation:
    """Say whether a record oscillates; the first bound that it does not keep is the answer."""
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
    """Standard deviation of every state over the size of its mean."""
    return states.std(axis=0) / np.maximum(np.abs(states.mean(axis=0)), np.finfo(float).tiny)


def has_decayed(
    states: Float[np.ndarray, "samples n_states"],
    earlier: Float[np.ndarray, "_ n_states"],
    share: float,
) -> Bool[np.ndarray, " n_states"]:
    """Whether every state varies by less than a share of what it did earlier, or elsewhere."""
    below: np.ndarray = states.std(axis=0) < share * earlier.std(axis=0)
    return below


def relative_amplitude(
    mean: Float[np.ndarray, " n_states"], std: Float[np.ndarray, " n_states"]
) -> float:
    """Root mean square over the states of standard deviation over the size of the mean."""
    return float(np.sqrt(np.square(std / zero_to_one(np.abs(mean))).mean()))
