"""Selection: the Pareto front of error against number of terms, and its knee."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.kernels import fit_masks
from ep2sindy.regression import Gram, Regression
from ep2sindy.search import Supports


@dataclass(frozen=True, eq=False)
class Candidate:
    """One support of one equation, with its least-squares fit to the training rows.

    coef: (terms of the support,), in SI. r2_train, r2_test: 1 - SS_res/SS_tot with the data as
    truth. share: share of bootstraps that found this support. inclusion: for each of its
    terms, the share of bootstraps in which the term stood in a support of this size.
    """

    equation: str
    terms: tuple[str, ...]
    coef: Float[np.ndarray, " support"]
    r2_train: float
    r2_test: float
    share: float
    inclusion: Float[np.ndarray, " support"]

    @property
    def n_terms(self) -> int:
        return len(self.terms)


@dataclass(frozen=True, eq=False)
class ParetoFront:
    """The best candidate of every size, the empty model first; the error falls with size.

    n_library: number of terms in the library.
    """

    equation: str
    candidates: Sequence[Candidate]
    n_library: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "candidates", tuple(self.candidates))
        assert self.candidates
        assert self.candidates[0].n_terms == 0
        assert all(np.diff([c.n_terms for c in self.candidates]) > 0)
        assert all(np.diff(self.errors) < 0)

    @property
    def errors(self) -> Float[np.ndarray, " candidates"]:
        """1 - R2 on held-out rows, or on the training rows where none are held out."""
        return np.array([1.0 - _score(c) for c in self.candidates])

    @property
    def sizes(self) -> Float[np.ndarray, " candidates"]:
        return np.array([float(c.n_terms) for c in self.candidates])


def _score(candidate: Candidate) -> float:
    return candidate.r2_train if np.isnan(candidate.r2_test) else candidate.r2_test


@dataclass(frozen=True)
class Knee:
    """Select the candidate closest to no error and no terms.

    distance = sqrt((1 - R2)^2 + (n_terms / n_norm)^2), where n_norm is the number of terms in
    the library (the thesis's Eq. 9), or for "max_terms" the largest candidate's plus one (what
    the thesis's Tables II and III were made with). Any term that raises R2 by less than about
    one step of n_terms / n_norm is dropped, by construction.
    """

    n_norm: str = "library"

    def __post_init__(self) -> None:
        if self.n_norm not in ("library", "max_terms"):
            raise ValueError(f"n_norm must be 'library' or 'max_terms': {self.n_norm!r} came")

    def distances(self, front: ParetoFront) -> Float[np.ndarray, " candidates"]:
        largest = front.n_library if self.n_norm == "library" else front.sizes.max() + 1
        return np.hypot(front.errors, front.sizes / largest)

    def select(self, front: ParetoFront) -> Candidate:
        return front.candidates[int(np.argmin(self.distances(front)))]


def pareto_front(problem: Regression, supports: Supports) -> ParetoFront:
    """Fit every support on all training rows and keep the best of each size.

    "Best" is by held-out rows, as in the thesis. A size whose best does not beat a smaller
    one is left out, and so are supports whose terms depend on each other.
    """
    equation = problem.equations.index(supports.equation)
    errors = _errors(problem, equation, supports.masks)
    sizes = supports.masks.sum(axis=1)
    candidates = [_fit(problem, equation, supports, None)]
    for size in np.unique(sizes[(sizes > 0) & np.isfinite(errors)]):
        of_size = np.flatnonzero(sizes == size)
        best = of_size[np.nanargmin(errors[of_size])]
        candidate = _fit(problem, equation, supports, int(best))
        if _score(candidate) > _score(candidates[-1]):
            candidates.append(candidate)
    return ParetoFront(supports.equation, candidates, len(problem.library))


def _errors(
    problem: Regression, equation: int, masks: np.ndarray
) -> Float[np.ndarray, " supports"]:
    """1 - R2 of every support from the Gram matrices alone; NaN where terms depend."""
    train = problem.train_gram
    judge = problem.test_gram if problem.test.any() else train
    coef, solvable = fit_masks(train.xx, np.ascontiguousarray(train.xy[:, equation]), masks)
    errors = _residual(judge, equation, coef) / judge.total[equation]
    errors[~solvable] = np.nan
    return errors


def _residual(
    gram: Gram, equation: int, coef: Float[np.ndarray, "supports terms"]
) -> Float[np.ndarray, " supports"]:
    explained = 2.0 * coef @ gram.xy[:, equation] - np.einsum("st,st->s", coef @ gram.xx, coef)
    return gram.yy[equation] - explained


def _fit(problem: Regression, equation: int, supports: Supports, chosen: int | None) -> Candidate:
    """Fit one support on the rows themselves: the Gram matrix would square its condition."""
    if chosen is None:
        columns, share = np.zeros(0, dtype=np.int64), _share_of_empty(supports)
    else:
        columns, share = np.flatnonzero(supports.masks[chosen]), supports.share[chosen]
    target = len(problem.library) + equation
    rows = problem.train_rows
    scaled = np.linalg.lstsq(rows[:, columns], rows[:, target], rcond=None)[0]

    def score(rows: np.ndarray) -> float:
        return r2(truth=rows[:, target], prediction=rows[:, columns] @ scaled)

    return Candidate(
        equation=supports.equation,
        terms=tuple(problem.term_names[k] for k in columns),
        coef=scaled * problem.target_scale[equation] / problem.theta_scale[columns],
        r2_train=score(rows),
        r2_test=score(problem.test_rows) if problem.test.any() else float("nan"),
        share=float(share),
        inclusion=supports.inclusion[len(columns), columns],
    )


def _share_of_empty(supports: Supports) -> float:
    empty = ~supports.masks.any(axis=1)
    return float(supports.share[empty].sum())


def r2(*, truth: Float[np.ndarray, " rows"], prediction: Float[np.ndarray, " rows"]) -> float:
    """Coefficient of determination, 1 - SS_res/SS_tot, the total about the truth's mean."""
    total = np.square(truth - truth.mean()).sum()
    if total == 0.0:
        raise ValueError(
            "R2 needs a target that varies: it is constant on these rows; hold out more rows "
            "or check that the state varies"
        )
    return float(1.0 - np.square(truth - prediction).sum() / total)
