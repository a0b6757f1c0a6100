"""Rules that score candidates one by one: information criteria, evidence, knee."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb, log
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.coerce import Task
from ep2sindy.library.library import Library
from ep2sindy.regression.front import Fronts, ParetoFront
from ep2sindy.regression.least_squares import LeastSquares, fit_masks_to_rows
from ep2sindy.regression.whitening import whiten_rows
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.selection.rule import Basis, Decision

# Least residual squares, as a share of the target's squares: below this value a criterion would
# select terms that fit the discretisation error of noise-free data.
FLOOR = 1e-6

# Rounds of weighting the rows by the covariance under the leading candidate.
MAX_ROUNDS = 5


@dataclass(frozen=True)
class EBIC:
    """The extended Bayesian criterion: a priori all sizes of support are equally likely.

    score = n log(RSS / n) + k log n + 2 gamma log(number of supports of k terms). Libraries are
    nested by degree, and the supports are counted in the smallest one that holds the candidate's
    terms, so that simple terms do not pay for the many terms of high degree.
    Assumes Gaussian residuals. Where the rows' covariance is known (`Weak`), the residuals must be
    white after weighting by it. Where it is not (`Differential`), they must be independent from row
    to row; neighbouring rows of a smoothed series are not, and too many terms are then kept.
    coarsening: no model is exact, and with enough rows any discrepancy becomes significant. The
    likelihood is therefore raised to the power 1 / (1 + n/coarsening), so that evidence stops
    growing at about that many rows. None uses the full likelihood.
    With gamma=0 and coarsening=None it is Schwarz's criterion, BIC, for which all models are
    equally likely a priori. There are many more models of middle size than small ones, so with a
    library of any size BIC keeps too many terms.
    Source: Chen & Chen 2008, doi:10.1093/biomet/asn034; Miller & Dunson 2019,
    doi:10.1080/01621459.2018.1469995; Schwarz 1978, doi:10.1214/aos/1176344136.
    """

    gamma: float = 1.0
    coarsening: float | None = 60.0
    basis: ClassVar[Basis] = "rows"

    def __post_init__(self) -> None:
        if not self.gamma >= 0.0:
            raise ValueError(f"gamma must be zero or more: {self.gamma} came")
        if self.coarsening is not None and not self.coarsening > 1.0:
            raise ValueError(
                f"coarsening counts rows, and must be above 1: {self.coarsening} came; None "
                "trusts the residuals to the end"
            )

    @property
    def label(self) -> str:
        return "BIC" if self.gamma == 0.0 and self.coarsening is None else "EBIC"

    def shared_by(self, n_points: int) -> EBIC:
        """The rule at one of n points with a common support: together they pay for it once."""
        return replace(self, gamma=self.gamma / n_points)

    def decide(
        self, fronts: Fronts, task: Task | None = None, *, progress: Progress = SILENT
    ) -> Decision:
        with progress.stage(None, "", f"candidates by {self.label}"):
            return Decision([self._score(front) for front in fronts])

    def _score(self, front: ParetoFront) -> Float[np.ndarray, " candidates"]:
        """Scores of all candidates, with rows that are weighted where their noise is known.

        The weights depend on the model. Those of the leading candidate serve all, and are updated
        until the leader stays the same.
        """
        problem = front.rows
        masks = np.array([np.isin(problem.term_names, c.terms) for c in front.candidates])
        equation = problem.equations.index(front.equation)
        theta, target = problem.train_theta, problem.train_target(equation)
        n_rows, leader = float(len(target)), -1
        n_effective = (
            n_rows if self.coarsening is None else n_rows / (1.0 + n_rows / self.coarsening)
        )
        penalties = np.array(
            [self._penalty(c.terms, n_effective, problem.library) for c in front.candidates]
        )
        for _ in range(MAX_ROUNDS):
            squares, coef = _fit_all(theta, target, masks)
            squares = np.maximum(squares, FLOOR * (target @ target))
            scores = n_effective * np.log(squares / n_rows) + penalties
            if problem.noisy is None or int(np.argmin(scores)) == leader:
                break
            leader = int(np.argmin(scores))
            white = whiten_rows(problem, masks[leader], coef[leader])
            theta, target = white.theta, white.target
        return scores

    def _penalty(self, terms: Sequence[str], n_rows: float, library: Library) -> float:
        return len(terms) * log(n_rows) + 2.0 * self.gamma * log_supports(library, terms)


def log_supports(library: Library, terms: Sequence[str]) -> float:
    """Log of the number of supports of this size among terms up to the highest degree of these."""
    degrees = library.degrees
    highest = max((degrees[library.index(name)] for name in terms), default=0)
    return log(comb(int((degrees <= highest).sum()), len(terms)))


def _fit_all(
    theta: Float[np.ndarray, "rows terms"],
    target: Float[np.ndarray, " rows"],
    masks: Bool[np.ndarray, "candidates terms"],
) -> tuple[Float[np.ndarray, " candidates"], Float[np.ndarray, "candidates terms"]]:
    """Least squares on every support: residual squares and coefficients."""
    # R of the QR factors holds all that least squares needs, without squaring the condition number.
    triangle = np.asarray(np.linalg.qr(np.column_stack([theta, target]), mode="r"))
    columns, right = triangle[:, :-1], triangle[:, -1]

    def residuals(coef: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        left = right - coef @ columns.T
        return np.square(left).sum(axis=1), left @ columns

    coef, squares = fit_masks_to_rows(columns.T @ columns, columns.T @ right, masks, residuals)
    for k in np.flatnonzero(np.isnan(squares)):  # weights have made its terms dependent
        fit = LeastSquares.of_rows(columns[:, masks[k]], right)
        coef[k], squares[k] = 0.0, fit.squares
        coef[k, masks[k]] = fit.coef
    return squares, coef


@dataclass(frozen=True)
class Evidence:
    """Select by -2 log likelihood of the trajectories plus a complexity penalty.

    A `TrajectorySearch` ranks its own candidates by this value. Fronts of regressions do not have
    it.
    """

    label: ClassVar[str] = "deviance"
    basis: ClassVar[Basis] = "likelihood"

    def decide(
        self, fronts: Fronts, task: Task | None = None, *, progress: Progress = SILENT
    ) -> Decision:
        deviances = [[candidate.deviance for candidate in front.candidates] for front in fronts]
        if any(None in values for values in deviances):
            raise ValueError(
                "Evidence weighs what a search of trajectories found: these fronts come from "
                "rows; take TrajectorySearch() (search=trajectory), or select by EBIC"
            )
        return Decision([np.array(values, dtype=np.float64) for values in deviances])


@dataclass(frozen=True)
class Knee:
    """Selects the candidate closest to zero error and zero terms: the thesis's rule.

    score = sqrt((1 - R2)^2 + (n_terms / n_norm)^2). For n_norm="library" it is the number of terms
    in the library (the thesis's Eq. 9); for "max_terms" it is the largest candidate's number plus
    one (used for the thesis's Tables II and III). Assumes that a term worth having raises R2 by
    about one step of n_terms / n_norm: any other is dropped, by construction.
    scale: "log" takes the logarithm of the error, so that a small term of an exact law counts:
    score = sqrt(((log e - log e_min) / (log e_max - log e_min))^2 + (n_terms / n_norm)^2). That
    assumes that errors span orders of magnitude: the largest fall sets the scale, and a true term
    that lowers the error by less than one step of it is dropped.
    Source: the thesis, Eq. 9; a corner of the curve of error and size, as Hansen 1992,
    doi:10.1137/1034115, takes it for regularisation.

    >>> rule, run = ep.Regression(selection=ep.Knee()), ep.lotka_volterra().trajectory()
    >>> list(ep.discover(run, method=rule).model.terms("x"))
    ['x', 'x*y']
    """

    n_norm: str = "library"
    scale: str = "linear"
    basis: ClassVar[Basis] = "rows"

    def __post_init__(self) -> None:
        if self.n_norm not in ("library", "max_terms"):
            raise ValueError(f"n_norm must be 'library' or 'max_terms': {self.n_norm!r} came")
        if self.scale not in ("linear", "log"):
            raise ValueError(f"scale must be 'linear' or 'log': {self.scale!r} came")

    @property
    def label(self) -> str:
        return "d_log" if self.scale == "log" else "d_pareto"

    def decide(
        self, fronts: Fronts, task: Task | None = None, *, progress: Progress = SILENT
    ) -> Decision:
        with progress.stage(None, "", f"candidates by {self.label}"):
            return Decision([self._score(front) for front in fronts])

    def _score(self, front: ParetoFront) -> Float[np.ndarray, " candidates"]:
        errors, sizes, library = front.errors, front.sizes, front.rows.library
        norm = float(len(library) if self.n_norm == "library" else sizes.max() + 1.0)
        if self.scale == "linear":
            return np.hypot(errors, sizes / norm)
        height = np.log(np.maximum(errors, FLOOR))
        height = (height - height.min()) / max(float(np.ptp(height)), np.finfo(float).tiny)
        return np.hypot(height, sizes / norm)
