"""Selection by resampling: stable terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ep2sindy.search.front import Candidate, ParetoFront


@dataclass(frozen=True)
class Stability:
    """The largest candidate all of whose terms stood in `threshold` of the bootstraps or more.

    A term counts for a bootstrap where it was at hand and stood in a support of the candidate's
    size. score = -n_terms for a stable candidate, otherwise the share of bootstraps that lacked
    its least stable term. Assumes that a term which is not in the law is chosen by chance, now
    this one and now that: one that mends the same error of the rows in every bootstrap is as
    stable as a true one, and then too many terms are kept. Bootstraps that cull a true term upset
    its companions too, which lowers their shares in a small library. The source bounds the
    number of false terms for thresholds above a half.
    Source: Meinshausen & Buehlmann 2010, doi:10.1111/j.1467-9868.2010.00740.x.
    """

    threshold: float = 0.7
    label: ClassVar[str] = "instability"

    def __post_init__(self) -> None:
        if not 0.5 < self.threshold <= 1.0:
            raise ValueError(f"threshold must lie in (0.5, 1]: {self.threshold} came")

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " _candidates"]]:
        """Raises ValueError for fronts without bootstraps."""
        _check_bootstraps([c for front in fronts for c in front.candidates])
        return [np.array([self._score(c) for c in front.candidates]) for front in fronts]

    def _score(self, candidate: Candidate) -> float:
        least = float(min(candidate.inclusion, default=1.0))
        return -float(candidate.n_terms) if least >= self.threshold else 1.0 - least


def _check_bootstraps(candidates: Sequence[Candidate]) -> None:
    if any(np.isnan(c.inclusion).any() for c in candidates):
        raise ValueError(
            "stability needs bootstraps: none stands behind a candidate; search with "
            "Bootstraps(n=32), or select with another rule"
        )
