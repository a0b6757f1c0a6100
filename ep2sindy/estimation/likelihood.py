"""The likelihood of whole trajectories: states at every sample and coefficients, fitted together.

The objective is, over the states x at all samples and the free coefficients z,

    S(x, z) = sum_k |(y_k - x_k) / noise_k|^2
            + sum_k |(flow(x_k; z) - x_(k+1)) / (model error * noise_k)|^2

With a large model error the states are nearly free; as it falls they become an exact trajectory of
the model, and S its chi-squared. Assumed are noise that is independent, normal and of known size,
and nothing about the first states. Under process noise of known size its variances stand in place
of those of the second sum, and S is -2 log of the joint density of samples and states.

A fit takes Gauss-Newton steps. The normal equations of a step couple each state to the next and to
the coefficients; a filter marginalises the states, and leaves those of the coefficients.
Source: de Jong 1991, doi:10.1214/aos/1176348139; Schweppe 1965, doi:10.1109/TIT.1965.1053737.

A sample is either a value or a pair of limits, if the sensor clipped or rounded it. A value
contributes its squared distance in units of the noise. A pair of limits contributes -2 log of the
normal probability between them. One step of Fisher scoring turns this into an apparent value with
an apparent noise, so that the same filter serves both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import log, pi
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.estimation.kernels import marginalise, smooth_corrections
from ep2sindy.estimation.problem import (
    ByCoefficient,
    BySample,
    ByState,
    EstimationProblem,
    ScaledRecord,
    StateMask,
    Support,
)
from ep2sindy.model.flow import Flow, flow
from ep2sindy.regression.gram_kernels import invert_gram

FREE_START = 100.0  # prior variance of the first state: ten times its RMS, squared
HELD_START = 1e-24  # the same of one that starts at zero
MAX_STEPS, SHORTEST = 10, 1e-3  # Gauss-Newton steps of one fit; the least fraction of a step tried
# Rate at which paths diverge, in nats per sample; chaotic systems that are resolved reach 0.3.
MAX_DIVERGENCE = 1.0
SETTLED = 1e-2  # a fall of the squares that ends the fit; a term's penalty is about ten
# Give up on a fit with mean square above FAR that falls by less than this fraction per step.
FAR, CRAWLS = 10.0, 0.02
RIDGE = 1e-12  # added to a Hessian of unit diagonal
# Samples that resolve the motion never need more substeps. Runaway coefficients may ask for more,
# and each substep costs as much as the first.
MAX_SUBSTEPS, MIN_ALLOWED, MAX_IN_ALL = 32, 4, 20_000
SUBSTEP_ERROR = 0.1  # RMS error of the substeps, as a fraction of the flow's
FAR_OUT = 1e3  # distance beyond a limit, in noise, from which the limit acts as a value
TELLS = 1e-3  # weight, relative to a value's, below which limits carry no information
LOG_ROOT_2PI = 0.5 * log(2.0 * pi)


@dataclass(frozen=True, eq=False)
class TrajectoryFit:
    """States and coefficients of a problem, fitted under some noise and error of the flow.

    noise: standard deviations of the samples of all records, scaled. model_error: of the flow, as a
    fraction of the noise. path: states at the samples of all records, one after the other, scaled.
    free: zero outside the support. n_substeps: Runge-Kutta steps between two samples.
    process_noise: the flow's error itself, if it is known. at_zero: states that start at zero, and
    would start below it; None for none.
    """

    problem: EstimationProblem
    noise: BySample
    model_error: float
    path: BySample
    free: ByCoefficient
    support: Support
    n_substeps: int = 1
    process_noise: ByState | None = None
    at_zero: Bool[np.ndarray, "records d"] | None = None

    def with_errors(self, noise: ByState, process_noise: ByState) -> TrajectoryFit:
        """The same states under other errors, alike at all samples."""
        noise = np.tile(noise, (len(self.path), 1))
        return replace(self, noise=noise, n_substeps=1, process_noise=process_noise)

    @property
    def has_law(self) -> StateMask:
        """Mask of the states whose rates depend on a state or an input."""
        varies = self.problem.library.degrees > 0
        return np.asarray((self.problem.coef(self.free)[varies] != 0.0).any(axis=0))

    @property
    def paths(self) -> list[BySample]:
        """The path of each record."""
        return self.problem.split(self.path)

    @cached_property
    def squares(self) -> ByState:
        """The objective (see the module), by state; infinite if the flow is not finite."""
        self.problem.monitor.look()
        with np.errstate(over="ignore", invalid="ignore"):
            record, variance = self.problem.all_records, np.square(self.noise)
            total = observe(record, self.path, variance).squares.sum(axis=0)
            total = total + (np.square(self.defects) / self.process).sum(axis=0)
        return np.where(np.isfinite(total), total, np.inf)

    @cached_property
    @np.errstate(over="ignore", invalid="ignore")  # callers look whether the flow is finite
    def defects(self) -> Float[np.ndarray, "steps d"]:
        """What the flow from each state misses of the next one; zero between records."""
        ends = self.problem.ends(self.path[:-1], self.free, self.n_substeps)
        defects = ends - self.path[1:]
        defects[self.problem.all_records.breaks] = 0.0
        return defects

    @property
    @np.errstate(over="ignore", invalid="ignore")
    def squared_defects(self) -> ByState:
        """Sums of the squares of the defects, by state."""
        return np.square(self.defects).sum(axis=0)

    @property
    def total(self) -> float:
        with np.errstate(over="ignore"):  # the sum is infinite then, as if one of them were
            return float(self.squares.sum())

    @property
    def process(self) -> Float[np.ndarray, "steps d"]:
        """Variances of the flow's error over all steps.

        Those between records are of states of which nothing is known, so that a filter whose slopes
        and defects are zero there begins each record anew.
        """
        noise, error = self.noise[:-1], self.process_noise
        error = self.model_error * noise if error is None else error
        found = np.square(np.broadcast_to(error, noise.shape))
        found[self.problem.all_records.breaks] = FREE_START
        return found


@dataclass(frozen=True, eq=False)
class Gram:
    """The squares as a quadratic function of some unknowns z, the states marginalised.

    squares(z) = offset - 2 linear' z + z' quadratic z, exact where the fit is linear.
    z: all free coefficients, and what a flow was differentiated by next to them.
    """

    quadratic: Float[np.ndarray, "z z"]
    linear: Float[np.ndarray, " z"]
    offset: float

    @property
    def finite(self) -> bool:
        """False if terms outside the present support overflow between two samples."""
        return bool(np.isfinite(self.quadratic).all() and np.isfinite(self.linear).all())

    def select(self, kept: Bool[np.ndarray, " z"]) -> Gram:
        """The same with the other unknowns at zero."""
        return Gram(self.quadratic[np.ix_(kept, kept)], self.linear[kept], self.offset)

    def minimise(self, over: Bool[np.ndarray, " z"]) -> Gram:
        """The least squares over some of the unknowns, as a function of the rest."""
        rest, inverse = ~over, invert_gram(self.quadratic[np.ix_(over, over)])
        projection = self.quadratic[np.ix_(rest, over)] @ inverse
        return Gram(
            self.quadratic[np.ix_(rest, rest)] - projection @ self.quadratic[np.ix_(over, rest)],
            self.linear[rest] - projection @ self.linear[over],
            self.offset - float(self.linear[over] @ inverse @ self.linear[over]),
        )


def fit_paths(fit: TrajectoryFit) -> TrajectoryFit:
    """Minimise the squares over states and coefficients, which keep their signs.

    The result is the nearest local minimum. A coefficient that must be positive and would not be
    leaves the support, and a state that is nonnegative and would start below zero starts there.
    """
    # The minimum without bounds, then an active set: what a bound holds leaves the unknowns, and
    # the normal equations of the rest are solved again.
    problem, fit = fit.problem, _descend(replace(fit, at_zero=None))
    while np.isfinite(fit.total):
        below = problem.nonnegative & [path[0] < 0.0 for path in fit.paths]
        below &= True if fit.at_zero is None else ~fit.at_zero
        if (fit.free[problem.positive] < 0.0).any():  # z >= 0: its row and column leave H c = g
            fit = _without_negative(fit)
        elif below.any():  # x_0 >= 0: the variance of its prior falls to nothing
            fit = _from_zero(fit, below)
        else:
            break
        fit = _descend(fit)
    return fit


def _without_negative(fit: TrajectoryFit) -> TrajectoryFit:
    """The fit without what least squares with bounds puts to zero, or all that is negative."""
    positive = fit.problem.positive
    negative = positive & (fit.free < 0.0)
    kept, own = fit.support & ~negative, np.flatnonzero(fit.support)
    quadratic, gradient = hessian_on(fit, fit.support)[:2]
    if np.isfinite(quadratic).all() and np.isfinite(gradient).all():
        linear = quadratic @ fit.free[own] + gradient
        bounded = within_bounds(quadratic, linear, positive[own])
        kept[own] = kept[own] if bounded.all() else bounded
    return replace(fit, support=kept, free=np.where(kept & ~negative, fit.free, 0.0))


def _from_zero(fit: TrajectoryFit, below: Bool[np.ndarray, "records d"]) -> TrajectoryFit:
    """The fit with states that start below zero at zero, where they are held."""
    path, starts = fit.path.copy(), np.append(0, fit.problem.all_records.breaks + 1)
    path[starts] = np.where(below, 0.0, path[starts])
    held = below if fit.at_zero is None else below | fit.at_zero
    return replace(fit, path=path, at_zero=held)


def _descend(fit: TrajectoryFit) -> TrajectoryFit:
    """Gauss-Newton with step halving, whatever the signs."""
    if not np.isfinite(fit.total):
        return fit  # no gradient to follow
    for _ in range(MAX_STEPS):
        fit.problem.monitor.step()
        step = _step(fit)
        if step is None:
            return fit  # derivatives overflow before the flow itself does
        (change, move), fraction = step, 1.0
        while fraction > SHORTEST:
            tried = replace(fit, path=fit.path + fraction * move, free=fit.free + fraction * change)
            if tried.total < fit.total:
                break
            fraction /= 2.0
        else:
            return fit
        gain, fit = fit.total - tried.total, tried
        crawls = fit.total > FAR * fit.problem.n_squares and gain < CRAWLS * fit.total
        if crawls or (fraction == 1.0 and gain < SETTLED):
            return fit
    return fit


def _step(fit: TrajectoryFit) -> tuple[ByCoefficient, BySample] | None:
    """One Gauss-Newton step: changes of the free coefficients and of the path; None for no number.

    The states are marginalised, so that the normal equations of the coefficients alone remain; the
    change of the states follows from theirs by the smoother.
    """
    # Reduced normal equations, H c = g: the Schur complement of the states' block.
    hessian, gradient, _, about = hessian_on(fit, fit.support)
    if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
        return None
    # In units of H's diagonal, with a ridge for directions that the samples do not tell.
    size = unit_sizes(hessian)
    scaled = hessian / np.outer(size, size) + RIDGE * np.eye(len(size))
    step = np.linalg.lstsq(scaled, gradient / size, rcond=None)[0] / size
    change = np.zeros_like(fit.free)
    change[fit.support] = step
    # Back-substitution into the states' block, which is block tridiagonal.
    defects = about.defects + about.slopes[:, :, fit.path.shape[1] :] @ step
    return change, smooth_corrections(*about.of_states._replace(defects=defects))


def divergence_rate(fit: TrajectoryFit) -> float:
    """How fast paths next to a fit part: nats per sample that are new, beyond a first state's.

    In a long record it is twice the sum of the positive Lyapunov exponents, per mean step. Where it
    is large, the least error of the flow steers the path to any sample, and the squares are no
    likelihood.
    """
    about, _, logs = innovations(fit)
    precision = np.where(np.isfinite(about.residuals), 1.0 / about.variance, 0.0)
    by_record = np.add.reduceat(precision, np.append(0, fit.problem.all_records.breaks + 1))
    information = (
        logs + np.log(precision[precision > 0.0]).sum() - np.log1p(FREE_START * by_record).sum()
    )
    return max(float(information), 0.0) / fit.problem.n_samples


def innovations(fit: TrajectoryFit) -> tuple[Linearised, float, float]:
    """The linearisation about a fit, and what all samples add to what came before.

    The latter are the sum of the squares of the innovations, in their standard deviations, and the
    sum of the logarithms of their variances.
    """
    about = linearise(fit)
    _, _, least, logs = marginalise(*about)
    return about, least, logs


@np.errstate(over="ignore", invalid="ignore")  # `Gram.finite` says whether the result counts
def gram(fit: TrajectoryFit, along: Flow | None = None) -> Gram:
    """Linearise about a fit: all free coefficients of all equations, the states marginalised.

    along: the flow on its path, if it is differentiated by more than the coefficients.
    """
    along = along or flow_by(fit, np.ones_like(fit.support))
    hessian, gradient, least, _ = marginalise(*linearise(fit, along))
    free, n = fit.free, len(fit.free)
    offset = least + free @ hessian[:n, :n] @ free + 2.0 * free @ gradient[:n]
    return Gram(hessian, hessian[:, :n] @ free + gradient, float(offset))


def enough_substeps(fit: TrajectoryFit) -> int:
    """Number of Runge-Kutta steps between samples for an error below a tenth of the flow's."""
    problem, n = fit.problem, fit.n_substeps
    most = min(MAX_SUBSTEPS, max(MIN_ALLOWED, MAX_IN_ALL // problem.n_samples))
    starts = fit.path[:-1]
    while 2 * n <= most:
        problem.monitor.look()
        with np.errstate(over="ignore", invalid="ignore"):
            change = problem.ends(starts, fit.free, n) - problem.ends(starts, fit.free, 2 * n)
            errors = np.square(change) / fit.process
            errors = np.delete(errors, problem.all_records.breaks, axis=0).mean(axis=0)
        if (errors <= SUBSTEP_ERROR**2).all():
            break
        n *= 2
    return n


class Linearised(NamedTuple):
    """The objective about a fit, as the three functions of `kernels` take it.

    slopes: derivatives of the flow by the state, then by the parameters; zero between records, as
    are the defects, what the flow from each sample misses of the next state of the path. residuals,
    variance: see `LinearisedObservation`. process: variances of the flow's error. start: of the
    first state.
    """

    slopes: Float[np.ndarray, "steps d columns"]
    defects: Float[np.ndarray, "steps d"]
    residuals: BySample
    variance: BySample
    process: Float[np.ndarray, "steps d"]
    start: ByState

    @property
    def of_states(self) -> Linearised:
        """The same with the derivatives by the state alone."""
        by_state = self.slopes[:, :, : self.defects.shape[1]]
        return self._replace(slopes=np.ascontiguousarray(by_state))


@np.errstate(over="ignore", invalid="ignore")  # callers look whether the result is finite
def linearise(fit: TrajectoryFit, along: Flow | None = None) -> Linearised:
    """The objective about a fit. along: the flow on its path; None: with slopes by the state."""
    problem, record = fit.problem, fit.problem.all_records
    problem.monitor.look()
    along = along or flow_by(fit, np.zeros_like(fit.support))
    # Rows of the steps: what the flow from each state misses of the next one.
    defects = along.ends - fit.path[1:]
    defects[record.breaks] = along.slopes[record.breaks] = 0.0
    # Rows of the samples: residuals, and the variances of their noise.
    residuals, variance, _ = observe(record, fit.path, np.square(fit.noise))
    # Weights of the steps, and of the first states, of which nothing is known unless held at zero.
    process, start = fit.process, np.full(len(problem.states), FREE_START)
    if fit.at_zero is not None:
        first, *others = np.where(fit.at_zero, HELD_START, FREE_START)
        process[record.breaks], start = np.reshape(others, (-1, len(start))), first
    return Linearised(along.slopes, defects, residuals, variance, process, start)


@np.errstate(over="ignore", invalid="ignore")  # callers look whether the flow is finite
def flow_by(fit: TrajectoryFit, support: Support, *, n_more: int = 0) -> Flow:
    """The flow along the path of a fit, with derivatives by the coefficients of a support.

    n_more: columns of zeros behind them, for derivatives by something else.
    """
    problem = fit.problem
    own, steps = problem.field(fit.free), problem.all_records.divided(fit.n_substeps)
    involved = np.flatnonzero(support if problem.C is None else problem.C[:, support].any(axis=1))
    by = problem.equation[involved], problem.column[involved]
    found = flow(own, fit.path[:-1], steps, by, n_more=n_more)
    if problem.C is None:
        return found
    d, p = len(problem.states), len(problem.states) + len(involved)
    by_free = found.slopes[:, :, d:p] @ problem.C[np.ix_(involved, support)]
    slopes = [found.slopes[:, :, :d], by_free, found.slopes[:, :, p:]]
    return replace(found, slopes=np.concatenate(slopes, axis=2))


def hessian_on(
    fit: TrajectoryFit, support: Support
) -> tuple[np.ndarray, np.ndarray, float, Linearised]:
    """Derivatives of the squares by the coefficients of a support, the states marginalised.

    Returns half the second derivatives, minus half the first, the least squares with these
    coefficients unchanged, and the linearisation.
    """
    about = linearise(fit, flow_by(fit, support))
    return *marginalise(*about)[:3], about


def within_bounds(
    quadratic: Float[np.ndarray, "n n"],
    linear: Float[np.ndarray, " n"],
    positive: Bool[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Mask of what least squares, z' quadratic z - 2 linear' z, leaves if some must be >= 0."""
    from scipy.optimize import lsq_linear  # import takes 0.5 s; most searches do not need it

    size = unit_sizes(quadratic)
    values, vectors = np.linalg.eigh(quadratic / np.outer(size, size))
    root = np.sqrt(np.maximum(values, RIDGE * values[-1]))
    bounds = np.where(positive, 0.0, -np.inf), np.inf
    target = vectors.T @ (linear / size) / root
    found = lsq_linear(root[:, None] * vectors.T, target, bounds, method="bvls").x
    kept: np.ndarray = ~positive | (found > 0.0)
    return kept


def unit_sizes(hessian: Float[np.ndarray, "n n"]) -> Float[np.ndarray, " n"]:
    """Roots of the diagonal; one for a term without effect, whose row is zero or rounding."""
    return np.sqrt(zero_to_one(np.maximum(np.diag(hessian), 0.0)))


class LinearisedObservation(NamedTuple):
    """Comparison of a record with a path; all arrays (samples, d).

    residuals: NaN where a sample carries no information. variance: of the noise of these residuals.
    squares: contributions to the objective, zero for a sample that the path meets.
    """

    residuals: BySample
    variance: BySample
    squares: BySample


def observe(record: ScaledRecord, path: BySample, variance: BySample) -> LinearisedObservation:
    """Compare the samples of a record with a path, given the variance of the noise."""
    residuals = np.where(record.missing, np.nan, record.samples - path)
    squares = np.where(record.missing, 0.0, np.square(record.samples - path) / variance)
    at = record.limits.at & ~record.missing
    if not at.any():
        return LinearisedObservation(residuals, variance, squares)
    variance = variance.copy()
    noise = np.sqrt(variance[at])
    lower = (record.limits.lower - path)[at] / noise
    upper = (record.limits.upper - path)[at] / noise
    pull, weight, squares[at] = between(lower, upper)
    residuals[at] = np.where(weight > TELLS, noise * pull / np.maximum(weight, TELLS), np.nan)
    variance[at] = np.square(noise) / np.maximum(weight, TELLS)
    return LinearisedObservation(residuals, variance, squares)


# Far out, limits may be one number to rounding: the probability is zero, and the squares infinite.
@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def between(
    lower: Float[np.ndarray, " n"], upper: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Statistics of a unit normal variable that is known to lie between two limits.

    Returns its mean, one minus its variance (the information in the limits), and -2 log of the
    probability between the limits.
    """
    from scipy.special import log_ndtr  # imported only if a sensor has limits

    turned = lower > -upper  # computed in the lower tail, which keeps its digits
    low, high = np.where(turned, -upper, lower), np.where(turned, -lower, upper)
    log_high = log_ndtr(high)
    log_p = log_high + np.log1p(-np.exp(log_ndtr(low) - log_high))
    at_low, at_high = (np.exp(-0.5 * np.square(x) - LOG_ROOT_2PI - log_p) for x in (low, high))
    mean = at_low - at_high
    # The density at an infinite limit is zero. Far out digits are lost: use a value there.
    slope = np.where(np.isfinite(low), low, 0.0) * at_low
    slope -= np.where(np.isfinite(high), high, 0.0) * at_high
    tells = np.where(high < -FAR_OUT, 1.0, np.clip(np.square(mean) - slope, 0.0, 1.0))
    return np.where(turned, -mean, mean), tells, -2.0 * log_p
