"""What a selection rule is: scores for the candidates of every front, the lowest selected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ep2sindy.constraints.relations import Relation
from ep2sindy.machine.progress import SILENT, Progress
from ep2sindy.model.model import SparseModel
from ep2sindy.search.front import Candidate, ParetoFront

# What no noise-free fit can fall below, as a share of the target's squares: beneath it a
# criterion would select terms that explain the discretisation.
FLOOR = 1e-6

# Error of a system at most, in variances: one that always gives the mean has 1.
MAX_ERROR = 10.0


@runtime_checkable
class Selection(Protocol):
    """Gives every candidate of every front a score; the lowest of a front is selected.

    label: what the score is called in tables.
    """

    label: ClassVar[str]

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " _candidates"]]: ...


def selected(front: ParetoFront, scores: Float[np.ndarray, " candidates"]) -> Candidate:
    """The candidate of least score; of several, the smallest."""
    return front.candidates[int(np.argmin(scores))]


@dataclass(frozen=True, eq=False)
class Decision:
    """What a rule decides that weighs whole systems of equations, with coefficients of its own.

    scores: per front, one per candidate, the winner's the least. model: the winner refined, with
    the covariance of its coefficients. note: how it was decided, in words.
    """

    scores: Sequence[Float[np.ndarray, " _candidates"]]
    model: SparseModel
    note: str


@runtime_checkable
class SystemSelection(Selection, Protocol):
    """A rule that judges combinations of candidates, one per equation, and refines the winner.

    relations: between coefficients; they hold in every system that is judged. progress: told of
    the systems that are tried.
    """

    def decide(
        self,
        fronts: Sequence[ParetoFront],
        relations: Sequence[Relation] = (),
        *,
        progress: Progress = SILENT,
    ) -> Decision: ...
