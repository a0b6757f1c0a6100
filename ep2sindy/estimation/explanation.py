"""What explains the samples: an exact trajectory, channels that come late, or process noise.

Each is a `Solution` under another `Observation`, and the one of least rank is reported. The search
for an exact trajectory starts from smoothed states. If what it finds does not fit, it starts again
from states under process noise, and then from other smoothings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import compress
from math import log

import numpy as np
from jaxtyping import Float

from ep2sindy.estimation.cost import OutOfTimeError
from ep2sindy.estimation.likelihood import TrajectoryFit
from ep2sindy.estimation.observation import (
    PAYS,
    SURE,
    Solution,
    delay_misfit,
    delay_price,
    delay_words,
    fit_delays,
    shift_channels,
    suspect_delays,
)
from ep2sindy.estimation.problem import MIN_SAMPLES, EstimationProblem
from ep2sindy.estimation.process_noise import process_noise_words, solve_with_process_noise
from ep2sindy.estimation.solver import (
    ENOUGH_SAMPLES,
    OTHER_STARTS,
    at_level,
    enough_samples,
    from_smooth,
    max_terms_for,
    settle,
    start_from_smooth,
    unfinished_solution,
)
from ep2sindy.estimation.unobserved import unobserved_state
from ep2sindy.estimation.working_set import admit_terms, first_set, search_within
from ep2sindy.runtime.progress import SILENT
from ep2sindy.trust.interruption import is_interruption

ADVICE = (
    "Name a hidden state (hidden=[...]), embed one signal (+exp=trace), or measure another state"
)
# Model error of the fits that compare courses: an input half a step late shows, with all terms.
COURSES_AT = 0.1
BETTER = 4.0  # least fall of -2 log likelihood for which the most plausible course is left
FIRST_MAX_TERMS, MORE_TERMS = 7, 5  # of one equation, and how many more where all are used
# Moves of late channels (the delay model is linear), and the move, in mean steps, that ends them.
MAX_MOVES, SETTLED = 3, 0.05
MAX_WIDER = 500  # terms of a library that a late channel competes with: more would take too long


@dataclass(frozen=True, eq=False)
class Explanation:
    """The solution that is reported: of the samples as given, or of the aligned ones if asked for.

    max_terms: the most terms of one equation that were tried. misfit: the reason why it does not
    explain the samples; empty if it does. delays: (d,), in mean steps. remarks: on how the samples
    were changed or explained.
    """

    solution: Solution
    max_terms: int
    misfit: str
    delays: Float[np.ndarray, " d"]
    remarks: tuple[str, ...] = ()

    @property
    def problem(self) -> EstimationProblem:
        return self.solution.problem

    @property
    def explained_states(self) -> tuple[str, ...]:
        """States whose equations explain their samples although others do not."""
        solution = self.solution
        return () if solution.fits else tuple(compress(self.problem.states, solution.explained))

    @property
    def rank(self) -> tuple[bool, tuple[int, bool, int, float]]:
        """Order between ways in which hidden states may enter: least is best."""
        return bool(self.misfit), self.solution.rank


def explain(problem: EstimationProblem, *, max_terms: int | None, align: bool) -> Explanation:
    """The most likely support, and what beside its trajectory explains the samples, if need be.

    max_terms: of one equation; None begins with 7, and allows more where an equation needs them.
    At the limit of its time, or interrupted while its progress is shown, the search ends with the
    best that it has.
    """
    monitor = problem.monitor
    monitor.best = None
    try:
        return _explain(problem, max_terms, align)
    except (OutOfTimeError, KeyboardInterrupt, SystemError) as stop:
        late, interrupted = isinstance(stop, OutOfTimeError), is_interruption(stop)
        # Nobody follows a silent search, which may be one of many: an interruption ends them all.
        watched = interrupted and monitor.progress is not SILENT
        if monitor.best is None or not (late or watched):
            if interrupted:
                raise KeyboardInterrupt("the search was interrupted") from stop
            raise
        monitor.ended = True
        by = "limit_s" if late else "an interruption"
        return _unfinished(
            monitor.best, f"ended by {by} after {monitor.elapsed_s:.3g} s", max_terms
        )
    finally:
        monitor.best = None  # what follows is a report, which nothing ends


def _unfinished(best: Solution | TrajectoryFit, ended: str, max_terms: int | None) -> Explanation:
    """The best so far of a search that was ended."""
    solution = best if isinstance(best, Solution) else unfinished_solution(best)
    limit = max_terms or FIRST_MAX_TERMS
    if solution.fits:
        words = f"the search was {ended}: other starts and terms were not tried"
        return _explanation(solution, limit, remarks=(words,))
    words = (
        f"the search was {ended}, and nothing fits as far as the noise yet: the equations are the "
        "best so far; raise limit_s, or take fewer terms"
    )
    return _explanation(solution, limit, words)


def _explanation(
    solution: Solution, max_terms: int, misfit: str = "", remarks: tuple[str, ...] = ()
) -> Explanation:
    """A solution, which explains the samples unless there is a misfit or a limit to its terms."""
    few_terms = max_terms_for(solution.problem, max_terms)
    misfit = misfit or _at_limit(solution, max_terms)
    return Explanation(solution, few_terms, misfit, solution.observation.delays, remarks)


def _explain(problem: EstimationProblem, max_terms: int | None, align: bool) -> Explanation:
    """`explain` without a limit to its time."""
    problem = on_likeliest_courses(problem, max_terms=max_terms or FIRST_MAX_TERMS)
    first, limit = _search_by_size(problem, max_terms)
    few_terms = max_terms_for(problem, limit)
    exact, best = _compare(first, few_terms)
    observed = best.observation
    if observed.delays.any():
        if words := _lacks_terms(best, few_terms):
            return _explanation(exact, limit, words)
        if not align:
            words = delay_misfit(problem, observed.delays)
            return replace(_explanation(exact, limit, words), delays=observed.delays)
        words = f"{delay_words(problem, observed.delays)}: brought together with the others"
        return _explanation(best, limit, remarks=(words,))
    if not best.fits:
        return _explanation(best, limit, _misfit(best))
    return _explanation(
        best, limit, remarks=(process_noise_words(best),) if observed.process.any() else ()
    )


def _compare(first: Solution, max_terms: int) -> tuple[Solution, Solution]:
    """The best exact solution of the samples as they are, and the best under any observation.

    first: from smoothed states.
    """
    problem, under_noise = first.problem, None
    exact = first
    if not first.fits:
        with problem.monitor.stage("process noise"):
            under_noise = solve_with_process_noise(problem, max_terms=max_terms)
            exact = _best(first, settle(under_noise.fit, max_terms=max_terms))
        problem.monitor.best = exact
    best = _best(exact, _align(first, max_terms))
    if best is not exact:
        return exact, best
    # Guesses of hidden states do not depend on how they are smoothed.
    for log10_ratio in OTHER_STARTS if problem.measured.all() else ():
        if exact.fits and problem.n_samples >= ENOUGH_SAMPLES:
            break
        with problem.monitor.stage("another start"):
            exact = _best(exact, from_smooth(problem, log10_ratio, max_terms=max_terms))
    if exact is not first:
        best = _best(exact, _align(exact, max_terms))
        if best is not exact:
            return exact, best
    # Terms outside the set were tested beside the first solution, if it fits.
    if not (exact is first if exact.fits else under_noise is not None and under_noise.fits):
        wider = admit_terms(exact if exact.fits else first, max_terms=max_terms)
        exact = wider if wider.fits else exact
    # A hidden state under process noise explains whatever there is.
    return exact, _best(exact, under_noise if problem.measured.all() else None)


def _best(one: Solution, other: Solution | None) -> Solution:
    """The one of less rank; the first if both are alike, or there is no other."""
    return one if other is None else min(one, other, key=lambda each: each.rank)


def _search_by_size(problem: EstimationProblem, max_terms: int | None) -> tuple[Solution, int]:
    """The solution from smoothed states by a working set, and the limit of its terms."""
    limit = max_terms or FIRST_MAX_TERMS
    found = search_within(problem, max_terms=max_terms_for(problem, limit))
    # More than half of the candidates would stand in for terms that the library lacks.
    most = 0 if max_terms else int(np.bincount(problem.block).max()) // 2
    while limit < most and _full(found, limit):
        wider = min(limit + MORE_TERMS, most)
        better = search_within(problem, max_terms=max_terms_for(problem, wider))
        if better.rank >= found.rank:
            break
        found, limit = better, wider
    problem.monitor.best = found
    return found, limit


def _align(found: Solution, max_terms: int) -> Solution | None:
    """A solution with late channels that fits and is likelier; None if there is none.

    Its samples are brought forward by their delays.
    """
    problem, around = found.problem, found.around
    # No model follows the samples, or a channel of its own rate cannot be moved onto the others.
    if around is None or problem.partial:
        return None
    step = suspect_delays(problem, around, found.fit.support, found.prices, max_terms=max_terms)
    if step is None:
        return None
    now, late, delays = found, step != 0.0, np.zeros(len(step))
    for _ in range(MAX_MOVES):
        delays = delays + step
        here = shift_channels(now.problem, now.fit.paths, step)
        if min(len(record.samples) for record in here.records) < MIN_SAMPLES:
            return None  # shifts as long as a record are no delays
        with problem.monitor.stage("channels that come late"):
            now = from_smooth(here, None, max_terms=max_terms)
        if now.around is None:
            return None
        _, step, errors = fit_delays(
            here, now.around, late, now.fit.support, now.prices, max_terms=max_terms
        )
        if np.abs(step).max() < SETTLED:
            break
    # Samples at the ends are left out: scale the likelihood to the full number of samples.
    deviance = now.deviance * problem.n_samples / here.n_samples
    price = late.sum() * delay_price(problem) + PAYS
    observation = replace(now.observation, delays=delays, price=price)
    now = replace(now, observation=observation, deviance=deviance)
    sure = (np.abs(delays) >= SURE * errors).all()
    return now if sure and now.fits and now.score < found.score else None


def _lacks_terms(late: Solution, max_terms: int) -> str:
    """Why terms are missing rather than a sensor late; empty unless one degree more is as good.

    With a channel that is moved, wrong equations may stand in for terms that the library lacks. But
    higher products also stand in for a delay: they count if there are no more terms of them.
    """
    wider = late.problem.widen and late.problem.widen()
    if wider is None or len(wider.library) > MAX_WIDER or not enough_samples(wider):
        return ""
    found = search_within(wider, max_terms=max_terms)
    n_more = found.fit.support.sum() - late.fit.support.sum()
    if not found.fits or found.score > late.score or n_more > 0:
        return ""
    return (
        f"this library lacks terms: with products up to degree {wider.library.degrees.max()} the "
        "samples are explained, and with no channel late; add these products. The equations are "
        "the nearest found"
    )


def _misfit(found: Solution) -> str:
    """Why a solution does not explain the samples, and what to do."""
    states, explained = found.problem.states, found.explained
    if explained.any():
        lacking, known = (" and ".join(compress(states, each)) for each in (~explained, explained))
        words = (
            f"no law of this library explains {lacking}: a term or a state is missing there. What "
            f"was measured of {known} is explained, with process noise of the size given"
        )
    else:
        words = (
            "no model of this library fits these data as far as their noise: "
            f"{'; '.join(found.signs)}. The equations are the nearest found; add terms or states, "
            "or judge them by free run"
        )
    sign = unobserved_state(found.problem)
    return f"{words}. A state is missing for certain: {sign}. {ADVICE}" if sign else words


def _full(found: Solution, max_terms: int) -> list[str]:
    """Equations with all terms allowed, though the library has more."""
    problem = found.problem
    if max_terms_for(problem, max_terms) < max_terms:
        return []  # too few samples: this is reported anyway
    used = problem.coef_SI(found.fit.free) != 0.0
    n_used = np.bincount(problem.equation[used], minlength=len(problem.states))
    n_all = np.bincount(problem.candidates.equation, minlength=len(problem.states))
    full = (n_used >= max_terms) & (n_all > max_terms)
    return [f"{state}'" for state in compress(problem.states, full)]


def _at_limit(found: Solution, max_terms: int) -> str:
    """Warning if an equation uses all terms allowed: many terms may stand in for a missing one."""
    full = _full(found, max_terms)
    if not full:
        return ""
    return (
        f"{', '.join(full)} with as many terms as may be (max_terms={max_terms}): they may "
        "stand for one that the library lacks, and intervals are not given; add terms to it, or "
        "raise max_terms"
    )


def on_likeliest_courses(problem: EstimationProblem, *, max_terms: int) -> EstimationProblem:
    """The problem with every input on the likeliest of the courses that its samples allow.

    They are compared before the search, with all terms: a wrong course would ask for wrong ones,
    and pass for a state that comes late. Noise is of unknown size, so that n log(squares) counts.
    """
    if all(len(options) == 1 for options in problem.allowed_courses):
        return problem
    part = problem.restricted(first_set(problem, max_terms))
    start = start_from_smooth(part, None)

    @cache
    def unlikely(courses: tuple[str, ...]) -> float:
        fit = at_level(
            replace(start, problem=part.on_courses(courses)),
            replace(start.level, model_error=COURSES_AT),
        )
        return part.n_squares * log(max(fit.total, np.finfo(np.float64).tiny))

    best = problem.courses
    for j, options in enumerate(problem.allowed_courses):
        first, *others = [(*best[:j], course, *best[j + 1 :]) for course in options]
        best = min([first, *others], key=lambda c: unlikely(c) - BETTER * (c == first))
    return problem.on_courses(best)
