"""How far a signal can be foreseen without a model, and whether a law may be found in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.forecasting.baselines import AUTOREGRESSION, NEIGHBOURS, baseline_errors
from ep2sindy.signals.trace import Trace

# Error of neighbours, in standard deviations, at which a signal is no longer foreseen: halfway to
# the mean, whose error is one.
HALF = 0.5

SHORT, LONG = 0.5, 2.0  # turns ahead for which neighbours are asked, the second if need be
N_STARTS = 100

# Of fewer turns, a moment may have no neighbours, and nothing is said.
ENOUGH_TURNS = 20.0

# What a signal with a law of few states shows: neighbours that go on alike for a quarter of a turn,
# or that are nearer than a linear autoregression for so long.
TURN, NEARER = 0.25, 0.9


@dataclass(frozen=True)
class Foresight:
    """How far a signal can be foreseen by what followed its own past that was most like the last.

    ahead: number of samples up to which these forecasts are off by no more than half of the
    standard deviation; None if they are nowhere within two turns, or if there
    are under twenty to look at.
    is_linear: whether they end within a quarter of a turn, and are no nearer there than a linear
    autoregression. No exact trajectory of a few states goes on like that, unless noise drowns it.
    """

    ahead: int | None = None
    is_linear: bool = False


def foresee(signal: Trace) -> Foresight:
    """Foresee the second half of a signal from its own past, by neighbours in the first."""
    if signal.n_periods < ENOUGH_TURNS:
        return Foresight()
    errors, turn = _errors(signal, SHORT), max(1, round(TURN * signal.per_period))
    if NEIGHBOURS in errors and (errors[NEIGHBOURS] <= HALF).all():
        errors = _errors(signal, LONG)
    if NEIGHBOURS not in errors or not (errors[NEIGHBOURS] > HALF).any():
        return Foresight()
    near, ahead = errors[NEIGHBOURS], int(np.argmax(errors[NEIGHBOURS] > HALF))
    linear = errors.get(AUTOREGRESSION, np.full(len(near), np.inf))
    is_linear = ahead < turn and near[:turn].mean() > NEARER * linear[:turn].mean()
    return Foresight(max(ahead, 1), bool(is_linear))


def _errors(signal: Trace, turns: float) -> dict[str, Float[np.ndarray, " ahead"]]:
    """Errors of forecasts without a model up to so many turns ahead."""
    n, longest = len(signal.t), max(1, round(turns * signal.per_period))
    return baseline_errors(
        signal.run, [signal.name], n_fitted=n // 2, longest=min(longest, n // 4), starts=N_STARTS
    )
