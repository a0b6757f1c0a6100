"""Process noise: coefficients of states that leave their model at random at every step.

Ecology, drifting phases and all that a model leaves out move its states at random. The variances of
this process noise and of the samples' noise are estimated together with the coefficients, and terms
are priced against this stochastic model:

    x_(k+1) = flow(x_k) + process * w_k,    y_k = x_k + noise * v_k,    w, v white and normal

The likelihood is that of the innovations (Schweppe 1965, doi:10.1109/TIT.1965.1053737).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.estimation.kernels import filter_states, marginalise
from ep2sindy.estimation.likelihood import TrajectoryFit, linearise
from ep2sindy.estimation.noise import (
    MORE_DEGREES,
    autocorrelations,
    excess_explained,
    noise_beside,
    powers_of,
)
from ep2sindy.estimation.observation import LackOfFit, Observation, Solution
from ep2sindy.estimation.problem import BySample, ByState, EstimationProblem
from ep2sindy.estimation.solver import (
    EXACT,
    exchange_terms,
    refit,
    start_from_smooth,
    with_open_loop,
)
from ep2sindy.estimation.supports import term_penalties

# Bounds on noise and process noise, in RMS of the states.
LEAST_NOISE, LEAST_PROCESS, MOST = 1e-5, 1e-7, 3.0
MAX_TRIALS = 120  # likelihoods per size of an error
FRACTIONS = (0.3, 1.0, 1.0, 1.0, 1.0)  # of the terms' penalties, in every round
LAGS = range(1, 9)  # at which innovations are correlated with themselves
# Standard errors that random innovations may show: see `_test_innovations`.
MOST_SHOWN = (5.0, 4.0, 6.0)
COLLINEAR = 1e-3  # fraction of a product that is left next to an equation's terms, if it is another
LASTING = "the process noise of {state} is not random"
RUNAWAY = 1e6  # innovations, in RMS of the states, of a model that follows no samples
# RMS defect of a step, in process noise: the likeliest is smaller than the true one.
MAX_DEFECT = 3.0
SETTLING = 5  # samples from whose start on innovations count


def likely_errors(fit: TrajectoryFit) -> tuple[ByState, ByState, float]:
    """The likeliest noise and process noise about the path of a fit, and -2 log likelihood.

    Both are standard deviations. The search for them starts from those of the fit.
    """
    from scipy.optimize import minimize  # imported only to estimate errors

    measured, about = fit.problem.measured, linearise(fit)
    n, d = int(measured.sum()), len(measured)
    low = np.log(np.repeat([LEAST_NOISE, LEAST_PROCESS], [n, d]))

    def sizes(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        held = np.exp(np.clip(logs, low, np.log(MOST)))
        own = np.ones(d)
        own[measured] = held[:n]
        return own, held[n:]

    def unlikely(logs: np.ndarray) -> float:
        tried = fit.with_errors(*sizes(logs))
        bounded = np.clip(logs, low, np.log(MOST))
        variance = np.square(tried.noise)
        case = about._replace(variance=variance, process=tried.process)
        return float(np.square(logs - bounded).sum() + sum(marginalise(*case)[2:]))

    assert fit.process_noise is not None
    start = np.log(np.append(fit.noise[0, measured], fit.process_noise))
    simplex = np.vstack([start, start + 1.5 * np.eye(len(start))])
    budget = {"maxfev": MAX_TRIALS * len(start), "fatol": 0.1, "xatol": 0.05}
    options = {"initial_simplex": simplex, **budget}
    found = minimize(unlikely, start, method="Nelder-Mead", options=options)
    return *sizes(found.x), float(found.fun)


def solve_with_process_noise(problem: EstimationProblem) -> Solution:
    """Errors and sparse coefficients in turn, from smoothed states with all coefficients free."""
    fit = start_from_smooth(problem, None)
    std, penalties = fit.noise[0], term_penalties(problem, float(problem.n_samples))
    fit = fit.with_errors(np.maximum(std, LEAST_NOISE), np.maximum(std, 1e-3))
    for fraction in FRACTIONS:
        fit = exchange_terms(refit(fit), fraction * penalties)
        std, process, deviance = likely_errors(fit)
        fit = fit.with_errors(std, process)
    fit = refit(fit)
    noise, none = noise_beside(fit), np.zeros(len(problem.states))
    explained = replace(noise, std=std, memory=none, unexplained=none, patterned=none > 0.0)
    solution = Solution(
        fit=fit,
        observation=Observation(explained, none, process),
        penalties=penalties,
        # Squares of innovations, scaled to their best size, are as many as samples.
        deviance=deviance - problem.n_squares,
        tests=(_test_defects(fit), *_test_innovations(fit)),
    )
    return with_open_loop(solution) if solution.fits else solution


def _test_defects(fit: TrajectoryFit) -> LackOfFit:
    """RMS of the defects of a path, in what process noise and noise allow.

    Infinite for a state without a law, which noise alone moves: of a constant rate at most.
    """
    defects = fit.squared_defects / len(fit.path)
    allowed = MAX_DEFECT**2 * fit.process[0] + np.square(EXACT * fit.noise[0])
    size = np.where(fit.has_law, np.sqrt(defects / allowed), np.inf)
    return LackOfFit(
        size, 1.0, "{state} does not follow its equation, not even under process noise"
    )


def process_noise_words(solution: Solution) -> str:
    """Sentence on the sizes of the process noise."""
    problem, process = solution.problem, solution.observation.process
    sizes = zip(problem.states, (process * problem.scale).tolist(), strict=True)
    words = ", ".join(f"{name} by {size:.2g}" for name, size in sizes)
    return (
        f"no exact trajectory explains these samples: process noise moves the states, {words} "
        "from one sample to the next; the intervals allow for it"
    )


def _test_innovations(fit: TrajectoryFit) -> list[LackOfFit]:
    """What innovations show that random ones would not, in standard errors.

    Their largest autocorrelation over a few lags, the largest fraction that one product of states
    explains next to the terms of the equation, and the fraction that all of them explain: what an
    equation lacks is a function of the states, and lasts as long as these.
    """
    problem, found = fit.problem, np.nan_to_num(filter_states(*linearise(fit))[0])
    new = [part[SETTLING:] for part in problem.split(found)]
    joined = np.concatenate(new)
    if not (np.abs(joined) < RUNAWAY).all():
        return [LackOfFit(np.full(joined.shape[1], np.inf), MOST_SHOWN[0], LASTING)]
    lasting = np.sqrt(len(joined)) * np.abs(autocorrelations(new, LAGS)).max(axis=0)
    before = np.concatenate([path[SETTLING - 1 : -1] for path in fit.paths])
    powers = powers_of(before, int(problem.candidates.library.degrees.max()) + MORE_DEGREES)
    shown = (
        lasting,
        _largest_fraction(fit, before, powers, joined),
        excess_explained(powers, joined),
    )
    return [LackOfFit(each, most, LASTING) for each, most in zip(shown, MOST_SHOWN, strict=True)]


def _largest_fraction(
    fit: TrajectoryFit, before: BySample, powers: Float[np.ndarray, "samples _"], new: BySample
) -> ByState:
    """The most that one of the powers explains of innovations next to an equation's terms."""
    unit = np.sqrt(len(new)) * new / np.maximum(np.linalg.norm(new, axis=0), 1e-150)
    problem, found = fit.problem, np.zeros(unit.shape[1])
    used = problem.coef(fit.free) != 0.0
    inputs = np.concatenate([r.inputs[SETTLING - 1 : -1] for r in problem.records])
    terms = problem.library.evaluate(np.concatenate([before, inputs], axis=1))
    for k in range(unit.shape[1]):
        own = np.column_stack([np.ones(len(before)), terms[:, used[:, k]]])
        basis = np.linalg.qr(own / zero_to_one(np.linalg.norm(own, axis=0)))[0]
        beside = powers - basis @ (basis.T @ powers)
        size = np.linalg.norm(beside, axis=0)
        kept = size > COLLINEAR * np.linalg.norm(powers, axis=0)
        found[k] = np.abs(unit[:, k] @ (beside[:, kept] / size[kept])).max(initial=0.0)
    return found
