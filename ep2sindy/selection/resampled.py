"""Selection by resampling: stable terms, and rows left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.regression.gram_fits import solve_masks
from ep2sindy.search.front import Candidate, ParetoFront
from ep2sindy.selection.rule import FLOOR


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

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " _candidates"]]:
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

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " _candidates"]]:
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
    variance = problem.train_target(equation).var()
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
