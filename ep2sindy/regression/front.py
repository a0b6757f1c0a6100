"""Pareto front of error versus number of terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.library.equations import equation_html, equation_text
from ep2sindy.model.scores import r2_of
from ep2sindy.regression.bootstraps import Supports
from ep2sindy.regression.gram_kernels import explained_squares, fit_masks
from ep2sindy.regression.least_squares import Blocks, fit_masks_to_rows, sum_residuals
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.runtime.screen import html_table, one_screen, text_table
from ep2sindy.runtime.values import check_count


@dataclass(frozen=True)
class Residual:
    """Residuals of one equation on its rows, whitened by the noise that propagates into them.

    chi_squared: per row, 1 if the residuals are nothing but noise. autocorrelation: of the
    residuals of neighbouring rows, then 0. leaves_noise: True if chi_squared is consistent with
    noise alone, or nearly nothing is left. unexplained: root mean square of the residuals over that
    of the rates of change.
    """

    chi_squared: float
    autocorrelation: float
    leaves_noise: bool
    unexplained: float

    def text(self, rate: str) -> str:
        """How much of a rate is left, next to noise: `12.3 % of x' (noise alone: 0.53 %)`."""
        noise = self.unexplained / np.sqrt(self.chi_squared) if self.chi_squared else 0.0
        size = f"{100.0 * self.unexplained:.3g}" if self.unexplained <= 1.0 else "over 100"
        return f"{size} % of {rate} (noise alone: {100.0 * min(noise, 1.0):.2g} %)"


@dataclass(frozen=True, eq=False)
class Candidate:
    """One support of one equation, with its fit.

    coef: (terms of the support,), in SI. From a regression: least squares on the training rows, or
    weighted by their noise; from a search of trajectories: the most likely values given the other
    equations.
    r2_train, r2_test: 1 - SS_res/SS_tot with the data as truth; NaN if there are no such rows.
    fraction: fraction of bootstraps that found this support. inclusion: for each of its terms, the
    fraction of bootstraps in which the term was in a support of this size. Both are NaN without
    bootstraps. deviance: -2 log likelihood of whole trajectories plus the penalty for the terms,
    relative to the best system; None if only rows were fitted. score: value of the selection rule,
    the lowest of the front being selected; NaN before selection. covariance: (terms, terms) of coef
    after a weighted fit, in SI; None if the noise of the rows is not known, or if the residuals
    exceed it. left: residuals of that fit.
    """

    equation: str
    terms: tuple[str, ...]
    coef: Float[np.ndarray, " support"]
    r2_train: float
    r2_test: float
    fraction: float
    inclusion: Float[np.ndarray, " support"]
    deviance: float | None = None
    score: float = float("nan")
    covariance: Float[np.ndarray, "support support"] | None = None
    left: Residual | None = None

    @staticmethod
    def of(equation: str, coef: Mapping[str, float], deviance: float | None = None) -> Candidate:
        """A candidate of these terms, without rows and bootstraps behind it."""
        nan, terms = float("nan"), tuple(coef)
        values, unknown = np.array([coef[term] for term in terms]), np.full(len(terms), np.nan)
        return Candidate(equation, terms, values, nan, nan, nan, unknown, deviance)

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
class Ensemble:
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
    problem: rows that the candidates were fitted to; None for a search of trajectories. ensemble:
    all supports that the candidates were taken from; None if the front was made from none.
    """

    equation: str
    candidates: Sequence[Candidate]
    problem: RegressionRows | None = field(default=None, repr=False)
    ensemble: Ensemble | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "candidates", tuple(self.candidates))
        assert self.candidates
        assert self.candidates[0].n_terms == 0

    @property
    def rows(self) -> RegressionRows:
        """Rows of the regression. Raises ValueError if there are none."""
        if self.problem is None:
            raise ValueError(
                f"rows are needed to assess the candidates of {self.equation!r}; a search of "
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
        head = f"ParetoFront of {self.equation}, {len(self.candidates)} candidates"
        return one_screen([head, *text_table(*self._table(equation_text))])

    def _repr_html_(self) -> str:
        return html_table(*self._table(equation_html))

    def _table(self, written: Callable[..., str]) -> tuple[list[str], list[list[str]]]:
        """Headings and rows; written: how an equation is."""
        rows = [
            [str(c.n_terms), text, written(self.equation, c.coef_by_term)]
            for c, text in zip(self.candidates, self._figures, strict=True)
        ]
        return ["terms", "R2" if self.has_errors else "deviance", "equation"], rows

    @property
    def _figures(self) -> list[str]:
        if self.has_errors:
            return [f"{c.r2:.6f}" for c in self.candidates]
        return ["" if c.deviance is None else f"{c.deviance:.6g}" for c in self.candidates]


Fronts = Sequence[ParetoFront]


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
    return _fit(problem, Supports(equation, masks, unknown, nothing))


def pareto_front(problem: RegressionRows, supports: Supports, *, depth: int = 1) -> ParetoFront:
    """Fit every support on all training rows and keep the `depth` best of each size.

    "Best" is by held-out rows, as in the thesis, or by the training rows if none are held out.
    A size whose best support does not beat all smaller sizes is left out, and so are supports
    with linearly dependent terms. With noise in the library a wrong support can score slightly
    better than the true one of the same size; a depth of 3 keeps both for a later selection.
    """
    depth, sizes = check_count("depth", depth), supports.masks.sum(axis=1)
    equation, train = problem.equations.index(supports.equation), problem.train_gram
    assess = problem.test_gram if problem.test.any() else train
    # From Gram matrices only: what each support takes of the target's sum of squares; NaN for
    # linearly dependent terms.
    coef = fit_masks(train.xx, train.xy[equation], supports.masks)
    explained = explained_squares(coef, assess.xx, assess.xy[equation])
    order = np.lexsort((-explained, sizes))
    order = order[np.isfinite(explained[order]) & (sizes[order] > 0)]
    rank = np.arange(len(order)) - np.searchsorted(sizes[order], sizes[order])
    best = order[rank < depth]
    empty = np.zeros((1, len(problem.library)), dtype=np.bool_)
    chosen = Supports(
        equation=supports.equation,
        masks=np.concatenate([empty, supports.masks[best]]),
        fraction=np.append(supports.fraction[sizes == 0].sum(), supports.fraction[best]),
        inclusion=supports.inclusion,
    )
    found = _fit(problem, chosen)
    kept = order_front(np.append(0, sizes[best]), errors_of(found), depth=depth)
    # The sum of squares about the mean is not zero here: `r2_of` would have raised before.
    spread = _squares_about_mean(problem, equation, test=assess is not train)
    errors = (assess.yy[equation] - explained) / spread
    fitted = np.isfinite(errors)
    ensemble = Ensemble(sizes[fitted], errors[fitted])
    return ParetoFront(supports.equation, [found[k] for k in kept], problem, ensemble)


def order_front(
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


def _fit(problem: RegressionRows, supports: Supports) -> list[Candidate]:
    """Fit every support to the training rows, and score it on both training and held-out rows."""
    equation, masks = problem.equations.index(supports.equation), supports.masks
    gram = problem.train_gram

    def blocks(*, test: bool = False) -> Blocks:
        n_terms = len(problem.library)
        return ((c[:n_terms], c[n_terms + equation]) for c in problem.blocks(test=test))

    coef, squares = fit_masks_to_rows(gram.xx, gram.xy[equation], masks, blocks)
    r2_train = r2_of(squares, spread=_squares_about_mean(problem, equation, test=False))
    r2_test = np.full(len(coef), np.nan)
    if problem.test.any():
        squares, _ = sum_residuals(coef, blocks(test=True))
        r2_test = r2_of(squares, spread=_squares_about_mean(problem, equation, test=True))
    names, coef_SI = np.array(problem.library.names), coef * problem.coef_scale(equation)
    return [
        Candidate(
            equation=supports.equation,
            terms=tuple(names[mask].tolist()),
            coef=coef_SI[k, mask],
            r2_train=float(r2_train[k]),
            r2_test=float(r2_test[k]),
            fraction=float(supports.fraction[k]),
            inclusion=supports.inclusion[np.count_nonzero(mask), mask],
        )
        for k, mask in enumerate(masks)
    ]


def _squares_about_mean(problem: RegressionRows, equation: int, *, test: bool) -> float:
    """Sum of squares of a scaled target about its mean, exactly zero for a constant."""
    values = problem.scaled_target(equation, test=test)
    values -= values[0]
    values -= values.mean()
    return float(values @ values)
