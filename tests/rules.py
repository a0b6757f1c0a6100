"""A rule for whole systems, for any test: it selects by size alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Relation
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.front import ParetoFront
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.selection.rule import Decision


@dataclass(frozen=True)
class BySize:
    """Selects the largest candidates; with `sign=1` the smallest, which have no terms at all."""

    sign: int = -1
    label: ClassVar[str] = "size"

    def scores(
        self, fronts: Sequence[ParetoFront], library: Library, runs: Sequence[Trajectory]
    ) -> list[np.ndarray]:
        return [self.sign * front.sizes for front in fronts]

    def decide(
        self,
        fronts: Sequence[ParetoFront],
        library: Library,
        runs: Sequence[Trajectory],
        relations: Sequence[Relation] = (),
        *,
        progress: Progress = SILENT,
    ) -> Decision:
        scores = self.scores(fronts, library, runs)
        best = [front.with_scores(s).best for front, s in zip(fronts, scores, strict=True)]
        coef = coef_matrix(library, [each.coef_by_term for each in best])
        return Decision(scores, SparseModel(library, [f.equation for f in fronts], coef), "by size")
