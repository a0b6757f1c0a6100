"""Forecasts from the past of a record alone, without a model, which a model must beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable
from warnings import catch_warnings, simplefilter

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.gaps import between_gaps
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.signals.attractor import Cycle, find_cycle
from ep2sindy.signals.spectrum import crossing_frequency, dominant_frequency, is_uniform

PERSISTENCE, HARMONICS, AUTOREGRESSION = "persistence", "harmonics", "autoregression"
WORST = 10.0  # error, in standard deviations, that counts for a forecast that has diverged

# Largest order of an autoregression of one state, and the sum of orders of one of several; samples
# that it is fitted to, from the end of the record.
MAX_ORDER, MAX_ORDERS, MAX_FITTED = 120, 40, 4000
SAMPLES_PER_COEFFICIENT = 5  # fewest, of an autoregression


def check_fitted(record: Trajectory, n_fitted: int) -> None:
    """Raise ValueError for a fitted or a held-out part of too few samples."""
    if not 8 <= n_fitted <= record.n_samples - 4:
        raise ValueError(
            "the fitted part must have eight samples or more, and leave four: "
            f"n_fitted={n_fitted} came for {record.n_samples} samples"
        )


def period_of(run: Trajectory, names: Sequence[str]) -> float:
    """Period of the record, or mean time between crossings; NaN if it holds fewer than two."""
    values = run.columns(names)
    cycle = find_cycle(run.t, values)
    if cycle is None:
        frequency_Hz = max(crossing_frequency(run.t, column) for column in values.T)
    else:
        frequency_Hz = cycle.frequency_Hz
    enough = frequency_Hz * float(run.t[-1] - run.t[0]) >= 2.0
    return 1.0 / frequency_Hz if enough else float("nan")


def spread_starts(
    t: Float[np.ndarray, " samples"], first: int, longest: int, n: int
) -> Int[np.ndarray, " starts"]:
    """At most n starts of forecasts of `longest` samples, evenly spread from a first one on.

    A forecast and the sample before it lie in one stretch without a gap, unless none of them does.
    """
    starts = np.arange(min(first, len(t) - longest), len(t) - longest + 1)
    end = np.array(between_gaps(t))[:, 1]
    piece = np.searchsorted(end, starts - 1, side="right")
    inside = starts + longest <= end[piece]
    starts = starts[inside] if inside.any() else starts
    return starts[spread_evenly(len(starts), n)]


def spread_evenly(n_all: int, n: int) -> Int[np.ndarray, " places"]:
    """At most n places among n_all, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, n_all - 1, n).round().astype(np.int64))


def horizon_errors(
    forecast: Float[np.ndarray, "starts ahead measured"],
    truth: Float[np.ndarray, "starts ahead measured"],
    scale: Float[np.ndarray, " measured"] | float,
) -> Float[np.ndarray, " ahead"]:
    """Root mean square error over starts and states at every horizon, in `scale`."""
    off = np.nan_to_num(np.abs(forecast - truth) / scale, nan=WORST, posinf=WORST)
    return np.sqrt(np.square(np.minimum(off, WORST)).mean(axis=(0, 2)))


def fit_baselines(fitted: Trajectory, names: Sequence[str]) -> tuple[dict[str, Baseline], int]:
    """The baselines that the record allows, by name, and the order of the autoregression."""
    own = Trajectory(fitted.t, fitted.columns(names), tuple(names))
    found: dict[str, Baseline] = {PERSISTENCE: Persistence()}
    if (harmonics := Harmonics.of(own)) is not None:
        found[HARMONICS] = harmonics
    if (linear := Autoregression.of(own)) is not None:
        found[AUTOREGRESSION] = linear
    return found, 0 if linear is None else linear.order


# Forecasts without a model of the system, which a model must beat to be worth anything.


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
