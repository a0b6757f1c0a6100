"""Calibration of bands: pushes of a size with which bands hold what they say where it can be seen.

The likeliest pushes are those that explain single steps. What a model misses lasts, however, over
many steps, so its forecasts scatter more than such pushes say; and where a record is pushed hard in
a few places alone, less.
"""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.bands import LEVEL
from ep2sindy.forecasting.rolling import RollingStarts, StatesOf, spread_evenly
from ep2sindy.forecasting.state_estimation import StateEstimator
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.runtime.threads import one_thread
from ep2sindy.signals.spectrum import is_uniform

N_STARTS, N_DRAWS, PERIODS_AHEAD = 24, 60, 1.5
TOLERANCE = 0.03  # deviation from the level at which a band counts as calibrated
FACTORS = 10.0 ** np.arange(-2.0, 2.1, 0.25)  # of the likeliest pushes


@one_thread()
def calibrate(
    estimator: StateEstimator,
    run: Trajectory,
    *,
    states_of: StatesOf | None = None,
    seed: int = 0,
    progress: Progress = SILENT,
) -> StateEstimator:
    """The estimator with pushes whose bands hold 90 % of the record that the model was fitted to.

    run: that record. states_of: as for `forecast_skill`. Forecasts of up to one and a half periods
    from its later half are counted. A estimator that is calibrated already, a driven model, and a
    record at unequal steps come back unchanged.
    """
    ahead = max(2, int(PERIODS_AHEAD * estimator.per_period))
    first = np.arange(max(estimator.memory, run.n_samples // 3), run.n_samples - ahead)
    if estimator.model.inputs or not is_uniform(run.t) or len(first) < N_STARTS:
        return estimator
    first = first[spread_evenly(len(first), N_STARTS)]
    rolling = RollingStarts(estimator, run, first, ahead)

    def coverage(factor: float) -> float:
        pushed = rolling.with_pushes(factor)
        return pushed.coverage(pushed.forecast(ends, N_DRAWS, seed), LEVEL)

    with progress.stage(None, "", "width of the forecasts' bands"):
        ends = rolling.ends(states_of)
        if abs(coverage(1.0) - LEVEL) <= TOLERANCE:
            return estimator
        # More pushes make wider bands.
        above = bisect_left(FACTORS[1:-1], LEVEL, key=coverage) + 1
    return rolling.with_pushes(float(FACTORS[above])).estimator
