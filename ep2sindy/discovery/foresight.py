"""Whether a signal shows more than a linear autoregression foresees; asked before any search."""

from __future__ import annotations

from ep2sindy.forecasting.baselines import AUTOREGRESSION, NEIGHBOURS, baseline_errors
from ep2sindy.signals.signal import Signal

# Error of neighbours, in standard deviations, at which a signal is no longer foreseen: halfway to
# the mean, whose error is one.
HALF = 0.5

AHEAD = 0.5  # turns ahead for which neighbours are chosen
N_STARTS = 100

# Of fewer turns, a moment may have no neighbours, and nothing is reported.
ENOUGH_TURNS = 20.0

# What a signal with a law of few states shows: neighbours that continue alike for a quarter of a
# turn, or that are nearer than a linear autoregression for so long.
TURN, NEARER = 0.25, 0.9


def is_linear(signal: Signal) -> bool:
    """Whether what followed the most similar moments tells no more than a linear autoregression.

    The second half of the signal is forecast from its own past, by neighbours in the first. They
    end within a quarter of a turn, and are no nearer there than the autoregression. No exact
    trajectory of a few states continues like that, unless noise drowns it. False for signals that
    repeat themselves, are driven by inputs, or have under twenty turns: they are not looked at.
    """
    if signal.repeats or signal.run.input_names or signal.n_periods < ENOUGH_TURNS:
        return False
    n, turn = len(signal.t), max(1, round(TURN * signal.per_period))
    longest = min(max(1, round(AHEAD * signal.per_period)), n // 4)
    errors = baseline_errors(
        signal.run, [signal.name], n_fitted=n // 2, longest=longest, starts=N_STARTS
    )
    if not {NEIGHBOURS, AUTOREGRESSION} <= set(errors):
        return False
    near, linear = errors[NEIGHBOURS][:turn], errors[AUTOREGRESSION][:turn]
    return bool((near > HALF).any() and near.mean() > NEARER * linear.mean())
