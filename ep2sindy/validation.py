"""Selection by validation: stable terms, rows left out, and trajectories integrated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.ensemble import DrivenWindows, Ensemble
from ep2sindy.kalman import KalmanSmoother
from ep2sindy.kernels import solve_masks
from ep2sindy.model import coef_matrix
from ep2sindy.pareto import Candidate, ParetoFront
from ep2sindy.selection import FLOOR
from ep2sindy.spectrum import dominant_frequency
from ep2sindy.trajectory import Trajectory


@dataclass(frozen=True)
class Stability:
    """The largest candidate all of whose terms stood in `threshold` of the bootstraps or more.

    A term counts for a bootstrap where it was at hand and stood in a support of the candidate's
    size. score = -n_terms for a stable candidate, otherwise the share of bootstraps that lacked
    its least stable term. Assumes that a term which is not in the law is chosen by chance, now
    this one and now that: one that mends the same error of the rows in every bootstrap is as
    stable as a true one, and then too many terms are kept. Bootstraps that cull a true term upset
    its companions too, which lowers their shares in a small library. The source bounds the
    number of false terms for thresholds above a half.
    Source: Meinshausen & Buehlmann 2010, doi:10.1111/j.1467-9868.2010.00740.x.
    """

    threshold: float = 0.7
    label: ClassVar[str] = "instability"

    def __post_init__(self) -> None:
        if not 0.5 < self.threshold <= 1.0:
            raise ValueError(f"threshold must lie in (0.5, 1]: {self.threshold} came")

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " candidates"]]:
        """Raises ValueError for fronts without bootstraps."""
        _check_bootstraps([c for front in fronts for c in front.candidates])
        return [np.array([self._score(c) for c in front.candidates]) for front in fronts]

    def _score(self, candidate: Candidate) -> float:
        least = float(min(candidate.inclusion, default=1.0))
        return -float(candidate.n_terms) if least >= self.threshold else 1.0 - least


def _check_bootstraps(candidates: Sequence[Candidate]) -> None:
    if any(np.isnan(c.inclusion).any() for c in candidates):
        raise ValueError(
            "stability needs bootstraps: none stands behind a candidate; search with "
            "Bootstraps(n=32), or select with another rule"
        )


@dataclass(frozen=True)
class CrossValidation:
    """The smallest candidate whose error on rows left out is within one standard error of least.

    The training rows are cut into `n_folds` blocks of groups that follow one another. Each
    candidate is fitted without a block and judged on it: its mean square residual, as a share of
    the target's variance. Groups next to a block are left out of the fit too, since windows and
    smoothed samples reach into their neighbours. score = the mean error over the blocks, no
    less than the best mean plus its standard error. Assumes that blocks are alike: each must
    show all of the dynamics.
    Source: Hastie, Tibshirani & Friedman 2009, doi:10.1007/978-0-387-84858-7, 7.10.
    """

    n_folds: int = 5
    label: ClassVar[str] = "CV error"

    def __post_init__(self) -> None:
        if self.n_folds < 2:
            raise ValueError(f"n_folds must be at least 2: {self.n_folds} came")

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " candidates"]]:
        """Raises ValueError for fewer groups than folds, or too few rows outside of a block."""
        found = []
        for front in fronts:
            errors = _block_errors(front, self.n_folds)
            limit = _within_one_error(errors, float(self.n_folds))
            found.append(np.maximum(errors.mean(axis=1), limit))
        return found


def blocked_folds(
    groups: Int[np.ndarray, " rows"], n_folds: int
) -> tuple[Bool[np.ndarray, "folds rows"], Bool[np.ndarray, "folds rows"]]:
    """Which rows each fold is fitted to, and which it is judged on.

    Groups are numbered along time. Raises ValueError for fewer groups than folds.
    """
    numbers = np.unique(groups)
    if len(numbers) < n_folds:
        raise ValueError(
            f"every fold needs a group of training rows: {len(numbers)} groups came for "
            f"{n_folds} folds; lower n_folds, shorten the windows or use longer trajectories"
        )
    blocks = np.array_split(numbers, n_folds)
    judged = np.array([np.isin(groups, block) for block in blocks])
    near = np.array([np.isin(groups, [block - 1, block, block + 1]) for block in blocks])
    return ~near, judged


def _block_errors(front: ParetoFront, n_folds: int) -> Float[np.ndarray, "candidates folds"]:
    """Mean square residual on every block, in variances of the target; inf where no fit exists."""
    problem = front.problem
    fitted, judged = blocked_folds(problem.groups[~problem.test], n_folds)
    _check_rows(fitted.sum(axis=1), front)
    fit = problem.resampled_grams(fitted.astype(np.float64))
    judge = problem.resampled_grams(judged.astype(np.float64))
    masks = np.array([np.isin(problem.term_names, c.terms) for c in front.candidates])
    equation = problem.equations.index(front.equation)
    squares = np.empty((len(masks), n_folds))
    for k in range(n_folds):
        coef = solve_masks(fit.xx[k], np.where(masks, fit.xy[k, equation], 0.0), masks)
        explained = coef * (2.0 * judge.xy[k, equation] - coef @ judge.xx[k])
        squares[:, k] = judge.yy[k, equation] - explained.sum(axis=1)
    variance = problem.train_rows[:, len(problem.library) + equation].var()
    errors = np.maximum(squares, 0.0) / judged.sum(axis=1) / variance
    return np.where(np.isfinite(errors), errors, np.inf)


def _check_rows(n_rows: Int[np.ndarray, " folds"], front: ParetoFront) -> None:
    largest = int(front.sizes.max())
    if n_rows.min() < largest:
        raise ValueError(
            f"a candidate of {largest} terms needs as many rows outside of a block and its "
            f"neighbours: {n_rows.min()} are left; use other n_folds, or more data"
        )


def _within_one_error(errors: Float[np.ndarray, "models judges"], n_independent: float) -> float:
    """The least mean error plus its standard error, and no less than the floor."""
    best = errors[np.argmin(errors.mean(axis=1))]
    spread = best.std(ddof=1) if len(best) > 1 else 0.0
    return max(float(best.mean() + spread / np.sqrt(n_independent)), FLOOR)


@dataclass(frozen=True)
class IntegralScore:
    """Judge equations together, by integrating them: which system keeps to the trajectories?

    Every combination of candidates, one per equation, starts from smoothed samples and runs
    over `n_windows` windows, spread evenly over the trajectories. Its error is the mean square
    distance to the samples in variances of each state, 1 - R2, averaged over the states; no more
    than 10, which a run that diverges gets. Of the combinations within one standard error of the
    least mean error, the one of fewest terms wins. score = the least error of all combinations
    with the candidate, no less than that limit; the winner's candidates a hair below.
    Assumes windows short enough that the error of their start does not outgrow that of the model.
    window_s: None for half a dominant period of the first state; no longer than a trajectory.
    The standard error counts no more windows than fit in side by side.
    max_combinations: more are refused. How they are integrated is in `Ensemble`.
    """

    window_s: float | None = None
    n_windows: int = 20
    max_combinations: int = 4096
    label: ClassVar[str] = "integral error"

    def __post_init__(self) -> None:
        if self.window_s is not None and not self.window_s > 0.0:
            raise ValueError(
                f"window_s must be positive: {self.window_s} came; leave it out to take half a "
                "period"
            )
        for name in ("n_windows", "max_combinations"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1: {getattr(self, name)} came")

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " candidates"]]:
        """Raises ValueError for rows without trajectories, a state without a front, or more than
        max_combinations.
        """
        places = combinations(fronts, self.max_combinations)
        records = records_of(fronts)
        window_s = self.window_s or _half_period(records)
        n_samples = sum(run.n_samples for run in records.runs)
        lengths, starts, n_independent = [], [], 0.0
        for run in records.runs:
            n_steps = int(np.clip(round(window_s / run.dt_s), 1, run.n_samples - 1))
            n_windows = max(1, round(self.n_windows * run.n_samples / n_samples))
            last = run.n_samples - 1 - n_steps
            starts.append(np.unique(np.linspace(0, last, n_windows).round().astype(np.int64)))
            lengths.append(n_steps)
            n_independent += min(len(starts[-1]), (run.n_samples - 1) / n_steps)
        errors = records.errors(ensemble_of(fronts, places), starts, lengths)
        limit = _within_one_error(errors, n_independent)
        return joint_scores(fronts, places, errors.mean(axis=1), limit=limit)


def combinations(
    fronts: Sequence[ParetoFront], most: int
) -> Int[np.ndarray, "combinations fronts"]:
    """Every choice of one candidate per front, by index. Raises ValueError for more than `most`."""
    counts = [len(front.candidates) for front in fronts]
    if prod(counts) > most:
        raise ValueError(
            f"at most {most} combinations of candidates are integrated: {counts} candidates make "
            f"{prod(counts)}; lower depth or the search's max_terms, or raise max_combinations"
        )
    return np.indices(counts).reshape(len(counts), -1).T


def ensemble_of(
    fronts: Sequence[ParetoFront], places: Int[np.ndarray, "combinations fronts"]
) -> Ensemble:
    """One model per combination, its states in the order of the fronts."""
    library = fronts[0].problem.library
    coef = [
        coef_matrix(library, [c.coef_by_term for c in front.candidates])[:, place]
        for front, place in zip(fronts, places.T, strict=True)
    ]
    return Ensemble(library, [front.equation for front in fronts], np.stack(coef, axis=1))


@dataclass(frozen=True, eq=False)
class Records:
    """The trajectories that equations are judged by, and their states smoothed."""

    runs: Sequence[Trajectory]
    smoothed: Sequence[Float[np.ndarray, "_ n_states"]]

    def errors(
        self,
        ensemble: Ensemble,
        starts: Sequence[Int[np.ndarray, " _"]],
        n_steps: Sequence[int],
    ) -> Float[np.ndarray, "models windows"]:
        """Error of every model on every window of every run, started from its smoothed sample.

        starts, n_steps: one per run, in samples. The error is that of `Ensemble.errors`, in
        variances of the smoothed states.
        """
        joined = np.concatenate(self.smoothed)
        centre, spread = joined.mean(axis=0), joined.std(axis=0)
        errors = []
        for run, x, at, n in zip(self.runs, self.smoothed, starts, n_steps, strict=True):
            if at.size:
                windows = DrivenWindows.of(run, x, ensemble.states, ensemble.inputs, at, n)
                errors.append(ensemble.errors(windows, centre=centre, spread=spread))
        return np.concatenate(errors, axis=1)


def records_of(fronts: Sequence[ParetoFront]) -> Records:
    """What stands behind the rows, states in the order of the fronts.

    Raises ValueError for rows without trajectories or a state without a front.
    """
    runs = fronts[0].problem.trajectories
    if not runs:
        raise ValueError(
            "to integrate, the rows must know their trajectories: none came with the regression; "
            "pass them as Regression(trajectories=...)"
        )
    equations = [front.equation for front in fronts]
    if sorted(equations) != sorted(runs[0].state_names):
        raise ValueError(
            f"to integrate, every state needs one front: {equations} came for the states "
            f"{list(runs[0].state_names)}"
        )
    return Records(runs, [KalmanSmoother().smooth(run.t, run.columns(equations)) for run in runs])


def joint_scores(
    fronts: Sequence[ParetoFront],
    places: Int[np.ndarray, "combinations fronts"],
    errors: Float[np.ndarray, " combinations"],
    *,
    limit: float,
) -> list[Float[np.ndarray, " candidates"]]:
    """Scores of candidates from the errors of their combinations.

    limit: errors up to there cannot be told from the least; of these the combination of fewest
    terms wins. A candidate's score is the least error of all combinations with it, no less than
    the limit; the winner's are a hair below.
    """
    n_terms = sum(f.sizes[k] for f, k in zip(fronts, places.T, strict=True))
    winner = np.lexsort((errors, n_terms, errors > limit))[0]
    scores = np.maximum(errors, limit)
    scores[winner] = np.nextafter(limit, 0.0)
    return [
        np.array([scores[column == k].min() for k in range(len(front.candidates))])
        for front, column in zip(fronts, places.T, strict=True)
    ]


def _half_period(records: Records) -> float:
    """Half the dominant period of the first state in the longest trajectory, or all of it."""
    pairs = zip(records.runs, records.smoothed, strict=True)
    run, x = max(pairs, key=lambda pair: np.ptp(pair[0].t))
    frequency_Hz = dominant_frequency(run.t, x[:, 0])
    return 0.5 / frequency_Hz if frequency_Hz > 0.0 else float(np.ptp(run.t))
