"""Pareto front of error versus number of terms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.library.equations import equation_html, equation_text
from ep2sindy.model.scores import r2_of
from ep2sindy.regression.bootstraps import Supports
from ep2sindy.regression.gram_kernels import explained_squares, fit_masks, solve_masks
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.runtime.drawing import draw
from ep2sindy.runtime.screen import html_table, one_screen, text_table
from ep2sindy.runtime.values import check_count

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Correction of coefficients, as a share of them, after which another one would be rounding.
REFINED = 1e-9


@dataclass(frozen=True, eq=False)
class Candidate:
    """One support of one equation, with its fit.

    coef: (terms of the support,), in SI. From a regression: least squares on the training rows;
    from a search of trajectories: the most likely values given the other equations.
    r2_train, r2_test: 1 - SS_res/SS_tot with the data as truth; NaN if there are no such rows.
    share: share of bootstraps that found this support. inclusion: for each of its terms, the share
    of bootstraps in which the term was in a support of this size. Both are NaN without bootstraps.
    deviance: -2 log likelihood of whole trajectories plus the penalty for the terms, relative to
    the best system; None if only rows were fitted.
    score: value of the selection rule, the lowest of the front being selected; NaN before
    selection.
    """

    equation: str
    terms: tuple[str, ...]
    coef: Float[np.ndarray, " support"]
    r2_train: float
    r2_test: float
    share: float
    inclusion: Float[np.ndarray, " support"]
    deviance: float | None = None
    score: float = float("nan")

    @property
    def n_terms(self) -> int:
        return len(self.terms)

    @property
    def coef_by_term(self) -> dict[str, float]:
        return dict(zip(self.terms, self.coef.tolist(), strict=True))

    @property
    def r2(self) -> float:
        """R2 on held-out rows, or on the training rows if none are held out."""
        return self.r2_train if np.isnan(self.r2_test) else self.r2_test


@dataclass(frozen=True, eq=False)
class Cloud:
    """Number of terms and error of every distinct support that a search proposed.

    errors: 1 - R2 as in `ParetoFront.errors`, but from Gram matrices only, so an exact fit has an
    error of about 1e-13, of either sign. Supports with linearly dependent terms are left out.
    """

    sizes: Int[np.ndarray, " supports"]
    errors: Float[np.ndarray, " supports"]


@dataclass(frozen=True, eq=False)
class ParetoFront:
    """The best candidates of every size, the empty model first.

    `pareto_front` sorts them by size, and within a size by error. The first candidates of the
    sizes form the front proper, along which the error decreases; the others are runners-up. A
    search shared by several points ranks by all of them, so errors may increase at one point.
    problem: rows that the candidates were fitted to; None for a search of trajectories. cloud:
    all supports that the candidates were taken from; None if the front was not made from a cloud.
    """

    equation: str
    candidates: Sequence[Candidate]
    problem: RegressionRows | None = field(default=None, repr=False)
    cloud: Cloud | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "candidates", tuple(self.candidates))
        assert self.candidates
        assert self.candidates[0].n_terms == 0

    @property
    def rows(self) -> RegressionRows:
        """Rows of the regression. Raises ValueError if there are none."""
        if self.problem is None:
            raise ValueError(
                f"rows are needed to judge the candidates of {self.equation!r}; a search of "
                "trajectories has none, and a discovery that was stored keeps none: take a "
                "regression, such as Regression(WeightedWeak())"
            )
        return self.problem

    @property
    def has_errors(self) -> bool:
        """True after a regression; a search of trajectories has scores alone."""
        return not np.isnan(self.candidates[0].r2)

    @property
    def held_out(self) -> bool:
        """True if some rows were held out from the fits."""
        return any(not np.isnan(candidate.r2_test) for candidate in self.candidates)

    @property
    def scores(self) -> Float[np.ndarray, " candidates"]:
        """Scores by the selection rule; the candidate of lowest score is selected."""
        return np.array([candidate.score for candidate in self.candidates])

    @property
    def best(self) -> Candidate:
        """Candidate of lowest score; the smallest one if several tie."""
        return self.candidates[int(np.argmin(self.scores))]

    def with_scores(self, scores: Float[np.ndarray, " candidates"]) -> ParetoFront:
        """Copy of the front whose candidates have these scores."""
        pairs = zip(self.candidates, scores.tolist(), strict=True)
        return replace(self, candidates=[replace(each, score=score) for each, score in pairs])

    @property
    def errors(self) -> Float[np.ndarray, " candidates"]:
        """1 - R2 on held-out rows, or on the training rows if none are held out."""
        return errors_of(self.candidates)

    @property
    def sizes(self) -> Float[np.ndarray, " candidates"]:
        return np.array([float(c.n_terms) for c in self.candidates])

    @property
    def leading(self) -> Bool[np.ndarray, " candidates"]:
        """True for the best candidate of each size."""
        return np.diff(self.sizes, prepend=-1.0) > 0

    def plot(self) -> Figure:
        """Figure of the candidates' errors, or scores if there are none, by number of terms."""
        return draw("front_plot", self)

    def __repr__(self) -> str:
        rows = [
            [str(c.n_terms), text, equation_text(self.equation, c.coef_by_term)]
            for c, text in zip(self.candidates, self._figures, strict=True)
        ]
        head = f"ParetoFront of {self.equation}, {len(rows)} candidates"
        return one_screen([head, *text_table(["terms", self._figure, "equation"], rows)])

    def _repr_html_(self) -> str:
        rows = [
            [str(c.n_terms), text, equation_html(self.equation, c.coef_by_term)]
            for c, text in zip(self.candidates, self._figures, strict=True)
        ]
        return html_table(["terms", self._figure, "equation"], rows)

    @property
    def _figure(self) -> str:
        """Heading of the figure of merit in tables."""
        return "R2" if self.has_errors else "deviance"

    @property
    def _figures(self) -> list[str]:
        if self.has_errors:
            return [f"{c.r2:.6f}" for c in self.candidates]
        return ["" if c.deviance is None else f"{c.deviance:.6g}" for c in self.candidates]


