"""Selection by refinement: systems of equations, refined, are judged on windows not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.coerce import Task
from ep2sindy.data.gaps import mean_step
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.refine import refine_batch, smooth_batch
from ep2sindy.refinement.windows import MIN_SAMPLES, WindowBatch, dominant_window
from ep2sindy.regression.front import Fronts
from ep2sindy.runtime.progress import SILENT, Advance, Progress, nothing
from ep2sindy.runtime.values import set_counts
from ep2sindy.selection.criteria import FLOOR, MAX_ERROR, Basis, Decision
from ep2sindy.selection.systems import (
    Records,
    Stretch,
    Systems,
    TrialSystem,
    combine,
    cut_stretches,
    deal,
    describe_demands,
    plan_refinement,
    smooth_records,
)

# Fewest pairs of windows to cut the records into if window_s is not set.
MIN_PAIRS = 3

# Groups that the windows are dealt into. With two, half of the windows of a relaxation oscillation
# may hold none of its jumps, which leaves the coefficients of the fast equation undetermined.
N_FOLDS = 3

# Standard errors by which the winner's error may exceed the least.
N_ERRORS = 2.0


@dataclass(frozen=True)
class RefinedScore:
    """Judge systems of equations, after refinement, on windows that were not used in the fit.

    The records are cut into windows that share no samples. Every combination of candidates, one per
    equation, is refined on two of three windows and judged on the third, in turn for each of the
    three. This corrects coefficients that noise in the library has biased, before they count. For
    judging, the coefficients are held and each window's start is fitted: from a smoothed start even
    the true system, if it is chaotic, runs away from its own samples.
    The error is the mean square distance to the samples in variances of each state, averaged over
    the states with weights 1 / residual of the leader, the combination of greatest likelihood. It
    is at most 10, which also stands for a window that a combination cannot run through. A
    refinement that blows up, or that does not converge and follows its own windows no better, keeps
    the coefficients of the regression, which are judged like any other.
    Of the combinations within two standard errors of the leader the one of fewest terms wins. The
    standard error is that of the difference between the two errors, in which noise that both meet
    cancels: with n independent residuals an excess share of q in the error has the standard error
    sqrt(4 q / n), so q = 16 / n is two of them. n is the number of residuals times (1 - rho) / (1 +
    rho), rho being the autocorrelation of the leader's residuals from sample to sample. So
    differences between models that miss more than white noise are uncertain.
    score = the least error of all combinations with the candidate, no less than that limit; the
    winner's candidates score marginally below it.
    window_s: None for one and a half dominant periods, or less if needed to leave three pairs of
    windows. n_windows: most windows to judge on, over all records. max_combinations: of more,
    the most promising are judged, those whose candidates rank best in their own fronts.
    """

    window_s: float | None = None
    n_windows: int = 20
    max_combinations: int = 4096
    label: ClassVar[str] = "refined error"
    basis: ClassVar[Basis] = "runs"

    def __post_init__(self) -> None:
        if self.window_s is not None and not self.window_s > 0.0:
            raise ValueError(
                f"window_s must be positive: {self.window_s} came; leave it out to have it chosen"
            )
        set_counts(self, {"n_windows": 2, "max_combinations": 1})

    def decide(self, fronts: Fronts, task: Task, *, progress: Progress = SILENT) -> Decision:
        """Score candidates by the errors of their combinations, and refine the winner on all data.

        Raises ValueError for a state without a front, records too short for two
        windows, or relations that no combination has the terms for.
        """
        systems = combine(fronts, task, most=self.max_combinations)
        return self.judge(systems, task.runs, progress=progress)

    def judge(
        self, found: Systems, runs: Sequence[Trajectory], *, progress: Progress = SILENT
    ) -> Decision:
        """Decide among given systems, as `decide` does among the combinations of candidates.

        A winner whose refined coefficients do not meet the demands on them is passed over.
        """
        systems = found.systems
        errors, limit = self._judge(systems, smooth_records(found.fronts, runs), progress)
        broken: list[str] = []
        for _ in systems:
            winner = found.find_smallest(errors, limit=limit)
            with progress.stage(None, "", "the best system refined on all data"):
                model = systems[winner].refine_on_all(runs)
            broken = systems[winner].broken(model)
            if not broken:
                break
            errors[winner] = np.inf
        scores = found.score(errors, limit=limit, winner=winner)
        note = describe_demands(self.label, broken) + found.left_out
        return Decision(scores, model, note, systems[winner].constraint)

    def _judge(
        self, systems: Sequence[TrialSystem], records: Records, progress: Progress
    ) -> tuple[Float[np.ndarray, " combinations"], float]:
        """Error of every combination on windows it was not refined on, and the winner's limit."""
        models = [system.model for system in systems]
        spread = np.concatenate(records.smoothed).std(axis=0)
        folds = self._folds(records.runs, models[0])
        parts = []
        n_fits = 2 * len(folds) * len(_order_by_size(models))
        with progress.stage(n_fits, "fit", "systems and window starts") as advance:
            for fitted, held in folds:
                refined = _refine(systems, fitted, advance)
                scale = held.scale[: len(spread)] / spread
                parts.append(_residuals(refined, held, advance) * scale)
        return _errors_and_limit(np.concatenate(parts, axis=1))

    def _folds(
        self, runs: Sequence[Trajectory], model: SparseModel
    ) -> list[tuple[WindowBatch, WindowBatch]]:
        """Pairs of windows to refine on and windows to judge on; every window judges once."""
        runs = [piece for run in runs for piece in run.stretches(2 * MIN_SAMPLES)]
        window = self._window(runs, model.states)

        def cut(stretches: Sequence[Stretch]) -> WindowBatch:
            return cut_stretches(runs, stretches, model, window=window, n_windows=len(stretches))

        dealt = deal(self._spread_windows(runs, window), N_FOLDS)
        return [(cut(fold.fitted), cut(fold.held)) for fold in dealt]

    def _spread_windows(self, runs: Sequence[Trajectory], window: int) -> list[Stretch]:
        """Pairs of neighbouring windows, spread over every record that is long enough."""
        n_samples = sum(run.n_samples for run in runs)
        found = []
        for number, run in enumerate(runs):
            n_pairs = max(1, round(self.n_windows / 2 * run.n_samples / n_samples))
            n_pairs = min(n_pairs, run.n_samples // (2 * window))
            last = max(run.n_samples - 2 * window, 0)
            for start in np.linspace(0, last, n_pairs).round().astype(np.int64).tolist():
                found += [Stretch(number, k, k + window) for k in (start, start + window)]
        return found

    def _window(self, runs: Sequence[Trajectory], states: Sequence[str]) -> int:
        """Number of samples in each window."""
        longest = max(run.n_samples for run in runs)
        if self.window_s is None:
            room = sum(run.n_samples for run in runs) // (2 * MIN_PAIRS)
            wanted = min(dominant_window(runs, states), room)
            window = min(max(wanted, MIN_SAMPLES), longest // 2)
        else:
            step_s = mean_step(*(run.t for run in runs))
            window = round(self.window_s / step_s) + 1
        if not MIN_SAMPLES <= window <= longest // 2:
            raise ValueError(
                "a record must hold a window to refine on and another to judge on, of "
                f"{MIN_SAMPLES} samples or more: 2 x {window} were asked of at most {longest}; "
                "change window_s, or use longer records"
            )
        return window


def _order_by_size(models: Sequence[SparseModel]) -> Int[np.ndarray, " models"]:
    """Indices of the models with terms, the smallest first, so that a batch costs alike."""
    n_terms = np.array([np.count_nonzero(model.coef) for model in models], dtype=np.int64)
    order = np.argsort(n_terms, kind="stable")
    return order[n_terms[order] > 0]


def _refine(
    systems: Sequence[TrialSystem], batch: WindowBatch, advance: Advance
) -> list[SparseModel]:
    """Every system refined on the same windows; models without terms stay as they are.

    One that did not converge, and follows its own windows no better, stays as it is, too.
    """
    models = [system.model for system in systems]
    order, refined = _order_by_size(models), list(models)
    if not order.size:
        return refined
    method, together = plan_refinement(batch, models[0].library)
    found = refine_batch(
        [models[k] for k in order],
        batch,
        method=method,
        constraints=[systems[k].constraint for k in order],
        points_per_batch=together,
        advance=advance,
    )
    for k, model in zip(order, found.models, strict=True):
        refined[k] = model
    doubtful = order[~found.finished]
    before, after = (
        _bounded_squares(_residuals([each[k] for k in doubtful], batch)).mean(axis=(1, 2))
        for each in (models, refined)
    )
    for k in doubtful[after >= before]:
        refined[k] = models[k]
    return refined


def _residuals(
    models: Sequence[SparseModel], batch: WindowBatch, advance: Advance = nothing
) -> Float[np.ndarray, "models windows samples n_states"]:
    """Distances of the best trajectories to the samples, in the batch's scale; NaN if none."""
    # Without terms a state is constant, and its best constant is the mean.
    still = batch.data.mean(axis=1, keepdims=True) - batch.data
    found, order = np.repeat(still[None], len(models), axis=0), _order_by_size(models)
    if order.size:
        method, together = plan_refinement(batch, models[0].library)
        paths = smooth_batch(
            [models[k] for k in order],
            batch,
            method=method,
            points_per_batch=together,
            advance=advance,
        )
        found[order] = paths - batch.data
    return found


def _errors_and_limit(
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
