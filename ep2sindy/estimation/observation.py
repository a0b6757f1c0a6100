"""How states show themselves in the samples, and solutions under such an observation.

The delay of a state that lags is one more parameter of how it is sampled:

    y_k(t) = x_k(t - tau_k) + noise, about x_k(t) - tau_k x_k'(t) + noise

With a delayed channel, wrong equations with more terms fit the data no worse. So the delays are not
read from the residuals. They are unknowns next to the coefficients, and are believed if the squares
plus the penalties of terms and delays fall: fewer terms then suffice, or likelier ones. Assumed is
that each delay is constant, and short next to the times on which the states change; without inputs
a delay that all states share leaves no trace.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, log

import numpy as np

from ep2sindy.estimation.likelihood import Gram, TrajectoryFit, flow_by, gram
from ep2sindy.estimation.noise import Noise
from ep2sindy.estimation.problem import (
    ByCoefficient,
    ByState,
    EstimationProblem,
    StateMask,
    Support,
)
from ep2sindy.estimation.supports import best_support, penalise
from ep2sindy.regression.gram_kernels import invert_gram

IGNORED = 0.5  # residual, as a fraction of a state's spread, if the model ignores the state
PAYS = 1.0  # least fall of squares plus penalties, beyond the delays' own penalty
SURE = 6.0  # standard errors of every delay: true ones of a sample show ten and more
HALF_WIDTH = 1.96  # standard errors of an interval of 95 %
MAX_SAMPLES = 10.0  # largest delay that is believed: more is no small clock error


@dataclass(frozen=True, eq=False)
class Observation:
    """How states x show themselves in samples y, and how far they follow the flow.

        y_k(t) = x_k(t - delays_k) + noise_k(t),    x(t + 1) = flow(x(t)) + process * white noise

    Of y a record has the value, a pair of limits, or nothing (`ScaledRecord`), whatever the other
    parts are. delays: (d,), in mean steps. process: (d,), scaled; zero for an exact trajectory.
    penalty: of the parameters that are not zero, on the scale of -2 log likelihood. delay_errors:
    (d,), standard errors of the delays; None without any.
    """

    noise: Noise
    delays: ByState
    process: ByState
    penalty: float = 0.0
    delay_errors: ByState | None = None


@dataclass(frozen=True, eq=False)
class LackOfFit:
    """A test of a fit, by state: a statistic, and the most that it may be.

    words: what a larger statistic shows, a format of {state} and {value}; without {state} it is of
    all states together.
    """

    statistic: ByState | StateMask
    bound: float
    words: str = ""

    @property
    def passes(self) -> StateMask:
        return np.asarray(self.statistic <= self.bound)  # NaN does not


@dataclass(frozen=True, eq=False)
class Solution:
    """The likeliest support that one search has found, under one observation of the states.

    Solutions are compared by -2 log likelihood + penalties of terms + penalty of the observation,
    after what they explain (`rank`).

    penalties: of the free coefficients. deviance: -2 log likelihood of the samples. tests: all that
    the fit must pass. flow_error: size of the deviations from the flow, as a fraction of the noise.
    around: linearisation with delays, where the support was compared with others.
    """

    fit: TrajectoryFit
    observation: Observation
    penalties: ByCoefficient
    deviance: float
    tests: tuple[LackOfFit, ...]
    flow_error: float = 0.0
    around: Gram | None = None

    @property
    def problem(self) -> EstimationProblem:
        return self.fit.problem

    @property
    def noise(self) -> Noise:
        return self.observation.noise

    @property
    def score(self) -> float:
        """-2 log likelihood plus penalties, comparable between solutions."""
        if not np.isfinite(self.fit.total):
            return inf
        return (
            self.deviance + float(self.penalties[self.fit.support].sum()) + self.observation.penalty
        )

    @property
    def explained(self) -> StateMask:
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


def delayed_gram(fit: TrajectoryFit) -> Gram:
    """Linearise about a fit: the free coefficients, then a delay tau of every state.

    Without inputs, a common delay of all states leaves no trace in the data. To first order, a
    state that is read tau early lies tau times its rate further on. At the start of a step this
    displacement goes through the flow; at the end of the step it is what the samples show.
    """
    problem, d = fit.problem, fit.path.shape[1]
    flow = flow_by(fit, np.ones_like(fit.support), n_more=d)
    values = np.concatenate([fit.path, problem.all_records.inputs], axis=1)
    rates = problem.field(fit.free).rates(values)
    flow.slopes[:, :, -d:] = flow.slopes[:, :, :d] * rates[:-1, None, :]
    flow.slopes[:, np.arange(d), np.arange(-d, 0)] -= rates[1:]
    return gram(fit, flow)


def without_delays(around: Gram, n: int) -> Gram:
    """The squares as a function of the n coefficients alone, no state delayed."""
    return around.select(np.arange(len(around.linear)) < n)


def free_delays(around: Gram, delayed: StateMask) -> Gram:
    """The squares as a function of the coefficients, minimised over some states' delays."""
    n = len(around.linear) - len(delayed)
    own = around.select(np.append(np.ones(n, dtype=np.bool_), delayed))
    return own.minimise(np.arange(len(own.linear)) >= n)


