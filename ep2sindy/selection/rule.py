"""Protocols of selection rules: scores of candidates, alone or combined, the lowest selected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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

# Least residual squares, as a share of the target's squares: below this value a criterion would
# select terms that fit the discretisation error of noise-free data.
FLOOR = 1e-6

# Upper bound on the error of a system, also used if it dies, diverges or cannot be refined. The
# unit is the variance of the data (a constant at the mean has error 1), or the bound of a free run.
MAX_ERROR = 10.0


@runtime_checkable
class Selection(Protocol):
    """A rule that scores every candidate of every front; the lowest score of a front is selected.

    label: name of the score in tables.
    """

    @property
    def label(self) -> str: ...

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " _candidates"]]: ...


@dataclass(frozen=True, eq=False)
class Decision:
    """Result of a rule that judges whole systems of equations and refines the coefficients.

    scores: for each front, one per candidate, the winner's the least. model: the winner refined,
    with the covariance of its coefficients. note: how it was decided, in words. constraint: what
    the winner's coefficients obey; None if the rule does not say.
    """

    scores: Sequence[Float[np.ndarray, " _candidates"]]
    model: SparseModel
    note: str
    constraint: Constraint | None = None


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
    fronts: Sequence[ParetoFront],
    most: int,
    *,
    use: str = "integrated",
    way_out: str = "raise max_combinations",
) -> Int[np.ndarray, "combinations fronts"]:
    """Every choice of one candidate per front, by index.

    use, way_out: of the caller, for the error.
    Raises ValueError for more than `most`.
    """
    counts = [len(front.candidates) for front in fronts]
    if prod(counts) > most:
        raise ValueError(
            f"at most {most} combinations of candidates are {use}: {counts} candidates make "
            f"{prod(counts)}; lower depth or the search's max_terms, or {way_out}"
        )
    return np.indices(counts).reshape(len(counts), -1).T


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


def admissible(
    fronts: Sequence[ParetoFront],
    places: Int[np.ndarray, "combinations fronts"],
    relations: Sequence[Relation],
) -> Int[np.ndarray, "_ fronts"]:
    """Combinations that have the terms named by the relations.

    Raises ValueError if there are none.
    """
    kept = [binding(relations, support_of(fronts, choice)) is not None for choice in places]
    if not any(kept):
        raise ValueError(
            f"the relations {[r.text for r in relations]} name terms that no combination of "
            "candidates has; raise the search's max_terms, or depth"
        )
    return places[np.array(kept)]
