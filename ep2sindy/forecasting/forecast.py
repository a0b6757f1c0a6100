"""Forecast of a model from the end of a record, with bands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ep2sindy.data.coerce import Run, trajectory_of
from ep2sindy.data.numbers import band_of, quantiles
from ep2sindy.forecasting.tracking import FittedState, Tracker, track
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.draws import draw_coef, draw_normal, draw_runs
from ep2sindy.model.inputs import driven
from ep2sindy.model.model import SparseModel
from ep2sindy.runtime.values import check_count, read_only
from ep2sindy.signals.spectrum import dominant_frequency

LEVEL = 0.9  # share of the samples that a band is to hold


@dataclass(frozen=True, eq=False)
class Forecast:
    """States that a model expects after a record, with the uncertainty of what a sensor will show.

    t: (samples,) in s, the first one after the record's end. states: (samples, n_states), the
    median of the draws, in SI. draws: (draws, samples, n_states), runs from starts and with
    coefficients drawn by their covariance, pushed at random as the record was; NaN where a run has
    diverged. noise_std: (n_states,), of the sensor's noise; NaN for states that it does not show.
    """

    t: Float[np.ndarray, " samples"]
    states: Float[np.ndarray, "samples n_states"]
    draws: Float[np.ndarray, "draws samples n_states"] = field(repr=False)
    noise_std: Float[np.ndarray, " n_states"]
    state_names: tuple[str, ...]
    units: Mapping[str, str]
    clock: Clock = SECONDS
    seed: int = field(default=0, repr=False)

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
        low, high = band_of(self.draws + noise, level)
        return low, high

    @property
    def diverged(self) -> float:
        """Share of the draws that diverged."""
        return float(np.isnan(self.draws[:, -1]).any(axis=1).mean())

    def frequency_Hz(self, level: float = LEVEL) -> tuple[float, float, float]:
        """Dominant frequency of the first state: lower bound, median, upper bound over the draws.

        Draws that diverged are left out; NaN if none is left.
        """
        kept = self.draws[~np.isnan(self.draws).any(axis=(1, 2)), :, 0]
        return _interval([dominant_frequency(self.t, path) for path in kept], level)

    def amplitude(self, state: str, level: float = LEVEL) -> tuple[float, float, float]:
        """Standard deviation in time of a state: lower bound, median, upper bound over the draws.

        Raises ValueError for an unknown state.
        """
        if state not in self.state_names:
            raise ValueError(f"unknown state {state!r}; this forecast has {list(self.state_names)}")
        kept = self.draws[~np.isnan(self.draws).any(axis=(1, 2)), :, self.state_names.index(state)]
        return _interval(kept.std(axis=1).tolist(), level)


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
    The noise of the samples, and random pushes for what the model does not describe, are the
    likeliest ones for the record that the model was fitted to. The bands follow from the
    uncertainty of the start, from the covariance of the model's coefficients if it has one, from
    these pushes, and from the noise.
    history: samples of all states and inputs of the model; a Trajectory, a table or (t, x).
    horizon: duration in s, in steps of the history; or the times (samples,) themselves, in s.
    fitted_to: the record that the model was fitted to; None takes the history. measured: states
    that were measured; others were made from them (`ep.signals.embed`), and only start the fit.
    inputs: of a driven model over the horizon, as for `simulate`.
    Raises ValueError for a history without some variable, or a horizon that does not lie ahead.

    >>> run = ep.lorenz().trajectory(noise=0.05, rng=0)
    >>> ahead = ep.forecast(ep.lorenz().model, run.window(0, 2000), 0.5)
    >>> low, high = ahead.band(0.9)
    >>> inside = (low <= run.states[2000:2050]) & (run.states[2000:2050] <= high)
    >>> bool(0.8 < inside.mean() <= 1.0)
    True
    """
    past = trajectory_of(history)
    times = _times(past.t, past.dt_s, horizon)
    known = past if fitted_to is None else trajectory_of(fitted_to)
    tracker = track(model, known, measured=measured)
    end = tracker.end_of(past)
    return forecasts(
        tracker, [end], past.t[-1:], times[None], inputs=inputs,
        n_draws=check_count("n_draws", n_draws), seed=seed, clock=past.clock,
    )[0]  # fmt: skip


def forecasts(
    tracker: Tracker,
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
    model, rng = tracker.model, np.random.default_rng(seed)
    starts = np.concatenate([draw_normal(end.mean, end.covariance, n_draws, rng) for end in ends])
    coef = draw_coef(model, model.covariance, len(starts), rng)
    grid = np.append(begins[0], times[0])
    drive, _ = driven(model.inputs, inputs, grid)
    runs = draw_runs(
        model,
        grid,
        starts,
        coef,
        drive=drive,
        push_std=tracker.noise.process,
        push_step_s=tracker.problem.step_s,
        reach=tracker.problem.scale,
        rng=rng,
    )[:, 1:].reshape(len(ends), n_draws, times.shape[1], -1)
    return [
        Forecast(
            t=own,
            states=quantiles(draws, [0.5])[0],
            draws=draws,
            noise_std=tracker.noise.samples,
            state_names=tuple(model.states),
            units=model.units,
            clock=clock,
            seed=seed,
        )
        for own, draws in zip(times, runs, strict=True)
    ]


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


def _interval(values: Sequence[float], level: float) -> tuple[float, float, float]:
    if not len(values):
        return (float("nan"),) * 3
    low, middle, high = np.quantile(values, [0.5 - 0.5 * level, 0.5, 0.5 + 0.5 * level])
    return float(low), float(middle), float(high)
