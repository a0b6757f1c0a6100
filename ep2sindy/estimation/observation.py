"""How states show themselves in the samples, and solutions under such an observation.

Of a state that comes late, a delay is one more parameter of how it is sampled:

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
from math import inf, log

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.estimation.kernels import marginalise
from ep2sindy.estimation.likelihood import Gram, TrajectoryFit, flow_by, linearise
from ep2sindy.estimation.noise import Noise
from ep2sindy.estimation.problem import EstimationProblem
from ep2sindy.estimation.supports import PenalisedFit, best_support, penalise
from ep2sindy.regression.gram_kernels import invert_gram

IGNORED = 0.5  # residual, as a share of a state's spread, if the model ignores the state
PAYS = 1.0  # least fall of squares plus prices, beyond the delays' own price
SURE = 6.0  # standard errors of every delay: true ones of a sample show ten and more
MAX_SAMPLES = 10.0  # largest delay that is believed: more is no small clock error


@dataclass(frozen=True, eq=False)
class Observation:
    """How states x show themselves in samples y, and how far they follow the flow.

        y_k(t) = x_k(t - delays_k) + noise_k(t),    x(t + 1) = flow(x(t)) + process * white noise

    Of y a record has the value, a pair of limits, or nothing (`ScaledRecord`), whatever the other
    parts are. delays: (d,), in mean steps. process: (d,), scaled; zero for an exact trajectory.
    price: of the parameters that are not zero, on the scale of -2 log likelihood.
    """

    noise: Noise
    delays: Float[np.ndarray, " d"]
    process: Float[np.ndarray, " d"]
    price: float = 0.0


@dataclass(frozen=True, eq=False)
class LackOfFit:
    """A test of a fit, by state: a statistic, and the most that it may be.

    words: what a larger statistic shows, a format of {state} and {value}; without {state} it is of
    all states together.
    """

    statistic: Float[np.ndarray, " d"] | Bool[np.ndarray, " d"]
    bound: float
    words: str = ""

    @property
    def passes(self) -> Bool[np.ndarray, " d"]:
        return np.asarray(self.statistic <= self.bound)  # NaN does not


@dataclass(frozen=True, eq=False)
class Solution:
    """The likeliest support that one search has found, under one observation of the states.

    Solutions are compared by -2 log likelihood + prices of terms + price of the observation,
    after what they explain (`rank`).

    prices: of the free coefficients. deviance: -2 log likelihood of the samples. tests: all that
    the fit must pass. flow_error: size of the deviations from the flow, as a share of the noise.
    around: linearisation with delays, where the support was compared with others.
    """

    fit: TrajectoryFit
    observation: Observation
    prices: Float[np.ndarray, " free"]
    deviance: float
    tests: tuple[LackOfFit, ...]
    flow_error: float = 0.0
    around: DelayedGram | None = None

    @property
    def problem(self) -> EstimationProblem:
        return self.fit.problem

    @property
    def noise(self) -> Noise:
        return self.observation.noise

    @property
    def score(self) -> float:
        """-2 log likelihood plus prices, comparable between solutions."""
        if not np.isfinite(self.fit.total):
            return inf
        return self.deviance + float(self.prices[self.fit.support].sum()) + self.observation.price

    @property
    def explained(self) -> Bool[np.ndarray, " d"]:
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
    quadratic, gradient, least, _ = marginalise(*linearise(fit, flow))
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
