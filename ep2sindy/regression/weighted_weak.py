"""Weak rows that are white under the whole library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.regression.ambiguity import usable_terms
from ep2sindy.regression.rows import Regression
from ep2sindy.regression.splits import RandomSplit
from ep2sindy.regression.weak import Weak
from ep2sindy.regression.whitening import whitened_rows
from ep2sindy.signals.smoothers import Smoother


@dataclass(frozen=True)
class WeightedWeak:
    """Weak rows that are white under the whole library: the sharpest rows for a search in noise.

    The rows of `weak` are weighted by their covariance and linearised about samples corrected by
    `n_steps` steps with all terms, so that no support is favoured; then a support's residual says
    how likely it is, and the true one leads its size far more often (docs/benchmark.md). Assumes
    that the samples hold white noise, and that the library holds the law: fast dynamics that no
    term follows would be taken for noise. Rows are in the unit of the derivative, up to a factor.
    Raises ValueError for held-out rows, which have no part in the weights.
    """

    weak: Weak = field(default_factory=lambda: Weak(split=RandomSplit(0.0)))
    n_steps: int = 2

    def __post_init__(self) -> None:
        if not self.weak.errors_in_variables:
            raise ValueError("weights need the noise: set weak.errors_in_variables to true")
        if self.n_steps < 0:
            raise ValueError(f"n_steps must be zero or more: {self.n_steps} came")

    @property
    def smoother(self) -> Smoother:
        return self.weak.smoother

    def assemble(
        self, trajectories: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> tuple[Regression, ...]:
        """One regression per state, as `Weak.assemble` gives it, with white rows."""
        problems = self.weak.assemble(trajectories, library, rng=rng)
        return tuple(self._weighted(problem) for problem in problems)

    def _weighted(self, problem: Regression) -> Regression:
        if problem.test.any():
            raise ValueError(
                "weighted rows cannot be held out: set weak.split.test_fraction to 0, or use Weak"
            )
        everything = usable_terms(problem)
        coef = np.zeros(len(problem.library))
        theta, target = problem.train_theta[:, everything], problem.train_target(0)
        coef[everything] = np.linalg.lstsq(theta, target)[0]
        white = whitened_rows(problem, everything, coef, n_steps=self.n_steps)
        # White rows are many standard deviations long; back to about the unit of the derivative.
        size = 1.0 / np.linalg.norm(white.target)
        return replace(
            problem,
            theta=white.theta * (problem.theta_scale * size),
            target=white.target[:, None] * (problem.target_scale * size),
            groups=np.arange(len(white.target)),
        )
