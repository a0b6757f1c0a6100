"""How far ahead a model forecasts a record that it has not seen, beside forecasts without it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.baselines import (
    AUTOREGRESSION,
    HARMONICS,
    N_STARTS,
    PERSISTENCE,
    Autoregression,
    check_fitted,
    fit_baselines,
    go_on,
    measured_part,
    period_of,
    root_mean,
    spread_evenly,
    spread_starts,
    squared_errors,
)
from ep2sindy.forecasting.forecast import (
    LEVEL,
    Forecast,
    RollingStarts,
    StatesOf,
    calibrate,
)
from ep2sindy.forecasting.state_estimation import StateEstimator, tune_estimator
from ep2sindy.library.units import Clock
from ep2sindy.model.model import SparseModel
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_count

PERIODS_AHEAD = 4.0  # longest horizon
N_HORIZONS = 120  # most horizons at which errors are counted
NEARER = 0.9  # share of the model's error below which a baseline is clearly nearer
MODEL = "model"


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
    names, period_s = estimator.names, period_of(fitted, estimator.names)
    longest = _horizon_of(record, n_fitted, period_s, horizon_s)
    first = spread_starts(record.t, n_fitted, longest, check_count("starts", starts))
    rolling = RollingStarts(estimator, record, first, longest)
    with watch.stage(len(first), "start", "forecasts") as advance:
        ends = rolling.ends(states_of, advance)
    ahead = rolling.forecast(ends, check_count("n_draws", n_draws), seed)
    shown, own = spread_evenly(longest, N_HORIZONS), measured_part(record, names)
    baselines = fit_baselines(own.window(0, n_fitted), longest)
    linear = baselines.get(AUTOREGRESSION)
    paths = {MODEL: rolling.measured(ahead)}
    paths |= {name: go_on(each, own, first, longest) for name, each in baselines.items()}
    scale = zero_to_one(record.columns(names)[n_fitted:].std(axis=0))
    errors = {
        name: root_mean(squared_errors(path, rolling.truth, scale))[shown]
        for name, path in paths.items()
    }
    return ForecastSkill(
        horizons_s=rolling.steps_s[shown],
        period_s=period_s,
        nrmse=MappingProxyType(errors),
        coverage_90=rolling.coverage(ahead, LEVEL),
        n_starts=len(first),
        example=ahead[0],
        order=linear.order if isinstance(linear, Autoregression) else 0,
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
