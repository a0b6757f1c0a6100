"""Forecasts from many starts along one record, each from its own past."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.gaps import between_gaps
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.bands import Forecast, draw_forecasts
from ep2sindy.forecasting.baselines import Baseline
from ep2sindy.forecasting.state_estimation import FittedState, StateEstimator
from ep2sindy.runtime.progress import Advance, nothing
from ep2sindy.signals.spectrum import is_uniform

# Makes all states of a past, whose first columns are the measured ones.
StatesOf = Callable[[Trajectory], Trajectory]


def spread_starts(
    t: Float[np.ndarray, " samples"], first: int, longest: int, n: int
) -> Int[np.ndarray, " starts"]:
    """At most n starts of forecasts of `longest` samples, evenly spread from a first one on.

    A forecast and the sample before it lie in one stretch without a gap, unless none of them does.
    """
    starts = np.arange(min(first, len(t) - longest), len(t) - longest + 1)
    end = np.array(between_gaps(t))[:, 1]
    piece = np.searchsorted(end, starts - 1, side="right")
    inside = starts + longest <= end[piece]
    starts = starts[inside] if inside.any() else starts
    return starts[spread_evenly(len(starts), n)]


def spread_evenly(n_all: int, n: int) -> Int[np.ndarray, " places"]:
    """At most n places among n_all, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, n_all - 1, n).round().astype(np.int64))


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
        if is_uniform(t):
            times = begins[:, None] + self.steps_s
            return draw(ends, begins, times, seed=seed)
        times = np.stack([t[k : k + self.longest] for k in self.first])
        return [
            draw([end], begin[None], own[None], seed=seed + k)[0]
            for k, (end, begin, own) in enumerate(zip(ends, begins, times, strict=True))
        ]

    def continued(self, baseline: Baseline) -> Float[np.ndarray, "starts ahead measured"]:
        """What a baseline forecasts from every start."""
        samples, t = self.record.columns(self.estimator.names), self.record.t
        return np.stack(
            [baseline.ahead(samples[:k], t[:k], t[k : k + self.longest]) for k in self.first]
        )

    def measured(self, ahead: Sequence[Forecast]) -> Float[np.ndarray, "starts ahead measured"]:
        return np.stack([each.states[:, self.estimator.measured] for each in ahead])

    def coverage(self, ahead: Sequence[Forecast], level: float) -> float:
        """Share of the samples that bands hold."""
        low, high = (
            np.stack(side)[:, :, self.estimator.measured]
            for side in zip(*[each.band(level) for each in ahead], strict=True)
        )
        return float(((low <= self.truth) & (self.truth <= high)).mean())

    def with_pushes(self, factor: float) -> RollingStarts:
        """The same with pushes larger by a factor."""
        noise = replace(self.estimator.noise, process=factor * self.estimator.noise.process)
        return replace(self, estimator=replace(self.estimator, noise=noise))
