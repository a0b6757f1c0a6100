"""From free states to exact trajectories: supports chosen at every level on the way.

It begins with smoothed states, and every coefficient from their derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.domain import kept_inside
from ep2sindy.data.scales import zero_to_one
from ep2sindy.estimation.lateness import DelayedGram, delayed_gram
from ep2sindy.estimation.likelihood import FAR, Fit, Level, enough_substeps, fitted, gram, squares
from ep2sindy.estimation.noise import FLOOR
from ep2sindy.estimation.problem import Problem
from ep2sindy.estimation.supports import alternatives, best_support, excess
from ep2sindy.signals.kalman import KalmanSmoother

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


UNSURE = 0.05  # of the RMS: noise taken for a start where the smoother's is not believed
CUTOFF = 1e-8  # singular values of unit columns: smaller ones follow noise


def smoothed_start(
    problem: Problem, log10_ratio: float | None
) -> tuple[Fit, tuple[np.ndarray, ...]]:
    """All coefficients free, on smoothed states; and the noise beside them, by record (samples, d).

    log10_ratio: of the smoother; None finds the most likely one of each record and state. Below
    some twenty samples a period the likely one may take signal for noise.
    """
    smoother = KalmanSmoother(log10_ratio)
    estimates = [smoother.estimate(r.times, r.samples) for r in problem.records]
    variance = np.mean([np.square(e.noise_std) for e in estimates], axis=0)
    samples = [np.concatenate([r.samples, r.inputs], axis=1) for r in problem.records]
    values = [
        kept_inside(problem.library, np.concatenate([e.smoothed, r.inputs], axis=1), raw)
        for e, r, raw in zip(estimates, problem.records, samples, strict=True)
    ]
    paths = tuple(each[:, : len(problem.states)] for each in values)
    theta = np.concatenate([problem.library.evaluate(each) for each in values])
    rates = np.concatenate([e.derivative for e in estimates])
    support = np.ones(problem.C.shape[1], dtype=np.bool_)
    fit = Fit(paths, _regressed(problem, theta, rates), support, np.full(len(variance), np.inf))
    std = np.maximum(np.sqrt(variance), FLOOR if log10_ratio is None else UNSURE)
    return fit, tuple(np.tile(std, (len(path), 1)) for path in paths)


def _regressed(
    problem: Problem,
    theta: Float[np.ndarray, "samples terms"],
    rates: Float[np.ndarray, "samples d"],
) -> Float[np.ndarray, " free"]:
    """Least squares of all equations at once, relations held."""
    n, d = rates.shape
    rows = np.zeros((n, d, len(problem.equation)))
    for k, (equation, column) in enumerate(zip(problem.equation, problem.column, strict=True)):
        rows[:, equation, k] = theta[:, column]
    target = (rates - rows @ problem.fixed).reshape(-1)
    if problem.related:
        return _solved(rows.reshape(n * d, -1) @ problem.C, target)
    free = np.zeros(problem.C.shape[1])
    for equation in range(d):  # far smaller, equation by equation
        own = problem.equation == equation
        free[own] = _solved(rows[:, equation, own], target.reshape(n, d)[:, equation])
    return free


def _solved(
    rows: Float[np.ndarray, "rows columns"], target: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " columns"]:
    size = zero_to_one(np.linalg.norm(rows, axis=0))
    return np.linalg.lstsq(rows / size, target, rcond=CUTOFF)[0] / size
