"""What came twice: a state that is another one, and samples that two runs share."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory

SAME = 1e-12  # of a state's variance, that rounding leaves of an exact copy
FEWEST_SHARED = 8  # samples in a row: rounded ones come again by chance


def check_repeats(runs: Sequence[Trajectory]) -> None:
    """Raise ValueError for a state that is another one, but for its scale and zero, and for runs
    that share samples: coefficients of the one are arbitrary, intervals of the other too small."""
    _check_states(runs)
    begin = np.array([run.states[0, 0] for run in runs])
    for i, run in enumerate(runs):
        for start in np.flatnonzero(np.isin(run.states[:, 0], np.delete(begin, i))).tolist():
            for j in np.flatnonzero(begin == run.states[start, 0]).tolist():
                if j == i or not (shared := _shared(run.states[start:], runs[j].states)):
                    continue
                names = [runs[k].label or f"run {k}" for k in (i, j)]
                raise ValueError(
                    f"every sample must come once: {shared} samples in a row stand in {names[0]!r} "
                    f"and in {names[1]!r}, which would make intervals too small; leave one run "
                    "out, or cut what they share"
                )


def _check_states(runs: Sequence[Trajectory]) -> None:
    names = runs[0].state_names
    if any(run.state_names != names for run in runs):
        return  # that is said where states are compared
    states = np.concatenate([run.states for run in runs])
    unit = (states - states.mean(axis=0)) / states.std(axis=0)
    alike = unit.T @ unit / len(unit)
    for i, j in combinations(range(len(names)), 2):
        sign = 1.0 if alike[i, j] > 0.0 else -1.0
        # The correlation has lost half the digits: what is left of a copy tells.
        if abs(alike[i, j]) < 0.999 or np.square(unit[:, j] - sign * unit[:, i]).mean() > SAME:
            continue
        factor = sign * states[:, j].std() / states[:, i].std()
        offset = states[:, j].mean() - factor * states[:, i].mean()
        shift = "" if abs(offset) < 1e-6 * states[:, j].std() else f" {offset:+.6g}"
        raise ValueError(
            f"states must differ: {names[j]} is {factor:.6g} {names[i]}{shift} at every sample, "
            f"and no data tell which of them a term holds; leave {names[j]} out"
        )


def _shared(first: Float[np.ndarray, "n d"], second: Float[np.ndarray, "m d"]) -> int:
    """How many samples both begin with, if that is all that the shorter one has; else none."""
    n = min(len(first), len(second))
    same = n >= FEWEST_SHARED and np.array_equal(first[:FEWEST_SHARED], second[:FEWEST_SHARED])
    return n if same and np.array_equal(first[:n], second[:n]) else 0
