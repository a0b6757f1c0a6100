"""The joint estimator of states and coefficients: continuation from free states to exact ones.

It starts from smoothed states, and from all coefficients regressed on their derivatives. The model
error falls in steps. Supports are chosen at every step on the way (`fit_by_continuation`), and
compared again at its end (`polish`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import keep_inside, noise_inside
from ep2sindy.data.numbers import least_squares
from ep2sindy.estimation.likelihood import (
    FAR,
    MAX_DIVERGENCE,
    Gram,
    TrajectoryFit,
    divergence_rate,
    enough_substeps,
    fit_paths,
    gram,
)
from ep2sindy.estimation.noise import FLOOR, Noise, flow_error, noise_beside
from ep2sindy.estimation.observation import (
    LackOfFit,
    Observation,
    Solution,
    delayed_gram,
    without_delays,
)
from ep2sindy.estimation.open_loop import try_open_loop
from ep2sindy.estimation.problem import (
    ByCoefficient,
    BySample,
    ByState,
    EstimationProblem,
    ScaledRecord,
)
from ep2sindy.estimation.supports import (
    alternatives,
    best_support,
    excess,
    penalise,
    term_penalties,
)
from ep2sindy.signals.smoothers import KalmanEstimate, KalmanSmoother

ENOUGH_SAMPLES = 300  # to trust the first start; with fewer, trying all starts is cheap
# Smoother settings (log10 of process to measurement noise) to try if no other start fits.
OTHER_STARTS = (-2.0, 0.0, 2.0)
MAX_PASSES = 4  # until noise and support agree; usually two
# Model errors, and the fraction of a term's penalty charged there. Free states hide part of what a
# term explains, and a term dropped too early would have to be found again.
CONTINUATION = ((0.3, 0.2), (0.1, 0.4), (0.03, 0.7), (0.01, 1.0), (0.003, 1.0), (0.001, 1.0))
NEARLY_EXACT = ((0.1, 1.0), (0.03, 1.0), (0.003, 1.0), (0.0001, 1.0))
# RMS defect of the flow of a hidden state, as a fraction of its steps, beyond which it follows
# none.
MAX_HIDDEN_DEFECT = 0.1
# RMS defect of a step, in noise, from which the path is no trajectory: right models have 1e-5.
EXACT = 1e-3
MAX_EXCHANGES = 3  # exchanges of supports at one level
# Model error at which supports are compared again. At a lower one the linearised flow says too
# little about other supports; at a higher one free states hide their differences.
COMPARED_AT = 0.003
# Model error, and the fraction of the penalties, at which another support may show that the
# solution is a wrong optimum; and by how much it must explain more of the squares.
RELAXED, EXPLAINS_MORE = (1.0, 0.5), 4.0
WITHIN, MAX_TRIED, MAX_ROUNDS = 12.0, 6, 6  # score above the chosen one; supports per round; rounds
UNSURE = 0.05  # fraction of the RMS: least noise at a start where the smoother's is not trusted
FINITE = float(np.finfo(np.float64).max)
LASTS = "what is left of {state} lasts ({value:.2f} from sample to sample)"
CUTOFF = 1e-8  # of singular values of unit columns: smaller ones fit noise


def from_smooth(problem: EstimationProblem, log10_ratio: float | None) -> Solution:
    """The exact solution from smoothed states, first with their noise, then with the residuals'.

    log10_ratio: of the smoother, see `start_from_smooth`.
    """
    return settle(start_from_smooth(problem, log10_ratio), CONTINUATION)


def settle(
    start: TrajectoryFit, schedule: Sequence[tuple[float, float]] = NEARLY_EXACT
) -> Solution:
    """The exact solution near a fit whose states leave the flow.

    Continues again until noise and support agree, and compares with what is nearly as likely.
    """
    penalties = term_penalties(start.problem, float(start.problem.n_samples))
    fit = fit_by_continuation(start, penalties, schedule)
    for _ in range(MAX_PASSES):
        before, noise = fit.support, noise_beside(fit)
        penalties = _penalties_beside(fit, noise)
        fit = replace(fit, noise=noise.effective)
        fit = fit_by_continuation(fit, penalties, NEARLY_EXACT)
        if np.array_equal(before, fit.support):
            break
    fit, around = polish(fit, penalties)
    fit, around = restart_relaxed(fit, around, penalties)
    noise, error, divergence = noise_beside(fit), 0.0, 0.0
    if np.isfinite(fit.total) and (noise.std > FLOOR).any():
        error = flow_error(fit, noise)
        squares = fit.squared_defects / np.square(noise.std)
        defect = float(np.sqrt(squares.max() / len(fit.path)))
        error = error if defect < EXACT else max(error, defect)  # it is due to the slack
        divergence = divergence_rate(replace(fit, noise=noise.white))
    found = replace(_exact_solution(fit, noise, penalties, error, divergence), around=around)
    return with_open_loop(found) if found.fits else found


def _penalties_beside(fit: TrajectoryFit, noise: Noise) -> ByCoefficient:
    """Penalties of the terms for samples whose noise is correlated in time."""
    return term_penalties(fit.problem, fit.problem.n_samples * float(noise.independent.mean()))


def unfinished_solution(fit: TrajectoryFit) -> Solution:
    """What a search that was ended on its way has, whose states still leave the flow."""
    noise = noise_beside(fit)
    return _exact_solution(fit, noise, _penalties_beside(fit, noise), fit.model_error, 0.0)


def _exact_solution(
    fit: TrajectoryFit, noise: Noise, penalties: np.ndarray, error: float, divergence: float
) -> Solution:
    """The solution of a trajectory without process noise, and its tests."""
    none = np.zeros(len(noise.std))
    apart = np.exp(min(divergence, 100.0) / 2.0)
    tests = (
        (none + fit.total, FINITE, "whatever was tried runs away between two samples"),
        (none + error, 0.0, "the states leave the model by {value:g} of the noise per sample"),
        (
            none + apart,
            float(np.exp(MAX_DIVERGENCE / 2.0)),
            "paths next to the fit part by a factor of {value:.2g} per sample, so it could follow "
            "any samples",
        ),
        (noise.unexplained, 0.0, LASTS),
        (noise.patterned, 0.0, "what is left of {state} holds a line or follows the states"),
        (hidden_defects(fit), MAX_HIDDEN_DEFECT, "{state} does not follow its own equation"),
    )
    return Solution(
        fit=fit,
        observation=Observation(noise, none, none),
        penalties=penalties,
        deviance=noise.deviance,
        tests=tuple(LackOfFit(*test) for test in tests),
        flow_error=error,
    )


def with_open_loop(found: Solution) -> Solution:
    """The solution with one test more: whether its model keeps the motion by itself.

    Its runs begin as far from the path as an exact one may miss its steps. Under process noise runs
    without it count as well: noise that is not new at every step would add up to more.
    """
    noise, process = found.noise.std, found.observation.process
    test = try_open_loop(found.fit, noise, process, start=EXACT * noise)
    if process.any() and not test.passes.all():
        test = try_open_loop(found.fit, noise, 0.0 * process, start=EXACT * noise)
    return replace(found, tests=(*found.tests, test))


def hidden_defects(fit: TrajectoryFit) -> ByState:
    """RMS defect of the flow of hidden states, relative to their steps; zero for measured ones.

    One that has become very small leaves the flow freely, and large coefficients make it count.
    """
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        steps = np.diff(fit.path, axis=0)
        steps[fit.problem.all_records.breaks] = 0.0
        fraction = np.sqrt(fit.squared_defects / np.square(steps).sum(axis=0))
        fraction = np.where(fit.squared_defects > 0.0, fraction, fit.squared_defects)
    return np.where(fit.problem.measured, 0.0, fraction)


def _penalised(fit: TrajectoryFit, penalties: ByCoefficient) -> float:
    """The squares plus the penalties of the terms, which decide between supports at one level."""
    return float(fit.total + penalties[fit.support].sum())


def fit_by_continuation(
    fit: TrajectoryFit, penalties: ByCoefficient, schedule: Sequence[tuple[float, float]]
) -> TrajectoryFit:
    """Fit level by level; at each level, exchange terms as long as squares plus penalties fall.

    The noise is that of the fit.
    """
    monitor, fit = fit.problem.monitor, replace(fit, n_substeps=1, process_noise=None)
    for model_error, fraction in schedule:
        fit = refit(replace(fit, model_error=model_error))
        fit = exchange_terms(fit, fraction * penalties)
        if not isinstance(monitor.best, Solution):
            monitor.best = fit
    return fit


def polish(fit: TrajectoryFit, penalties: ByCoefficient) -> tuple[TrajectoryFit, Gram | None]:
    """Refit each support that is nearly as likely by the linear model, and keep a likelier one.

    Returns the linearisation in which none is likelier too; None if it tells nothing, as about a
    fit that does not follow its samples.
    """
    problem = fit.problem
    if not fit.total < FAR * problem.n_squares:
        return fit, None
    fit = refit(fit)
    tried = {fit.support.tobytes()}
    for _ in range(MAX_ROUNDS):
        warm = refit(replace(fit, model_error=COMPARED_AT))
        around = delayed_gram(warm)
        at_rest = without_delays(around, problem.n_free)
        if not (at_rest.finite and np.isfinite(fit.total)):
            break
        others = alternatives(problem, at_rest, penalties, warm.support, within=WITHIN)
        others = [each for each in others if each.support.tobytes() not in tried]
        for each in others[:MAX_TRIED]:
            tried.add(each.support.tobytes())
            other = refit(replace(warm, support=each.support, free=each.free))
            other = refit(replace(other, model_error=fit.model_error))
            if _is_likelier(other, fit, penalties):
                fit = other
                break
        else:
            return fit, around
    return fit, None


def _is_likelier(fit: TrajectoryFit, than: TrajectoryFit, penalties: ByCoefficient) -> bool:
    """True if a fit is likelier, penalties included, and not by steering its path."""
    return (
        _penalised(fit, penalties) < _penalised(than, penalties)
        and divergence_rate(fit) < MAX_DIVERGENCE
    )


def restart_relaxed(
    fit: TrajectoryFit, around: Gram | None, penalties: ByCoefficient
) -> tuple[TrajectoryFit, Gram | None]:
    """Continue again if states that are relaxed show a better support; the likelier of both.

    Exchanges between nearly exact flows cannot leave a wrong optimum of many terms. Free states
    hide part of what a term explains, so a support counts as better there only if it explains more
    by no more terms. around: of the fit, see `polish`.
    """
    if not fit.total < FAR * fit.problem.n_squares:
        return fit, around
    model_error, fraction = RELAXED
    relaxed = refit(replace(fit, model_error=model_error))
    pair, cheap = gram(relaxed), fraction * penalties
    if not pair.finite:
        return fit, around
    here = penalise(pair, relaxed.support, cheap)
    other = best_support(fit.problem, pair, cheap, relaxed.support)
    n_more = int(other.support.sum()) - int(here.support.sum())
    gain = here.score - other.score - float(cheap[here.support].sum() - cheap[other.support].sum())
    if n_more > 0 or gain < EXPLAINS_MORE:
        return fit, around
    start = replace(relaxed, support=other.support, free=other.free)
    again = fit_by_continuation(start, penalties, (*CONTINUATION, NEARLY_EXACT[-1]))
    again, beside = polish(again, penalties)
    return (again, beside) if _is_likelier(again, fit, penalties) else (fit, around)


def refit(fit: TrajectoryFit) -> TrajectoryFit:
    """Fit under the errors of a fit, with as many substeps as it needs."""
    fit = replace(fit, n_substeps=enough_substeps(fit))
    if not np.isfinite(fit.squares).all():
        fit = replace(fit, free=np.zeros_like(fit.free))  # the zero flow is finite
    return fit_paths(fit)


def exchange_terms(fit: TrajectoryFit, penalties: ByCoefficient) -> TrajectoryFit:
    """Exchange terms by the Gram matrix, refit, and accept any fall of squares plus penalties."""
    problem = fit.problem
    for _ in range(MAX_EXCHANGES):
        pair, score = gram(fit), _penalised(fit, penalties)
        if not (pair.finite and np.isfinite(score)):
            break
        found = best_support(problem, pair, penalties, fit.support)
        if np.array_equal(found.support, fit.support):
            break
        tried = fit_paths(replace(fit, support=found.support, free=found.free))
        too_large = excess(problem, fit.support) > 0
        if not (_penalised(tried, penalties) < score or (too_large and np.isfinite(tried.total))):
            break
        fit = tried
    return fit


def start_from_smooth(problem: EstimationProblem, log10_ratio: float | None) -> TrajectoryFit:
    """Start on smoothed states with all coefficients free.

    log10_ratio: of the smoother, process to measurement noise; None takes the most likely ratio of
    each record and state. Below about twenty samples a period this ratio may take signal for noise.
    The noise is that of the residuals.
    """
    path, rates, noise = smooth_states(problem, log10_ratio)
    values = np.concatenate([path, problem.all_records.inputs], axis=1)
    free = _regress(problem, problem.library.evaluate(values), rates)
    return TrajectoryFit(problem, noise, 1.0, path, free, np.ones(len(free), dtype=np.bool_))


def _smooth_record(
    problem: EstimationProblem, record: ScaledRecord, log10_ratio: float | None
) -> KalmanEstimate:
    """Smooth every state over the samples that it has; between these it follows a cubic."""
    smoother, own = KalmanSmoother(log10_ratio), ~(record.missing & problem.measured)
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


def smooth_states(
    problem: EstimationProblem, log10_ratio: float | None
) -> tuple[BySample, BySample, BySample]:
    """Smoothed states, in the domains of the library's functions, their rates, and the noise.

    The latter are standard deviations at all samples. log10_ratio: as in `start_from_smooth`.
    """
    estimates, paths = [], []
    for record in problem.records:
        problem.monitor.look()
        each = _smooth_record(problem, record, log10_ratio)
        samples, values = (
            np.concatenate([states, record.inputs], axis=1)
            for states in (record.samples, each.smoothed)
        )
        inside = keep_inside(problem.library, values, noise_inside(problem.library, samples))
        estimates.append(each)
        paths.append(inside[:, : len(problem.states)])
    variance = np.mean([np.square(each.noise_std) for each in estimates], axis=0)
    std = np.maximum(np.sqrt(variance), FLOOR if log10_ratio is None else UNSURE)
    std[~problem.measured] = std[problem.measured].mean()
    rates = np.concatenate([each.derivative for each in estimates])
    return np.concatenate(paths), rates, np.tile(std, (len(rates), 1))


def _regress(
    problem: EstimationProblem, theta: Float[np.ndarray, "samples terms"], rates: BySample
) -> ByCoefficient:
    """Least squares of all equations at once, under the relations."""
    n, d = rates.shape
    if problem.C is not None:
        rows = np.zeros((n, d, len(problem.equation)))
        rows[:, problem.equation, np.arange(rows.shape[2])] = theta[:, problem.column]
        target = (rates - rows @ (problem.fixed_SI / problem.to_SI)).reshape(-1)
        return least_squares(rows.reshape(n * d, -1) @ problem.C, target, cutoff=CUTOFF)
    free = np.zeros(problem.n_free)
    for equation in range(d):  # far smaller systems, one per equation
        own = problem.equation == equation
        columns = theta[:, problem.column[own]]
        free[own] = least_squares(columns, rates[:, equation], cutoff=CUTOFF)
    return free
