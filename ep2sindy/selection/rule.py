"""The protocol of selection rules, and what a rule decides; the lowest score is selected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import Task
from ep2sindy.library.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.front import Fronts
from ep2sindy.runtime.progress import SILENT, Progress

Basis = Literal["rows", "likelihood", "runs"]


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
    """What a rule decides.

    scores: for each front, one per candidate, the winner's the least. model: the winner refined,
    with the covariance of its coefficients; None if the rule scores candidates one by one, and the
    coefficients are still to be fitted. note: how it was decided, in words. constraint: what the
    winner's coefficients obey; None if the rule does not say. others: systems of its size that
    would do as well, the best first.
    """

    scores: Sequence[Float[np.ndarray, " _candidates"]]
    model: SparseModel | None = None
    note: str = ""
    constraint: Constraint | None = None
    others: Sequence[OtherSystem] = ()


@runtime_checkable
class Selection(Protocol):
    """A rule that scores every candidate of every front; the lowest score of a front is selected.

    label: name of the score in tables. basis: what is scored: "rows" of a regression, the
    "likelihood" of trajectories, or "runs" of whole systems, one candidate per equation, of which
    the rule refines the winner. `decide` gets the fronts of all equations, what was asked (its
    runs, and the relations between coefficients), and whom to notify of the systems it tries.
    """

    @property
    def label(self) -> str: ...

    @property
    def basis(self) -> Basis: ...

    def decide(self, fronts: Fronts, task: Task, *, progress: Progress = SILENT) -> Decision: ...
