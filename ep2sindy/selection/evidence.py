"""Selection by the likelihood of whole trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ep2sindy.search.front import ParetoFront


@dataclass(frozen=True)
class Evidence:
    """The candidate under which the trajectories are most likely, its terms' prices paid.

    What a `Joint` search weighs its own candidates by; fronts of other searches have none.
    """

    label: ClassVar[str] = "deviance"

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " _candidates"]]:
        for front in fronts:
            if any(candidate.deviance is None for candidate in front.candidates):
                raise ValueError(
                    "Evidence weighs what a joint search found: these fronts come from rows; set "
                    "search=Joint() (search=joint), or select by EBIC"
                )
        return [
            np.array([candidate.deviance for candidate in front.candidates], dtype=np.float64)
            for front in fronts
        ]
