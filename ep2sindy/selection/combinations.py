"""Combinations of candidates, one per equation: the most promising first, and their scores."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from heapq import heappop, heappush
from itertools import islice
from math import prod

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.library.relations import Relation, binding
from ep2sindy.regression.front import Fronts, ParetoFront
from ep2sindy.selection.criteria import EBIC

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


def score_combinations(
    fronts: Fronts,
    places: Int[np.ndarray, "combinations fronts"],
    errors: Float[np.ndarray, " combinations"],
    *,
    limit: float,
    winner: int,
) -> list[Float[np.ndarray, " _candidates"]]:
    """Scores of candidates from the errors of their combinations.

    limit: errors up to this value cannot be told from the least. winner: index of the combination
    that is selected among them. A candidate's score is the least error of all
    combinations with it, no less than the limit, or MAX_ERROR if there are none. The winner's
    candidates score marginally below the limit.
    """
    scores = np.maximum(errors, limit)
    scores[winner] = np.nextafter(limit, 0.0)
    return [
        np.array([scores[column == k].min(initial=MAX_ERROR) for k in range(len(front.candidates))])
        for front, column in zip(fronts, places.T, strict=True)
    ]


def find_smallest(
    fronts: Fronts,
    places: Int[np.ndarray, "combinations fronts"],
    errors: Float[np.ndarray, " combinations"],
    *,
    limit: float,
) -> int:
    """Index of the combination of fewest terms, then least error, among errors up to the limit."""
    n_terms = sum(f.sizes[k] for f, k in zip(fronts, places.T, strict=True))
    return int(np.lexsort((errors, n_terms, errors > limit))[0])


def support_of(fronts: Fronts, choice: Int[np.ndarray, " fronts"]) -> dict[str, tuple[str, ...]]:
    """The terms of every state in one combination."""
    pairs = zip(fronts, choice, strict=True)
    return {front.equation: front.candidates[k].terms for front, k in pairs}
