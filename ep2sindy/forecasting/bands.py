"""Forecasts as draws: runs from fitted states, their median and their bands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ep2sindy.data.numbers import band_of, quantiles
from ep2sindy.forecasting.state_estimation import FittedState, StateEstimator
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.draws import draw_coef, draw_normal, draw_runs
from ep2sindy.model.inputs import driven
from ep2sindy.runtime.values import read_only

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
        push_std=estimator.noise.process,
        push_step_s=estimator.problem.step_s,
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
