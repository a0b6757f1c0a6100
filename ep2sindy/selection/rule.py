"""What a selection rule is: scores for the candidates of every front, the lowest selected."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ep2sindy.search.front import Candidate, ParetoFront

# What no noise-free fit can fall below, as a share of the target's squares: beneath it a
# criterion would select terms that explain the discretisation.
FLOOR = 1e-6


@runtime_checkable
class Selection(Protocol):
    """Gives every candidate of every front a score; the lowest of a front is selected.

    label: what the score is called in tables.
    """

    label: ClassVar[str]

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " candidates"]]: ...


def selected(front: ParetoFront, scores: Float[np.ndarray, " candidates"]) -> Candidate:
    """The candidate of least score; of several, the smallest."""
    return front.candidates[int(np.argmin(scores))]
