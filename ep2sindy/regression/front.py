"""Pareto front of error versus number of terms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.library.equations import equation_html, equation_text
from ep2sindy.model.scores import r2_of
from ep2sindy.regression.bootstraps import Supports
from ep2sindy.regression.gram_kernels import explained_squares, fit_masks
from ep2sindy.regression.least_squares import fit_masks_to_rows
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.runtime.screen import html_table, one_screen, text_table
from ep2sindy.runtime.values import check_count

ROWS_AT_ONCE = 4096  # rows whose residuals, of all fits, are held at once


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
        # `replace` would look at each of hundreds of fields one by one.
        scored = [Candidate(**(vars(each) | {"score": score})) for each, score in pairs]
        return replace(self, candidates=scored)

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
    number = problem.equations.index(equation)
    unknown = np.full(len(masks), np.nan)
    nothing = np.full((len(problem.library) + 1, len(problem.library)), np.nan)
    supports = Supports(equation, masks, unknown, nothing)
    fits = _fit(problem, number, masks, _spread(problem, number))
    return _candidates(problem, supports, fits, range(len(masks)))


def pareto_front(problem: RegressionRows, supports: Supports, *, depth: int = 1) -> ParetoFront:
    """Fit every support on all training rows and keep the `depth` best of each size.

    "Best" is by held-out rows, as in the thesis, or by the training rows if none are held out.
    A size whose best support does not beat all smaller sizes is left out, and so are supports
    with linearly dependent terms. With noise in the library a wrong support can score slightly
    better than the true one of the same size; a depth of 3 keeps both for a later selection.
    """
    depth, equation = check_count("depth", depth), problem.equations.index(supports.equation)
    sizes = supports.masks.sum(axis=1)
    explained, best = _rank(problem, equation, supports.masks, depth)
    empty = np.zeros((1, len(problem.library)), dtype=np.bool_)
    chosen = Supports(
        equation=supports.equation,
        masks=np.concatenate([empty, supports.masks[best]]),
        share=np.append(supports.share[sizes == 0].sum(), supports.share[best]),
        inclusion=supports.inclusion,
    )
    about_mean = _spread(problem, equation)
    fits = _fit(problem, equation, chosen.masks, about_mean)
    order = front_order(np.append(0, sizes[best]), -fits.r2, depth=depth)
    candidates = _candidates(problem, chosen, fits, order)
    cloud = _cloud(problem, equation, about_mean, sizes, explained)
    return ParetoFront(supports.equation, candidates, problem, cloud)


def front_order(
    sizes: Int[np.ndarray, " candidates"], errors: Float[np.ndarray, " candidates"], *, depth: int
) -> list[int]:
    """Indices of the front: the `depth` best of each size whose best beats all smaller sizes."""
    depth = check_count("depth", depth)
    front: list[int] = []
    lowest = np.inf
    of, ranks = sizes.tolist(), np.lexsort((errors, sizes)).tolist()
    for _, same_size in groupby(ranks, key=of.__getitem__):
        ranked = list(same_size)[:depth]
        if errors[ranked[0]] < lowest:
            lowest = errors[ranked[0]]
            front += ranked
    return front


class Spread(NamedTuple):
    """Sums of squares of a scaled target about its mean; that of held-out rows is NaN for none."""

    train: float
    test: float


class RowFits(NamedTuple):
    """Least-squares fits of supports to the training rows, in scaled columns, and their scores."""

    coef: Float[np.ndarray, "supports terms"]
    r2_train: Float[np.ndarray, " supports"]
    r2_test: Float[np.ndarray, " supports"]

    @property
    def r2(self) -> Float[np.ndarray, " supports"]:
        """R2 on held-out rows, or on the training rows if none are held out."""
        return np.where(np.isnan(self.r2_test), self.r2_train, self.r2_test)


def _spread(problem: RegressionRows, equation: int) -> Spread:
    held_out = problem.test_target(equation)
    return Spread(
        train=_squares_about_mean(problem.train_target(equation)),
        test=_squares_about_mean(held_out) if len(held_out) else float("nan"),
    )


def _squares_about_mean(values: Float[np.ndarray, " rows"]) -> float:
    """Sum of squares about the mean, exactly zero for a constant."""
    values = values - values[0]
    values -= values.mean()
    return float(values @ values)


def _candidates(
    problem: RegressionRows, supports: Supports, fits: RowFits, chosen: Iterable[int]
) -> list[Candidate]:
    """Candidates of the chosen supports."""
    equation = problem.equations.index(supports.equation)
    coef_SI = problem.coef_SI(fits.coef, equation)
    sizes = supports.masks.sum(axis=1)
    of, columns = np.nonzero(supports.masks)
    coef, inclusion = coef_SI[of, columns], supports.inclusion[sizes[of], columns]
    of_terms = problem.term_names
    names, ends = [of_terms[j] for j in columns.tolist()], np.cumsum(sizes).tolist()
    r2_train, r2_test, share = (
        fits.r2_train.tolist(),
        fits.r2_test.tolist(),
        supports.share.tolist(),
    )
    found = []
    for k in chosen:
        own = slice(ends[k - 1] if k else 0, ends[k])
        found.append(
            Candidate(
                equation=supports.equation,
                terms=tuple(names[own]),
                coef=coef[own],
                r2_train=r2_train[k],
                r2_test=r2_test[k],
                share=share[k],
                inclusion=inclusion[own],
            )
        )
    return found


def _rank(
    problem: RegressionRows, equation: int, masks: Bool[np.ndarray, "supports terms"], depth: int
) -> tuple[Float[np.ndarray, " supports"], Int[np.ndarray, " best"]]:
    """Reduction of the target's sum of squares by each support, on the rows used for scoring.

    Computed from Gram matrices only; NaN for linearly dependent terms. And the indices of the
    `depth` supports that reduce it most of each size, ordered by size.
    """
    train = problem.train_gram
    judge = problem.test_gram if problem.test.any() else train
    coef = fit_masks(train.xx[0], train.xy[0, equation], masks)
    explained, sizes = (
        explained_squares(coef, judge.xx[0], judge.xy[0, equation]),
        masks.sum(axis=1),
    )
    order = np.lexsort((-explained, sizes))
    order = order[np.isfinite(explained[order]) & (sizes[order] > 0)]
    rank = np.arange(len(order)) - np.searchsorted(sizes[order], sizes[order])
    return explained, order[rank < depth]


def _cloud(
    problem: RegressionRows,
    equation: int,
    about_mean: Spread,
    sizes: Int[np.ndarray, " supports"],
    explained: Float[np.ndarray, " supports"],
) -> Cloud:
    """Sizes and errors of all supports.

    The sum of squares about the mean is not zero here: `r2_of` would have raised before.
    """
    held_out = problem.test.any()
    gram = problem.test_gram if held_out else problem.train_gram
    errors = (gram.yy[0, equation] - explained) / (
        about_mean.test if held_out else about_mean.train
    )
    fitted = np.isfinite(errors)
    return Cloud(sizes[fitted], errors[fitted])


def _fit(
    problem: RegressionRows,
    equation: int,
    masks: Bool[np.ndarray, "supports terms"],
    about_mean: Spread,
) -> RowFits:
    """Fit every support to the training rows, and score it on both training and held-out rows."""
    gram = problem.train_gram

    def residuals(coef: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        left = np.zeros_like(coef)
        return _residual_squares(problem, equation, coef, test=False, products=left), left

    coef, squares = fit_masks_to_rows(gram.xx[0], gram.xy[0, equation], masks, residuals)
    r2_train = r2_of(squares, spread=about_mean.train)
    if np.isnan(about_mean.test):
        return RowFits(coef, r2_train, np.full(len(coef), np.nan))
    squares = _residual_squares(problem, equation, coef, test=True)
    return RowFits(coef, r2_train, r2_of(squares, spread=about_mean.test))


def _residual_squares(
    problem: RegressionRows,
    equation: int,
    coef: Float[np.ndarray, "supports terms"],
    *,
    test: bool,
    products: Float[np.ndarray, "_ terms"] | None = None,
) -> Float[np.ndarray, " supports"]:
    """Squares of every support's residual, on training or held-out rows.

    products: if given, the products of the residuals and the terms are added.
    """
    squares, n_terms = np.zeros(len(coef)), len(problem.library)
    for columns in problem.blocks(test=test):
        for start in range(0, columns.shape[1], ROWS_AT_ONCE):
            some = columns[:, start : start + ROWS_AT_ONCE]
            left = some[n_terms + equation] - coef @ some[:n_terms]
            squares += np.einsum("sr,sr->s", left, left)
            if products is not None:
                products += left @ some[:n_terms].T
    return squares
