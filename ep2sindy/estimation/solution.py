"""A solution of the estimation problem: fit, observation, and the tests of what the fit leaves."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.estimation.delay import DelayedGram
from ep2sindy.estimation.likelihood import TrajectoryFit
from ep2sindy.estimation.noise import Noise
from ep2sindy.estimation.problem import EstimationProblem

IGNORED = 0.5  # residual, as a share of a state's spread, if the model ignores the state


@dataclass(frozen=True, eq=False)
class Observation:
    """How states x show themselves in samples y, and how far they follow the flow.

        y_k(t) = x_k(t - delays_k) + noise_k(t),    x(t + 1) = flow(x(t)) + process * white noise

    Of y a record has the value, a pair of limits, or nothing (`ScaledRecord`), whatever the other
    parts are. delays: (d,), in mean steps. process: (d,), scaled; zero for an exact trajectory.
    price: of the parameters that are not zero, on the scale of -2 log likelihood.
    """

    noise: Noise
    delays: Float[np.ndarray, " d"]
    process: Float[np.ndarray, " d"]
    price: float = 0.0


@dataclass(frozen=True, eq=False)
class LackOfFit:
    """A test of a fit, by state: a statistic, and the most that it may be.

    words: what a larger statistic shows, a format of {state} and {value}; without {state} it is of
    all states together.
    """

    statistic: Float[np.ndarray, " d"] | Bool[np.ndarray, " d"]
    bound: float
    words: str = ""

    @property
    def passes(self) -> Bool[np.ndarray, " d"]:
        return np.asarray(self.statistic <= self.bound)  # NaN does not


@dataclass(frozen=True, eq=False)
class Solution:
    """The likeliest support that one search has found, under one observation of the states.

    Solutions are compared by -2 log likelihood + prices of terms + price of the observation,
    after what they explain (`rank`).

    prices: of the free coefficients. deviance: -2 log likelihood of the samples. tests: all that
    the fit must pass. flow_error: size of the deviations from the flow, as a share of the noise.
    around: linearisation with delays, where the support was compared with others.
    """

    fit: TrajectoryFit
    observation: Observation
    prices: Float[np.ndarray, " free"]
    deviance: float
    tests: tuple[LackOfFit, ...]
    flow_error: float = 0.0
    around: DelayedGram | None = None

    @property
    def problem(self) -> EstimationProblem:
        return self.fit.problem

    @property
    def noise(self) -> Noise:
        return self.observation.noise

    @property
    def score(self) -> float:
        """-2 log likelihood plus prices, comparable between solutions."""
        if not np.isfinite(self.fit.total):
            return inf
        return self.deviance + float(self.prices[self.fit.support].sum()) + self.observation.price

    @property
    def explained(self) -> Bool[np.ndarray, " d"]:
        """Mask of the states that the fit explains; an exact trajectory explains all or none."""
        found = np.all([test.passes for test in self.tests], axis=0) & np.isfinite(self.score)
        return found if self.observation.process.any() else np.full(len(found), found.all())

    @property
    def fits(self) -> bool:
        """True if the fit explains all states."""
        return bool(self.explained.all())

    @property
    def rank(self) -> tuple[int, bool, int, float]:
        """Order between solutions, least is best: what they explain, the simpler, the likelier.

        The score of states that leave the flow is no likelihood. A crude model may score best by
        following one state exactly and ignoring another.
        """
        spread = self.problem.all_records.samples.std(axis=0)
        ignored = self.noise.is_error & (self.noise.std > IGNORED * spread)
        n_ignored = int((ignored & self.problem.measured).sum())
        process = bool(self.observation.process.any())
        return int((~self.explained).sum()), process, n_ignored, self.score

    @property
    def signs(self) -> list[str]:
        """What tells that the fit does not explain the samples, in words."""
        words = [
            test.words.format(state=state, value=test.statistic[k])
            for k, state in enumerate(self.problem.states)
            for test in self.tests
            if not test.passes[k]
        ]
        return list(dict.fromkeys(words))
