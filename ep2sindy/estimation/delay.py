"""Channels that come late: a delay of each state, as one more parameter of how it is sampled.

    y_k(t) = x_k(t - tau_k) + noise, about x_k(t) - tau_k x_k'(t) + noise

With a delayed channel, wrong equations with more terms fit the data no worse. So the delays are not
read from the residuals. They are unknowns beside the coefficients, and are believed if the squares
plus the prices of terms and delays fall: fewer terms then suffice, or likelier ones. Assumed is
that each delay is constant, and short beside the times on which the states change; without inputs
a delay that all states share leaves no trace.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.estimation.kernels import eliminate
from ep2sindy.estimation.likelihood import Gram, TrajectoryFit, flow_by, linearise
from ep2sindy.estimation.problem import EstimationProblem
from ep2sindy.estimation.supports import PenalisedFit, best_support, penalise
from ep2sindy.regression.gram_kernels import invert_gram

PAYS = 1.0  # least fall of squares plus prices, beyond the delays' own price
SURE = 6.0  # standard errors of every delay: true ones of a sample show ten and more
MAX_SAMPLES = 10.0  # largest delay that is believed: more is no small clock error


@dataclass(frozen=True, eq=False)
class DelayedGram:
    """The squares as a quadratic function of the free coefficients z and some states' delays tau.

        S(z, tau) = at_rest(z) + 2 tau' of_both' z + tau' of_delays tau - 2 linear' tau

    Linearised about a fit without delays. at_rest: the part without delays. of_both: (free,
    delays), of_delays: (delays, delays), both quadratic; linear: (delays,).
    """

    at_rest: Gram
    of_both: Float[np.ndarray, "free delays"]
    of_delays: Float[np.ndarray, "delays delays"]
    linear: Float[np.ndarray, " delays"]

    def of(self, late: Bool[np.ndarray, " delays"]) -> DelayedGram:
        """Keep the delays of some states only."""
        own = self.of_delays[np.ix_(late, late)]
        return DelayedGram(self.at_rest, self.of_both[:, late], own, self.linear[late])

    @property
    def freed(self) -> Gram:
        """The squares as a function of the coefficients, minimised over the delays."""
        inverse = invert_gram(self.of_delays)
        share = self.of_both @ inverse
        return Gram(
            self.at_rest.quadratic - share @ self.of_both.T,
            self.at_rest.linear - share @ self.linear,
            self.at_rest.offset - float(self.linear @ inverse @ self.linear),
        )

    def delays(
        self, support: Bool[np.ndarray, " free"]
    ) -> tuple[Float[np.ndarray, " delays"], Float[np.ndarray, " delays"]]:
        """Best delays jointly with the coefficients on a support, and their standard errors."""
        quadratic = self.at_rest.quadratic[np.ix_(support, support)]
        share = self.of_both[support].T @ invert_gram(quadratic)
        inverse = invert_gram(self.of_delays - share @ self.of_both[support])
        best = inverse @ (self.linear - share @ self.at_rest.linear[support])
        return best, np.sqrt(np.maximum(np.diag(inverse), 0.0))


def delayed_gram(fit: TrajectoryFit) -> DelayedGram:
    """Linearise about a fit, with a delay of every state.

    Without inputs, a common delay of all states leaves no trace in the data. To first order, a
    state that is read tau early lies tau times its rate further on. At the start of a step this
    displacement goes through the flow; at the end of the step it is what the samples show.
    """
    problem, d, n = fit.problem, fit.path.shape[1], len(fit.support)
    flow = flow_by(fit, np.ones_like(fit.support), n_more=d)
    rates = problem.rates(problem.all_records, fit.path, fit.free)
    flow.slopes[:, :, -d:] = flow.slopes[:, :, :d] * rates[:-1, None, :]
    flow.slopes[:, np.arange(d), np.arange(-d, 0)] -= rates[1:]
    quadratic, gradient, least, _ = eliminate(*linearise(fit, flow))
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
    """Delays by state, in mean steps, that make fewer or likelier terms suffice; None if none."""
    late = problem.measured.copy()
    late[np.argmax(late)] = problem.driven  # without inputs the first state sets the clock
    if not (late.any() and around.of(late).freed.finite):
        return None
    best = fit_delays(problem, around, late, support, prices, max_terms=max_terms)[0]
    gain = penalise(around.at_rest, support, prices).score - best.score
    if gain < delay_price(problem) + PAYS:
        return None
    delays = _significant_delays(problem, around, best.support, late)
    gain -= np.count_nonzero(delays) * delay_price(problem)
    return delays if gain > PAYS and 0.0 < np.abs(delays).max() <= MAX_SAMPLES else None


def delay_price(problem: EstimationProblem) -> float:
    """Price of a delay: that of a coefficient, chosen among as many as there are channels."""
    return log(problem.n_samples) + 2.0 * log(problem.measured.sum())


def fit_delays(
    problem: EstimationProblem,
    around: DelayedGram,
    late: Bool[np.ndarray, " d"],
    support: Bool[np.ndarray, " free"],
    prices: Float[np.ndarray, " free"],
    *,
    max_terms: int,
) -> tuple[PenalisedFit, Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """The best terms if some states are delayed, the delays, in mean steps, and their errors."""
    own = around.of(late)
    best = best_support(problem, own.freed, prices, support, max_terms=max_terms)
    delays, errors = np.zeros((2, len(late)))
    delays[late], errors[late] = own.delays(best.support)
    return best, delays, errors


def _significant_delays(
    problem: EstimationProblem,
    around: DelayedGram,
    support: Bool[np.ndarray, " free"],
    late: Bool[np.ndarray, " d"],
) -> Float[np.ndarray, " d"]:
    """Delays that each pay for themselves: of as few states as possible, late rather than early."""
    delays = np.zeros(len(late))
    delays[late] = around.of(late).delays(support)[0]
    if not problem.driven:
        measured = np.flatnonzero(problem.measured)
        order = measured[np.argsort(delays[measured], kind="stable")]
        late = problem.measured & (np.arange(len(late)) != order[(len(order) - 1) // 2])
    while late.any():
        delays[:] = 0.0
        delays[late], errors = around.of(late).delays(support)
        shown = np.where(late, 0.0, np.inf)  # zero if rounding leaves no error to compare with
        tells = errors > 0.0
        shown[np.flatnonzero(late)[tells]] = np.square(delays[late][tells] / errors[tells])
        if shown.min() > SURE**2:
            return delays
        late = late & (np.arange(len(late)) != int(np.argmin(shown)))
    return np.zeros(len(late))


def shift_channels(
    problem: EstimationProblem, paths: Sequence[np.ndarray], delays: Float[np.ndarray, " d"]
) -> EstimationProblem:
    """The problem with every channel brought forward by its delay, in mean steps.

    A sample moves along the fitted path beside it and keeps its distance, so its noise stays white.
    Samples that would lie beyond either end are left out.
    """
    from scipy.interpolate import CubicSpline  # imported only if channels are late

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


def delay_words(problem: EstimationProblem, delays: Float[np.ndarray, " d"]) -> str:
    """Delays in words, `z comes 0.00333 s late (0.99 samples)`, for every delayed state."""
    parts = [
        f"{state} comes {abs(delay) * problem.step_s:.3g} s {'late' if delay > 0.0 else 'early'} "
        f"({abs(delay):.2f} samples)"
        for state, delay in zip(problem.states, delays, strict=True)
        if delay
    ]
    return " and ".join(parts)


def delay_misfit(problem: EstimationProblem, delays: Float[np.ndarray, " d"]) -> str:
    """Explanation why samples with a late channel are a misfit, and what to do about it."""
    return (
        f"{delay_words(problem, delays)}: brought together, the samples are better explained "
        "by other equations; ask for those by ep.TrajectorySearch(align=True), in configs "
        "search.align=true. These are of the samples as they are"
    )
