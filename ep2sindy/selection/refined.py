"""Selection by refinement: systems of equations, refined, are judged on windows not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.gaps import mean_step
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, Relation
from ep2sindy.model.many import Ensemble
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.refine import refine_batch, smooth_batch
from ep2sindy.refinement.windows import MIN_SAMPLES, WindowBatch, cut_windows, dominant_window
from ep2sindy.regression.front import ParetoFront
from ep2sindy.runtime.progress import SILENT, Advance, Progress, nothing
from ep2sindy.runtime.values import set_counts
from ep2sindy.selection.criteria import FLOOR
from ep2sindy.selection.rule import (
    MAX_ERROR,
    Decision,
    combination_scores,
    combinations,
    smallest,
)
from ep2sindy.selection.systems import (
    Records,
    Systems,
    TrialSystem,
    budget,
    combined,
    demands_note,
    records_of,
    systems_of,
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

    def __post_init__(self) -> None:
        if self.window_s is not None and not self.window_s > 0.0:
            raise ValueError(
                f"window_s must be positive: {self.window_s} came; leave it out to have it chosen"
            )
        set_counts(self, {"n_windows": 2, "max_combinations": 1})

    def scores(
        self, fronts: Sequence[ParetoFront], library: Library, runs: Sequence[Trajectory]
    ) -> list[Float[np.ndarray, " _candidates"]]:
        """Scores of every candidate by the errors of its combinations.

        Raises ValueError for no runs, a state without a front, or records too short for two
        windows.
        """
        places = combinations(fronts, self.max_combinations)
        systems = systems_of(fronts, places, library, runs)
        errors, limit = self._judge(systems, records_of(fronts, runs), SILENT)
        return combination_scores(fronts, places, errors, limit=limit)

    def decide(
        self,
        fronts: Sequence[ParetoFront],
        library: Library,
        runs: Sequence[Trajectory],
        relations: Sequence[Relation] = (),
        *,
        progress: Progress = SILENT,
    ) -> Decision:
        """Score the candidates as `scores` does, and refine the winner on windows of all the data.

        Also raises ValueError for relations that no combination has the terms for.
        """
        found = combined(fronts, library, runs, relations, most=self.max_combinations)
        return self.judge(found, runs, progress=progress)

    def judge(
        self, found: Systems, runs: Sequence[Trajectory], *, progress: Progress = SILENT
    ) -> Decision:
        """Decide among given systems, as `decide` does among the combinations of candidates.

        A winner whose refined coefficients do not meet the demands on them is passed over.
        """
        fronts, places, systems = found.fronts, found.places, found.systems
        errors, limit = self._judge(systems, records_of(fronts, runs), progress)
        broken: list[str] = []
        for _ in systems:
            winner = smallest(fronts, places, errors, limit=limit)
            with progress.stage(None, "", "the best system refined on all data"):
                model = systems[winner].refined_on_all(runs)
            broken = systems[winner].broken(model)
            if not broken:
                break
            errors[winner] = np.inf
        scores = combination_scores(fronts, places, errors, limit=limit, winner=winner)
        note = demands_note(self.label, broken) + found.left_out
        return Decision(scores, model, note, systems[winner].constraint)

    def _judge(
        self, systems: Sequence[TrialSystem], records: Records, progress: Progress
    ) -> tuple[Float[np.ndarray, " combinations"], float]:
        """Error of every combination on windows it was not refined on, and the winner's limit."""
        coef = np.stack([system.model.coef for system in systems], axis=2)
        model = systems[0].model
        ensemble = Ensemble(model.library, model.states, coef)
        constraints = [system.constraint for system in systems]
        spread = np.concatenate(records.smoothed).std(axis=0)
        folds = self._folds(records.runs, ensemble)
        parts = []
        n_fits = 2 * len(folds) * len(_by_size(ensemble))
        with progress.stage(n_fits, "fit", "systems and window starts") as advance:
            for fitted, held in folds:
                refined = _refined(ensemble, fitted, constraints, advance)
                scale = held.scale[: len(spread)] / spread
                parts.append(_residuals(refined, held, advance) * scale)
        return _errors_and_limit(np.concatenate(parts, axis=1))

    def _folds(
        self, runs: Sequence[Trajectory], ensemble: Ensemble
    ) -> list[tuple[WindowBatch, WindowBatch]]:
        """Pairs of windows to refine on and windows to judge on; every window judges once."""
        runs = [piece for run in runs for piece in run.stretches(2 * MIN_SAMPLES)]
        pieces = self._pieces(runs, self._window(runs, ensemble.states))
        n_folds = min(N_FOLDS, len(pieces))
        nothing_left_to_chance = np.random.default_rng(0)  # one window per trajectory

        def batch(chosen: list[Trajectory]) -> WindowBatch:
            return cut_windows(
                chosen,
                states=ensemble.states,
                inputs=ensemble.inputs,
                n_windows=len(chosen),
                window=chosen[0].n_samples,
                rng=nothing_left_to_chance,
            )

        return [
            (
                batch([each for k, each in enumerate(pieces) if k % n_folds != fold]),
                batch(pieces[fold::n_folds]),
            )
            for fold in range(n_folds)
        ]

    def _pieces(self, runs: Sequence[Trajectory], window: int) -> list[Trajectory]:
        """Pairs of neighbouring windows, spread over every record that is long enough."""
        n_samples = sum(run.n_samples for run in runs)
        pieces = []
        for run in runs:
            n_pairs = max(1, round(self.n_windows / 2 * run.n_samples / n_samples))
            n_pairs = min(n_pairs, run.n_samples // (2 * window))
            last = max(run.n_samples - 2 * window, 0)
            for start in np.linspace(0, last, n_pairs).round().astype(np.int64).tolist():
                pieces += [run.window(k, k + window) for k in (start, start + window)]
        return pieces

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


def _models(ensemble: Ensemble, places: Int[np.ndarray, " models"]) -> list[SparseModel]:
    states = list(ensemble.states)
    return [SparseModel(ensemble.library, states, ensemble.coef[:, :, k]) for k in places]


def _by_size(ensemble: Ensemble) -> Int[np.ndarray, " models"]:
    """Indices of the models with terms, the smallest first, so that a batch costs alike."""
    n_terms = (ensemble.coef != 0.0).sum(axis=(0, 1))
    order = np.argsort(n_terms, kind="stable")
    return order[n_terms[order] > 0]


def _refined(
    ensemble: Ensemble,
    batch: WindowBatch,
    constraints: Sequence[Constraint],
    advance: Advance,
) -> Ensemble:
    """Every model refined on the same windows; models without terms stay as they are."""
    order = _by_size(ensemble)
    if not order.size:
        return ensemble
    method, together = budget(batch, ensemble.library)
    found = refine_batch(
        _models(ensemble, order),
        batch,
        method=method,
        constraints=[constraints[k] for k in order],
        points_per_batch=together,
        advance=advance,
    )
    coef = ensemble.coef.copy()
    coef[:, :, order] = np.stack([model.coef for model in found.models], axis=2)
    refined = replace(ensemble, coef=coef)
    doubtful = order[~found.finished]
    before, after = (
        _bounded_squares(_residuals(replace(each, coef=each.coef[:, :, doubtful]), batch))
        for each in (ensemble, refined)
    )
    worse = doubtful[after.mean(axis=(1, 2)) >= before.mean(axis=(1, 2))]
    coef[:, :, worse] = ensemble.coef[:, :, worse]
    return refined


def _residuals(
    ensemble: Ensemble, batch: WindowBatch, advance: Advance = nothing
) -> Float[np.ndarray, "models windows samples n_states"]:
    """Distances of the best trajectories to the samples, in the batch's scale; NaN if none."""
    # Without terms a state is constant, and its best constant is the mean.
    still = batch.data.mean(axis=1, keepdims=True) - batch.data
    found = np.repeat(still[None], ensemble.coef.shape[2], axis=0)
    order = _by_size(ensemble)
    if order.size:
        method, together = budget(batch, ensemble.library)
        paths = smooth_batch(
            _models(ensemble, order),
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
