"""Forecast of a model from the end of a record, with bands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.forecasting.bands import Forecast, draw_forecasts
from ep2sindy.forecasting.calibration import calibrate
from ep2sindy.forecasting.state_estimation import tune_estimator
from ep2sindy.model.model import SparseModel
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_count


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
    this process noise, and from the noise.
    history: samples of the measured states and of the inputs; a Trajectory, a table or (t, x).
    States of the model that it lacks are told from the others (`estimate_states`).
    horizon: duration in s, in steps of the history; or the times (samples,) themselves, in s.
    fitted_to: the record that the model was fitted to; None takes the history. measured: states
    that were measured; others that the history has were made from them (`ep.signals.embed`), and
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
    end = estimator.filter(past)
    return draw_forecasts(
        estimator, [end], past.t[-1:], times[None], inputs=inputs,
        n_draws=check_count("n_draws", n_draws), seed=seed, clock=past.clock,
    )[0]  # fmt: skip


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
