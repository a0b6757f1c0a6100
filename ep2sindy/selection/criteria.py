"""Selection rules: their protocol, what they decide, and those that score candidates one by one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import islice
from math import comb, log, prod
from typing import ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, Relation, binding
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.front import Fronts, ParetoFront
from ep2sindy.regression.least_squares import LeastSquares, fit_masks_to_rows
from ep2sindy.regression.whitening import whiten_rows
from ep2sindy.runtime.progress import SILENT, Progress

Basis = Literal["rows", "likelihood", "runs"]


@dataclass(frozen=True)
class OtherSystem:
    """A sustained system of as many free coefficients as the selected one.

    terms: by equation, such as `n_i'`, or under roles by role, such as `n_n to n_i`. Figures are
    the worst over the folds that the system was not fitted to. deviation: of frequency, amplitudes
    and waveform, in units of the bounds. f_error, amplitude: relative errors. waveform: in standard
    deviations.
    """

    terms: Mapping[str, tuple[str, ...]]
    deviation: float
    f_error: float
    amplitude: float
    waveform: float


@dataclass(frozen=True, eq=False)
class Decision:
    """What a rule decides.

    scores: for each front, one per candidate, the winner's the least. model: the winner refined,
    with the covariance of its coefficients; None if the rule scores candidates one by one, and the
    coefficients are still to be fitted. note: how it was decided, in words. constraint: what the
    winner's coefficients obey; None if the rule does not say. others: systems of its size that
    would do as well, the best first.
    """

    scores: Sequence[Float[np.ndarray, " _candidates"]]
    model: SparseModel | None = None
    note: str = ""
    constraint: Constraint | None = None
    others: Sequence[OtherSystem] = ()


@runtime_checkable
class Selection(Protocol):
    """A rule that scores every candidate of every front; the lowest score of a front is selected.

    label: name of the score in tables. basis: what is scored: "rows" of a regression, the
    "likelihood" of trajectories, or "runs" of whole systems, one candidate per equation, of which
    the rule refines the winner. `decide` gets the fronts of all equations, what was asked (its
    runs, and the relations between coefficients), and whom to notify of the systems it tries.
    """

    @property
    def label(self) -> str: ...

    @property
    def basis(self) -> Basis: ...

    def decide(
        self, fronts: Fronts, task: DiscoveryProblem, *, progress: Progress = SILENT
    ) -> Decision: ...


# Least residual squares, as a fraction of the target's squares: below this value a criterion would
# select terms that fit the discretisation error of noise-free data.
FLOOR = 1e-6

# Rounds of weighting the rows by the covariance under the leading candidate.
MAX_ROUNDS = 5


@dataclass(frozen=True)
class EBIC:
    """Select by the extended Bayesian information criterion: a priori all sizes are equally likely.

    Parameters
    ----------
    gamma : float, default 1.0
        Weight of the number of supports of each size, zero or more. 1 makes all sizes equally
        likely. 0, with coarsening=None, gives Schwarz's criterion BIC, for which all models are
        equally likely a priori; it selects too many terms from a library of any size, since there
        are many more models of middle size than small ones.
    coarsening : float or None, default 60.0
        Number of rows at which evidence stops growing. No model is exact, and with enough rows any
        discrepancy becomes significant; the likelihood is therefore raised to the power 1 / (1 + n
        / coarsening). None uses the full likelihood.

    Raises
    ------
    ValueError
        If gamma is negative, or coarsening is not above 1.

    Notes
    -----
    Minimises, over the candidates of one equation,

        score = m log(RSS / n) + k log m + 2 gamma log N_k,   m = n / (1 + n / coarsening)

    with n rows, k terms, the residual sum of squares RSS, and the number N_k of supports of k terms
    in the library up to the highest degree of the candidate, so that simple terms do not pay for
    the many terms of high degree. Assumes Gaussian residuals. Where the covariance of the rows is
    known (`Weak`), the residuals must be white after weighting by it. Where it is not
    (`Differential`), they must be independent from row to row; neighbouring rows of a smoothed
    series are not, and too many terms are then selected.

    Source: Chen & Chen 2008, doi:10.1093/biomet/asn034; Miller & Dunson 2019,
    doi:10.1080/01621459.2018.1469995; Schwarz 1978, doi:10.1214/aos/1176344136.

    Examples
    --------
    >>> run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    >>> found = ep.discover(run, method=ep.Regression(selection=ep.EBIC(gamma=0.5)))
    >>> found.chosen["x"].terms
    ('x', 'x*y')
    """

    gamma: float = 1.0
    coarsening: float | None = 60.0
    basis: ClassVar[Basis] = "rows"

    def __post_init__(self) -> None:
        if not self.gamma >= 0.0:
            raise ValueError(f"gamma must be zero or more, got {self.gamma}")
        if self.coarsening is not None and not self.coarsening > 1.0:
            raise ValueError(
                f"coarsening counts rows, and must be above 1, got {self.coarsening}; None "
                "trusts the residuals to the end"
            )

    @property
    def label(self) -> str:
        return "BIC" if self.gamma == 0.0 and self.coarsening is None else "EBIC"

    def shared_by(self, n_points: int) -> EBIC:
        """The rule at one of n points with a common support: together they pay for it once."""
        return replace(self, gamma=self.gamma / n_points)

    def decide(
        self, fronts: Fronts, task: DiscoveryProblem | None = None, *, progress: Progress = SILENT
    ) -> Decision:
        with progress.stage(None, "", f"candidates by {self.label}"):
            return Decision([self._score(front) for front in fronts])

    def _score(self, front: ParetoFront) -> Float[np.ndarray, " candidates"]:
        """Scores of all candidates, with rows that are weighted where their noise is known.

        The weights depend on the model. Those of the leading candidate serve all, and are updated
        until the leader stays the same.
        """
        problem = front.rows
        masks = np.array([np.isin(problem.library.names, c.terms) for c in front.candidates])
        equation = problem.equations.index(front.equation)
        theta, target = problem.train_theta, problem.scaled_target(equation)
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
    coef, squares = fit_masks_to_rows(
        columns.T @ columns, columns.T @ right, masks, lambda: [(columns.T, right)]
    )
    for k in np.flatnonzero(np.isnan(squares)):  # weights have made its terms dependent
        fit = LeastSquares.of_rows(columns[:, masks[k]], right)
        coef[k], squares[k] = 0.0, fit.squares
        coef[k, masks[k]] = fit.coef
    return squares, coef


@dataclass(frozen=True)
class Evidence:
    """Select by -2 log likelihood of the trajectories plus a penalty for complexity.

    A `TrajectorySearch` ranks its own candidates by this value. Fronts of regressions do not have
    it.

    Notes
    -----
    Minimises

        -2 log L + sum over terms j of (log n + 2 log N_q + 2 log(2) (q - 1))

    with the likelihood L, n samples, the degree q of term j (at least 1), and the number N_q of
    terms up to that degree. Every degree above the first is half as likely a priori as the one
    below.

    Source: Schwarz 1978, doi:10.1214/aos/1176344136, for log n; Chen & Chen 2008,
    doi:10.1093/biomet/asn034, for the count.
    """

    label: ClassVar[str] = "deviance"
    basis: ClassVar[Basis] = "likelihood"

    def decide(
        self, fronts: Fronts, task: DiscoveryProblem | None = None, *, progress: Progress = SILENT
    ) -> Decision:
        deviances = [[candidate.deviance for candidate in front.candidates] for front in fronts]
        return Decision([np.array(values, dtype=np.float64) for values in deviances])


@dataclass(frozen=True)
class Knee:
    """Select the candidate closest to zero error and zero terms: the rule of the thesis.

    Parameters
    ----------
    n_norm : str, default 'library'
        "library" divides the number of terms by that of the library (the thesis's Eq. 9),
        "max_terms" by the largest candidate's number plus one (the thesis's Tables II and III).
    scale : str, default 'linear'
        "linear" takes the error 1 - R2. "log" takes its logarithm, so that a small term of an exact
        law counts.

    Raises
    ------
    ValueError
        If n_norm or scale is another word.

    Notes
    -----
    Minimises, over the candidates of one equation,

        linear: score = sqrt((1 - R2)^2 + (n_terms / n_norm)^2)
        log:    score = sqrt((log(e / e_min) / log(e_max / e_min))^2 + (n_terms / n_norm)^2)

    with e = 1 - R2. The linear scale assumes that a term worth having raises R2 by about one step
    of n_terms / n_norm: any other is dropped, by construction. The logarithmic scale assumes that
    errors span orders of magnitude: a true term that lowers the logarithm by less than one step of
    the largest fall is dropped.

    Source: the thesis, Eq. 9; a corner of the curve of error and size, as Hansen 1992,
    doi:10.1137/1034115, takes it for regularisation.

    Examples
    --------
    >>> rule, run = ep.Regression(selection=ep.Knee()), ep.lotka_volterra().trajectory()
    >>> list(ep.discover(run, method=rule).model.terms("x"))
    ['x', 'x*y']
    """

    n_norm: str = "library"
    scale: str = "linear"
    basis: ClassVar[Basis] = "rows"

    def __post_init__(self) -> None:
        if self.n_norm not in ("library", "max_terms"):
            raise ValueError(f"n_norm must be 'library' or 'max_terms', got {self.n_norm!r}")
        if self.scale not in ("linear", "log"):
            raise ValueError(f"scale must be 'linear' or 'log', got {self.scale!r}")

    @property
    def label(self) -> str:
        return "d_log" if self.scale == "log" else "d_pareto"

    def decide(
        self, fronts: Fronts, task: DiscoveryProblem | None = None, *, progress: Progress = SILENT
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


# Combinations of candidates, one per equation: the most promising first, and their scores.

# Upper bound on the error of a system, also used if it dies, diverges or cannot be refined. The
# unit is the variance of the data (a constant at the mean has error 1), or the bound of a free run.
MAX_ERROR = 10.0

# Most combinations to look at for one that the relations admit, per combination to be tried.
TRIED = 64


def combinations(
    fronts: Fronts, most: int, relations: Sequence[Relation] = ()
) -> Int[np.ndarray, "combinations fronts"]:
    """Choices of one candidate per front, by index, that have the terms named by the relations.

    If there are more than `most`, these are the most promising ones: those with the least sum of
    ranks, a candidate's rank being its place in its own front by deviance or, after a regression,
    by EBIC. They are returned in the order of their indices.
    Memory grows with `most` alone, and at most TRIED times as many are looked at.
    Raises ValueError if none of these has the terms that the relations name.
    """
    ranks = [_rank_candidates(front) for front in fronts]
    kept = list(islice(cheapest_first(fronts, ranks, relations, most_tried=TRIED * most), most))
    if not kept:
        raise ValueError(
            f"the relations {[r.text for r in relations]} name terms that no combination of "
            "candidates has; raise the search's max_terms, or depth"
        )
    found = np.array(kept, dtype=np.int64)
    return found[np.lexsort(found.T[::-1])]


def cheapest_first(
    fronts: Fronts,
    costs: Sequence[Float[np.ndarray, " _candidates"]],
    relations: Sequence[Relation],
    *,
    most_tried: int,
) -> Iterator[Int[np.ndarray, " fronts"]]:
    """Choices with the terms that relations name, by the summed cost of their candidates."""
    order = [np.argsort(cost, kind="stable") for cost in costs]
    ranked = best_first([cost[places] for cost, places in zip(costs, order, strict=True)])
    for choice in islice(ranked, most_tried):
        place = np.array([places[rank] for places, rank in zip(order, choice, strict=True)])
        if not relations or binding(relations, support_of(fronts, place)) is not None:
            yield place


def _rank_candidates(front: ParetoFront) -> Float[np.ndarray, " _candidates"]:
    """Rank of each candidate in its front, the most promising first; by R2 if no rows were kept.

    Where rows are kept they are not ranked by R2: of rows that were fitted it rises with every
    term, so that the largest supports would come first.
    """
    costs = np.array([c.deviance for c in front.candidates], dtype=np.float64)
    if np.isnan(costs).any():  # of None: only a search of trajectories knows a deviance
        costs = front.errors if front.problem is None else EBIC().decide([front]).scores[0]
    return np.argsort(np.argsort(costs, kind="stable")).astype(np.float64)


def best_first(costs: Sequence[Float[np.ndarray, " _"]]) -> Iterator[tuple[int, ...]]:
    """Every choice of one place in each row of costs, by the summed cost, then by the places.

    costs: each row in ascending order. A choice is put on the heap by one other alone, in which
    its last place that is not zero is lower by one. So none comes twice, nothing is remembered but
    the heap, and the heap grows by less than the number of rows at every choice.
    """

    def cost(choice: tuple[int, ...]) -> float:
        return sum(float(row[k]) for row, k in zip(costs, choice, strict=True))

    first = (0,) * len(costs)
    heap = [(cost(first), first)] if all(map(len, costs)) else []
    while heap:
        _, choice = heappop(heap)
        yield choice
        last = max((k for k, place in enumerate(choice) if place), default=0)
        for k in range(last, len(costs)):
            if choice[k] + 1 < len(costs[k]):
                later = (*choice[:k], choice[k] + 1, *choice[k + 1 :])
                heappush(heap, (cost(later), later))


def describe_left_out(fronts: Fronts, n_tried: int, most: int) -> str:
    """Note on combinations that were not tried, empty if the cap left out none."""
    n_all = prod(len(front.candidates) for front in fronts)
    if n_tried < most or n_all <= most:
        return ""
    return f"; the {n_tried} most promising of {n_all} combinations were tried"


def support_of(fronts: Fronts, choice: Int[np.ndarray, " fronts"]) -> dict[str, tuple[str, ...]]:
    """The terms of every state in one combination."""
    pairs = zip(fronts, choice, strict=True)
    return {front.equation: front.candidates[k].terms for front, k in pairs}
