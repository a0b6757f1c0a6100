"""Differential form: derivatives at samples are regressed on library terms at the samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ep2sindy.data.coerce import check_domain, keep_inside
from ep2sindy.data.trajectory import Trajectory, check_agreement
from ep2sindy.library.library import Library
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.splits import RandomSplit, Split
from ep2sindy.runtime.values import check_kind
from ep2sindy.signals.smoothers import SavitzkyGolay, Smoother


@dataclass(frozen=True)
class Differential:
    """Regress the derivative at every sample on the library at that sample.

    smooth_library: evaluate the terms on smoothed samples (default) or on raw ones (the thesis).
    With noise in the terms a wrong support can score best.
    """

    smoother: Smoother = field(default_factory=SavitzkyGolay)
    smooth_library: bool = True
    split: Split = field(default_factory=RandomSplit)

    def __post_init__(self) -> None:
        check_kind("smoother", self.smoother, Smoother, "ep.signals.SavitzkyGolay()")
        check_kind("split", self.split, Split, "ep.RandomSplit()")

    def assemble(
        self,
        trajectories: Sequence[Trajectory],
        library: Library,
        *,
        rng: np.random.Generator,
    ) -> tuple[RegressionRows, ...]:
        """Stack the rows of all trajectories; every row uses samples of one trajectory only.

        All equations share their rows, so there is one regression.
        Raises ValueError for no trajectory, trajectories with different states, or a variable of
        the library that a trajectory lacks.
        """
        check_agreement(trajectories, library.variables)
        check_domain(trajectories, library)
        parts = [self._rows(run, library) for run in trajectories]
        test = [self.split.held_out(run.n_samples, rng) for run in trajectories]
        n_rows = sum(run.n_samples for run in trajectories)
        problem = RegressionRows(
            theta=np.concatenate([theta for theta, _ in parts]),
            target=np.concatenate([target for _, target in parts]),
            library=library,
            equations=trajectories[0].state_names,
            groups=np.arange(n_rows),
            test=np.concatenate(test),
            trajectories=tuple(trajectories),
        )
        return (problem,)

    def _rows(self, run: Trajectory, library: Library) -> tuple[np.ndarray, np.ndarray]:
        values = run.columns(library.variables)
        if self.smooth_library:
            values = keep_inside(library, self.smoother.smooth(run.t, values), values)
        with np.errstate(over="ignore"):  # RegressionRows names a term that is not finite
            return library.evaluate(values), self.smoother.derivative(run.t, run.states)
