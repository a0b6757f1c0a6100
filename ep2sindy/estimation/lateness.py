"""Channels that come late: a delay of each state, one more parameter of how samples see it.

With a delayed channel other equations look right, which have more terms and fit no worse. So the
delay is not read from what a model leaves: it is asked whether fewer terms would do with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.estimation.likelihood import Gram, Level, TrajectoryFit, hessian
from ep2sindy.estimation.problem import EstimationProblem, Flow, ScaledRecord
from ep2sindy.estimation.supports import PenalisedFit, best_support, inverse_of, penalise

PAYS = 1.0  # by which delays must lower squares and prices, beyond their own price
MAX_SAMPLES = 10.0  # of a delay that is believed: a larger one is no small error of a clock


@dataclass(frozen=True, eq=False)
class DelayedGram:
    """The squares as a function of all free coefficients, and of delays of some states.

    Linear about a fit without delays. at_rest: without them. of_both: (free, delays); of_delays:
    (delays, delays); linear: (delays,).
    """

    at_rest: Gram
    of_both: Float[np.ndarray, "free delays"]
    of_delays: Float[np.ndarray, "delays delays"]
    linear: Float[np.ndarray, " delays"]

    def of(self, late: Bool[np.ndarray, " delays"]) -> DelayedGram:
        """With delays of some states alone."""
        own = self.of_delays[np.ix_(late, late)]
        return DelayedGram(self.at_rest, self.of_both[:, late], own, self.linear[late])

    @property
    def freed(self) -> Gram:
        """With the best delays, whatever the coefficients are."""
        inverse = inverse_of(self.of_delays)
        share = self.of_both @ inverse
        return Gram(
            self.at_rest.quadratic - share @ self.of_both.T,
            self.at_rest.linear - share @ self.linear,
            self.at_rest.offset - float(self.linear @ inverse @ self.linear),
        )

    def delays(
        self, support: Bool[np.ndarray, " free"]
    ) -> tuple[Float[np.ndarray, " delays"], Float[np.ndarray, " delays"]]:
        """The best ones beside a support's best coefficients, and their standard errors."""
        quadratic = self.at_rest.quadratic[np.ix_(support, support)]
        share = self.of_both[support].T @ inverse_of(quadratic)
        inverse = inverse_of(self.of_delays - share @ self.of_both[support])
        best = inverse @ (self.linear - share @ self.at_rest.linear[support])
        return best, np.sqrt(np.maximum(np.diag(inverse), 0.0))


def delayed_gram(problem: EstimationProblem, fit: TrajectoryFit, level: Level) -> DelayedGram:
    """Linearise about a fit, all states delayed: by as much, nothing would show but for inputs.

    A state read tau early is, to first order, tau times its rate further on: at the start of a
    step that goes the way of the flow, at its end it is what the samples show.
    """
    d, n = len(problem.states), len(fit.support)

    def flow(record: ScaledRecord, path: np.ndarray) -> Flow:
        everything = np.ones_like(fit.support)
        found = problem.flow(record, path[:-1], fit.free, everything, level.n_substeps)
        rates = problem.rates(record, path, fit.free)
        columns = found.slopes[:, :, :d] * rates[:-1, None, :]
        columns[:, np.arange(d), np.arange(d)] -= rates[1:]
        return replace(found, slopes=np.concatenate([found.slopes, columns], axis=2))

    quadratic, gradient, least, _ = hessian(problem, fit, level, flow)
    linear = quadratic[:, :n] @ fit.free + gradient
    own = quadratic[:n, :n]
    offset = least + fit.free @ own @ fit.free + 2.0 * fit.free @ gradient[:n]
    at_rest = Gram(own, linear[:n], float(offset))
    return DelayedGram(at_rest, quadratic[:n, n:], quadratic[n:, n:], linear[n:])


def suspect_delays(
    problem: EstimationProblem,
    around: DelayedGram,
    support: Bool[np.ndarray, " free"],
    prices: Float[np.ndarray, " free"],
    *,
    max_terms: int,
) -> Float[np.ndarray, " d"] | None:
    """Delays by state, in mean steps, with which fewer or likelier terms would do; None without."""
    late = np.full(len(problem.states), True)
    late[0] = problem.driven  # what drives has no delay; else the first stands for it
    if not (late.any() and around.of(late).freed.finite):
        return None
    best = fit_delays(problem, around, late, support, prices, max_terms=max_terms)[0]
    gain = penalise(around.at_rest, support, prices).score - best.score
    if gain < log(problem.n_samples) + PAYS:
        return None
    delays = _those_that_show(problem, around, best.support, late)
    gain -= np.count_nonzero(delays) * log(problem.n_samples)
    return delays if gain > PAYS and 0.0 < np.abs(delays).max() <= MAX_SAMPLES else None


def fit_delays(
    problem: EstimationProblem,
    around: DelayedGram,
    late: Bool[np.ndarray, " d"],
    support: Bool[np.ndarray, " free"],
    prices: Float[np.ndarray, " free"],
    *,
    max_terms: int,
) -> tuple[PenalisedFit, Float[np.ndarray, " d"]]:
    """The best terms where some states have a delay, and these, in mean steps."""
    own = around.of(late)
    best = best_support(problem, own.freed, prices, support, max_terms=max_terms)
    delays = np.zeros(len(late))
    delays[late] = own.delays(best.support)[0]
    return best, delays


def _those_that_show(
    problem: EstimationProblem,
    around: DelayedGram,
    support: Bool[np.ndarray, " free"],
    late: Bool[np.ndarray, " d"],
) -> Float[np.ndarray, " d"]:
    """Delays, each of which pays for itself; among states as few as may be, and late rather than
    early."""
    delays = np.zeros(len(late))
    delays[late] = around.of(late).delays(support)[0]
    if not problem.driven:
        reference = int(np.argsort(delays, kind="stable")[(len(delays) - 1) // 2])
        late = np.arange(len(late)) != reference
    while late.any():
        delays[:] = 0.0
        delays[late], errors = around.of(late).delays(support)
        shown = np.where(late, np.square(delays), np.inf)
        shown[late] /= np.square(errors)
        if shown.min() > log(problem.n_samples):
            return delays
        late = late & (np.arange(len(late)) != int(np.argmin(shown)))
    return np.zeros(len(late))


def move_channels(
    problem: EstimationProblem, paths: Sequence[np.ndarray], delays: Float[np.ndarray, " d"]
) -> EstimationProblem:
    """The problem with every channel brought forward by its delay, in mean steps.

    A sample goes along the path that it lies beside, and keeps its distance: its noise stays white.
    Samples whose place is beyond either end are left out.
    """
    from scipy.interpolate import CubicSpline  # for those alone whose channels are late

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
