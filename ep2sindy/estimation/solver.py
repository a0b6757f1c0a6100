"""States and coefficients together: the estimator, its passes, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, log

import numpy as np
from jaxtyping import Float

from ep2sindy.estimation.anneal import COLD, COOLING, Annealed, annealed, polished, smoothed_start
from ep2sindy.estimation.lateness import PAYS, moved, suspected, with_delays
from ep2sindy.estimation.noise import FLOOR, Noise, flow_error, noise_beside
from ep2sindy.estimation.problem import Problem
from ep2sindy.estimation.supports import term_prices

SAMPLES_PER_TERM = 5  # of the library: fewer do not tell which
SAMPLES_PER_COEFFICIENT = 10  # of an equation, where they do not: more terms follow the noise
LET_GO = 0.5  # of a state's spread: what is left of a state that the model does not follow
ENOUGH_SAMPLES = 300  # to trust the first start: fewer are quickly tried from all
# Moves of late channels, since the model of a delay is linear; mean steps that need no other.
MOST_MOVES, SETTLED = 3, 0.05
MOST_PASSES = 4  # until noise and support agree: two are the rule
# Of the smoother, by log10 of process to measurement noise: where the likely one leads astray.
OTHER_STARTS = (-2.0, 0.0, 2.0)


@dataclass(frozen=True)
class Joint:
    """Search by the likelihood of whole trajectories, states and coefficients fitted together.

    For noisy samples of all states of a system whose law the library holds: no derivative is
    estimated, so it finds what no regression can (docs/estimation.md). White noise, or noise that
    lasts for some samples. max_terms: of one equation. align: channels that are found to come late
    are brought forward; else the model is said to be a misfit, with their delays.
    Raises ValueError for fewer than one term.
    """

    max_terms: int = 7
    align: bool = False

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


@dataclass(frozen=True, eq=False)
class Aligned:
    """What fits samples whose channels were brought forward by their delays.

    delays: (d,), in mean steps.
    """

    problem: Problem
    solution: Solution
    delays: Float[np.ndarray, " d"]


def solve(problem: Problem, *, max_terms: int) -> tuple[Solution, Aligned | None]:
    """The most likely support from the likely smoothing, and from others where it fits badly; and
    what explains the samples better, if some channels come late."""
    spread = np.concatenate([record.samples for record in problem.records]).std(axis=0)

    def rank(each: Solution) -> tuple[int, float]:
        # A crude model may be likeliest where it follows one state exactly and another not at all.
        let_go = (each.noise.unexplained > 0.0) & (each.noise.std > LET_GO * spread)
        return int(let_go.sum()), each.score

    best = first = _from_start(problem, None, max_terms)
    late = _aligned(problem, first, max_terms)
    for log10_ratio in OTHER_STARTS:
        if late or (best.fits and problem.n_samples >= ENOUGH_SAMPLES):
            break
        best = min([best, _from_start(problem, log10_ratio, max_terms)], key=rank)
    return best, late if best is first else _aligned(problem, best, max_terms)


def _aligned(problem: Problem, found: Solution, max_terms: int) -> Aligned | None:
    """What fits, and is likelier, with channels that come late; None where none does."""
    around = found.annealed.around
    if around is None:  # no model follows the samples
        return None
    support = found.annealed.fit.support
    step = suspected(problem, around, support, found.prices, max_terms=max_terms)
    if step is None:
        return None
    here, now, late, delays = problem, found, step != 0.0, np.zeros(len(step))
    for _ in range(MOST_MOVES):
        delays = delays + step
        here = moved(here, now.annealed.fit.paths, step)
        now = _from_start(here, None, max_terms)
        if now.annealed.around is None:
            return None
        around, support = now.annealed.around, now.annealed.fit.support
        step = with_delays(here, around, late, support, now.prices, max_terms=max_terms)[1]
        if np.abs(step).max() < SETTLED:
            break
    # Samples at the ends are left out: their share of the likelihood is that of the others.
    score = now.score + now.noise.deviance * (problem.n_samples / here.n_samples - 1.0)
    price = late.sum() * log(problem.n_samples) + PAYS
    return Aligned(here, now, delays) if now.fits and score + price < found.score else None


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
