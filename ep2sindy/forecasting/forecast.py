"""Forecasts of a model, from the end of a record or from many starts along it, with bands.

Bands are calibrated where they can be seen: the likeliest process noise is that which explains
single steps. What a model misses lasts, however, over many steps, so its forecasts scatter more
than such noise says; and where a record is moved hard in a few places alone, less.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from ep2sindy.data.numbers import band_of, quantiles
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.baselines import (
    AUTOREGRESSION,
    Autoregression,
    measured_part,
    spread_starts,
)
from ep2sindy.forecasting.state_estimation import FittedState, StateEstimator, tune_estimator
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.draws import draw_coef, draw_normal, draw_runs
from ep2sindy.model.inputs import driven
from ep2sindy.model.model import SparseModel
from ep2sindy.runtime.progress import SILENT, Advance, Progress, nothing
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_count, read_only
from ep2sindy.signals.spectrum import is_uniform

LEVEL = 0.9  # share of the samples that a band is to hold

# Makes all states of a past, whose first columns are the measured ones.
StatesOf = Callable[[Trajectory], Trajectory]

# Starts of the forecasts whose bands are calibrated, draws of each, and how far they go.
N_STARTS, N_DRAWS, PERIODS_AHEAD = 24, 60, 1.5
LEAST_HELD = 0.6  # share of fitted samples that bands hold, below which they are not shown
TOLERANCE = 0.03  # deviation from the level at which a band counts as calibrated
FACTORS = 10.0 ** np.arange(-2.0, 2.1, 0.25)  # of the likeliest process noise


@dataclass(frozen=True, eq=False)
class Forecast:
    """States that a model expects after a record, with the uncertainty of what a sensor will show.

    t: (samples,) in s, the first one after the record's end. states: (samples, n_states), the
    median of the draws, in SI. draws: (draws, samples, n_states), runs from starts and with
    coefficients drawn by their covariance, under the record's process noise; NaN where a run has
    diverged. noise_std: (n_states,), of the sensor's noise; NaN for states that it does not show.
    sound: (draws, samples, measured), draws of an autoregression, the sensor's noise included,
    whose band stands in place of the model's, which did not hold where the model was fitted; None
    if it did.
    """

    t: Float[np.ndarray, " samples"]
    states: Float[np.ndarray, "samples n_states"]
    draws: Float[np.ndarray, "draws samples n_states"] = field(repr=False)
    noise_std: Float[np.ndarray, " n_states"]
    state_names: tuple[str, ...]
    units: Mapping[str, str]
    clock: Clock = SECONDS
    seed: int = field(default=0, repr=False)
    sound: Float[np.ndarray, "draws samples _"] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        for name in ("t", "states", "draws", "noise_std"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def band(
        self, level: float = LEVEL
    ) -> tuple[Float[np.ndarray, "samples n_states"], Float[np.ndarray, "samples n_states"]]:
        """Lower and upper bound that hold this share of the samples, the sensor's noise included.

        Draws that diverged count neither way. Raises ValueError for a level that is no share.
        """
        rng = np.random.default_rng(self.seed)
        noise = np.nan_to_num(self.noise_std) * rng.standard_normal(self.draws.shape)
        draws = self.draws + noise
        if self.sound is not None:
            draws[..., np.isfinite(self.noise_std)] = self.sound
        low, high = band_of(draws, level)
        return low, high

    @property
    def band_of(self) -> str:
        """Whose band it is: `model`, or `autoregression`."""
        return "model" if self.sound is None else AUTOREGRESSION

    @property
    def diverged(self) -> float:
        """Share of the draws that diverged."""
        return float(np.isnan(self.draws[:, -1]).any(axis=1).mean())


def draw_forecasts(
    estimator: StateEstimator,
    ends: Sequence[FittedState],
    begins: Float[np.ndarray, " starts"],
    times: Float[np.ndarray, "starts samples"],
    *,
    inputs: ArrayLike | Mapping[str, Any] | None = None,
    n_draws: int,
    seed: int,
    clock: Clock = SECONDS,
) -> list[Forecast]:
    """Forecasts from several fitted states, at times that are alike when counted from each start.

    begins: times of the fitted states, in s.
    """
    model, rng = estimator.model, np.random.default_rng(seed)
    starts = np.concatenate([draw_normal(end.mean, end.covariance, n_draws, rng) for end in ends])
    coef = draw_coef(model, model.covariance, len(starts), rng)
    grid = np.append(begins[0], times[0])
    drive, _ = driven(model.inputs, inputs, grid, model.courses)
    runs = draw_runs(
        model,
        grid,
        starts,
        coef,
        drive=drive,
        process_std=estimator.noise.process,
        process_step_s=estimator.problem.step_s,
        reach=estimator.problem.scale,
        rng=rng,
    )[:, 1:].reshape(len(ends), n_draws, times.shape[1], -1)
    return [
        Forecast(
            t=own,
            states=quantiles(draws, [0.5])[0],
            draws=draws,
            noise_std=estimator.noise.samples,
            state_names=tuple(model.states),
            units=model.units,
            clock=clock,
            seed=seed,
        )
        for own, draws in zip(times, runs, strict=True)
    ]


@one_thread()
def forecast(
    model: SparseModel,
    history: Run,
    horizon: float | ArrayLike,
    *,
    fitted_to: Run | None = None,
    measured: Sequence[str] | None = None,
    inputs: ArrayLike | Mapping[str, Any] | None = None,
    n_draws: int = 200,
    seed: int = 0,
) -> Forecast:
    """Forecast from the end of a history, whose last periods determine the start.

    The model itself is fitted to the samples of the last four periods: nothing but the past enters.
    The noise of the samples, and process noise for what the model does not describe, are the
    likeliest ones for the record that the model was fitted to; the latter is then scaled until
    bands hold 90 % of that record, if it is long enough (`calibrate`). The bands follow from the
    uncertainty of the start, from the covariance of the model's coefficients if it has one, from
    this process noise, and from the noise. If they hold under 60 % of that record all the same,
    they are those of an autoregression that is fitted to it.
    history: samples of the measured states and of the inputs; a Trajectory, a table or (t, x).
    States of the model that it lacks are told from the others (`estimate_states`).
    horizon: duration in s, in steps of the history; or the times (samples,) themselves, in s.
    fitted_to: the record that the model was fitted to; None takes the history. measured: states
    that were measured; others that the history has were made from them (`ep.embed`), and
    only start the fit.
    inputs: of a driven model over the horizon, as for `simulate`.
    Raises ValueError for a history without any state or some input of the model, or a horizon that
    does not lie ahead.

    >>> run = ep.lorenz().trajectory(noise=0.05, rng=0)
    >>> ahead = ep.forecast(ep.lorenz().model, run.window(0, 2000), 0.5)
    >>> low, high = ahead.band(0.9)
    >>> inside = (low <= run.states[2000:2150]) & (run.states[2000:2150] <= high)
    >>> bool(0.8 < inside.mean() <= 1.0)
    True
    """
    past = trajectory_of(history)
    times = _times(past.t, past.dt_s, horizon)
    known = past if fitted_to is None else trajectory_of(fitted_to)
    estimator = calibrate(tune_estimator(model, known, measured=measured), known, seed=seed)
    end, grid = estimator.filter(past), np.append(past.t[-1], times)
    ahead = draw_forecasts(
        estimator, [end], past.t[-1:], times[None], inputs=inputs,
        n_draws=check_count("n_draws", n_draws), seed=seed, clock=past.clock,
    )[0]  # fmt: skip
    if not estimator.held < LEAST_HELD:
        return ahead
    own, known = (measured_part(run, estimator.names, model.inputs) for run in (past, known))
    later = driven(model.inputs, inputs, grid, model.courses)[1][1:]
    linear, t = Autoregression.of(known), np.append(own.t, times)
    return with_band_of(linear, ahead, own.states, t, np.vstack([own.inputs, later]))


def with_band_of(
    linear: Autoregression | None,
    ahead: Forecast,
    past: Float[np.ndarray, "samples measured"],
    t: Float[np.ndarray, " times"],
    inputs: Float[np.ndarray, "times n_inputs"],
) -> Forecast:
    """The forecast with the band of an autoregression. t and inputs: see `Baseline.ahead`."""
    if linear is None:
        return ahead
    draws = linear.draws(past, t, inputs, len(ahead.draws), np.random.default_rng(ahead.seed))
    return replace(ahead, sound=draws)


def _times(t: np.ndarray, step_s: float, horizon: float | ArrayLike) -> np.ndarray:
    """The times to forecast, in s."""
    asked = np.asarray(horizon, dtype=np.float64)
    if asked.ndim == 0 and asked > 0.0 and np.isfinite(asked):
        return t[-1] + step_s * np.arange(1, max(1, int(asked / step_s + 1e-6)) + 1)
    if asked.ndim != 1 or not asked.size or not (np.diff(np.append(t[-1], asked)) > 0.0).all():
        raise ValueError(
            "horizon must be a positive duration in s, or increasing times after the history's "
            f"end at {t[-1]:.6g} s: {horizon!r} came"
        )
    return asked


@dataclass(frozen=True, eq=False)
class RollingStarts:
    """Starts of forecasts: numbers of the first samples that each forecasts, `longest` from it."""

    estimator: StateEstimator
    record: Trajectory
    first: Int[np.ndarray, " starts"]
    longest: int

    @property
    def steps_s(self) -> Float[np.ndarray, " ahead"]:
        """Horizons, in s since the last sample of the past, as from the first start."""
        k = int(self.first[0])
        return self.record.t[k : k + self.longest] - self.record.t[k - 1]

    @property
    def truth(self) -> Float[np.ndarray, "starts ahead measured"]:
        samples = self.record.columns(self.estimator.names)
        return np.stack([samples[k : k + self.longest] for k in self.first])

    def ends(self, states_of: StatesOf | None, advance: Advance = nothing) -> list[FittedState]:
        """The state before every start, from its past alone."""
        found = []
        for k in self.first.tolist():
            past = self.record.window(max(0, k - 2 * self.estimator.memory), k)
            found.append(self.estimator.filter(past if states_of is None else states_of(past)))
            advance(1)
        return found

    def forecast(self, ends: Sequence[FittedState], n_draws: int, seed: int) -> list[Forecast]:
        """Forecasts from fitted states; at equal steps, all of them are drawn together."""
        t, begins = self.record.t, self.record.t[self.first - 1]
        draw = partial(draw_forecasts, self.estimator, n_draws=n_draws, clock=self.record.clock)
        inputs = self.record.columns(self.estimator.model.inputs)
        if is_uniform(t) and not inputs.size:
            times = begins[:, None] + self.steps_s
            return draw(ends, begins, times, seed=seed)
        times = np.stack([t[k : k + self.longest] for k in self.first])
        return [
            draw(
                [end],
                begin[None],
                own[None],
                inputs=inputs[k - 1 : k + self.longest],
                seed=seed + n,
            )[0]
            for n, (k, end, begin, own) in enumerate(
                zip(self.first.tolist(), ends, begins, times, strict=True)
            )
        ]

    def with_sound_bands(
        self, ahead: Sequence[Forecast], linear: Autoregression | None
    ) -> list[Forecast]:
        """The forecasts, with an autoregression's bands if the model's did not hold before."""
        if not self.estimator.held < LEAST_HELD:
            return list(ahead)
        own = measured_part(self.record, self.estimator.names, self.estimator.model.inputs)
        ends = [(k, k + self.longest) for k in self.first.tolist()]
        return [
            with_band_of(linear, each, own.states[:k], own.t[:end], own.inputs[:end])
            for each, (k, end) in zip(ahead, ends, strict=True)
        ]

    def measured(self, ahead: Sequence[Forecast]) -> Float[np.ndarray, "starts ahead measured"]:
        return np.stack([each.states[:, self.estimator.measured] for each in ahead])

    def coverage(self, ahead: Sequence[Forecast], level: float) -> float:
        """Share of the samples that bands hold."""
        low, high = (
            np.stack(side)[:, :, self.estimator.measured]
            for side in zip(*[each.band(level) for each in ahead], strict=True)
        )
        return float(((low <= self.truth) & (self.truth <= high)).mean())

    def scale_process(self, factor: float) -> RollingStarts:
        """The same with process noise larger by a factor."""
        noise = replace(self.estimator.noise, process=factor * self.estimator.noise.process)
        return replace(self, estimator=replace(self.estimator, noise=noise))


@one_thread()
def calibrate(
    estimator: StateEstimator,
    run: Trajectory,
    *,
    states_of: StatesOf | None = None,
    seed: int = 0,
    progress: Progress = SILENT,
) -> StateEstimator:
    """The estimator with process noise whose bands hold 90 % of the record that it was tuned on.

    run: that record. states_of: as for `forecast_skill`. Forecasts of up to one and a half periods
    from its later two thirds are counted. Of a record that is too short for these, the estimator
    comes back unchanged.
    """
    ahead = max(2, int(PERIODS_AHEAD * estimator.per_period))
    begin = max(estimator.memory, run.n_samples // 3)
    if run.n_samples - ahead - begin < N_STARTS:
        return estimator
    first = spread_starts(run.t, begin, ahead, N_STARTS)
    rolling = RollingStarts(estimator, run, first, ahead)

    def coverage(factor: float) -> float:
        scaled = rolling.scale_process(factor)
        return scaled.coverage(scaled.forecast(ends, N_DRAWS, seed), LEVEL)

    with progress.stage(None, "", "width of the forecasts' bands"):
        ends, factor = rolling.ends(states_of), 1.0
        held = coverage(factor)
        if abs(held - LEVEL) > TOLERANCE:
            # More process noise makes wider bands.
            above = bisect_left(FACTORS[1:-1], LEVEL, key=coverage) + 1
            factor = float(FACTORS[above])
            held = coverage(factor)
    return replace(rolling.scale_process(factor).estimator, held=held)
