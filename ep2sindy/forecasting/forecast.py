"""Forecasts of a model, from the end of a record or from many starts along it, with bands.

The likeliest process noise is that which explains single steps. What a model misses lasts, however,
over many steps, so its forecasts scatter more than such noise says; and where a record is moved
hard in a few places alone, less. So both are held to what forecasts missed where it can be seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from math import nan
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.special import ndtri, stdtrit

from ep2sindy.data.numbers import band_of, quantiles, zero_to_one
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.problem import MIN_SAMPLES
from ep2sindy.forecasting.baselines import spread_starts, squared_errors, standard_error
from ep2sindy.forecasting.state_estimation import (
    BandWidths,
    FittedState,
    StateEstimator,
    measured_states,
    tune_estimator,
)
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.comparison import spirals
from ep2sindy.model.draws import draw_coef, draw_normal, draw_runs
from ep2sindy.model.inputs import driven
from ep2sindy.model.model import SparseModel
from ep2sindy.runtime.progress import SILENT, Advance, Progress, nothing
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_count, read_only
from ep2sindy.signals.spectrum import is_uniform

LEVEL = 0.9  # fraction of the samples that a band is to hold
UPPER = 0.5 + 0.5 * LEVEL  # level of its upper bound

# Makes all states of a past, whose first columns are the measured ones.
StatesOf = Callable[[Trajectory], Trajectory]

# Starts of the forecasts whose bands are calibrated, draws of each, and how far they go.
N_STARTS, N_DRAWS, N_WEIGHED, PERIODS_AHEAD = 40, 100, 30, 4.0
# Slow variations from start to start that tell the error of a fraction, and the least such error;
# with under twice as many starts, a band is not reported.
N_WAVES, SURELY = 4, 1e-3
LEAST_STARTS = 2 * N_WAVES
# Of the likeliest process noise, what is taken: it explains single steps, and what a model misses
# there may be no process noise. Under too large process noise, the median of the draws leaves the
# model's own path.
FACTORS = (0.1, 0.3, 1.0)


@dataclass(frozen=True, eq=False)
class Forecast:
    """States that a model expects after a record, with the uncertainty of what a sensor will show.

    t: (samples,) in s, the first one after the record's end. states: (samples, n_states), the
    median of the draws, in SI. draws: (draws, samples, n_states), runs from starts and with
    coefficients drawn by their covariance, under the record's process noise; NaN where a run has
    diverged. noise_std: (n_states,), of the sensor's noise; NaN for states that it does not show.
    width: (samples, n_states), of the band in widths of the draws' own; NaN where none is shown.
    """

    t: Float[np.ndarray, " samples"]
    states: Float[np.ndarray, "samples n_states"]
    draws: Float[np.ndarray, "draws samples n_states"] = field(repr=False)
    noise_std: Float[np.ndarray, " n_states"]
    width: Float[np.ndarray, "samples n_states"] = field(repr=False)
    state_names: tuple[str, ...]
    units: Mapping[str, str]
    clock: Clock = SECONDS
    seed: int = field(default=0, repr=False)

    def __post_init__(self) -> None:
        for name in ("t", "states", "draws", "noise_std", "width"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def band(
        self, level: float = LEVEL
    ) -> tuple[Float[np.ndarray, "samples n_states"], Float[np.ndarray, "samples n_states"]]:
        """Bounds that hold this fraction of the samples, the sensor's noise included.

        Draws that diverged count neither way; NaN where no band is shown. Raises ValueError for a
        level that is no fraction.
        """
        rng = np.random.default_rng(self.seed)
        noise = np.nan_to_num(self.noise_std) * rng.standard_normal(self.draws.shape)
        low, high = self.states + self.width * (band_of(self.draws + noise, level) - self.states)
        return low, high

    @property
    def diverged(self) -> float:
        """Fraction of the draws that diverged."""
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
            width=estimator.widths.at(own - begin),
            state_names=tuple(model.states),
            units=model.units,
            clock=clock,
            seed=seed,
        )
        for own, begin, draws in zip(times, begins, runs, strict=True)
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

    The start is fitted to the samples of the last four periods by the model itself, so that nothing
    but the past enters. The bands follow from the uncertainty of this start, the covariance of the
    model's coefficients if it has one, process noise for what the model does not describe, and the
    noise of the samples. They are as many times wider as the errors of forecasts within the fitted
    record require (`calibrate`).

    Parameters
    ----------
    model : SparseModel
        The equations.
    history : run
        Samples of the measured states and of the inputs. States of the model that it lacks are
        estimated from the others (`ep.model.estimate_states`).
    horizon : float or (samples,) array
        Duration in s, in steps of the history; or the times themselves, in s.
    fitted_to : run, optional
        The record that the model was fitted to, from which the noise is estimated. None takes the
        history.
    measured : sequence of str, optional
        States that were measured. Others that the history has were made from them (`ep.embed`), and
        only start the fit.
    inputs : array-like or mapping of str to any, optional
        Inputs of a driven model over the horizon, as for `SparseModel.simulate`.
    n_draws : int, default 200
        Number of runs of which the bands are made.
    seed : int, default 0
        Of the random draws.

    Returns
    -------
    Forecast
        Median and draws of the states at the times of the horizon. `band(level)` gives their
        bounds.

    Raises
    ------
    ValueError
        If the history has no state of the model or lacks an input, the horizon does not lie ahead,
        or all draws diverge within it.

    Notes
    -----
    The start x_0 and the size of the process noise are the most likely ones of a Kalman smoother
    whose mean follows the model, y_k = x_k + noise, x_(k+1) = F(x_k) + process noise.

    Examples
    --------
    >>> system = ep.lotka_volterra()
    >>> run = system.trajectory(noise=0.02, rng=0)
    >>> ahead = ep.forecast(system.model, run.window(0, 300), 2.0, n_draws=50)
    >>> low, high = ahead.band(0.9)
    >>> inside = (low <= run.states[300:320]) & (run.states[300:320] <= high)
    >>> bool(0.8 < inside.mean() <= 1.0)
    True
    """
    past = trajectory_of(history)
    times = _times(past.t, past.dt_s, horizon)
    known = past if fitted_to is None else trajectory_of(fitted_to)
    is_guessed = len(measured_states(model, known)) < len(model.states)
    for follow in (False, True) if is_guessed else (False,):
        tuned = tune_estimator(model, known, measured=measured, follow=follow)
        estimator = calibrate(tuned, known, seed=seed)
        (ahead,) = draw_forecasts(
            estimator, [estimator.filter(past)], past.t[-1:], times[None], inputs=inputs,
            n_draws=check_count("n_draws", n_draws), seed=seed, clock=past.clock,
        )  # fmt: skip
        lost = np.isnan(ahead.states).any(axis=1)
        if not lost.any():
            return ahead
    last_s = float(times[lost.argmax()] - past.t[-1])
    raise ValueError(
        f"a forecast must be of numbers: all {n_draws} runs of the model diverge within "
        f"{last_s:.4g} s after the history's end; ask for a shorter horizon, give the record that "
        "the model was fitted to (fitted_to=...), or take another model"
    )


