"""Runs of a model from samples all over a record, next to the samples that follow each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.gaps import between_gaps
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.draws import BLOW_UP, MAX_SUBSTEPS, runs_from, step_error
from ep2sindy.model.inputs import Curve, driven
from ep2sindy.model.vector_field import Equations, VectorField
from ep2sindy.signals.attractor import noise_std

# Steps between samples are as fine as changes a state by no more than this fraction of its largest
# sample, so that the exact law of clean samples scores 1.000.
ACCURATE = 1e-7

# What a start is moved by to see where its run goes, in standard deviations; and steps in which it
# is fitted to the samples that follow.
# They end once none of them takes a thousandth of what is left.
MOVED, N_FITTING, SETTLED = 1e-5, 6, 0.999

MOST_STARTS = 200  # along a record

# A forecast is scored where the noise of its start and of its end takes at most this fraction of
# the variance of what is to be foreseen.
LIMITED = 0.01

# Error of a forecast, in standard deviations, that counts for one that has diverged; standard
# errors from which a loss is no chance; and what noise takes that is not worth a word.
# Farther than CLOSE above what noise is said to allow, coarse samples were taken for noise.
WORST, SURELY, NOTHING, CLOSE = 10.0, 1.645, 1e-3, 0.05


@dataclass(frozen=True, eq=False)
class Restarts:
    """A model that is run along a record, driven by its inputs, from any of its samples.

    Samples that were not measured start no run and are compared with none. accurate: largest error
    of a step between samples, as a fraction of a state's largest sample.
    """

    model: Equations
    record: Trajectory
    accurate: float = ACCURATE

    def of(self, model: Equations) -> Restarts:
        """Another model of the same terms along the same record, by the same steps."""
        other = replace(self, model=model)
        for name in ("samples", "std", "_n_substeps", "_drive", "_bound"):
            other.__dict__[name] = getattr(self, name)
        return other

    @cached_property
    def samples(self) -> Float[np.ndarray, "samples n_states"]:
        """The model's states in SI, NaN where a state was not measured."""
        samples, missing = self.record.columns(self.model.states), self.record.missing
        if missing is not None:
            order = [self.record.state_names.index(state) for state in self.model.states]
            samples[missing[:, order]] = np.nan
        return samples

    @cached_property
    def std(self) -> Float[np.ndarray, " n_states"]:
        """Standard deviation of every state's samples, in SI; one for a state that rests."""
        return zero_to_one(np.nanstd(self.samples, axis=0))

    @cached_property
    def noise(self) -> Float[np.ndarray, " n_states"]:
        """Standard deviation of the white noise in every state, in SI."""
        known = [(np.isfinite(x), x) for x in self.samples.T]
        return np.array([noise_std(self.record.t[seen], x[seen]) for seen, x in known])

    @cached_property
    def _field(self) -> VectorField:
        model = self.model
        return VectorField.of(model.library, [*model.states, *model.inputs], model.coef[None])

    @cached_property
    def _drive(self) -> Curve:
        model, run = self.model, self.record
        return driven(model.inputs, run.columns(model.inputs), run.t, model.courses)[0]

    @cached_property
    def _bound(self) -> Float[np.ndarray, " n_states"]:
        return BLOW_UP * zero_to_one(np.nanmax(np.abs(self.samples), axis=0))

    @cached_property
    def _n_substeps(self) -> int:
        """Steps between two samples."""
        some = np.flatnonzero(np.isfinite(self.samples[:-1]).all(axis=1))
        some = some[np.linspace(0, len(some) - 1, min(len(some), 40)).astype(np.int64)]
        size, n = self._bound / BLOW_UP, 1
        while n < MAX_SUBSTEPS:
            off = step_error(
                self._field, self.samples[some], self.record.t, self._drive, some, n, self._bound
            )
            if np.max(np.nan_to_num(off, nan=np.inf) / size, initial=0.0) <= self.accurate:
                break
            n *= 2
        return n

    def starts(
        self, n_ahead: int, most: int = MOST_STARTS, *, measured: bool = True
    ) -> Int[np.ndarray, " starts"]:
        """Samples that start a run of `n_ahead` samples without a gap, evenly spread.

        measured: whether all states have to be measured there. Empty if there is none.
        """
        found = [np.arange(a, b - n_ahead) for a, b in between_gaps(self.record.t)]
        places = np.concatenate(found)
        if measured:
            places = places[np.isfinite(self.samples[places]).all(axis=1)]
        chosen = np.linspace(0, len(places) - 1, min(len(places), most)).round()
        return places[chosen.astype(np.int64)]

    def paths(
        self,
        starts: Float[np.ndarray, "runs n_states"],
        first: Int[np.ndarray, " runs"],
        n_ahead: int,
    ) -> Float[np.ndarray, "runs samples n_states"]:
        """States of runs from the samples `first`, these included; NaN after one has diverged."""
        n, t = self._n_substeps, self.record.t
        return runs_from(self._field, starts, t, self._drive, first, n_ahead + 1, n, self._bound)

    def off(
        self, paths: Float[np.ndarray, "runs samples n_states"], first: Int[np.ndarray, " runs"]
    ) -> Float[np.ndarray, "runs samples n_states"]:
        """Distances from the samples, in standard deviations; NaN where nothing was measured.

        A run that has diverged is infinitely far.
        """
        truth = self.samples[first[:, None] + np.arange(paths.shape[1])]
        off = np.where(np.isnan(paths), np.inf, paths - truth) / self.std
        return np.where(np.isnan(truth), np.nan, off)

    def fitted(
        self, first: Int[np.ndarray, " runs"], n_ahead: int
    ) -> Float[np.ndarray, "runs n_states"]:
        """Starts at the samples `first` whose runs come nearest to those that follow, in SI.

        Sums of squares in standard deviations are least, over an eighth of the samples first, then
        over twice as many: in chaos, a run from a sample with noise is soon far from them.
        """
        starts = self.record.columns(self.model.states)[first]  # interpolated where not measured
        for n in sorted({max(1, n_ahead // part) for part in (8, 4, 2, 1)}):
            starts = self.nearer(first, n, starts)
        return starts

    def nearer(
        self, first: np.ndarray, n_ahead: int, starts: np.ndarray
    ) -> Float[np.ndarray, "runs n_states"]:
        """Starts after some Gauss-Newton steps, each halved until it pays."""
        n, d = starts.shape
        moves = np.vstack([np.zeros(d), MOVED * np.diag(self.std)])
        best, least = starts, np.full(n, np.inf)
        for _ in range(N_FITTING):
            around = (starts[None] + moves[:, None]).reshape(-1, d)
            places = np.tile(first, d + 1)
            off = self.off(self.paths(around, places, n_ahead), places).reshape(d + 1, n, -1)
            off = np.where(np.isnan(off), 0.0, off)
            better = np.isfinite(off).all(axis=(0, 2))
            off = np.where(better[:, None], off, 0.0)
            cost = np.square(off[0]).mean(axis=1)
            better &= cost < least
            best = np.where(better[:, None], starts, best)
            least, before = np.where(better, cost, least), least
            if (least > SETTLED * before).all():
                break
            slopes = ((off[1:] - off[0]) / MOVED).transpose(1, 0, 2)
            normal = slopes @ slopes.transpose(0, 2, 1) + 1e-12 * np.eye(d)
            step = np.linalg.solve(normal, slopes @ off[0][..., None])[..., 0] * self.std
            starts = np.where(better[:, None], starts - step, 0.5 * (best + starts))
        return best


@dataclass(frozen=True, eq=False)
class OneStep:
    """Forecasts over one step from samples all over some records, from these samples alone.

    n_ahead: samples in the step. r2: (n_states,), of the change that is foreseen over the step: 1
    is exact, 0 as good as that nothing changes. limit: (n_states,), what the noise of the samples
    leaves an exact law. error, rest, mean: (starts,), mean squares over states, in variances, of
    the model's error, of that of the last sample, and of that of the mean.
    """

    n_ahead: int
    r2: Float[np.ndarray, " n_states"]
    limit: Float[np.ndarray, " n_states"]
    error: Float[np.ndarray, " starts"]
    rest: Float[np.ndarray, " starts"]
    mean: Float[np.ndarray, " starts"]

    @property
    def score(self) -> float:
        """Mean of R2 over the states."""
        return float(self.r2.mean())

    @property
    def rival(self) -> str:
        """What forecasts clearly better than the model, in words; empty if neither does."""
        losses = {"the last sample": self.error - self.rest, "the mean": self.error - self.mean}
        surely = SURELY / np.sqrt(len(self.error))
        return next((name for name, x in losses.items() if x.mean() > surely * x.std()), "")

    @property
    def text(self) -> str:
        """`0.981 over 3 samples; the noise allows 0.983`."""
        step = f"{self.n_ahead} sample{'s' * (self.n_ahead > 1)}"
        limit = float(self.limit.mean())
        is_known = limit < 1.0 - NOTHING and self.score < limit + CLOSE
        noise = f"; the noise allows {limit:.3f}" if is_known else ""
        return f"{self.score:.3f} over {step}{noise}"


def one_step(
    model: Equations, records: Sequence[Trajectory], *, horizon_s: float | None = None
) -> OneStep:
    """Forecast every record over one step from its own samples; see `SparseModel.score`.

    horizon_s: the step in s. None takes the shortest in which every state changes by ten times
    its noise, or by its standard deviation, as it does within a sixth of a turn.
    Raises ValueError if no sample of all states is followed by such a step.
    """
    along = [Restarts(model, record) for record in records]
    longest = max(record.n_samples for record in records) // 4
    if horizon_s is None:
        tried = np.unique(np.round(np.geomspace(1, max(1, longest), 40)).astype(np.int64)).tolist()
        n_ahead = next((n for n in tried if _stands_out(along, n)), tried[-1])
    else:
        n_ahead = max(1, round(horizon_s / records[0].dt_s))
    off, change, level, left = [], [], [], []
    for each in along:
        if len(first := each.starts(n_ahead)):
            own, *moved = (
                np.nan_to_num(each.paths(each.samples[first] + move, first, n_ahead), nan=np.inf)
                for move in np.vstack([np.zeros(len(each.noise)), np.diag(each.noise)])
            )
            end, worst = own[:, -1], WORST * each.std
            off.append(np.minimum(np.abs(end - each.samples[first + n_ahead]), worst))
            with np.errstate(invalid="ignore"):  # of runs that diverge from either start
                lost = [np.minimum(np.abs(path[:, -1] - end), worst) for path in moved]
            left.append(np.square(each.noise) + np.nansum(np.square(lost), axis=0))
            change.append(each.samples[first + n_ahead] - each.samples[first])
            level.append(each.samples[first + n_ahead] - np.nanmean(each.samples, axis=0))
    if not off:
        raise ValueError(
            f"a forecast needs samples of all states {list(model.states)} that {n_ahead} samples "
            f"without a gap follow, got none in {longest * 4} samples; ask for a shorter horizon_s"
        )
    squares = [np.square(np.concatenate(values)) for values in (off, change, level)]
    moves = np.concatenate(change)
    spread, n_known = zero_to_one(_variance(moves)), np.isfinite(moves).sum(axis=0)
    scale = np.mean([np.square(each.std) for each in along], axis=0)
    kept = np.isfinite(squares[0]).any(axis=1)  # something was measured at the end of the step
    error, rest, mean = (np.nanmean(values[kept] / scale, axis=1) for values in squares)
    return OneStep(
        n_ahead=n_ahead,
        r2=1.0 - np.nansum(squares[0], axis=0) / np.maximum(n_known, 1) / spread,
        limit=1.0 - np.concatenate(left).mean(axis=0) / spread,
        error=error,
        rest=rest,
        mean=mean,
    )


def _stands_out(along: Sequence[Restarts], n_ahead: int) -> bool:
    """Whether every state changes over a step by far more than its noise, or by as much as ever."""
    changes, size = _changes(along, n_ahead), np.mean([np.square(e.std) for e in along], axis=0)
    is_wide = _variance(changes) >= size
    return bool((is_wide | (_noise_taken(along, n_ahead) <= LIMITED)).all())


def _changes(along: Sequence[Restarts], n_ahead: int) -> Float[np.ndarray, "changes n_states"]:
    return np.concatenate([each.samples[n_ahead:] - each.samples[:-n_ahead] for each in along])


def _noise_taken(along: Sequence[Restarts], n_ahead: int) -> Float[np.ndarray, " n_states"]:
    """Fraction of the variance of changes over a step that is noise of its start and its end."""
    noise = 2.0 * np.mean([np.square(each.noise) for each in along], axis=0)
    return np.minimum(noise / zero_to_one(_variance(_changes(along, n_ahead))), 1.0)


def _variance(values: Float[np.ndarray, "rows n_states"]) -> Float[np.ndarray, " n_states"]:
    """Variance of the known values in every column; zero of none."""
    known = np.isfinite(values)
    n = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, values, 0.0).sum(axis=0) / n
    return np.where(known, np.square(values - mean), 0.0).sum(axis=0) / n
