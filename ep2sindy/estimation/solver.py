"""The joint estimator of states and coefficients: annealing from free states to exact trajectories.

It starts from smoothed states, and from all coefficients regressed on their derivatives. Supports
are chosen at every level on the way (`anneal`), and compared again at its end (`polish`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import keep_inside, noise_inside
from ep2sindy.data.numbers import least_squares
from ep2sindy.estimation.delay import DelayedGram, delayed_gram
from ep2sindy.estimation.likelihood import (
    FAR,
    STEERED,
    Level,
    TrajectoryFit,
    enough_substeps,
    fit_paths,
    gram,
    joined,
    parting,
    squares,
)
from ep2sindy.estimation.noise import FLOOR, Noise, flow_error, noise_beside
from ep2sindy.estimation.problem import EstimationProblem, ScaledRecord
from ep2sindy.estimation.solution import LackOfFit, Observation, Solution
from ep2sindy.estimation.supports import alternatives, best_support, excess, penalise, term_prices
from ep2sindy.signals.kalman import KalmanEstimate, KalmanSmoother

SAMPLES_PER_TERM = 5  # of the library: fewer samples do not tell which terms are present
ENOUGH_SAMPLES = 300  # to trust the first start; with fewer, trying all starts is cheap
# Smoother settings (log10 of process to measurement noise) to try if no other start fits.
OTHER_STARTS = (-2.0, 0.0, 2.0)
SAMPLES_PER_COEFFICIENT = 10  # of an equation, if samples are few: more terms would fit noise
MAX_PASSES = 4  # until noise and support agree; usually two
# rho, and the share of a term's price charged at that level. Free states hide part of what a term
# explains, and a term dropped too early would have to be found again.
COOLING = ((0.3, 0.2), (0.1, 0.4), (0.03, 0.7), (0.01, 1.0), (0.003, 1.0), (0.001, 1.0))
COLD = ((0.1, 1.0), (0.03, 1.0), (0.003, 1.0), (0.0001, 1.0))
ASTRAY = 0.1  # RMS miss of the flow, as a share of the steps of a hidden state, if it follows none
# RMS miss of a step, in noise, from which the path is no trajectory: right models miss by 1e-5.
EXACT = 1e-3
MAX_EXCHANGES = 3  # exchanges of supports at one level
# rho at which supports are compared again. At lower rho the linearised flow says too little about
# other supports; at higher rho free states hide their differences.
WEIGHED_AT = 0.003
# rho, and the share of the prices, at which another support may show that the solution is a wrong
# optimum; and by how much it must explain more of the squares.
REHEATED, EXPLAINS_MORE = (1.0, 0.5), 4.0
WITHIN, MAX_TRIED, MAX_ROUNDS = 12.0, 6, 6  # score above the chosen one; supports per round; rounds
UNSURE = 0.05  # share of the RMS: least noise at a start where the smoother's is not trusted
CUTOFF = 1e-8  # of singular values of unit columns: smaller ones fit noise


def max_terms_for(problem: EstimationProblem, max_terms: int) -> int:
    """Most terms allowed in one equation; fewer than asked for if the samples are few."""
    if enough_samples(problem):
        return max_terms
    return max(1, min(max_terms, problem.n_samples // SAMPLES_PER_COEFFICIENT))


def enough_samples(problem: EstimationProblem) -> bool:
    """True if there are enough samples to tell which terms of the library are present."""
    return problem.n_samples >= SAMPLES_PER_TERM * len(problem.candidates.library)


def from_smooth(
    problem: EstimationProblem, log10_ratio: float | None, *, max_terms: int
) -> Solution:
    """Anneal with the smoother's noise, then with the residuals'.

    log10_ratio: of the smoother, see `start_from_smooth`.
    """
    fit, std = start_from_smooth(problem, log10_ratio)
    prices = term_prices(problem, float(problem.n_samples))
    found = anneal(problem, fit, std, prices, COOLING, max_terms=max_terms)
    return _settle(found, max_terms)


def settle(
    problem: EstimationProblem,
    fit: TrajectoryFit,
    noise: tuple[np.ndarray, ...],
    *,
    max_terms: int,
) -> Solution:
    """The exact solution near a fit whose states leave the flow a little."""
    prices = term_prices(problem, float(problem.n_samples))
    found = anneal(problem, fit, noise, prices, COLD, max_terms=max_terms)
    return _settle(found, max_terms)


def _settle(found: AnnealedFit, max_terms: int) -> Solution:
    """Anneal again until noise and support agree, and compare with what is nearly as likely."""
    problem = found.problem
    for _ in range(MAX_PASSES):
        before, noise = found.fit.support, noise_beside(problem, found.fit)
        prices = term_prices(problem, problem.n_samples * float(noise.independent.mean()))
        found = anneal(problem, found.fit, noise.effective, prices, COLD, max_terms=max_terms)
        if np.array_equal(before, found.fit.support):
            break
    found = polish(found, prices, max_terms=max_terms)
    found = reheat(found, prices, max_terms=max_terms)
    noise = noise_beside(problem, found.fit)
    error = steered = 0.0
    defects, _ = squares_of_steps(problem, found.fit, found.level)
    if np.isfinite(found.score) and (noise.std > FLOOR).any():
        error = flow_error(problem, found.fit, noise, found.level)
        defect = np.sqrt((defects / np.square(noise.std)).max() / problem.n_samples)
        error = error if defect < EXACT else max(error, float(defect))  # it lives on the slack
        steered = parting(problem, found.fit, replace(found.level, noise=noise.white))
    return _exact_solution(found, noise, prices, error, steered)


def unfinished_solution(found: AnnealedFit) -> Solution:
    """What a search that was ended on its way has, whose states still leave the flow."""
    noise = noise_beside(found.problem, found.fit)
    n_independent = found.problem.n_samples * float(noise.independent.mean())
    return _exact_solution(
        found, noise, term_prices(found.problem, n_independent), found.level.rho, 0.0
    )


def _exact_solution(
    found: AnnealedFit, noise: Noise, prices: np.ndarray, error: float, steered: float
) -> Solution:
    """The solution of a trajectory without process noise, and its tests."""
    none = np.zeros(len(noise.std))
    apart = np.exp(min(steered, 100.0) / 2.0)
    tests = (
        LackOfFit(
            none + found.fit.total,
            float(np.finfo(np.float64).max),
            "whatever was tried runs away between two samples",
        ),
        LackOfFit(
            none + error, 0.0, "the states leave the model by {value:g} of the noise per sample"
        ),
        LackOfFit(
            none + apart,
            float(np.exp(STEERED / 2.0)),
            "paths beside the fit part by a factor of {value:.2g} per sample, so it could follow "
            "any samples",
        ),
        LackOfFit(
            noise.unexplained, 0.0, "what is left of {state} lasts ({value:.2f} from sample to "
            "sample)",
        ),
        LackOfFit(
            noise.patterned, 0.0, "what is left of {state} holds a line or follows the states"
        ),
        LackOfFit(astray(found), ASTRAY, "{state} does not follow its own equation"),
    )  # fmt: skip
    return Solution(
        problem=found.problem,
        fit=found.fit,
        level=found.level,
        observation=Observation(noise, none, none),
        prices=prices,
        deviance=noise.deviance,
        tests=tests,
        flow_error=error,
        around=found.around,
    )


def astray(found: AnnealedFit) -> Float[np.ndarray, " d"]:
    """RMS miss of the flow of hidden states, as a share of their steps; zero for measured ones.

    One that has become very small leaves the flow freely, and large coefficients make it count.
    """
    defects, steps = squares_of_steps(found.problem, found.fit, found.level)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(defects > 0.0, np.sqrt(defects / steps), defects)
    return np.where(found.problem.measured, 0.0, share)


@np.errstate(over="ignore", invalid="ignore")  # callers look whether the flow is finite
def squares_of_steps(
    problem: EstimationProblem, fit: TrajectoryFit, level: Level
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Sums of squares, by state: of what the flow from each sample misses, and of the steps."""
    record, path = problem.all_records, joined(fit.paths)
    steps = np.diff(path, axis=0)
    missed = problem.ends(record, path[:-1], fit.free, level.n_substeps) - path[1:]
    missed[record.breaks] = steps[record.breaks] = 0.0
    return np.square(missed).sum(axis=0), np.square(steps).sum(axis=0)


