"""Forecasts without a model of the system, which a model must beat to be worth anything."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable
from warnings import catch_warnings, simplefilter

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.signals.attractor import Cycle, find_cycle
from ep2sindy.signals.spectrum import dominant_frequency, is_uniform

# Largest order of an autoregression of one state, and the sum of orders of one of several; samples
# that it is fitted to, from the end of the record.
MAX_ORDER, MAX_ORDERS, MAX_FITTED = 120, 40, 4000
SAMPLES_PER_COEFFICIENT = 5  # fewest, of an autoregression


@runtime_checkable
class Baseline(Protocol):
    """Interface of the baselines: forecasts of the next samples from the past alone."""

    def ahead(
        self, past: Float[np.ndarray, "samples n_states"], t: Float[np.ndarray, " samples"],
        times: Float[np.ndarray, " ahead"],
    ) -> Float[np.ndarray, "ahead n_states"]: ...  # fmt: skip


@dataclass(frozen=True)
class Persistence:
    """The last sample stays."""

    def ahead(self, past: np.ndarray, t: np.ndarray, times: np.ndarray) -> np.ndarray:
        return np.repeat(past[-1:], len(times), axis=0)


@dataclass(frozen=True, eq=False)
class Harmonics:
    """The mean waveform of a record goes on, at the phase that the last period shows."""

    cycle: Cycle

    @staticmethod
    def of(run: Trajectory) -> Harmonics | None:
        """None for a record without a period."""
        cycle = find_cycle(run.t, run.states)
        return None if cycle is None else Harmonics(cycle)

    def ahead(self, past: np.ndarray, t: np.ndarray, times: np.ndarray) -> np.ndarray:
        turns = 2.0 * np.pi * self.cycle.frequency_Hz
        late = t >= t[-1] - 1.0 / self.cycle.frequency_Hz
        shifts = 2.0 * np.pi * np.arange(72) / 72.0
        spread = np.where(self.cycle.std > 0.0, self.cycle.std, 1.0)
        off = [
            np.square((self.cycle.waveform(turns * t[late] + shift) - past[late]) / spread).sum()
            for shift in shifts
        ]
        return self.cycle.waveform(turns * times + shifts[int(np.argmin(off))])


@dataclass(frozen=True, eq=False)
class Autoregression:
    """A linear autoregression, of all states at once, whose order has the least AIC.

    constant: (n_states,). coef: (order, n_states, n_states), of the last sample first.
    """

    constant: Float[np.ndarray, " n_states"]
    coef: Float[np.ndarray, "order n_states n_states"]

    @staticmethod
    def of(run: Trajectory) -> Autoregression | None:
        """None for steps that are not equal, or too few samples."""
        d = run.states.shape[1]
        most = _largest_order(run)
        if most < 1 or not is_uniform(run.t):
            return None
        states = run.states[-MAX_FITTED:]
        mean, scale = states.mean(axis=0), zero_to_one(states.std(axis=0))
        x = (states - mean) / scale
        if d == 1:
            from statsmodels.tsa.ar_model import AutoReg, ar_select_order  # takes a second

            with catch_warnings():  # of a record without noise, for which any solution is exact
                simplefilter("ignore")
                lags = ar_select_order(x[:, 0], maxlag=most, ic="aic").ar_lags or [1]
                params = AutoReg(x[:, 0], lags=max(lags)).fit().params
            constant, coef = params[:1], params[1:].reshape(-1, 1, 1)
        else:
            from statsmodels.tsa.vector_ar.var_model import VAR

            fit = VAR(x).fit(maxlags=most, ic="aic")
            if fit.k_ar == 0:
                return None
            constant, coef = fit.intercept, fit.coefs
        coef = coef * scale[:, None] / scale
        constant = scale * constant + mean - coef.sum(axis=0) @ mean
        return Autoregression(constant, coef)

    @property
    def order(self) -> int:
        return len(self.coef)

    def ahead(self, past: np.ndarray, t: np.ndarray, times: np.ndarray) -> np.ndarray:
        known = list(past[-self.order :])
        if len(known) < self.order:
            return np.full((len(times), past.shape[1]), np.nan)
        for _ in range(len(times)):
            last = np.array(known[: -self.order - 1 : -1])
            known.append(self.constant + np.einsum("lij,lj->i", self.coef, last))
        return np.array(known[self.order :])


def _largest_order(run: Trajectory) -> int:
    """Largest order that is tried: two periods, if there are samples enough."""
    frequency_Hz = max(dominant_frequency(run.t, column) for column in run.states.T)
    periods = frequency_Hz * float(run.t[-1] - run.t[0])
    d = run.states.shape[1]
    most = MAX_ORDER if d == 1 else MAX_ORDERS / d
    wanted = 2.0 * run.n_samples / periods if periods >= 1.0 else most
    return int(min(wanted, most, run.n_samples / (SAMPLES_PER_COEFFICIENT * d)))
