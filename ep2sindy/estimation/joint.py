"""States and coefficients together: the estimator, its passes, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from jaxtyping import Float

from ep2sindy.estimation.anneal import COLD, COOLING, Annealed, annealed, polished
from ep2sindy.estimation.noise import FLOOR, Noise, flow_error, noise_beside
from ep2sindy.estimation.problem import Problem
from ep2sindy.estimation.start import smoothed_start
from ep2sindy.estimation.supports import term_prices

SAMPLES_PER_TERM = 5  # of the library: fewer do not tell which
SAMPLES_PER_COEFFICIENT = 10  # of an equation, where they do not: more terms follow the noise
LET_GO = 0.5  # of a state's spread: what is left of a state that the model does not follow
ENOUGH_SAMPLES = 300  # to trust the first start: fewer are quickly tried from all
MOST_PASSES = 4  # until noise and support agree: two are the rule
# Of the smoother, by log10 of process to measurement noise: where the likely one leads astray.
OTHER_STARTS = (-2.0, 0.0, 2.0)


@dataclass(frozen=True)
class Joint:
    """Search by the likelihood of whole trajectories, states and coefficients fitted together.

    For noisy samples of all states of a system whose law the library holds: no derivative is
    estimated, so it finds what no regression can (docs/estimation.md). White noise, or noise that
    lasts for some samples. max_terms: of one equation.
    Raises ValueError for fewer than one term.
    """

    max_terms: int = 7

    def __post_init__(self) -> None:
        if self.max_terms < 1:
            raise ValueError(f"max_terms must be at least 1: {self.max_terms} came")

    def terms_for(self, problem: Problem) -> int:
        """Terms that one equation may have: fewer where the samples are few."""
        if enough_samples(problem):
            return self.max_terms
        return max(1, min(self.max_terms, problem.n_samples // SAMPLES_PER_COEFFICIENT))


def enough_samples(problem: Problem) -> bool:
    """Whether they can tell which terms of the library there are."""
    return problem.n_samples >= SAMPLES_PER_TERM * len(problem.library)


@dataclass(frozen=True, eq=False)
class Solution:
    """The end of one start. score: -2 log likelihood plus prices, comparable between starts."""

    annealed: Annealed
    noise: Noise
    prices: Float[np.ndarray, " free"]
    flow_error: float

    @property
    def score(self) -> float:
        if not np.isfinite(self.annealed.score):
            return inf
        return self.noise.deviance + float(self.prices[self.annealed.fit.support].sum())

    @property
    def fits(self) -> bool:
        """Whether what is left looks like noise."""
        exact = self.flow_error == 0.0 and not self.noise.unexplained.any()
        return exact and bool(np.isfinite(self.score))


def solve(problem: Problem, *, max_terms: int) -> Solution:
    """The most likely support from the likely smoothing, and from others where it fits badly."""
    spread = np.concatenate([record.samples for record in problem.records]).std(axis=0)

    def rank(each: Solution) -> tuple[int, float]:
        # A crude model may be likeliest where it follows one state exactly and another not at all.
        let_go = (each.noise.unexplained > 0.0) & (each.noise.std > LET_GO * spread)
        return int(let_go.sum()), each.score

    best = _from_start(problem, None, max_terms)
    for log10_ratio in OTHER_STARTS:
        if best.fits and problem.n_samples >= ENOUGH_SAMPLES:
            break
        best = min([best, _from_start(problem, log10_ratio, max_terms)], key=rank)
    return best


def _from_start(problem: Problem, log10_ratio: float | None, max_terms: int) -> Solution:
    """Anneal with the smoother's noise, then with the noise that the model leaves, until both
    and the support agree."""
    fit, std = smoothed_start(problem, log10_ratio)
    prices = term_prices(problem, float(problem.n_samples))
    found = annealed(problem, fit, std, prices, COOLING, max_terms=max_terms)
    for _ in range(MOST_PASSES):
        before, noise = found.fit.support, noise_beside(problem, found.fit)
        prices = term_prices(problem, problem.n_samples * float(noise.independent.mean()))
        found = annealed(problem, found.fit, noise.effective, prices, COLD, max_terms=max_terms)
        if np.array_equal(before, found.fit.support):
            break
    found = polished(problem, found, prices, max_terms=max_terms)
    noise = noise_beside(problem, found.fit)
    error = 0.0
    if np.isfinite(found.score) and (noise.std > FLOOR).any():
        error = flow_error(problem, found.fit, noise, found.level)
    return Solution(found, noise, prices, error)
