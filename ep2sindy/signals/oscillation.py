"""Whether a record holds an oscillation, or why it says nothing of one."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.signals.spectrum import dominant_frequency, power_spectrum

OSCILLATING, STEADY = "oscillating", "steady"
LEAST_SPREAD = 0.01  # of every state, in means, in the second half of the record
LEAST_SHARE = 0.5  # of the first half's standard deviation that is left in the second
LEAST_PERIODS = 4.0  # in the record: fewer may be a drift
# The spectrum's peak, 5 % or two bins to either side, must hold a fifth of the power: white noise
# has a tenth there at most, the thruster's breathing two thirds.
PEAK_WIDTH, LEAST_PEAK = 0.05, 0.2


def oscillation(run: Trajectory) -> str:
    """`oscillating`, or why a record says nothing of an oscillation.

    steady: a state varies by under 1 % of its mean in the second half. decaying: by under half of
    what it did in the first. no dominant frequency: the first state has no peak in its spectrum,
    or the record is under four of its periods.
    """
    first, second = np.array_split(run.states, 2)
    if (spread(second) < LEAST_SPREAD).any():
        return STEADY
    if (second.std(axis=0) < LEAST_SHARE * first.std(axis=0)).any():
        return "decaying"
    frequency, power = power_spectrum(run.t, run.states[:, 0])
    peak = dominant_frequency(run.t, run.states[:, 0])
    near = np.abs(frequency - peak) <= max(PEAK_WIDTH * peak, 2.0 * frequency[1])
    short = peak * (run.t[-1] - run.t[0]) < LEAST_PERIODS
    if short or power[near].sum() < LEAST_PEAK * power.sum():
        return "no dominant frequency"
    return OSCILLATING


def spread(states: Float[np.ndarray, "samples n_states"]) -> Float[np.ndarray, " n_states"]:
    """Standard deviation of every state over the size of its mean."""
    return states.std(axis=0) / np.maximum(np.abs(states.mean(axis=0)), np.finfo(float).tiny)
