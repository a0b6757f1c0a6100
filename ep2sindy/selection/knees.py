"""The knee of error against size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.search.front import ParetoFront
from ep2sindy.selection.rule import FLOOR


@dataclass(frozen=True)
class Knee:
    """Select the candidate closest to no error and no terms: the thesis's rule.

    score = sqrt((1 - R2)^2 + (n_terms / n_norm)^2), where n_norm is the number of terms in
    the library (the thesis's Eq. 9), or for "max_terms" the largest candidate's plus one (what
    the thesis's Tables II and III were made with). Assumes that a term worth having raises R2 by
    about one step of n_terms / n_norm: any other is dropped, by construction.
    scale: "log" takes the logarithm of the error, so that a small term of an exact law counts:
    score = sqrt(((log e - log e_min) / (log e_max - log e_min))^2 + (n_terms / n_norm)^2).
    That assumes that errors span orders of magnitude: the largest fall sets the scale, and a true
    term that lowers the error by less than one step of it is dropped.
    """

    n_norm: str = "library"
    scale: str = "linear"

    def __post_init__(self) -> None:
        if self.n_norm not in ("library", "max_terms"):
            raise ValueError(f"n_norm must be 'library' or 'max_terms': {self.n_norm!r} came")
        if self.scale not in ("linear", "log"):
            raise ValueError(f"scale must be 'linear' or 'log': {self.scale!r} came")

    @property
    def label(self) -> str:
        return "d_log" if self.scale == "log" else "d_pareto"

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " _candidates"]]:
        return [
            np.hypot(self._height(front), front.sizes / _norm_of_sizes(front, self.n_norm))
            for front in fronts
        ]

    def _height(self, front: ParetoFront) -> Float[np.ndarray, " candidates"]:
        """Errors, or their logarithms from 0 to 1."""
        if self.scale == "linear":
            return front.errors
        height = np.log(np.maximum(front.errors, FLOOR))
        return (height - height.min()) / max(float(np.ptp(height)), np.finfo(float).tiny)


def _norm_of_sizes(front: ParetoFront, n_norm: str) -> float:
    if n_norm == "library":
        return float(len(front.problem.library))
    return float(front.sizes.max()) + 1.0
