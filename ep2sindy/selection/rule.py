"""Protocols of selection rules: scores of candidates, alone or combined, the lowest selected."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import islice
from math import prod
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, Relation, binding
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.front import ParetoFront
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.selection.criteria import EBIC

# Upper bound on the error of a system, also used if it dies, diverges or cannot be refined. The
# unit is the variance of the data (a constant at the mean has error 1), or the bound of a free run.
MAX_ERROR = 10.0

# Most combinations to look at for one that the relations admit, per combination to be tried.
TRIED = 64


@runtime_checkable
class Selection(Protocol):
    """A rule that scores every candidate of every front; the lowest score of a front is selected.

    label: name of the score in tables.
    """

    @property
    def label(self) -> str: ...

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " _candidates"]]: ...


@dataclass(frozen=True)
class OtherSystem:
    """A system of as many free coefficients as the selected one, which lives too.

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
    """Result of a rule that judges whole systems of equations and refines the coefficients.

    scores: for each front, one per candidate, the winner's the least. model: the winner refined,
    with the covariance of its coefficients. note: how it was decided, in words. constraint: what
    the winner's coefficients obey; None if the rule does not say. others: systems of its size that
    would do as well, the best first.
    """

    scores: Sequence[Float[np.ndarray, " _candidates"]]
    model: SparseModel
    note: str
    constraint: Constraint | None = None
    others: Sequence[OtherSystem] = ()


@runtime_checkable
class SystemSelection(Protocol):
    """A rule that judges combinations of candidates, one per equation, and refines the winner.

    library: of the candidates' terms. runs: the data that systems are judged on. relations: between
    coefficients; they hold in every system that is judged. progress: notified of the systems that
    are tried. label: name of the score in tables.
    """

    @property
    def label(self) -> str: ...

    def scores(
        self, fronts: Sequence[ParetoFront], library: Library, runs: Sequence[Trajectory]
    ) -> list[Float[np.ndarray, " _candidates"]]: ...

    def decide(
        self,
        fronts: Sequence[ParetoFront],
        library: Library,
        runs: Sequence[Trajectory],
        relations: Sequence[Relation] = (),
        *,
        progress: Progress = SILENT,
    ) -> Decision: ...


def score_candidates(
    rule: Selection | SystemSelection,
    fronts: Sequence[ParetoFront],
    library: Library,
    runs: Sequence[Trajectory],
) -> list[Float[np.ndarray, " _candidates"]]:
    """Scores by a rule of either kind, of single candidates or of whole systems."""
    if isinstance(rule, SystemSelection):
        return rule.scores(fronts, library, runs)
    return rule.scores(fronts)


def combinations(
    fronts: Sequence[ParetoFront], most: int, relations: Sequence[Relation] = ()
) -> Int[np.ndarray, "combinations fronts"]:
    """Choices of one candidate per front, by index, that have the terms named by the relations.

    If there are more than `most`, these are the most promising ones: those with the least sum of
    ranks, a candidate's rank being its place in its own front by deviance or, after a regression,
    by EBIC. They are returned in the order of their indices.
    Memory grows with `most` alone, and at most TRIED times as many are looked at.
    Raises ValueError if none of these has the terms that the relations name.
    """
    order = [_rank_candidates(front) for front in fronts]
    ranks = best_first([np.arange(len(places), dtype=np.float64) for places in order])
    kept = []
    for choice in islice(ranks, TRIED * most):
        place = np.array([places[rank] for places, rank in zip(order, choice, strict=True)])
        if not relations or binding(relations, support_of(fronts, place)) is not None:
            kept.append(place)
        if len(kept) == most:
            break
    if not kept:
        raise ValueError(
            f"the relations {[r.text for r in relations]} name terms that no combination of "
            "candidates has; raise the search's max_terms, or depth"
        )
    found = np.array(kept, dtype=np.int64)
    return found[np.lexsort(found.T[::-1])]


def _rank_candidates(front: ParetoFront) -> Int[np.ndarray, " _candidates"]:
    """Places of the candidates of one front, the most promising first; by R2 if no rows were kept.

    Where rows are kept they are not ranked by R2: of rows that were fitted it rises with every
    term, so that the largest supports would come first.
    """
    costs = np.array([c.deviance for c in front.candidates], dtype=np.float64)
    if np.isnan(costs).any():  # of None: only a search of trajectories knows a deviance
        costs = front.errors if front.problem is None else EBIC().scores([front])[0]
    return np.argsort(costs, kind="stable")


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


def left_out(fronts: Sequence[ParetoFront], n_tried: int, most: int) -> str:
    """Note on combinations that were not tried, empty if the cap left out none."""
    n_all = prod(len(front.candidates) for front in fronts)
    if n_tried < most or n_all <= most:
        return ""
    return f"; the {n_tried} most promising of {n_all} combinations were tried"


def combination_scores(
    fronts: Sequence[ParetoFront],
    places: Int[np.ndarray, "combinations fronts"],
    errors: Float[np.ndarray, " combinations"],
    *,
    limit: float,
    winner: int | None = None,
) -> list[Float[np.ndarray, " _candidates"]]:
    """Scores of candidates from the errors of their combinations.

    limit: errors up to this value cannot be told from the least; of these the combination of fewest
    terms wins, unless `winner` names another. A candidate's score is the least error of all
    combinations with it, no less than the limit, or MAX_ERROR if there are none. The winner's
    candidates score marginally below the limit.
    """
    winner = smallest(fronts, places, errors, limit=limit) if winner is None else winner
    scores = np.maximum(errors, limit)
    scores[winner] = np.nextafter(limit, 0.0)
    return [
        np.array([scores[column == k].min(initial=MAX_ERROR) for k in range(len(front.candidates))])
        for front, column in zip(fronts, places.T, strict=True)
    ]


def smallest(
    fronts: Sequence[ParetoFront],
    places: Int[np.ndarray, "combinations fronts"],
    errors: Float[np.ndarray, " combinations"],
    *,
    limit: float,
) -> int:
    """Index of the combination of fewest terms, then least error, among errors up to the limit."""
    n_terms = sum(f.sizes[k] for f, k in zip(fronts, places.T, strict=True))
    return int(np.lexsort((errors, n_terms, errors > limit))[0])


def support_of(
    fronts: Sequence[ParetoFront], choice: Int[np.ndarray, " fronts"]
) -> dict[str, tuple[str, ...]]:
    """The terms of every state in one combination."""
    pairs = zip(fronts, choice, strict=True)
    return {front.equation: front.candidates[k].terms for front, k in pairs}