def best_delays(around: Gram, support: Support, delayed: StateMask) -> tuple[ByState, ByState]:
    """Best delays of some states jointly with the terms of a support, and their standard errors."""
    own = around.select(np.append(support, delayed))
    own = own.minimise(np.arange(len(own.linear)) < support.sum())
    inverse = invert_gram(own.quadratic)
    delays, errors = np.zeros((2, len(delayed)))
    delays[delayed] = inverse @ own.linear
    errors[delayed] = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    return delays, errors


def suspect_delays(
    problem: EstimationProblem, around: Gram, support: Support, penalties: ByCoefficient
) -> ByState | None:
    """Delays by state, in mean steps, that make fewer or likelier terms suffice; None if none."""
    delayed = problem.measured.copy()
    # Without inputs the first state sets the clock.
    delayed[np.argmax(delayed)] = bool(problem.inputs)
    if not (delayed.any() and free_delays(around, delayed).finite):
        return None
    best = best_support(problem, free_delays(around, delayed), penalties, support)
    here = penalise(without_delays(around, len(support)), support, penalties)
    gain = here.score - best.score
    if gain < delay_penalty(problem) + PAYS:
        return None
    delays = _significant_delays(problem, around, best.support, delayed)
    gain -= np.count_nonzero(delays) * delay_penalty(problem)
    return delays if gain > PAYS and 0.0 < np.abs(delays).max() <= MAX_SAMPLES else None


def delay_penalty(problem: EstimationProblem) -> float:
    """Penalty of a delay: that of a coefficient, chosen among as many as there are channels."""
    return log(problem.n_samples) + 2.0 * log(problem.measured.sum())


def _significant_delays(
    problem: EstimationProblem, around: Gram, support: Support, delayed: StateMask
) -> ByState:
    """Delays that each pay for themselves: of as few states as possible, lags rather than leads."""
    if not problem.inputs:
        delays, _ = best_delays(around, support, delayed)
        measured = np.flatnonzero(problem.measured)
        order = measured[np.argsort(delays[measured], kind="stable")]
        delayed = problem.measured & (np.arange(len(delayed)) != order[(len(order) - 1) // 2])
    while delayed.any():
        delays, errors = best_delays(around, support, delayed)
        # Zero if rounding leaves no error to compare with.
        shown = np.square(delays / np.where(errors > 0.0, errors, np.inf))
        shown[~delayed] = np.inf
        if shown.min() > SURE**2:
            return delays
        delayed = delayed & (np.arange(len(delayed)) != int(np.argmin(shown)))
    return np.zeros(len(delayed))


def shift_channels(
    problem: EstimationProblem, paths: Sequence[np.ndarray], delays: ByState
) -> EstimationProblem:
    """The problem with every channel brought forward by its delay, in mean steps.

    A sample moves along the fitted path next to it and keeps its distance, so its noise stays
    white. Samples that would lie beyond either end are left out.
    """
    from scipy.interpolate import CubicSpline  # imported only if channels lag

    records = []
    for record, path in zip(problem.records, paths, strict=True):
        start = record.times[0] + max(0.0, -float(delays.min()))
        end = record.times[-1] - max(0.0, float(delays.max()))
        kept = (record.times >= start) & (record.times <= end)
        samples = record.samples[kept].copy()
        for j in np.flatnonzero(delays):
            curve = CubicSpline(record.times, path[:, j])
            samples[:, j] += curve(record.times[kept] + delays[j]) - path[kept, j]
        records.append(record.kept(kept, samples))
    return replace(problem, records=tuple(records))


def delay_words(problem: EstimationProblem, observed: Observation) -> str:
    """Delays in words, `z lags by 0.0033 s (0.99 ± 0.02 samples)`, for every delayed state."""
    assert observed.delay_errors is not None  # of delayed states
    errors = HALF_WIDTH * observed.delay_errors
    parts = [
        f"{state} {'lags' if delay > 0.0 else 'leads'} by {abs(delay) * problem.step_s:.3g} s "
        f"({abs(delay):.2f} ± {error:.1g} samples)"
        for state, delay, error in zip(problem.states, observed.delays, errors, strict=True)
        if delay
    ]
    return " and ".join(parts)


def delay_lack_of_fit(problem: EstimationProblem, observed: Observation) -> str:
    """Explanation why samples with a delayed channel do not fit, and what to do about it."""
    return (
        f"{delay_words(problem, observed)}: brought together, the samples are better explained "
        "by other equations; ask for those by ep.TrajectorySearch(align=True), in configs "
        "search.align=true. These are of the samples as they are"
    )