def errors_of(candidates: Sequence[Candidate]) -> Float[np.ndarray, " candidates"]:
    """1 - R2 on held-out rows, or on the training rows if none are held out."""
    return np.array([1.0 - candidate.r2 for candidate in candidates])


def fit_support(problem: RegressionRows, equation: str, terms: Sequence[str]) -> Candidate:
    """Fit one given support of one equation to the training rows, without bootstraps.

    Raises ValueError for an unknown term, or terms that are linearly dependent on these rows.
    """
    mask = np.zeros((1, len(problem.library)), dtype=np.bool_)
    mask[0, [problem.library.index(name) for name in terms]] = True
    (candidate,) = fit_supports(problem, equation, mask)
    if not np.isfinite(candidate.coef).all():
        raise ValueError(f"terms must be independent to be fitted: {list(terms)} are not")
    return candidate


def fit_supports(
    problem: RegressionRows, equation: str, masks: Bool[np.ndarray, "supports terms"]
) -> list[Candidate]:
    """Fit given supports as in `fit_support`; coefficients of dependent terms are NaN."""
    unknown = np.full(len(masks), np.nan)
    nothing = np.full((len(problem.library) + 1, len(problem.library)), np.nan)
    return _candidates(problem, Supports(equation, masks, unknown, nothing))


def pareto_front(problem: RegressionRows, supports: Supports, *, depth: int = 1) -> ParetoFront:
    """Fit every support on all training rows and keep the `depth` best of each size.

    "Best" is by held-out rows, as in the thesis, or by the training rows if none are held out.
    A size whose best support does not beat all smaller sizes is left out, and so are supports
    with linearly dependent terms. With noise in the library a wrong support can score slightly
    better than the true one of the same size; a depth of 3 keeps both for a later selection.
    """
    n_terms = len(problem.library)
    equation = problem.equations.index(supports.equation)
    sizes = supports.masks.sum(axis=1)
    explained = _explain(problem, equation, supports.masks)
    best = _best_of_each_size(sizes, explained, depth)
    empty = np.zeros((1, n_terms), dtype=np.bool_)
    chosen = Supports(
        equation=supports.equation,
        masks=np.concatenate([empty, supports.masks[best]]),
        share=np.append(supports.share[~supports.masks.any(axis=1)].sum(), supports.share[best]),
        inclusion=supports.inclusion,
    )
    candidates = _candidates(problem, chosen)
    order = front_order(
        np.array([c.n_terms for c in candidates]),
        np.array([-c.r2 for c in candidates]),
        depth=depth,
    )
    cloud = _cloud(problem, equation, sizes, explained)
    return ParetoFront(supports.equation, [candidates[k] for k in order], problem, cloud)


def front_order(
    sizes: Int[np.ndarray, " candidates"], errors: Float[np.ndarray, " candidates"], *, depth: int
) -> list[int]:
    """Indices of the front: the `depth` best of each size whose best beats all smaller sizes."""
    depth = check_count("depth", depth)
    front: list[int] = []
    lowest = np.inf
    for _, same_size in groupby(np.lexsort((errors, sizes)).tolist(), key=lambda k: sizes[k]):
        ranked = list(same_size)[:depth]
        if errors[ranked[0]] < lowest:
            lowest = errors[ranked[0]]
            front += ranked
    return front