def _times(t: np.ndarray, step_s: float, horizon: float | ArrayLike) -> np.ndarray:
    """The times to forecast, in s."""
    asked = np.asarray(horizon, dtype=np.float64)
    if asked.ndim == 0 and asked > 0.0 and np.isfinite(asked):
        return t[-1] + step_s * np.arange(1, max(1, int(asked / step_s + 1e-6)) + 1)
    if asked.ndim != 1 or not asked.size or not (np.diff(np.append(t[-1], asked)) > 0.0).all():
        raise ValueError(
            "horizon must be a positive duration in s, or increasing times after the history's "
            f"end at {t[-1]:.6g} s, got {horizon!r}"
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

    def pasts(self, states_of: StatesOf | None) -> list[Trajectory]:
        """The states before every start, made of their past alone."""
        back = 2 * self.estimator.memory
        pasts = [self.record.window(max(0, k - back), k) for k in self.first.tolist()]
        return pasts if states_of is None else [states_of(past) for past in pasts]

    def ends(self, pasts: Sequence[Trajectory], advance: Advance = nothing) -> list[FittedState]:
        """The state before every start."""
        found = []
        for past in pasts:
            found.append(self.estimator.filter(past))
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

    def measured(self, ahead: Sequence[Forecast]) -> Float[np.ndarray, "starts ahead measured"]:
        return np.stack([each.states[:, self.estimator.measured] for each in ahead])

    def coverage(self, ahead: Sequence[Forecast], level: float) -> float:
        """Fraction of the samples that bands hold, where there are any; NaN if there are none."""
        off = self.off(ahead, level)
        return float((off <= 1.0).sum() / np.isfinite(off).sum()) if np.isfinite(off).any() else nan

    def off(
        self, ahead: Sequence[Forecast], level: float
    ) -> Float[np.ndarray, "starts ahead measured"]:
        """Distances of samples from the medians, in those of the band's bound on their side."""
        low, high = (
            np.stack(side)[:, :, self.estimator.measured]
            for side in zip(*[each.band(level) for each in ahead], strict=True)
        )
        middle = self.measured(ahead)
        side = np.where(self.truth > middle, high, low)
        with np.errstate(divide="ignore", invalid="ignore"):  # a band without width
            return (self.truth - middle) / (side - middle)


@one_thread()
def calibrate(
    estimator: StateEstimator,
    run: Trajectory,
    *,
    states_of: StatesOf | None = None,
    seed: int = 0,
    progress: Progress = SILENT,
) -> StateEstimator:
    """The estimator with the process noise and the widths of bands that suit its own record.

    Forecasts from its later two thirds, each from its own past, go up to four periods ahead, or
    a quarter of these. The process noise under which they err least in the median is taken. Widths,
    of bands that hold 90 %, are reported at horizons of 1, 2 to 3, 4 to 7 samples and so on. None
    are reported of a record that is too short, where forecasts diverge, or of one that grows or
    decays throughout, whose past errors do not tell later ones. run: that record. states_of: as for
    `forecast_skill`. Source: Vovk, Gammerman & Shafer 2005, doi:10.1007/b106715, for bands by ranks
    of past errors.
    """
    begin = max(MIN_SAMPLES, run.n_samples // 3)
    longest = min(int(PERIODS_AHEAD * estimator.per_period), (run.n_samples - begin) // 4)
    unknown = BandWidths(np.ones(1), np.full((1, len(estimator.measured)), nan))
    if run.n_samples - begin - longest < LEAST_STARTS:
        return replace(estimator, widths=unknown)
    first = spread_starts(run.t, begin, longest, N_STARTS)
    tried = [
        RollingStarts(estimator.with_process_noise(factor), run, first, longest)
        for factor in FACTORS
    ]
    scale = zero_to_one(run.columns(estimator.names).std(axis=0))
    with progress.stage(None, "", "width of the forecasts' bands"):
        pasts = tried[0].pasts(states_of)
        ends = [each.ends(pasts) for each in tried]
        ahead = [r.forecast(own, N_WEIGHED, seed) for r, own in zip(tried, ends, strict=True)]
        errors = [
            np.median(squared_errors(each.measured(own), each.truth, scale))
            for each, own in zip(tried, ahead, strict=True)
        ]
        best = int(np.argmin(errors))
        if spirals(run.columns(estimator.names)):
            return replace(tried[best].estimator, widths=unknown)
        off = tried[best].off(tried[best].forecast(ends[best], N_DRAWS, seed), LEVEL)
    edges = np.append(2 ** np.arange(int(np.log2(longest)) + 1), longest + 1) - 1
    widths = np.full((len(edges) - 1, len(estimator.measured)), nan)
    widths[:, estimator.measured] = [
        [_width(column) for column in np.moveaxis(off[:, start:stop], 2, 0)]
        for start, stop in pairwise(edges)
    ]
    bands = BandWidths(tried[best].steps_s[edges[1:] - 1], widths)
    return replace(tried[best].estimator, widths=bands)


def _width(off: Float[np.ndarray, "starts ahead"]) -> float:
    """Width of a band that holds as many samples as it should, in the one of which these are off.

    It is the quantile of the distances. Their fractions within it, start by start, tell its
    standard error, and so how many independent distances there were. A quantile of these is
    uncertain itself: it is larger by the ratio of Student's quantile, of as many degrees, to the
    normal one.
    """
    off = np.nan_to_num(off, nan=np.inf)
    quantile = float(np.quantile(off, LEVEL, method="higher"))
    error = standard_error((off < quantile).mean(axis=1), N_WAVES)
    n_free = LEVEL * (1.0 - LEVEL) / max(error, SURELY) ** 2
    width = quantile * float(stdtrit(max(n_free, 1.0), UPPER) / ndtri(UPPER))
    return width if np.isfinite(width) else nan