@dataclass(frozen=True, eq=False)
class AnnealedFit:
    """A fit, the level that it ended at, and its score: the squares plus the prices of its terms.

    around: linearisation about the fit at the level where its support was compared with others.
    """

    problem: EstimationProblem
    fit: TrajectoryFit
    level: Level
    score: float
    around: DelayedGram | None = None


def anneal(
    problem: EstimationProblem,
    fit: TrajectoryFit,
    noise: tuple[np.ndarray, ...],
    prices: Float[np.ndarray, " free"],
    schedule: Sequence[tuple[float, float]],
    *,
    max_terms: int,
) -> AnnealedFit:
    """Fit level by level; at each level, exchange terms as long as squares plus prices fall."""
    n_substeps, score = 1, np.inf
    for rho, share in schedule:
        fit, level = at_level(problem, fit, Level(noise, rho, n_substeps))
        n_substeps = level.n_substeps
        fit, score = exchange_terms(problem, fit, level, share * prices, max_terms)
        found = AnnealedFit(problem, fit, level, score)
        if not isinstance(problem.watch.best, Solution):
            problem.watch.best = found
    return found


def polish(
    found: AnnealedFit, prices: Float[np.ndarray, " free"], *, max_terms: int
) -> AnnealedFit:
    """Refit each support that is nearly as likely by the linear model, and keep a likelier one.

    A fit that does not follow its samples is returned unchanged: its linearisation tells nothing.
    """
    problem = found.problem
    if not found.fit.total < FAR * problem.n_squares:
        return found
    fit, cold = at_level(problem, found.fit, found.level)
    found = AnnealedFit(problem, fit, cold, float(fit.total + prices[fit.support].sum()))
    tried = {found.fit.support.tobytes()}
    for _ in range(MAX_ROUNDS):
        warmer, level = at_level(problem, found.fit, replace(found.level, rho=WEIGHED_AT))
        around = delayed_gram(problem, warmer, level)
        pair = around.at_rest
        if not (pair.finite and np.isfinite(found.score)):
            return found
        others = alternatives(
            problem, pair, prices, warmer.support, within=WITHIN, max_terms=max_terms
        )
        others = [each for each in others if each.support.tobytes() not in tried]
        for each in others[:MAX_TRIED]:
            tried.add(each.support.tobytes())
            start = replace(warmer, support=each.support, free=each.free)
            fit, cold = at_level(problem, start, level)
            fit, cold = at_level(problem, fit, replace(cold, rho=found.level.rho))
            score = float(fit.total + prices[fit.support].sum())
            if score < found.score and parting(problem, fit, cold) < STEERED:
                found = AnnealedFit(problem, fit, cold, score)
                break
        else:
            return replace(found, around=around)
    return found


