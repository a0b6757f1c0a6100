"""How far ahead a model forecasts a record that it has not seen, next to forecasts without it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int
from scipy.special import stdtrit

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.baselines import (
    AUTOREGRESSION,
    HARMONICS,
    N_STARTS,
    NEIGHBOURS,
    PERSISTENCE,
    Autoregression,
    check_fitted,
    fit_baselines,
    go_on,
    measured_part,
    period_of,
    root_mean,
    spread_starts,
    squared_errors,
    standard_error,
)
from ep2sindy.forecasting.forecast import LEVEL, Forecast, RollingStarts, StatesOf, calibrate
from ep2sindy.forecasting.state_estimation import StateEstimator, tune_estimator
from ep2sindy.model.model import SparseModel
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_count
from ep2sindy.signals.spectrum import is_uniform

PERIODS_AHEAD = 4.0  # longest horizon
NEARER = 0.9  # fraction of the model's error below which a baseline is clearly nearer
FEWEST = 0.1  # fraction of the horizons from which a span that begins later counts: many are tried
EARLY = 0.25  # periods, over which a forecast must not be worse than the last sample or the mean
MODEL, MEAN = "model", "mean"
WORDS = {
    MODEL: "the model",
    PERSISTENCE: "the last sample",
    HARMONICS: "the mean cycle",
    AUTOREGRESSION: "the autoregression",
    NEIGHBOURS: "nearest neighbours",
    MEAN: "the mean",
}

# Errors are averaged over horizons of a twentieth of a period, or a 120th of the longest. At one
# sample a right model and an autoregression are both at the floor of the noise: their difference is
# a small part of it, and needs many samples to be seen. Over a twentieth of a period, by contrast,
# what is to be forecast has hardly moved on.
BINS_PER_PERIOD, MOST_BINS = 20, 120

# Levels of Student's distribution: of a gain that exceeds its standard error, at every horizon; and
# of one that chance alone makes in a case of twenty, on average over all of them.
EXCEEDS, SURE = 0.841, 0.95
# Degrees of freedom of a standard error, half the number of starts that do not overlap: with more,
# correlated starts count as free ones.
LEAST_FREE, MOST_FREE = 2, 8


@dataclass(frozen=True, eq=False)
class ForecastSkill:
    """Errors of forecasts from starts all over a held-out part, by horizon and by who forecasts.

    horizons_s: (horizons,), each the longest of those that its errors are averaged over. period_s:
    NaN for a record without an oscillation. step_s, apart_s: between samples, and between starts.
    squared: by `model` and by the baselines `persistence`, `harmonics`, `autoregression` and
    `neighbours`, (starts, horizons): mean square errors over measured states, in variances of the
    held-out samples. A baseline that the record does not allow is left out. coverage_90: fraction
    of the held-out samples that the bands of 90 % hold; NaN without bands. example: the forecast
    from the first start. order: of the autoregression. resampled: whether baselines took samples at
    other times. seen: whether the model was fitted to the part that is held out from the baselines.
    """

    horizons_s: Float[np.ndarray, " horizons"]
    period_s: float
    step_s: float
    apart_s: float
    squared: Mapping[str, Float[np.ndarray, "starts horizons"]] = field(repr=False)
    coverage_90: float
    example: Forecast = field(repr=False)
    order: int
    resampled: bool = False
    seen: bool = False

    @cached_property
    def nrmse(self) -> Mapping[str, Float[np.ndarray, " horizons"]]:
        """Root mean square errors by who forecasts, in standard deviations of the held-out part."""
        return MappingProxyType({name: root_mean(each) for name, each in self.squared.items()})

    @property
    def rival(self) -> str:
        """The baseline that counts: the autoregression, or persistence if there is none."""
        return AUTOREGRESSION if AUTOREGRESSION in self.nrmse else PERSISTENCE

    @cached_property
    def better(self) -> tuple[int, int] | None:
        """First and last horizon of the longest span at which the model is better than the rival.

        At each of them the gain in mean square error, over the rival and over the mean of the
        samples, exceeds its standard error over the starts; averaged over all of them, the gain
        over the rival is one that chance makes in a case of twenty. A span that does not begin at
        the first horizon is at least a tenth of them. None if there is no such span.
        """
        own = self.squared[MODEL]
        gain = self.squared[self.rival] - own
        exceeds = [
            all(self._exceeds(each[:, n], n, EXCEEDS) for each in (gain, 1.0 - own))
            for n in range(own.shape[1])
        ]
        for first, last in _spans(exceeds):
            least = 1 if not first else FEWEST * len(exceeds)
            if last - first + 1 >= least and self._exceeds(
                gain[:, first : last + 1].mean(axis=1), last, SURE
            ):
                return first, last
        return None

    @cached_property
    def nearer(self) -> tuple[int, int] | None:
        """The longest span at which it errs less than nine tenths of the rival, or None.

        It has to be over half of the horizons, and may be by chance.
        """
        near = self.nrmse[MODEL] < NEARER * np.minimum(self.nrmse[self.rival], 1.0)
        spans = _spans(near.tolist())
        return spans[0] if 2 * near.sum() > len(near) else None

    def _exceeds(self, gain: Float[np.ndarray, " starts"], horizon: int, level: float) -> bool:
        """Whether gains of the starts are positive next to their standard error."""
        n_apart = len(gain) * self.apart_s / float(self.horizons_s[horizon])  # do not overlap
        most = min(MOST_FREE, len(gain) - 1)
        n_free = int(np.clip(0.5 * n_apart, min(LEAST_FREE, most), most))
        if not n_free:
            return False
        bound = stdtrit(n_free, level) * standard_error(gain, n_free)
        return bool(gain.mean() > bound)

    @property
    def better_periods(self) -> tuple[float, float] | None:
        """From where to where it does, in periods, or in samples without an oscillation."""
        return None if self.better is None else self._in_units(self.better)

    def _in_units(self, span: tuple[int, int]) -> tuple[float, float]:
        first, last = span
        return (self._ahead(first - 1) if first else 0.0), self._ahead(last)

    def _span(self, span: tuple[int, int]) -> str:
        """`from 0.3 to 4 periods`, or `up to 1 period`."""
        begin, end = self._in_units(span)
        unit = self.unit.removesuffix("s") if end == 1.0 else self.unit
        return f"from {begin:.2g} to {end:.2g} {unit}" if begin else f"up to {end:.2g} {unit}"

    @property
    def veto(self) -> str:
        """What forecasts the first horizons better than the model; empty if nothing simple does.

        It is the last sample or the mean of the record, over the first quarter of a period, or a
        sixteenth of all horizons, by more than chance makes in a case of twenty.
        """
        early = self.horizons_s <= EARLY * self.period_s
        early |= np.arange(len(early)) < max(1, len(early) // 16)
        own, last = self.squared[MODEL][:, early].mean(axis=1), int(np.flatnonzero(early)[-1])
        rivals = {
            "the last sample": self.squared[PERSISTENCE][:, early].mean(axis=1),
            "the mean": np.ones(len(own)),
        }
        lost = [name for name, each in rivals.items() if self._exceeds(own - each, last, SURE)]
        return lost[0] if lost else ""

    @property
    def text(self) -> str:
        """The verdict by ranges of horizons, `better than an autoregression up to 4 periods`."""
        rival = "an autoregression" if self.rival == AUTOREGRESSION else "the last sample"
        rival += " (in sample)" if self.seen else ""
        if self.better is not None:
            return f"better than {rival} {self._span(self.better)}"
        if self.nearer is not None and not self.seen:
            return f"nearer than {rival} {self._span(self.nearer)}, within chance"
        return f"forecasts no better than {rival}"

    @property
    def nearest_text(self) -> str:
        """Which forecast errs least, by ranges of a tenth of the horizons, in a sentence.

        A change of less than a tenth of the error is passed over.
        """
        parts = np.array_split(np.arange(len(self.horizons_s)), min(10, len(self.horizons_s)))
        errors = {name: [each[part].mean() for part in parts] for name, each in self.nrmse.items()}
        errors[MEAN] = [1.0] * len(parts)
        best: list[str] = []
        for k in range(len(parts)):
            least = min(errors, key=lambda name: errors[name][k])
            kept = best and errors[least][k] > NEARER * errors[best[-1]][k]
            best.append(best[-1] if kept else least)
        ends = [k for k, name in enumerate(best) if best[k + 1 : k + 2] != [name]]
        spans = [f"{WORDS[best[k]]} up to {self._ahead(int(parts[k][-1])):.2g}" for k in ends]
        return f"Least error: {', '.join(spans)} {self.unit}."

    def _ahead(self, horizon: int) -> float:
        """A horizon in periods, or in samples."""
        return float(self.horizons_s[horizon]) / self.unit_s

    def at(self, horizon_s: float) -> dict[str, float]:
        """Errors at the horizon nearest to the given one, by who forecasts."""
        k = int(np.argmin(np.abs(self.horizons_s - horizon_s)))
        return {name: float(values[k]) for name, values in self.nrmse.items()}

    def summary(self) -> dict[str, object]:
        """For `summary.json`: the errors at a few horizons."""
        last = len(self.horizons_s) - 1
        places = sorted({round(k / 16 * last) for k in (0, 1, 2, 4, 8, 12, 16)})
        return {
            "text": self.text,
            "is_better": self.better is not None,
            "horizons_periods": [h / self.unit_s for h in self.horizons_s[places].tolist()],
            "nrmse": {name: values[places].tolist() for name, values in self.nrmse.items()},
            "better_periods": self.better_periods,
            "unit_s": self.unit_s,
            "coverage_90": self.coverage_90,
        }

    @property
    def unit_s(self) -> float:
        """What horizons are counted in: periods, or samples."""
        return self.period_s if np.isfinite(self.period_s) else self.step_s

    @property
    def unit(self) -> str:
        return "periods" if np.isfinite(self.period_s) else "samples"


def _spans(holds: Sequence[bool]) -> list[tuple[int, int]]:
    """First and last place of every span of neighbours that hold, the longest first."""
    edges = np.flatnonzero(np.diff([0, *holds, 0]))
    found = [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return sorted(found, key=lambda span: span[0] - span[1])


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
    """Forecast a held-out part repeatedly, each time from its own past, and count the errors.

    Parameters
    ----------
    model : SparseModel
        The equations. Inputs are known ahead, also to the autoregression.
    run : run
        A record of all states and inputs of the model.
    n_fitted : int
        Number of samples at its start that were fitted, and that also serve the baselines.
    starts : int, default N_STARTS
        Number of starts, evenly spread over the rest.
    horizon_s : float, optional
        The longest horizon in s. None takes four periods, or what half of the rest allows.
    measured : sequence of str, optional
        States that were measured, as for `ep.forecast`.
    states_of : StatesOf, optional
        Makes the states of a past whose first columns are the measured ones (`ep.embed`).
    n_draws : int, default 100
        Number of runs in every forecast.
    estimator : StateEstimator, optional
        State estimator calibrated on the fitted part. None calibrates one.
    seed : int, default 0
        Of the random draws.
    progress : Progress or bool, default False
        True shows a bar.

    Returns
    -------
    ForecastSkill
        Errors by horizon, of the model and of the baselines.

    Raises
    ------
    ValueError
        If the held-out part is too short, or the record lacks an input.
    """
    record, watch = trajectory_of(run), as_progress(progress)
    check_fitted(record, n_fitted)
    fitted = record.window(0, n_fitted)
    if estimator is None:
        estimator = tune_estimator(model, fitted, measured=measured, progress=watch)
        estimator = calibrate(estimator, fitted, states_of=states_of, progress=watch)
    names, period_s = estimator.names, period_of(fitted, estimator.names)
    longest = _horizon_of(record, n_fitted, period_s, horizon_s)
    first = spread_starts(record.t, n_fitted, longest, check_count("starts", starts))
    own = measured_part(record, names, model.inputs)
    baselines = fit_baselines(own.window(0, n_fitted), longest)
    linear = baselines.get(AUTOREGRESSION)
    assert linear is None or isinstance(linear, Autoregression)
    rolling = RollingStarts(estimator, record, first, longest)
    with watch.stage(len(first), "start", "forecasts") as advance:
        ends = rolling.ends(rolling.pasts(states_of), advance)
    ahead = rolling.forecast(ends, check_count("n_draws", n_draws), seed)
    begins = _bins(longest, period_s / record.dt_s)
    scale = zero_to_one(own.states[n_fitted:].std(axis=0))
    paths = {MODEL: rolling.measured(ahead)}
    paths |= {name: go_on(each, own, first, longest) for name, each in baselines.items()}
    errors = {name: squared_errors(path, rolling.truth, scale) for name, path in paths.items()}
    return ForecastSkill(
        horizons_s=rolling.steps_s[np.append(begins[1:], longest) - 1],
        period_s=period_s,
        step_s=record.dt_s,
        apart_s=float(np.ptp(record.t[first])) / max(1, len(first) - 1),
        squared=MappingProxyType({name: _average(each, begins) for name, each in errors.items()}),
        coverage_90=rolling.coverage(ahead, LEVEL),
        example=ahead[0],
        order=0 if linear is None else linear.order,
        resampled=not is_uniform(record.t),
    )


def _bins(longest: int, per_period: float) -> Int[np.ndarray, " horizons"]:
    """Where the bins of horizons begin, over which errors are averaged, in samples."""
    width = per_period / BINS_PER_PERIOD if np.isfinite(per_period) else longest / MOST_BINS
    return np.arange(0, longest, max(1, round(width)))


def _average(
    squared: Float[np.ndarray, "starts ahead"], begins: Int[np.ndarray, " horizons"]
) -> Float[np.ndarray, "starts horizons"]:
    """Means over the bins."""
    sizes = np.diff(np.append(begins, squared.shape[1]))
    return np.add.reduceat(squared, begins, axis=1) / sizes


def _horizon_of(record: Trajectory, n_fitted: int, period_s: float, horizon_s: float | None) -> int:
    """Longest horizon, in samples."""
    left = record.n_samples - n_fitted
    wanted = PERIODS_AHEAD * period_s if horizon_s is None else horizon_s
    if not np.isfinite(wanted):
        return max(1, left // 2)
    n = max(1, round(wanted / record.dt_s))
    if horizon_s is not None and n >= left:
        raise ValueError(
            f"the horizon must leave room for starts, got {horizon_s:g} s, and "
            f"{left * record.dt_s:.4g} s are held out"
        )
    return min(n, max(1, left // 2)) if horizon_s is None else n
