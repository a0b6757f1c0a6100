"""How far a signal can be foreseen without a model, and whether a law may be found in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ep2sindy.forecasting.baselines import AUTOREGRESSION, NEIGHBOURS, baseline_errors
from ep2sindy.signals.trace import Trace

# Error of neighbours, in standard deviations, at which a signal is no longer foreseen: halfway to
# the mean, whose error is one.
HALF = 0.5

LONGEST = 1.5  # periods ahead for which neighbours are asked
N_STARTS = 100

# What a signal with a law of few states shows: neighbours that go on alike for a quarter of a turn,
# or that are nearer than a linear autoregression for so long; with fewer turns to look at, there
# may be no neighbours.
TURN, NEARER, ENOUGH_TURNS = 0.25, 0.9, 20.0


@dataclass(frozen=True)
class Foresight:
    """How far a signal can be foreseen by what followed its own past that was most like the last.

    ahead: number of samples up to which these forecasts are off by no more than half of the
    standard deviation; None if they are nowhere within one and a half periods, or cannot be made.
    is_linear: whether they end within a quarter of a turn, and are no nearer there than a linear
    autoregression. No exact trajectory of a few states goes on like that, unless noise drowns it.
    """

    ahead: int | None = None
    is_linear: bool = False


def foresee(signal: Trace) -> Foresight:
    """Foresee the second half of a signal from its own past, by neighbours in the first."""
    n, per_period = len(signal.t), signal.per_period
    longest = max(1, min(round(LONGEST * per_period), n // 4))
    errors = baseline_errors(
        signal.run, [signal.name], n_fitted=n // 2, longest=longest, starts=N_STARTS
    )
    if NEIGHBOURS not in errors or not (lost := np.flatnonzero(errors[NEIGHBOURS] > HALF)).size:
        return Foresight()
    ahead, turn = max(int(lost[0]), 1), max(1, round(TURN * per_period))
    near, linear = (
        errors[k][:turn].mean() if k in errors else np.inf for k in (NEIGHBOURS, AUTOREGRESSION)
    )
    few = signal.n_periods < ENOUGH_TURNS
    return Foresight(ahead, bool(lost[0] < turn and near > NEARER * linear and not few))
