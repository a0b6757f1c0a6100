"""Differential form: derivatives at samples are regressed on library terms at the samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import check_domain, keep_inside, noise_inside
from ep2sindy.data.trajectory import Trajectory, check_agreement
from ep2sindy.library.library import Library
from ep2sindy.regression.rows import MOST_ROWS, RegressionRows, TermsAt
from ep2sindy.regression.splits import RandomSplit, Split
from ep2sindy.runtime.values import check_kind, locked
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
        """Stack the rows of all trajectories; every row uses samples of one stretch without a gap.

        All equations share their rows, so there is one regression.
        Raises ValueError for no trajectory, trajectories with different states, or a variable of
        the library that a trajectory lacks.
        """
        check_agreement(trajectories, library.variables)
        check_domain(trajectories, library, smooth=self.smooth_library)
        pieces = [piece for run in trajectories for piece in run.stretches()]
        n_samples = [run.n_samples for run in pieces]
        values = np.empty((sum(n_samples), len(library.variables)))
        target = np.empty((len(values), len(trajectories[0].state_names)))
        ends = np.cumsum(n_samples)
        for run, end in zip(pieces, ends.tolist(), strict=True):
            rows = slice(end - run.n_samples, end)
            self._fill(run, library, values[rows], target[rows])
        terms = TermsAt(library, values)
        problem = RegressionRows(
            theta=terms if len(values) > MOST_ROWS else terms[:],
            target=locked(target),
            library=library,
            equations=trajectories[0].state_names,
            groups=np.arange(len(values)),
            test=np.concatenate([self.split.held_out(n, rng) for n in n_samples]),
            trajectories=tuple(trajectories),
        )
        return (problem,)

    def _fill(
        self,
        run: Trajectory,
        library: Library,
        values: Float[np.ndarray, "samples variables"],
        target: Float[np.ndarray, "samples n_states"],
    ) -> None:
        """Write the library's variables and the derivatives of one trajectory at its samples."""
        n_columns = 1 if run.n_samples > MOST_ROWS else len(run.names)  # at once: each is copied
        values[:] = run.columns(library.variables)
        for k in range(0, target.shape[1], n_columns):
            some = slice(k, k + n_columns)
            target[:, some] = self.smoother.derivative(run.t, run.states[:, some])
        if not self.smooth_library:
            return
        for k in range(0, values.shape[1], n_columns):
            some = slice(k, k + n_columns)
            values[:, some] = self.smoother.smooth(run.t, values[:, some])
        if library.functions:
            raw = noise_inside(library, run.columns(library.variables))
            values[:] = keep_inside(library, values, raw)
