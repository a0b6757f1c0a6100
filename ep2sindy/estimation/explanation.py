"""What explains the samples: an exact trajectory, channels that lag, or process noise.

Each is a `Solution` under another `Observation`, and the one of least rank is reported. The search
for an exact trajectory starts from smoothed states. If what it finds does not fit, it starts again
from states under process noise, and then from other smoothings. With hidden states, whose guesses
are far off, it starts from what was found under process noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import compress
from math import log

import numpy as np
from jaxtyping import Float

from ep2sindy.estimation.cost import SMALL, OutOfTimeError
from ep2sindy.estimation.likelihood import TrajectoryFit
from ep2sindy.estimation.observation import (
    PAYS,
    SURE,
    Solution,
    best_delays,
    delay_lack_of_fit,
    delay_penalty,
    delay_words,
    free_delays,
    shift_channels,
    suspect_delays,
)
from ep2sindy.estimation.problem import (
    FIRST_MAX_TERMS,
    MIN_SAMPLES,
    BySample,
    ByState,
    EstimationProblem,
)
from ep2sindy.estimation.process_noise import process_noise_words, solve_with_process_noise
from ep2sindy.estimation.solver import (
    ENOUGH_SAMPLES,
    OTHER_STARTS,
    from_smooth,
    refit,
    settle,
    smooth_states,
    start_from_smooth,
    unfinished_solution,
)
from ep2sindy.estimation.supports import best_support
from ep2sindy.estimation.working_set import admit_terms, first_set, search_within
from ep2sindy.runtime.progress import SILENT
from ep2sindy.trust.interruption import is_interruption

ADVICE = (
    "Name a hidden state (hidden=[...]), embed one signal (+exp=trace), or measure another state"
)
# Model error of the fits that compare courses: an input half a step late shows, with all terms.
COURSES_AT = 0.1
BETTER = 4.0  # least fall of -2 log likelihood for which the most plausible course is left
MORE_TERMS = 5  # of one equation, where all allowed are used
# Moves of delayed channels (the delay model is linear), and the move, in mean steps, that ends
# them.
MAX_MOVES, SETTLED = 3, 0.05
MAX_WIDER = 500  # terms of a library that a delayed channel competes with: more would take too long
# Signs of an unobserved state, see `unobserved_state`.
CLEAR = 4.0  # steps between the points of a path, in standard deviations of the noise
MOST_POINTS = 3000  # of a path that is looked at, the first ones
STRAIGHT = 0.95  # least cosine of the turn from one step to the next
LEAST_SINE = 0.5  # of the angle of a crossing: noise turns a path by less
LEAST_CROSSINGS = 3  # one may come from a gap or an outlier


@dataclass(frozen=True, eq=False)
class Explanation:
    """The solution that is reported: of the samples as given, or of the aligned ones if asked for.

    lack_of_fit: the reason why it does not explain the samples; empty if it does. delays: (d,), in
    mean steps. data_warnings: on how the samples were changed or explained.
    """

    solution: Solution
    lack_of_fit: str
    delays: ByState
    data_warnings: tuple[str, ...] = ()


def explain(
    problem: EstimationProblem, *, max_terms: int | None, align: bool,
    under_noise: Explanation | None = None,
) -> Explanation:  # fmt: skip
    """The most likely support, and what next to its trajectory explains the samples, if need be.

    max_terms: of one equation; None begins with 7, and allows more where an equation needs them.
    under_noise: of the same problem, if it was asked for before, see `explain_under_noise`.
    At the limit of its time, or interrupted while its progress is shown, the search ends with the
    best that it has.
    """
    problem = replace(problem, most_terms=max_terms or FIRST_MAX_TERMS)
    begun = None if under_noise is None else under_noise.solution
    return _in_time(problem, lambda: _explain(problem, begun, align, wider=max_terms is None))


def explain_under_noise(problem: EstimationProblem, *, max_terms: int | None) -> Explanation:
    """What explains the samples if process noise moves the states; ends as `explain` does.

    Of hidden states it is quick, and nearly always explains the samples if an exact trajectory
    does. The reverse does not hold: process noise makes up for much.
    """
    problem = replace(problem, most_terms=max_terms or FIRST_MAX_TERMS)
    return _in_time(
        problem, lambda: _explanation(_solve_under_noise(on_likeliest_courses(problem)))
    )


def _in_time(problem: EstimationProblem, search: Callable[[], Explanation]) -> Explanation:
    """What a search of a problem finds, or the best that it has when it is ended."""
    monitor = problem.monitor
    monitor.best = None
    try:
        return search()
    except (OutOfTimeError, KeyboardInterrupt, SystemError) as stop:
        timed_out, interrupted = isinstance(stop, OutOfTimeError), is_interruption(stop)
        # Nobody follows a silent search, which may be one of many: an interruption ends them all.
        watched = interrupted and monitor.progress is not SILENT
        if monitor.best is None or not (timed_out or watched):
            if interrupted:
                raise KeyboardInterrupt("the search was interrupted") from stop
            raise
        monitor.ended = True
        by = "limit_s" if timed_out else "an interruption"
        return _unfinished(monitor.best, f"ended by {by} after {monitor.elapsed_s:.3g} s")
    finally:
        monitor.best = None  # what follows is a report, which nothing ends


def _unfinished(best: Solution | TrajectoryFit, ended: str) -> Explanation:
    """The best so far of a search that was ended."""
    solution = best if isinstance(best, Solution) else unfinished_solution(best)
    if solution.fits:
        words = f"the search was {ended}: other starts and terms were not tried"
        return _explanation(solution, data_warnings=(words,))
    words = (
        f"the search was {ended}, and nothing fits to within the noise yet: the equations are the "
        "best so far; raise limit_s, or take fewer terms"
    )
    return _explanation(solution, words)


def _explanation(
    solution: Solution, lack_of_fit: str = "", data_warnings: tuple[str, ...] = ()
) -> Explanation:
    """A solution, which explains the samples unless there does not fit or a limit to its terms."""
    lack_of_fit = lack_of_fit or _at_limit(solution)
    return Explanation(solution, lack_of_fit, solution.observation.delays, data_warnings)


def _explain(
    problem: EstimationProblem, under_noise: Solution | None, align: bool, *, wider: bool
) -> Explanation:
    """`explain` without a limit to its time. wider: True allows equations to have more terms."""
    first = None
    if under_noise is not None:
        problem = under_noise.problem
        first = settle(under_noise.fit)
    else:
        problem = on_likeliest_courses(problem)
    if first is None or not first.fits:
        first = _best(_search_by_size(problem, wider=wider), first)
    exact, best = _compare(first, under_noise)
    observed = best.observation
    if observed.delays.any() and (other := _on_other_courses(problem, exact)):
        exact = best = other
    if best is exact and best.fits:
        return _explanation(best)
    if words := _lacks_terms(best):
        return _explanation(exact if observed.delays.any() else best, words)
    if observed.delays.any():
        if not align:
            words = delay_lack_of_fit(problem, observed)
            return replace(_explanation(exact, words), delays=observed.delays)
        words = f"{delay_words(problem, observed)}: brought together with the others"
        return _explanation(best, data_warnings=(words,))
    if not best.fits:
        return _explanation(best, _lack_of_fit(best))
    return _explanation(best, data_warnings=(process_noise_words(best),))


def _on_other_courses(problem: EstimationProblem, delayed: Solution) -> Solution | None:
    """A solution with no delayed state, and another course of an input; None without any."""
    taken = delayed.problem.courses
    for j, options in enumerate(problem.allowed_courses):
        for course in options:
            if course != taken[j]:
                courses = (*taken[:j], course, *taken[j + 1 :])
                found = search_within(delayed.problem.candidates.on_courses(courses))
                if found.fits:
                    return found
    return None


def _solve_under_noise(problem: EstimationProblem) -> Solution:
    with problem.monitor.stage("process noise"):
        return solve_with_process_noise(problem)


def _compare(first: Solution, under_noise: Solution | None) -> tuple[Solution, Solution]:
    """The best exact solution of the samples as they are, and the best under any observation.

    first: the best so far. under_noise: with process noise, if `first` knows of it.
    """
    problem, exact = first.problem, first
    if not first.fits and under_noise is None:
        under_noise = _solve_under_noise(problem)
        exact = _best(first, settle(under_noise.fit))
        problem.monitor.best = exact
    best = _best(exact, _align(first))
    if best is not exact:
        return exact, best
    # Guesses of hidden states do not depend on how they are smoothed.
    for log10_ratio in OTHER_STARTS if problem.measured.all() else ():
        if exact.fits and problem.n_samples >= ENOUGH_SAMPLES:
            break
        with problem.monitor.stage("another start"):
            exact = _best(exact, from_smooth(problem, log10_ratio))
    if exact is not first:
        best = _best(exact, _align(exact))
        if best is not exact:
            return exact, best
    # Terms outside the set were tested next to the first solution, if it fits.
    if not (exact is first if exact.fits else under_noise is not None and under_noise.fits):
        wider = admit_terms(exact if exact.fits else first)
        exact = wider if wider.fits else exact
    # A hidden state under process noise explains whatever there is.
    return exact, _best(exact, under_noise if problem.measured.all() else None)


def _best(one: Solution, other: Solution | None) -> Solution:
    """The one of less rank; the first if both are alike, or there is no other."""
    return one if other is None else min(one, other, key=lambda each: each.rank)


def _search_by_size(problem: EstimationProblem, *, wider: bool) -> Solution:
    """The solution from smoothed states by a working set, with more terms where all are used."""
    found = search_within(problem)
    # More than half of the candidates would stand in for terms that the library lacks.
    most = int(np.bincount(problem.block).max()) // 2 if wider else 0
    while problem.most_terms < most and _full(found):
        problem = replace(problem, most_terms=min(problem.most_terms + MORE_TERMS, most))
        better = search_within(problem)
        if better.rank >= found.rank:
            break
        found = better
    problem.monitor.best = found
    return found


def _align(found: Solution) -> Solution | None:
    """A solution with delayed channels that fits and is likelier; None if there is none.

    Its samples are brought forward by their delays.
    """
    problem, around = found.problem, found.around
    # No model follows the samples, or a channel of its own rate cannot be moved onto the others.
    if around is None or (problem.n_measured[problem.measured] < problem.n_samples).any():
        return None
    step = suspect_delays(problem, around, found.fit.support, found.penalties)
    if step is None:
        return None
    now, delayed, delays = found, step != 0.0, np.zeros(len(step))
    for _ in range(MAX_MOVES):
        delays = delays + step
        here = shift_channels(now.problem, now.fit.paths, step)
        if min(len(record.samples) for record in here.records) < MIN_SAMPLES:
            return None  # shifts as long as a record are no delays
        with problem.monitor.stage("delayed channels"):
            now = from_smooth(here, None)
        if now.around is None:
            return None
        with_delays = free_delays(now.around, delayed)
        terms = best_support(here, with_delays, now.penalties, now.fit.support).support
        step, errors = best_delays(now.around, terms, delayed)
        if np.abs(step).max() < SETTLED:
            break
    # Samples at the ends are left out: scale the likelihood to the full number of samples.
    deviance = now.deviance * problem.n_samples / here.n_samples
    penalty = delayed.sum() * delay_penalty(problem) + PAYS
    observation = replace(now.observation, delays=delays, penalty=penalty, delay_errors=errors)
    now = replace(now, observation=observation, deviance=deviance)
    sure = (np.abs(delays) >= SURE * errors).all()
    return now if sure and now.fits and now.score < found.score else None


def _lacks_terms(found: Solution) -> str:
    """Why terms are missing: one degree more explains the samples as they are; else empty.

    With a channel that is moved, wrong equations may stand in for terms that the library lacks. But
    higher products also stand in for a delay: they count if there are no more terms of them. A
    solution that explains the samples by anything else has to be likelier.
    """
    problem, delayed = found.problem, bool(found.observation.delays.any())
    wider = _wider(problem, MAX_WIDER if delayed else SMALL)
    if wider is None:
        return ""
    wider = replace(wider, most_terms=problem.most_terms)
    with problem.monitor.stage("products of one degree more"):
        try:
            better = search_within(wider)
            for log10_ratio in OTHER_STARTS if len(wider.library) <= SMALL else ():
                if better.fits or problem.n_samples >= ENOUGH_SAMPLES:
                    break
                better = _best(better, from_smooth(wider, log10_ratio))
        finally:
            problem.monitor.best = found  # whose library is the one asked for
    n_more = better.fit.support.sum() - found.fit.support.sum()
    if not better.fits or (found.fits and better.score > found.score) or (delayed and n_more > 0):
        return ""
    degree = int(wider.library.degrees.max())
    return (
        f"this library lacks terms: with products up to degree {degree} the samples are explained"
        f"{', and with no channel delayed' if delayed else ''}: take {_next_library(problem)}. The "
        "equations are the nearest found"
    )


def _wider(problem: EstimationProblem, most: int) -> EstimationProblem | None:
    """The problem with products of one degree more, if it has no more terms; None without any.

    Of hidden states they are not tried: every way in which these may enter would be searched again.
    """
    if problem.widen is None or not problem.measured.all() or problem.candidates.required.all():
        return None
    wider = problem.widen()
    if len(wider.library) > most or not wider.enough_samples:
        return None
    return wider.on_courses(problem.courses)


def _next_library(problem: EstimationProblem) -> str:
    """How to ask for a library of one degree more, in Python and on the command line."""
    degree = int(problem.candidates.library.degrees.max()) + 1
    names = [*problem.states, *problem.inputs]
    return (
        f"ep.polynomial({names}, degree={degree}), with +exp=discover "
        f"libraries.model.degree={degree}"
    )


def _lack_of_fit(found: Solution) -> str:
    """Why a solution does not explain the samples, and what to do."""
    states, explained = found.problem.states, found.explained & found.problem.measured
    tried = _wider(found.problem, SMALL) is not None
    next_one = f"try {_next_library(found.problem)}"
    more = "products of one degree more do not help" if tried else next_one
    if explained.any():
        lacking, known = (" and ".join(compress(states, each)) for each in (~explained, explained))
        words = (
            f"no law of this library explains {lacking}: a term or a state is missing there ({more}"
            f"). What was measured of {known} is explained, with process noise of the size given"
        )
    else:
        words = (
            "no model of this library fits these data to within their noise: "
            f"{'; '.join(found.signs)}. The equations are the nearest found; add terms ({more}) or "
            "states, or test them by free run"
        )
    sign = unobserved_state(found.problem)
    return f"{words}. A state is missing for certain: {sign}. {ADVICE}" if sign else words


def _full(found: Solution) -> list[str]:
    """Equations with all terms allowed, though the library has more."""
    problem = found.problem
    if problem.max_terms < problem.most_terms:
        return []  # too few samples: this is reported anyway
    used = problem.coef_SI(found.fit.free) != 0.0
    n_used = np.bincount(problem.equation[used], minlength=len(problem.states))
    n_all = np.bincount(problem.candidates.equation, minlength=len(problem.states))
    full = (n_used >= problem.max_terms) & (n_all > problem.max_terms)
    return [f"{state}'" for state in compress(problem.states, full)]


def _at_limit(found: Solution) -> str:
    """Warning if an equation uses all terms allowed: many terms may stand in for a missing one."""
    full = _full(found)
    if not full:
        return ""
    return (
        f"{', '.join(full)} with as many terms as are allowed "
        f"(max_terms={found.problem.most_terms}): they may stand for one that the library lacks, "
        "and intervals are not given; add terms to it, or raise max_terms"
    )


def on_likeliest_courses(problem: EstimationProblem) -> EstimationProblem:
    """The problem with every input on the likeliest of the courses that its samples allow.

    They are compared before the search, with all terms: a wrong course would ask for wrong ones,
    and pass for a state that lags. Noise is of unknown size, so that n log(squares) counts.
    """
    if all(len(options) == 1 for options in problem.allowed_courses):
        return problem
    part = problem.restricted(first_set(problem))
    start = start_from_smooth(part, None)

    @cache
    def unlikely(courses: tuple[str, ...]) -> float:
        fit = refit(replace(start, problem=part.on_courses(courses), model_error=COURSES_AT))
        return part.n_squares * log(max(fit.total, np.finfo(np.float64).tiny))

    best = problem.courses
    for j, options in enumerate(problem.allowed_courses):
        first, *others = [(*best[:j], course, *best[j + 1 :]) for course in options]
        best = min([first, *others], key=lambda c: unlikely(c) - BETTER * (c == first))
    return problem.on_courses(best)


def unobserved_state(problem: EstimationProblem) -> str:
    """The sign that a state is unobserved; empty if there is none, inputs drive, or d is above two.

    A state that moves by a law of its own cannot pass a value upwards and later downwards, and the
    path of two states in their plane cannot cross itself.
    """
    d = len(problem.states)
    if problem.inputs or d > 2 or not problem.measured.all():
        return ""
    smooth, _, noise = smooth_states(problem, None)
    paths = [_clear_steps(path) for path in problem.split(smooth / noise)]
    name = problem.states[0]
    if d == 1 and sum(_turns(path[:, 0]) for path in paths) >= LEAST_CROSSINGS:
        return f"{name} passes the same values up and down, which no law of {name} alone does"
    if d == 2 and sum(_crossings(path) for path in paths) >= LEAST_CROSSINGS:
        both = " and ".join(problem.states)
        return f"the path of {both} crosses itself, which no law of {both} alone does"
    return ""


def _clear_steps(path: BySample) -> Float[np.ndarray, "points d"]:
    """Points of a path that lie clearly apart; in units of the noise."""
    kept = [0]
    for k in range(1, len(path)):
        if np.square(path[k] - path[kept[-1]]).sum() > CLEAR**2:
            kept.append(k)
            if len(kept) == MOST_POINTS:
                break
    return path[kept]


def _turns(x: Float[np.ndarray, " points"]) -> int:
    """Number of turns from up to down."""
    up = np.diff(x) > 0.0
    return int((up[:-1] & ~up[1:]).sum())


def _crossings(path: Float[np.ndarray, "points 2"]) -> int:
    """Number of pairs of steps that cross each other at a clear angle."""
    if len(path) < 4:
        return 0
    points = path / np.maximum(path.std(axis=0), 1e-150)
    step = np.diff(points, axis=0)
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-150)
    along = (step[1:] * step[:-1]).sum(axis=1) > STRAIGHT * length[1:] * length[:-1]
    # The chord of an arc cuts its corner: only where the path goes straight does it lie on it.
    straight = np.flatnonzero(along[1:] & along[:-1]) + 1
    points, step, length = points[straight], step[straight], length[straight]
    count = 0
    for k in range(len(step) - 1):
        # Step k is p + s u, and a later one q + t v, with s and t from 0 to 1.
        between, later = points[k + 1 :] - points[k], step[k + 1 :]
        area = step[k, 0] * later[:, 1] - step[k, 1] * later[:, 0]
        clear = np.abs(area) > LEAST_SINE * length[k] * length[k + 1 :]
        safe = np.where(clear, area, 1.0)
        s = (between[:, 0] * later[:, 1] - between[:, 1] * later[:, 0]) / safe
        t = (between[:, 0] * step[k, 1] - between[:, 1] * step[k, 0]) / safe
        count += int((clear & (s >= 0.0) & (s < 1.0) & (t >= 0.0) & (t < 1.0)).sum())
    return count