def reheat(
    found: AnnealedFit, prices: Float[np.ndarray, " free"], *, max_terms: int
) -> AnnealedFit:
    """Anneal again if states that are let go show a better support; the likelier of both.

    Exchanges between nearly exact flows cannot leave a wrong optimum of many terms. Free states
    hide part of what a term explains, so a support counts as better there only if it explains more
    by no more terms.
    """
    problem = found.problem
    if not found.fit.total < FAR * problem.n_squares:
        return found
    rho, share = REHEATED
    warm, level = at_level(problem, found.fit, replace(found.level, rho=rho))
    pair = gram(problem, warm, level)
    if not (pair.finite and np.isfinite(found.score)):
        return found
    cheap = share * prices
    here = penalise(pair, warm.support, cheap)
    other = best_support(problem, pair, cheap, warm.support, max_terms=max_terms)
    n_more = int(other.support.sum()) - int(here.support.sum())
    gain = here.score - other.score - float(cheap[here.support].sum() - cheap[other.support].sum())
    if n_more > 0 or gain < EXPLAINS_MORE:
        return found
    start = replace(warm, support=other.support, free=other.free)
    schedule = (*COOLING, COLD[-1])
    again = anneal(problem, start, found.level.noise, prices, schedule, max_terms=max_terms)
    again = polish(again, prices, max_terms=max_terms)
    likelier = again.score < found.score and parting(problem, again.fit, again.level) < STEERED
    return again if likelier else found


def at_level(
    problem: EstimationProblem, fit: TrajectoryFit, level: Level
) -> tuple[TrajectoryFit, Level]:
    """Fit at a level, with as many substeps as it needs."""
    level = replace(level, n_substeps=enough_substeps(problem, fit, level))
    if not np.isfinite(squares(problem, fit.paths, fit.free, level)).all():
        fit = replace(fit, free=np.zeros_like(fit.free))  # the zero flow is finite
    return fit_paths(problem, fit, level), level


def exchange_terms(
    problem: EstimationProblem,
    fit: TrajectoryFit,
    level: Level,
    prices: Float[np.ndarray, " free"],
    max_terms: int,
) -> tuple[TrajectoryFit, float]:
    """Exchange terms by the Gram matrix, refit, and accept any fall of squares plus prices."""
    score = fit.total + prices[fit.support].sum()
    for _ in range(MAX_EXCHANGES):
        pair = gram(problem, fit, level)
        if not (pair.finite and np.isfinite(score)):
            break
        found = best_support(problem, pair, prices, fit.support, max_terms=max_terms)
        if np.array_equal(found.support, fit.support):
            break
        tried = fit_paths(problem, replace(fit, support=found.support, free=found.free), level)
        tried_score = tried.total + prices[tried.support].sum()
        too_large = excess(problem, fit.support, max_terms) > 0
        if not (tried_score < score or (too_large and np.isfinite(tried_score))):
            break
        fit, score = tried, tried_score
    return fit, float(score)


