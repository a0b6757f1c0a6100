"""How far ahead a model forecasts a record that it has not seen, beside forecasts without it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol, runtime_checkable
from warnings import catch_warnings, simplefilter

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.forecast import (
    LEVEL,
    Forecast,
    RollingStarts,
    StatesOf,
    calibrate,
    spread_evenly,
    spread_starts,
)
from ep2sindy.forecasting.state_estimation import StateEstimator, tune_estimator
from ep2sindy.library.units import Clock
from ep2sindy.model.model import SparseModel
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_count
from ep2sindy.signals.attractor import Cycle, find_cycle
from ep2sindy.signals.spectrum import crossing_frequency, dominant_frequency, is_uniform

N_STARTS = 40
PERIODS_AHEAD = 4.0  # longest horizon
N_HORIZONS = 120  # most horizons at which errors are counted
WORST = 10.0  # error, in standard deviations, that counts for a forecast that has diverged
NEARER = 0.9  # share of the model's error below which a baseline is clearly nearer
MODEL, PERSISTENCE, HARMONICS, AUTOREGRESSION = (
    "model", "persistence", "harmonics", "autoregression",
)  # fmt: skip

# Largest order of an autoregression of one state, and the sum of orders of one of several; samples
# that it is fitted to, from the end of the record.
MAX_ORDER, MAX_ORDERS, MAX_FITTED = 120, 40, 4000
SAMPLES_PER_COEFFICIENT = 5  # fewest, of an autoregression


@dataclass(frozen=True, eq=False)
class ForecastSkill:
    """Errors of forecasts from starts all over a held-out part, by horizon and by who forecasts.

    horizons_s: (horizons,). period_s: NaN for a record without an oscillation. nrmse: by `model`,
    `persistence`, `harmonics` and `autoregression`, (horizons,): root mean square error over starts
    and measured states, in standard deviations of the held-out samples. A baseline that the record
    does not allow is left out. coverage_90: share of the held-out samples that the bands of 90 %
    hold. example: the forecast from the first start. order: of the autoregression.
    """

    horizons_s: Float[np.ndarray, " horizons"]
    period_s: float
    nrmse: Mapping[str, Float[np.ndarray, " horizons"]]
    coverage_90: float
    n_starts: int
    example: Forecast = field(repr=False)
    order: int
    clock: Clock = field(repr=False)

    @property
    def rival(self) -> str:
        """The baseline that counts: the autoregression, or persistence if there is none."""
        return AUTOREGRESSION if AUTOREGRESSION in self.nrmse else PERSISTENCE

    @property
    def better_span_s(self) -> tuple[float, float]:
        """The longest span of horizons over which the model is better than the rival, in s.

        From zero if it begins at the first horizon; (0, 0) if there is none.
        """
        is_better = self.nrmse[MODEL] < self.nrmse[self.rival]
        edges = np.flatnonzero(np.diff(is_better, prepend=False, append=False)).reshape(-1, 2)
        if not len(edges):
            return 0.0, 0.0
        begin, end = edges[np.argmax(edges[:, 1] - edges[:, 0])].tolist()
        return float(self.horizons_s[begin]) if begin else 0.0, float(self.horizons_s[end - 1])

    @property
    def better_until_periods(self) -> float:
        """The end of that span in periods, or in samples for a record without an oscillation."""
        return self._in_unit(self.better_span_s[1])

    @property
    def text(self) -> str:
        """One sentence, such as `better than an autoregression (AR 18) for 3.1 periods`."""
        rival = f"an autoregression (AR {self.order})" if self.order else self.rival
        return f"{self._beside(rival)}{self._beside_the_cycle()}"

    def _beside(self, rival: str) -> str:
        begin, end = self.better_span_s
        if not end:
            return f"at no horizon better than {rival}"
        unit = "periods" if np.isfinite(self.period_s) else "samples"
        more = " and more" if end >= self.horizons_s[-1] else ""
        until = f"{self._in_unit(end):.2g} {unit}{more}"
        span = f"for {until}" if not begin else f"from {self._in_unit(begin):.2g} to {until} ahead"
        return f"better than {rival} {span}"

    def _beside_the_cycle(self) -> str:
        """A remark if the mean cycle, going on, is nearer than the model at most horizons."""
        if HARMONICS not in self.nrmse:
            return ""
        nearer = self.nrmse[HARMONICS] < NEARER * self.nrmse[MODEL]
        words = "; the mean cycle, going on, is nearer at most horizons"
        return words if nearer.mean() > 0.5 else ""

    def at(self, horizon_s: float) -> dict[str, float]:
        """Errors at the horizon nearest to the given one, by who forecasts."""
        k = int(np.argmin(np.abs(self.horizons_s - horizon_s)))
        return {name: float(values[k]) for name, values in self.nrmse.items()}

    def summary(self) -> dict[str, object]:
        """For `summary.json`: the errors at a few horizons."""
        last = len(self.horizons_s) - 1
        places = sorted({round(k / 16 * last) for k in (0, 1, 2, 4, 8, 12, 16)})
        return {
            "horizons_periods": [self._in_unit(h) for h in self.horizons_s[places].tolist()],
            "nrmse": {name: values[places].tolist() for name, values in self.nrmse.items()},
            "better_until_periods": self.better_until_periods,
            "coverage_90": self.coverage_90,
        }

    def _in_unit(self, duration_s: float) -> float:
        """A duration in periods, or in samples."""
        unit_s = self.period_s if np.isfinite(self.period_s) else float(self.horizons_s[0])
        return duration_s / unit_s


@one_thread()
def forecast_skill(
    model: SparseModel,
    run: Run,
    *,
    n_fitted: int,
    starts: int = N_STARTS,
    horizon_s: float | None = None,
    measured: Sequence[str] | None = None,
    states_of: StatesOf | None = None,
    n_draws: int = 100,
    estimator: StateEstimator | None = None,
    seed: int = 0,
    progress: Progress | bool = False,
) -> ForecastSkill:
    """Forecast a held-out part again and again, each time from its own past, and count the errors.

    run: a record of all states and inputs of the model; its first `n_fitted` samples were fitted,
    and also serve the baselines. starts: number of starts, evenly spread over the rest. horizon_s:
    the longest horizon; None takes four periods, or what half of the rest allows. measured: as for
    `forecast`. states_of: makes the states of a past whose first columns are the measured ones
    (`ep.embed`). estimator: calibrated on the fitted part. n_draws: of every forecast.
    Raises ValueError for a driven model, or a part that is too short.
    """
    record, watch = trajectory_of(run), as_progress(progress)
    fitted = _fitted_part(model, record, n_fitted)
    if estimator is None:
        estimator = tune_estimator(model, fitted, measured=measured, progress=watch)
        estimator = calibrate(estimator, fitted, states_of=states_of, progress=watch)
    names, period_s = estimator.names, _period_of(fitted, estimator.names)
    longest = _horizon_of(record, n_fitted, period_s, horizon_s)
    first = spread_starts(record.t, n_fitted, longest, check_count("starts", starts))
    rolling = RollingStarts(estimator, record, first, longest)
    with watch.stage(len(first), "start", "forecasts") as advance:
        ends = rolling.ends(states_of, advance)
    ahead = rolling.forecast(ends, check_count("n_draws", n_draws), seed)
    shown, (baselines, order) = spread_evenly(longest, N_HORIZONS), _fit_baselines(fitted, names)
    paths = {MODEL: rolling.measured(ahead)}
    paths |= {name: _go_on(each, rolling) for name, each in baselines.items()}
    scale = zero_to_one(record.columns(names)[n_fitted:].std(axis=0))
    errors = {n: horizon_errors(path, rolling.truth, scale)[shown] for n, path in paths.items()}
    return ForecastSkill(
        horizons_s=rolling.steps_s[shown],
        period_s=period_s,
        nrmse=MappingProxyType(errors),
        coverage_90=rolling.coverage(ahead, LEVEL),
        n_starts=len(first),
        example=ahead[0],
        order=order,
        clock=record.clock,
    )


def _fitted_part(model: SparseModel, record: Trajectory, n_fitted: int) -> Trajectory:
    """The samples that were fitted. Raises ValueError for a driven model, or too few samples."""
    if model.inputs:
        raise ValueError(
            f"the skill of forecasts is counted for models without inputs: this one is driven by "
            f"{list(model.inputs)}, whose future nobody knows; compare `model.rollout` along them"
        )
    check_fitted(record, n_fitted)
    return record.window(0, n_fitted)


def check_fitted(record: Trajectory, n_fitted: int) -> None:
    """Raise ValueError for a fitted or a held-out part of too few samples."""
    if not 8 <= n_fitted <= record.n_samples - 4:
        raise ValueError(
            "the fitted part must have eight samples or more, and leave four: "
            f"n_fitted={n_fitted} came for {record.n_samples} samples"
        )


def _period_of(run: Trajectory, names: Sequence[str]) -> float:
    """Period of the record, or mean time between crossings; NaN if it holds fewer than two."""
    values = run.columns(names)
    cycle = find_cycle(run.t, values)
    if cycle is None:
        frequency_Hz = max(crossing_frequency(run.t, column) for column in values.T)
    else:
        frequency_Hz = cycle.frequency_Hz
    enough = frequency_Hz * float(run.t[-1] - run.t[0]) >= 2.0
    return 1.0 / frequency_Hz if enough else float("nan")


def _horizon_of(record: Trajectory, n_fitted: int, period_s: float, horizon_s: float | None) -> int:
    """Longest horizon, in samples."""
    left = record.n_samples - n_fitted
    wanted = PERIODS_AHEAD * period_s if horizon_s is None else horizon_s
    if not np.isfinite(wanted):
        return max(1, left // 2)
    n = max(1, round(wanted / record.dt_s))
    if horizon_s is not None and n >= left:
        raise ValueError(
            f"the horizon must leave room for starts: {horizon_s:g} s came, and "
            f"{left * record.dt_s:.4g} s are held out"
        )
    return min(n, max(1, left // 2)) if horizon_s is None else n


def _fit_baselines(fitted: Trajectory, names: Sequence[str]) -> tuple[dict[str, Baseline], int]:
    """The baselines that the record allows, by name, and the order of the autoregression."""
    own = Trajectory(fitted.t, fitted.columns(names), tuple(names))
    found: dict[str, Baseline] = {PERSISTENCE: Persistence()}
    if (harmonics := Harmonics.of(own)) is not None:
        found[HARMONICS] = harmonics
    if (linear := Autoregression.of(own)) is not None:
        found[AUTOREGRESSION] = linear
    return found, 0 if linear is None else linear.order


def _go_on(
    baseline: Baseline, rolling: RollingStarts
) -> Float[np.ndarray, "starts ahead measured"]:
    """What a baseline forecasts from every start."""
    record, n = rolling.record, rolling.longest
    samples, t = record.columns(rolling.estimator.names), record.t
    return np.stack([baseline.ahead(samples[:k], t[:k], t[k : k + n]) for k in rolling.first])


def horizon_errors(
    forecast: Float[np.ndarray, "starts ahead measured"],
    truth: Float[np.ndarray, "starts ahead measured"],
    scale: Float[np.ndarray, " measured"] | float,
) -> Float[np.ndarray, " ahead"]:
    """Root mean square error over starts and states at every horizon, in `scale`."""
    off = np.nan_to_num(np.abs(forecast - truth) / scale, nan=WORST, posinf=WORST)
    return np.sqrt(np.square(np.minimum(off, WORST)).mean(axis=(0, 2)))


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
