"""From free states to exact trajectories: supports chosen at every level on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.estimation.lateness import DelayedGram, delayed_gram
from ep2sindy.estimation.likelihood import FAR, Fit, Level, enough_substeps, fitted, gram, squares
from ep2sindy.estimation.problem import Problem
from ep2sindy.estimation.supports import alternatives, best_support, excess

# rho, and the share of a term's price that is asked there: free states hide part of what a term
# explains, and what is dropped too early would have to be found again.
COOLING = ((0.3, 0.2), (0.1, 0.4), (0.03, 0.7), (0.01, 1.0), (0.003, 1.0), (0.001, 1.0))
COLD = ((0.1, 1.0), (0.03, 1.0), (0.003, 1.0), (0.0001, 1.0))
MOST_EXCHANGES = 3  # of supports at one level
# Where supports are weighed again: colder, a linear model of the flow tells too little of others;
# warmer, free states hide what tells them apart.
WEIGHED_AT = 0.003
WITHIN, MOST_TRIED, MOST_ROUNDS = 12.0, 6, 6  # above the chosen score; of each round; of all


@dataclass(frozen=True, eq=False)
class Annealed:
    """A fit, the level that it ended at, and its squares plus the prices of its terms.

    around: what is near it, where its support was weighed against others.
    """

    fit: Fit
    level: Level
    score: float
    around: DelayedGram | None = None


def annealed(
    problem: Problem,
    fit: Fit,
    noise: tuple[np.ndarray, ...],
    prices: Float[np.ndarray, " free"],
    schedule: Sequence[tuple[float, float]],
    *,
    max_terms: int,
) -> Annealed:
    """Fit level by level; at each, exchange terms as long as squares plus prices fall."""
    n_substeps, score = 1, np.inf
    for rho, share in schedule:
        fit, level = at_level(problem, fit, Level(noise, rho, n_substeps))
        n_substeps = level.n_substeps
        fit, score = _exchanged(problem, fit, level, share * prices, max_terms)
    return Annealed(fit, level, score)


def polished(
    problem: Problem, found: Annealed, prices: Float[np.ndarray, " free"], *, max_terms: int
) -> Annealed:
    """Fit again whatever is nearly as likely by a linear model, and keep what is likelier.

    What does not follow its samples is left: a linear model of that tells nothing.
    """
    if not found.fit.total < FAR * problem.n_squares:
        return found
    tried = {found.fit.support.tobytes()}
    for _ in range(MOST_ROUNDS):
        warmer, level = at_level(problem, found.fit, replace(found.level, rho=WEIGHED_AT))
        around = delayed_gram(problem, warmer, level)
        pair = around.at_rest
        if not (pair.finite and np.isfinite(found.score)):
            return found
        others = alternatives(
            problem, pair, prices, warmer.support, within=WITHIN, max_terms=max_terms
        )
        others = [each for each in others if each.support.tobytes() not in tried]
        for each in others[:MOST_TRIED]:
            tried.add(each.support.tobytes())
            start = replace(warmer, support=each.support, free=each.free)
            fit, cold = at_level(problem, start, level)
            fit, cold = at_level(problem, fit, replace(cold, rho=found.level.rho))
            score = float(fit.total + prices[fit.support].sum())
            if score < found.score:
                found = Annealed(fit, cold, score)
                break
        else:
            return replace(found, around=around)
    return found


def at_level(problem: Problem, fit: Fit, level: Level) -> tuple[Fit, Level]:
    """Fit at a level, with as many substeps as that asks for."""
    level = replace(level, n_substeps=enough_substeps(problem, fit, level))
    if not np.isfinite(squares(problem, fit.paths, fit.free, level)).all():
        fit = replace(fit, free=np.zeros_like(fit.free))  # a flow that stands still is finite
    return fitted(problem, fit, level), level


def _exchanged(
    problem: Problem, fit: Fit, level: Level, prices: Float[np.ndarray, " free"], max_terms: int
) -> tuple[Fit, float]:
    """Exchange terms by the Gram pair, fit again, and accept what lowers squares plus prices."""
    score = fit.total + prices[fit.support].sum()
    for _ in range(MOST_EXCHANGES):
        pair = gram(problem, fit, level)
        if not (pair.finite and np.isfinite(score)):
            break
        found = best_support(problem, pair, prices, fit.support, max_terms=max_terms)
        if np.array_equal(found.support, fit.support):
            break
        tried = fitted(problem, replace(fit, support=found.support, free=found.free), level)
        tried_score = tried.total + prices[found.support].sum()
        too_large = excess(problem, fit.support, max_terms) > 0
        if not (tried_score < score or (too_large and np.isfinite(tried_score))):
            break
        fit, score = tried, tried_score
    return fit, float(score)