def _candidates(problem: RegressionRows, supports: Supports) -> list[Candidate]:
    """Candidates fitted to the training rows, and scored on both training and held-out rows."""
    equation = problem.equations.index(supports.equation)
    coef = _fit(problem, equation, supports.masks)
    coef_SI = problem.coef_SI(coef, equation)
    r2_train, r2_test = (_r2(problem, equation, coef, test=test) for test in (False, True))
    return [
        Candidate(
            equation=supports.equation,
            terms=tuple(problem.term_names[j] for j in columns),
            coef=coef_SI[k, columns],
            r2_train=float(r2_train[k]),
            r2_test=float(r2_test[k]),
            share=float(supports.share[k]),
            inclusion=supports.inclusion[len(columns), columns],
        )
        for k, columns in enumerate(map(np.flatnonzero, supports.masks))
    ]


def _explain(
    problem: RegressionRows, equation: int, masks: Bool[np.ndarray, "supports terms"]
) -> Float[np.ndarray, " supports"]:
    """Reduction of the target's sum of squares by each support, on the rows used for scoring.

    Computed from Gram matrices only; NaN for linearly dependent terms.
    """
    train = problem.train_gram
    judge = problem.test_gram if problem.test.any() else train
    coef = fit_masks(train.xx[0], train.xy[0, equation], masks)
    return explained_squares(coef, judge.xx[0], judge.xy[0, equation])


def _best_of_each_size(
    sizes: Int[np.ndarray, " supports"], explained: Float[np.ndarray, " supports"], depth: int
) -> Int[np.ndarray, " best"]:
    """Indices of the `depth` supports of least error of each size, ordered by size."""
    order = np.lexsort((-explained, sizes))
    order = order[np.isfinite(explained[order]) & (sizes[order] > 0)]
    _, first, count = np.unique(sizes[order], return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(first, count)
    return order[rank < depth]


def _cloud(
    problem: RegressionRows,
    equation: int,
    sizes: Int[np.ndarray, " supports"],
    explained: Float[np.ndarray, " supports"],
) -> Cloud:
    """Sizes and errors of all supports.

    The sum of squares about the mean is not zero here: `r2` would have raised before.
    """
    held_out = problem.test.any()
    y = problem.test_target(equation) if held_out else problem.train_target(equation)
    errors = (y @ y - explained) / np.square(y - y.mean()).sum()
    fitted = np.isfinite(errors)
    return Cloud(sizes[fitted], errors[fitted])


def _fit(
    problem: RegressionRows, equation: int, masks: Bool[np.ndarray, "supports terms"]
) -> Float[np.ndarray, "supports terms"]:
    """Least-squares coefficients of every support on the training rows, in scaled columns.

    The Gram matrix squares the condition number of the rows, so its solution is refined with the
    residuals of the rows themselves (Bjorck 1996, Numerical Methods for Least Squares, 2.9.3).
    """
    gram = problem.train_gram
    xx = gram.xx[0]
    coef = fit_masks(xx, gram.xy[0, equation], masks)
    for _ in range(2):
        left = np.zeros_like(coef)
        for theta, residual in _residuals(problem, equation, coef, test=False):
            left += residual @ theta
        step = solve_masks(xx, left, masks)
        coef = coef + step
        if not (np.abs(step) > REFINED * np.abs(coef).max(axis=1, keepdims=True)).any():
            break  # the next step would be as much smaller again
    return coef


def _r2(
    problem: RegressionRows,
    equation: int,
    coef: Float[np.ndarray, "supports terms"],
    *,
    test: bool,
) -> Float[np.ndarray, " supports"]:
    """R2 of every support on training or held-out rows; NaN if there are none."""
    target = problem.test_target(equation) if test else problem.train_target(equation)
    if not len(target):
        return np.full(len(coef), np.nan)
    squares = np.zeros(len(coef))
    for _, residual in _residuals(problem, equation, coef, test=test):
        squares += np.square(residual).sum(axis=1)
    return r2_of(squares, truth=target)


def _residuals(
    problem: RegressionRows,
    equation: int,
    coef: Float[np.ndarray, "supports terms"],
    *,
    test: bool,
) -> Iterator[tuple[Float[np.ndarray, "_ terms"], Float[np.ndarray, "supports _"]]]:
    """Scaled terms, and the residuals of every support, on one block of rows after another."""
    n_terms = len(problem.library)
    for rows in problem.blocks(test=test):
        theta, target = rows[:, :n_terms], rows[:, n_terms + equation]
        yield theta, target - coef @ theta.T
