"""The working set: the few terms of each equation that a search weighs, out of a large library.

The first set comes from each equation by itself: its own state is relaxed, the others are taken
from their smoothed samples. After the search every term j outside is tested on what the solution
leaves, and enters if its score test promises more than its penalty:

    (dS/dz_j)^2 / (4 variance of dS/(2 dz_j)) > price_j

where S is the objective of `likelihood`, and the variance is that under noise alone, the states and
the chosen coefficients fitted to it. Assumed is that S is quadratic as far as the best z_j. The
cost grows with the terms of the set, and only slowly with those of the library.
Source: Rao 1948, doi:10.1017/S0305004100023987.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.estimation.cost import SMALL
from ep2sindy.estimation.kernels import marginalise, smooth_corrections
from ep2sindy.estimation.likelihood import (
    FREE_START,
    Gram,
    Linearised,
    TrajectoryFit,
    hessian_on,
    observe,
)
from ep2sindy.estimation.observation import Solution
from ep2sindy.estimation.problem import (
    SAMPLES_PER_COEFFICIENT,
    ByCoefficient,
    BySample,
    EstimationProblem,
    Support,
)
from ep2sindy.estimation.solver import (
    COMPARED_AT,
    OTHER_STARTS,
    from_smooth,
    refit,
    settle,
    smooth_states,
)
from ep2sindy.estimation.supports import N_BEST, term_penalties
from ep2sindy.regression.gram_kernels import invert_gram
from ep2sindy.regression.searches import exchange_terms

# Model errors of the first set: the state nearly free, or quite. One alone leaves out more true
# terms.
FIRST_MODEL_ERRORS = (0.3, 3.0)
MOST_ADMITTED, MAX_ADMISSIONS = 3, 4  # terms of one equation that enter at once; times that some do
DEPENDENT = 1e-6  # fraction of a score's scatter that the chosen terms leave, if they span the term
N_PROBES = 40  # draws of noise that tell how far a score scatters: to 22 % of its square


def search_within(problem: EstimationProblem) -> Solution:
    """The solution from smoothed states by a working set, whose terms its problem has.

    Of a library that is large for its samples the linear terms are tried alone first: where they
    explain the samples and no other term would pay for itself, that is the solution. A search that
    begins with all terms would take products that stand in for linear terms over a transient.
    """
    part = problem.restricted(first_set(problem))
    linear = problem.restricted(problem.required | (problem.degrees <= 1))
    few = problem.n_samples < SAMPLES_PER_COEFFICIENT * len(problem.library)
    if few and linear.n_free < problem.n_free > part.n_free:
        with problem.monitor.stage(_weighed(linear)):
            tried = [from_smooth(linear, log10_ratio) for log10_ratio in (None, *OTHER_STARTS)]
        found = min(tried, key=lambda each: each.rank)
        if found.fits and admit_terms(found) is found:
            return found
    with problem.monitor.stage(_weighed(part)):
        found = from_smooth(part, None)
    # About a solution that does not fit first order tells little, and other starts cost less.
    return admit_terms(found) if found.fits else found


def admit_terms(found: Solution) -> Solution:
    """Let terms into the working set as long as they make the solution likelier."""
    problem = found.problem.candidates
    problem.monitor.best = found
    for _ in range(MAX_ADMISSIONS):
        kept = found.problem.taken
        entering = ~kept & _would_pay(problem, kept, found)
        if not entering.any():
            break
        larger, fit = kept | entering, found.fit
        whole = problem.restricted(larger)
        widened = replace(
            fit,
            problem=whole,
            noise=found.noise.effective,
            free=_spread(fit.free, kept)[larger],
            support=_spread(fit.support, kept)[larger] | entering[larger],
        )
        with problem.monitor.stage(_weighed(whole)):
            tried = settle(widened)
        if tried.rank >= found.rank:
            break
        found = problem.monitor.best = tried
    return found


def _weighed(part: EstimationProblem) -> str:
    n_all = part.candidates.n_free
    of = "" if part.n_free == n_all else f" of {n_all}"
    return f"weighing {part.n_free}{of} coefficients"


def first_set(problem: EstimationProblem) -> Support:
    """Required terms, and of each equation the terms of its best few supports of every size.

    All of them if the equations are small, or tied together by relations or hidden states.
    """
    kept = problem.required.copy()
    sizes = np.bincount(problem.block[~kept], minlength=len(problem.states))
    if problem.C is not None or not problem.measured.all() or (sizes <= SMALL).all():
        return np.ones_like(kept)
    path, _, noise = smooth_states(problem, None)
    steps = _integrals(problem, path)
    for block in np.flatnonzero(sizes).tolist():
        own = np.flatnonzero((problem.block == block) & ~problem.required)
        if len(own) <= SMALL:
            kept[own] = True
            continue
        for model_error in FIRST_MODEL_ERRORS:
            fit = TrajectoryFit(problem, noise, model_error, path, np.zeros(problem.n_free), kept)
            pair = _own_squares(fit, steps, block, own)
            size = np.sqrt(zero_to_one(np.diag(pair.quadratic)))
            masks = exchange_terms(
                (pair.quadratic / np.outer(size, size))[None],
                (pair.linear / size)[None],
                np.array([pair.offset]),
                max_terms=problem.max_terms,
                n_best=N_BEST,
            )
            kept[own[masks.any(axis=0)]] = True
        kept[own] |= _mimicked(problem, own, kept[own])
    return kept


def _mimicked(
    problem: EstimationProblem, own: np.ndarray, chosen: Bool[np.ndarray, " own"]
) -> Bool[np.ndarray, " own"]:
    """Constant and linear terms of one equation, of factors that its cubic terms and higher have.

    Where z hovers about a mean, y z^2 and y z^3 together follow y more closely than its noise.
    """
    factors = problem.library.exponents[problem.column[own]] > 0
    degrees = problem.degrees[own]
    has = factors[chosen & (degrees > 2)].any(axis=0)
    return (degrees <= 1) & ~factors[:, ~has].any(axis=1)


def _integrals(problem: EstimationProblem, path: BySample) -> Float[np.ndarray, "steps terms"]:
    """Integral of every term over each step along all paths, by the trapezoidal rule.

    It is zero from one path to the next. A term that overflows is not available: zero.
    """
    record = problem.all_records
    with np.errstate(over="ignore", invalid="ignore"):
        ends = [
            problem.library.evaluate(np.concatenate([states, record.inputs_at(fraction)], axis=1))
            for states, fraction in ((path[:-1], 0.0), (path[1:], 1.0))
        ]
        integrals = 0.5 * record.steps[:, None] * (ends[0] + ends[1])
    return np.where(np.isfinite(integrals).all(axis=0), integrals, 0.0)


@np.errstate(over="ignore", invalid="ignore")  # a term that overflows is not chosen
def _own_squares(
    fit: TrajectoryFit, steps: Float[np.ndarray, "steps terms"], block: int, own: np.ndarray
) -> Gram:
    """The squares as a quadratic function of one equation's coefficients, the other states held.

    steps: integrals of the terms over each step.
    """
    record, path, one = fit.problem.all_records, fit.path, slice(block, block + 1)
    columns = steps[:, fit.problem.column[own]]
    flow = np.concatenate([np.ones((len(columns), 1)), columns], axis=1)[:, None]
    defects = -np.diff(path[:, one], axis=0)
    flow[record.breaks] = defects[record.breaks] = 0.0
    residuals, variance, _ = observe(record, path, np.square(fit.noise))
    values, noise, process = (
        np.ascontiguousarray(each[:, one]) for each in (residuals, variance, fit.process)
    )
    quadratic, linear, offset, _ = marginalise(flow, defects, values, noise, process, FREE_START)
    tells = np.isfinite(np.diag(quadratic)) & np.isfinite(linear)
    pairs = np.isfinite(quadratic) & tells & tells[:, None]
    return Gram(np.where(pairs, quadratic, 0.0), np.where(tells, linear, 0.0), float(offset))


def _would_pay(problem: EstimationProblem, kept: Support, found: Solution) -> Support:
    """Terms that would lower the squares by more than their penalty, at most a few per equation.

    Score tests: the derivative of the squares by each coefficient, against its scatter if the
    samples were the solution and noise. Draws of such noise pass through the same linear fit of
    states and chosen coefficients; this costs no Hessian of the whole library.
    Source: Rao 1948, doi:10.1017/S0305004100023987.
    """
    enters = np.zeros_like(kept)
    if kept.all() or not np.isfinite(found.score):
        return enters
    fit = refit(replace(found.fit, model_error=COMPARED_AT))
    gains = _gains(problem, fit) - term_penalties(problem, float(problem.n_samples))
    gains[kept] = -np.inf
    for block in range(len(problem.states)):
        own = np.flatnonzero((problem.block == block) & (gains > 0.0))
        enters[own[np.argsort(-gains[own])[:MOST_ADMITTED]]] = True
    return enters


def _gains(problem: EstimationProblem, fit: TrajectoryFit) -> ByCoefficient:
    """Fall of the squares that each coefficient by itself would bring, to first order."""
    quadratic, _, _, about = hessian_on(fit, fit.support)
    if not np.isfinite(quadratic).all():
        return np.zeros(problem.n_free)
    # Neither terms nor slopes lead from one record to the next, whatever is missed there.
    terms, std = _integrals(problem, fit.path), fit.noise
    score = np.square(terms.T @ (about.defects / about.process))
    with_states, with_all = np.zeros_like(score), np.zeros_like(score)
    rng, inverse = np.random.default_rng(0), invert_gram(quadratic)
    for _ in range(N_PROBES):
        noise = std * rng.standard_normal(std.shape)
        without = _weighted_defects(about, noise, np.zeros(len(inverse)))
        gradient = np.einsum("kd,kds->s", without, about.slopes[:, :, fit.path.shape[1] :])
        fitted = _weighted_defects(about, noise, -inverse @ gradient)
        with_states += np.square(terms.T @ without) / N_PROBES
        with_all += np.square(terms.T @ fitted) / N_PROBES
    # A term that the chosen ones span leaves only rounding: it is not available.
    tells = with_all > DEPENDENT * with_states
    gains = np.where(tells, score / np.where(tells, with_all, 1.0), 0.0)
    return gains[problem.column, problem.equation]


def _weighted_defects(
    about: Linearised, noise: BySample, change: Float[np.ndarray, " support"]
) -> Float[np.ndarray, "steps d"]:
    """How far states that follow a draw of noise leave the flow, the coefficients changed.

    Over the variance of the flow's error.
    """
    d, states = noise.shape[1], about.of_states
    moved = about.slopes[:, :, d:] @ change
    draw = np.where(np.isfinite(about.residuals), noise, np.nan)
    off = smooth_corrections(*states._replace(defects=moved, residuals=draw))
    return (np.einsum("kij,kj->ki", states.slopes, off[:-1]) + moved - off[1:]) / about.process


def _spread(values: np.ndarray, kept: Support) -> np.ndarray:
    """Values of the set's coefficients among all, zero (or False) for the others."""
    every = np.zeros(len(kept), dtype=values.dtype)
    every[kept] = values
    return every
