"""Whether a model follows the samples of a record, to within their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ep2sindy.data.gaps import between_gaps
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.baselines import period_of
from ep2sindy.model.comparison import ComparedRecord, spirals
from ep2sindy.model.model import SparseModel
from ep2sindy.model.restarts import Restarts
from ep2sindy.model.rollout import Rollout

# A run follows samples if its distance from those of every state is at most the white noise there,
# or this fraction of their standard deviation, if that is more. The noise is estimated: a distance
# may exceed it by a tenth, and by two standard errors of a standard deviation.
# Of some state the noise is at most NOISY of its standard deviation: within more, a model at rest
# would follow.
FLOOR, WITHIN, STANDARD_ERRORS, NOISY = 1e-3, 1.1, 2.0, 0.4

# A fitted start is not looked for any longer once a run is so many times the noise away over a part
# of the record; runs that are restarted along a record.
# A start is fitted to so many samples at most, or twice as many, and then only run on.
FAR, N_RESTARTS, MOST_FITTED = 5.0, 40, 4000


@dataclass(frozen=True, eq=False)
class Following:
    """Distances of a model's runs from the samples of a record, in units of their noise.

    rollout: the run from the first sample. compared: the record with its cycle, if it repeats one.
    assessed: numbers of the states that were measured.
    """

    model: SparseModel
    record: Trajectory
    rollout: Rollout
    compared: ComparedRecord
    assessed: Sequence[int]

    @cached_property
    def restarts(self) -> Restarts:
        return Restarts(self.model, self.record)

    @cached_property
    def unit(self) -> Float[np.ndarray, " n_states"]:
        """White noise of every state, in standard deviations of its samples; at least `FLOOR`."""
        return np.maximum(self.restarts.noise / self.restarts.std, FLOOR)

    @cached_property
    def distances(self) -> Float[np.ndarray, " n_states"]:
        """Root mean square distance over the record of every state, in units of its noise.

        Of the run from the first sample, or from a start that is fitted to the samples, whichever
        is nearer. Infinite for a run that diverges.
        """
        along, own, nearest = self.restarts, list(self.assessed), np.full(len(self.unit), np.inf)
        is_exact = bool((self.unit[own] <= FLOOR).all() and np.isfinite(along.samples[0]).all())
        if not self.rollout.diverged:
            off = (self.rollout.states - along.samples) / along.std
            nearest = np.sqrt(np.nanmean(np.square(off), axis=0)) / self.unit
        if is_exact or (nearest[own] <= self._bound).all():
            return nearest
        squares = [self._fitted_run(*piece) for piece in between_gaps(self.record.t)]
        fitted = np.sqrt(np.nanmean(np.concatenate(squares), axis=0))
        return fitted if fitted[own].max() < nearest[own].max() else nearest

    def _fitted_run(self, first: int, last: int) -> Float[np.ndarray, "samples n_states"]:
        """Squared distances of a run over a segment, whose start is fitted to more and more of it.

        Infinite if it is far from a part already, so that no start follows all of it.
        """
        along, begin, whole = self.restarts, np.array([first]), last - 1 - first
        if not whole:
            return np.full((1, len(self.unit)), np.nan)
        n = min(self._per_turn, whole)
        start = along.fitted(begin, n)
        while True:
            squares = np.square(along.off(along.paths(start, begin, n), begin)[0] / self.unit)
            if n == whole or not np.nanmean(squares) <= FAR**2:
                break
            n = min(2 * n, whole) if n < MOST_FITTED else whole
            start = along.nearer(begin, n, start) if n <= 2 * MOST_FITTED else start
        return squares if n == whole else np.full((1, len(self.unit)), np.inf)

    @property
    def _per_turn(self) -> int:
        """Samples in a period, or in the mean turn of a record that does not repeat itself."""
        period_s, n = period_of(self.record, self.model.states), self.record.n_samples - 1
        return max(1, min(n, round(period_s / self.record.dt_s)) if period_s == period_s else n)

    @property
    def _bound(self) -> float:
        """Distance up to which a run follows samples, in units of their noise."""
        return WITHIN + STANDARD_ERRORS / float(np.sqrt(2.0 * self.record.n_samples))

    @cached_property
    def followed_s(self) -> float:
        """Time over which a run stays within the noise of the samples, in s; 0.0 if it does not.

        All of the record; or a turn at a time, of a record that does not repeat itself, whose runs
        leave each other, or that is driven: then runs that are restarted all over the record stay
        within the noise, from starts that are fitted to the turn.
        """
        own, t, n = list(self.assessed), self.record.t, self._per_turn
        if not (self.unit[own] <= NOISY).any():
            return 0.0  # coarse samples may be all that looks like noise
        if (self.distances[own] <= self._bound).all():
            return float(t[-1] - t[0])
        wanders = bool(self.model.inputs) or not self.compared.repeats
        if not wanders or spirals(self.compared.states) or 2 * n > len(t):
            return 0.0
        along = self.restarts
        first = along.starts(n, N_RESTARTS, measured=False)
        off = along.off(along.paths(along.fitted(first, n), first, n), first)
        distances = np.sqrt(np.nanmean(np.square(off), axis=(0, 1))) / self.unit
        is_near = len(first) > 1 and bool((distances <= self._bound)[own].all())
        return n * self.record.dt_s if is_near else 0.0

    @property
    def text(self) -> str:
        """For how long the samples are followed, `for 10 s` or `for 0.7 s at a time`."""
        part = self.followed_s < float(self.record.t[-1] - self.record.t[0])
        span = self.record.clock.duration_text(self.followed_s)
        return f"for {span}{' at a time' if part else ''}"
