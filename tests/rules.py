"""A rule for whole systems, for any test: it selects by size alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.front import ParetoFront
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.selection.criteria import Basis, Decision


@dataclass(frozen=True)
class BySize:
    """Selects the largest candidates; with `sign=1` the smallest, which have no terms at all."""

    sign: int = -1
    label: ClassVar[str] = "size"
    basis: ClassVar[Basis] = "runs"

    def decide(
        self, fronts: Sequence[ParetoFront], task: DiscoveryProblem, *, progress: Progress = SILENT
    ) -> Decision:
        scores = [self.sign * front.sizes for front in fronts]
        best = [front.with_scores(s).best for front, s in zip(fronts, scores, strict=True)]
        coef = coef_matrix(task.library, [each.coef_by_term for each in best])
        model = SparseModel(task.library, [front.equation for front in fronts], coef)
        return Decision(scores, model, "by size")
