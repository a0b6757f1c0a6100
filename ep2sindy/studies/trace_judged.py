"""What a model of one signal is judged on: the end of its record, and starts off its cycle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.model.stability import LimitCycle
from ep2sindy.signals.trace import LEAST_PERIODS, Trace

LEAST_JUDGED = 4.0  # periods of the end of a record, to be held out

N_PERIODS = 12.0  # of a run from another start

STARTS = (0.3, 0.6, 1.4, 0.6, 1.4)  # distances from the cycle's middle, in those of its states


def fitted_samples(signal: Trace, states: Trajectory, held_out: float) -> int:
    """Samples to fit: all of a record too short for a part of it to be held out."""
    n_fitted = round((1.0 - held_out) * states.n_samples)
    periods = states.dt_s / signal.period_s * np.array([n_fitted, states.n_samples - n_fitted])
    enough = periods[0] >= LEAST_PERIODS + 0.5 and periods[1] >= LEAST_JUDGED
    return n_fitted if enough else states.n_samples


def as_measured(signal: Trace, held: Trajectory) -> Trajectory:
    """Held-out states with the samples of the signal in place of the smoothed ones."""
    first = int(np.searchsorted(signal.t, held.t[0] - 1e-6 * held.dt_s))
    states = held.states.copy()
    states[:, 0] = signal.x[first : first + held.n_samples]
    return replace(held, states=states)


def paths_off(model: SparseModel, cycle: LimitCycle) -> list[Rollout]:
    """Runs from states off the cycle: nearer to its middle, and farther."""
    middle = cycle.states.mean(axis=0)
    t = np.linspace(0.0, N_PERIODS * cycle.period_s, round(100 * N_PERIODS))
    places = np.arange(len(STARTS)) * len(cycle.states) // len(STARTS)
    found = []
    for state, factor in zip(cycle.states[places], STARTS, strict=True):
        start = middle + factor * (state - middle)
        start[0] = _inside(start[0], cycle.states[:, 0])
        found.append(model.simulate(t, start, blow_up=30.0))
    return found


def _inside(value: float, states: np.ndarray) -> float:
    """A start with the sign that the signal has on the cycle, if it has one."""
    return max(value, 0.5 * float(states.min())) if (states > 0.0).all() else value