def start_from_smooth(
    problem: EstimationProblem, log10_ratio: float | None
) -> tuple[TrajectoryFit, tuple[np.ndarray, ...]]:
    """Start on smoothed states with all coefficients free.

    log10_ratio: of the smoother, process to measurement noise; None takes the most likely ratio of
    each record and state. Below about twenty samples a period this ratio may take signal for noise.
    Returns the fit, and the residuals' standard deviations, by record (samples, d).
    """
    start = smoothed(problem, log10_ratio)
    values = np.concatenate([joined(start.paths), problem.all_records.inputs], axis=1)
    free = _regress(problem, problem.library.evaluate(values), joined(start.rates))
    support = np.ones(problem.n_free, dtype=np.bool_)
    fit = TrajectoryFit(start.paths, free, support, np.full(len(problem.states), np.inf))
    return fit, start.noise


def _estimated(
    problem: EstimationProblem, record: ScaledRecord, log10_ratio: float | None
) -> KalmanEstimate:
    """Smooth every state over the samples that it has; between these it follows a cubic."""
    smoother, own = KalmanSmoother(log10_ratio), record.at_hand | ~problem.measured
    found = smoother.estimate(record.times, record.samples)
    lacking = np.flatnonzero(~own.all(axis=0))
    if not lacking.size:
        return found
    from scipy.interpolate import CubicHermiteSpline  # imported only if samples are missing

    smooth, rates, std = (
        np.array(each) for each in (found.smoothed, found.derivative, found.noise_std)
    )
    for k in lacking:
        t = record.times[own[:, k]]
        alone = smoother.estimate(t, record.samples[own[:, k], k : k + 1])
        curve = CubicHermiteSpline(t, alone.smoothed[:, 0], alone.derivative[:, 0])
        inside = np.clip(record.times, t[0], t[-1])
        smooth[:, k], rates[:, k], std[k] = curve(inside), curve(inside, 1), alone.noise_std[0]
    return replace(found, smoothed=smooth, derivative=rates, noise_std=std)


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Smoothed states, their rates, and standard deviations of the noise, by record (samples, d).

    They lie in the domains of the library's functions.
    """

    paths: tuple[np.ndarray, ...]
    rates: tuple[np.ndarray, ...]
    noise: tuple[np.ndarray, ...]


def smoothed(problem: EstimationProblem, log10_ratio: float | None) -> Smoothed:
    """Smooth the samples; log10_ratio as in `start_from_smooth`."""
    estimates = []
    for record in problem.records:
        problem.watch.look()
        estimates.append(_estimated(problem, record, log10_ratio))
    variance = np.mean([np.square(e.noise_std) for e in estimates], axis=0)
    paths = []
    for each, record in zip(estimates, problem.records, strict=True):
        samples = np.concatenate([record.samples, record.inputs], axis=1)
        values = np.concatenate([each.smoothed, record.inputs], axis=1)
        inside = keep_inside(problem.library, values, noise_inside(problem.library, samples))
        paths.append(inside[:, : len(problem.states)])
    std = np.maximum(np.sqrt(variance), FLOOR if log10_ratio is None else UNSURE)
    std[~problem.measured] = std[problem.measured].mean()
    return Smoothed(
        paths=tuple(paths),
        rates=tuple(each.derivative for each in estimates),
        noise=tuple(np.tile(std, (len(path), 1)) for path in paths),
    )


def _regress(
    problem: EstimationProblem,
    theta: Float[np.ndarray, "samples terms"],
    rates: Float[np.ndarray, "samples d"],
) -> Float[np.ndarray, " free"]:
    """Least squares of all equations at once, under the relations."""
    n, d = rates.shape
    if problem.C is not None:
        rows = np.zeros((n, d, len(problem.equation)))
        for k, (equation, column) in enumerate(zip(problem.equation, problem.column, strict=True)):
            rows[:, equation, k] = theta[:, column]
        target = (rates - rows @ problem.fixed).reshape(-1)
        return least_squares(rows.reshape(n * d, -1) @ problem.C, target, cutoff=CUTOFF)
    free = np.zeros(problem.n_free)
    for equation in range(d):  # far smaller systems, one per equation
        own = problem.equation == equation
        columns = theta[:, problem.column[own]]
        free[own] = least_squares(columns, rates[:, equation], cutoff=CUTOFF)
    return free
