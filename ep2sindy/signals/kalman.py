"""Kalman smoother that smooths and differentiates noisy samples and estimates their noise."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import least_beside_grid, zero_to_one
from ep2sindy.data.trajectory import check_time
from ep2sindy.runtime.values import read_only
from ep2sindy.signals.wiener import WienerProcess

# The range extends from a memory of about 200 samples to interpolation.
LOG10_RATIO_MIN, LOG10_RATIO_MAX = -14.0, 4.0

# Finer than data can determine: over 1000 samples the most likely ratio scatters by 0.03 or more.
LOG10_RATIO_TOLERANCE = 0.01

# Three samples determine a parabola; at least two more are needed to tell noise from signal.
MIN_SAMPLES = 5


@dataclass(frozen=True, eq=False)
class KalmanEstimate:
    """Result of the Kalman smoother for samples in u, column by column.

    smoothed: in u; derivative: in u/s.
    noise_std: standard deviation of the white noise in the samples, in u.
    log10_ratio: log10 of the ratio of process to measurement noise, with the mean step as the
    unit of time.
    """

    smoothed: Float[np.ndarray, "samples columns"]
    derivative: Float[np.ndarray, "samples columns"]
    noise_std: Float[np.ndarray, " columns"]
    log10_ratio: Float[np.ndarray, " columns"]

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, read_only(getattr(self, field.name)))


@dataclass(frozen=True)
class KalmanSmoother:
    """Smoother for a twice integrated Wiener process with white noise; steps may be unequal.

    The mean of the process given all samples is the quintic smoothing spline. Each column has its
    own ratio of process to measurement noise: the most likely one, unless log10_ratio sets it for
    all columns. The initial state is diffuse, so a parabola passes unchanged.
    finest_s, coarsest_s: bounds on the memory of the process, in s, for the most likely ratio.
    Components faster than `finest_s` count as noise. On pulses, or with few samples to a period,
    the likelihood has a second maximum where the whole signal counts as noise; `coarsest_s` keeps
    the search away from it. None sets no bound.
    Raises ValueError for a log10_ratio outside [-14, 4], or bounds that are not positive times.
    Source: Wahba 1978, doi:10.1111/j.2517-6161.1978.tb01050.x; Durbin & Koopman 2012,
    doi:10.1093/acprof:oso/9780199641178.001.0001.
    """

    log10_ratio: float | None = None
    finest_s: float | None = None
    coarsest_s: float | None = None

    def __post_init__(self) -> None:
        if self.log10_ratio is not None:
            _check_ratio(self.log10_ratio)
        check_memory_bounds(self.finest_s, self.coarsest_s)

    def estimate(
        self, t: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"]
    ) -> KalmanEstimate:
        """Smooth every column and estimate its derivative and noise.

        `smooth` and `derivative` return parts of this result, each at the full cost.

        t: (samples,) in s. A constant column is returned unchanged: its noise and derivative are
        zero, and its ratio is the smoothest one unless log10_ratio is set.
        Raises ValueError for fewer than five samples.
        """
        steps, step_s = _unit_steps(t, values)
        process, spread = WienerProcess.at(steps), values.max(axis=0) - values.min(axis=0)
        columns = (values - values[0]) / zero_to_one(spread)
        signal, noise_std = np.empty(values.shape), np.empty(len(spread))
        log10_ratio = self._ratios(process, columns, step_s)
        for j, ratio in enumerate((10.0**log10_ratio).tolist()):
            column = columns[:, j : j + 1]
            signal[:, j : j + 1] = process.signal(column, ratio)
            noise_std[j] = np.sqrt(process.likelihood(column, ratio)[1][0])
        return KalmanEstimate(
            smoothed=values[0] + spread * signal,
            derivative=spread * process.slope(signal) / step_s,
            noise_std=spread * noise_std,
            log10_ratio=log10_ratio,
        )

    def smooth(
        self, t: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"]
    ) -> Float[np.ndarray, "samples columns"]:
        """Raises ValueError for fewer than five samples."""
        return self.estimate(t, values).smoothed

    def derivative(
        self, t: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"]
    ) -> Float[np.ndarray, "samples columns"]:
        """Raises ValueError for fewer than five samples."""
        return self.estimate(t, values).derivative

    def _ratios(self, process: WienerProcess, values: np.ndarray, step_s: float) -> np.ndarray:
        if self.log10_ratio is not None:
            return np.full(values.shape[1], self.log10_ratio)
        bounds = ratio_bounds(
            self.finest_s, self.coarsest_s, step_s, (LOG10_RATIO_MIN, LOG10_RATIO_MAX)
        )
        return most_likely_ratios(process, values, *bounds)


def ratio_bounds(
    finest_s: float | None, coarsest_s: float | None, step_s: float, limits: tuple[float, float]
) -> tuple[float, float]:
    """Least and largest log10_ratio at which the memory of the process lies within its bounds.

    If the bounds contradict each other, the signal is followed: `coarsest_s` holds.
    """
    lowest, highest = limits
    if coarsest_s is not None:
        lowest = float(np.clip(6.0 * np.log10(step_s / coarsest_s), *limits))
    if finest_s is not None:
        highest = float(np.clip(6.0 * np.log10(step_s / finest_s), *limits))
    return lowest, max(lowest, highest)


def most_likely_ratios(
    process: WienerProcess,
    values: Float[np.ndarray, "samples columns"],
    lowest: float = LOG10_RATIO_MIN,
    highest: float = LOG10_RATIO_MAX,
) -> Float[np.ndarray, " columns"]:
    """log10 of the noise ratio of greatest likelihood for each column, within bounds."""
    if not values.shape[1]:
        return np.empty(0)  # LAPACK takes no empty right-hand sides
    decades = np.append(np.arange(lowest, highest, 1.0), highest)
    on_grid = np.stack([-process.likelihood(values, 10.0**decade)[0] for decade in decades])
    ratios = np.empty(values.shape[1])
    for j, misfits in enumerate(on_grid.T):
        column = values[:, j : j + 1]
        ratios[j] = least_beside_grid(
            partial(_misfit, process, column),
            decades,
            misfits,
            tolerance=LOG10_RATIO_TOLERANCE,
        )
    return ratios


def _misfit(process: WienerProcess, column: np.ndarray, log10_ratio: float) -> float:
    return -float(process.likelihood(column, 10.0**log10_ratio)[0][0])


def check_memory_bounds(finest_s: float | None, coarsest_s: float | None) -> None:
    """Raise ValueError for bounds on a smoother's memory that are no positive times."""
    for name, value in {"finest_s": finest_s, "coarsest_s": coarsest_s}.items():
        if value is not None and not value > 0.0:
            raise ValueError(f"{name} must be a positive time in s: {value} came")


def _check_ratio(log10_ratio: float) -> None:
    if not LOG10_RATIO_MIN <= log10_ratio <= LOG10_RATIO_MAX:
        raise ValueError(
            f"log10_ratio must lie in [{LOG10_RATIO_MIN:g}, {LOG10_RATIO_MAX:g}]: "
            f"{log10_ratio:g} came; leave it out to have the most likely one found"
        )


def _unit_steps(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """Time steps in units of their mean, and that mean in s."""
    if len(t) < MIN_SAMPLES:
        raise ValueError(
            f"the Kalman smoother needs at least {MIN_SAMPLES} samples: {len(t)} came; "
            "join more data"
        )
    if len(values) != len(t):
        raise ValueError(
            f"values must have one row per time: {len(values)} rows came with {len(t)} times"
        )
    check_time(t)
    step_s = (t[-1] - t[0]) / (len(t) - 1)
    return np.diff(t) / step_s, step_s
