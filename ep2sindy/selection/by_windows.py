"""Systems assessed on windows that they were not refined on, for records without a cycle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.model import SparseModel
from ep2sindy.model.restarts import Restarts
from ep2sindy.refinement.windows import MIN_SAMPLES, dominant_window
from ep2sindy.runtime.progress import Progress
from ep2sindy.selection.criteria import FLOOR, MAX_ERROR
from ep2sindy.selection.systems import (
    BatchRefinement,
    ConfirmedSystem,
    Fold,
    Segment,
    Trial,
    TrialSystem,
    deal,
)

# Fewest pairs of windows to cut the records into.
MIN_PAIRS = 3

# Standard errors by which the winner's error may exceed the least.
N_ERRORS = 2.0


@dataclass(frozen=True, eq=False)
class WindowsLeftOut:
    """Errors of systems on windows that share no samples with those that they were refined on.

    To assess a system, its coefficients are held and each window's start is fitted
    (`model.restarts`): from a smoothed start even the true system, if it is chaotic, runs away from
    its own samples. The error is the mean square distance to the samples in variances of each
    state, averaged over the states with weights 1 / residual of the leader, the system of greatest
    likelihood. It is at most 10, which also stands for a window that a system cannot run through. A
    refinement that blows up keeps the coefficients of the regression, which are assessed like any
    other. The bound of the error is two standard errors above the leader's. The standard error is
    that of the difference between the two errors, in which noise that both meet cancels: with n
    independent residuals an excess fraction of q in the error has the standard error sqrt(4 q / n),
    so q = 16 / n is two of them. n is the number of residuals times (1 - rho) / (1 + rho), rho
    being the autocorrelation of the leader's residuals from sample to sample. So differences
    between models that miss more than white noise are uncertain.

    runs: the records between their gaps. spread: standard deviation of each state over all runs.
    n_windows: that are assessed, over all records, each in one fold.
    """

    runs: Sequence[Trajectory]
    spread: Float[np.ndarray, " n_states"]
    states: Sequence[str]
    n_windows: int
    n_folds: int
    window_on_all = None  # one and a half periods
    n_reweights = 1

    @cached_property
    def window(self) -> int:
        """Number of samples in each: one and a half periods, or what leaves three pairs."""
        lengths = [run.n_samples for run in self.runs]
        wanted = min(dominant_window(self.runs, self.states), sum(lengths) // (2 * MIN_PAIRS))
        if max(lengths) < 2 * MIN_SAMPLES:
            raise ValueError(
                "a record must hold a window to refine on and another to assess on, of "
                f"{MIN_SAMPLES} samples or more, got at most {max(lengths)}; use longer records"
            )
        return min(max(wanted, MIN_SAMPLES), max(lengths) // 2)

    @cached_property
    def folds(self) -> list[Fold]:
        """Pairs of neighbouring windows, spread over every record that is long enough, dealt out.

        Blocks of a record, as for free runs, would tell right from wrong less often.
        """
        lengths, window, found = [run.n_samples for run in self.runs], self.window, []
        for number, length in enumerate(lengths):
            n_pairs = max(1, round(self.n_windows / 2 * length / sum(lengths)))
            n_pairs = min(n_pairs, length // (2 * window))
            last = max(length - 2 * window, 0)
            for start in np.linspace(0, last, n_pairs).round().astype(np.int64).tolist():
                found += [Segment(number, k, k + window) for k in (start, start + window)]
        return deal(found, self.n_folds)

    def count(self, segments: Sequence[Segment]) -> int:
        """Number of windows: each segment is one."""
        return len(segments)

    def admits(self, system: TrialSystem) -> bool:
        return bool(system.model.coef.any())

    def assess(
        self,
        systems: Sequence[TrialSystem],
        refined: BatchRefinement,
        fold: Fold,
        progress: Progress,
    ) -> Float[np.ndarray, "systems windows samples n_states"]:
        """Distances to windows held out, in `spread`; NaN once a run has diverged."""
        number, first = np.array([(window.run, window.start) for window in fold.held]).T
        found = np.empty((len(systems), len(first), self.window, len(self.states)))
        with progress.stage(len(systems), "system", "starts of windows held out") as advance:
            for model, distances in zip(refined.models, found, strict=True):
                for k in np.unique(number).tolist():
                    along, own = Restarts(model, self.runs[k]), number == k
                    starts = along.fitted(first[own], self.window - 1)
                    paths = along.paths(starts, first[own], self.window - 1)
                    samples = along.samples[first[own, None] + np.arange(self.window)]
                    distances[own] = (paths - samples) / self.spread
                advance(1)
        return found

    def figures(self, tried: Sequence[np.ndarray]) -> Float[np.ndarray, "systems 5"]:
        """Errors in units of their bound, zero up to the bound, as those systems are alike."""
        errors, bound = _errors_and_bound(np.concatenate(tried, axis=1))
        unknown = np.full_like(errors, np.nan)
        ratios = np.where(errors > bound, np.minimum(errors / bound, MAX_ERROR), 0.0)
        return np.column_stack([ratios, unknown, unknown, errors, errors])

    def confirm(self, trial: Trial, model: SparseModel) -> ConfirmedSystem:
        """A system is confirmed if its coefficients, refined on all data, meet the demands."""
        broken = trial.system.broken(model)
        return ConfirmedSystem(trial, model, broken, fraction=float(not broken))


def _errors_and_bound(
    residuals: Float[np.ndarray, "models windows samples n_states"],
) -> tuple[Float[np.ndarray, " models"], float]:
    """Error of every model, and the largest error not distinguishable from the leader's."""
    squares = _bounded_squares(residuals)
    by_state = np.maximum(squares.mean(axis=1), FLOOR)
    leader = int(np.argmin(np.log(by_state).sum(axis=1)))
    least = by_state[leader]
    errors = np.minimum((by_state / least).mean(axis=1) * least.mean(), MAX_ERROR)
    n = _independent(np.nan_to_num(residuals[leader]))
    return errors, float(least.mean() * (1.0 + (2.0 * N_ERRORS) ** 2 / n))


def _bounded_squares(
    residuals: Float[np.ndarray, "models windows samples n_states"],
) -> Float[np.ndarray, "models windows n_states"]:
    """Mean squares over a window, at most MAX_ERROR, which also stands for a missing trajectory."""
    with np.errstate(over="ignore"):
        squares = np.square(residuals).mean(axis=2)
    return np.where(squares < MAX_ERROR, squares, MAX_ERROR)


def _independent(residuals: Float[np.ndarray, "windows samples n_states"]) -> float:
    """Number of independent residuals with the same information on a mean, by autocorrelation."""
    power = np.maximum(np.square(residuals).sum(axis=(0, 1)), 1e-300)
    rho = (residuals[:, 1:] * residuals[:, :-1]).sum(axis=(0, 1)) / power
    rho = np.clip(rho, 0.0, 1.0)
    n_samples = residuals.shape[0] * residuals.shape[1]
    return max(float((n_samples * (1.0 - rho) / (1.0 + rho)).sum()), 1.0)
