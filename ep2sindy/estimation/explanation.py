"""What explains the samples: an exact trajectory, channels that come late, or random pushes.

The search for an exact trajectory starts from smoothed states. If what it finds does not fit, it
starts again from states that random pushes let go their own way, and then from other smoothings.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import compress
from math import log

import numpy as np
from jaxtyping import Float

from ep2sindy.estimation.cost import OutOfTimeError
from ep2sindy.estimation.lateness import (
    PAYS,
    SURE,
    delay_price,
    delay_words,
    fit_delays,
    late_words,
    move_channels,
    suspect_delays,
)
from ep2sindy.estimation.likelihood import STEERED, Level
from ep2sindy.estimation.noise import noise_beside
from ep2sindy.estimation.problem import MIN_SAMPLES, EstimationProblem
from ep2sindy.estimation.pushed import (
    PushedFit,
    push_words,
    solution_under_pushes,
    solve_pushed,
)
from ep2sindy.estimation.solver import (
    ENOUGH_SAMPLES,
    OTHER_STARTS,
    AnnealedFit,
    Solution,
    astray,
    at_level,
    enough_samples,
    from_smooth,
    max_terms_for,
    settle,
    smoothed,
    start_from_smooth,
)
from ep2sindy.estimation.supports import term_prices
from ep2sindy.estimation.working_set import first_set, search_within, with_entrances
from ep2sindy.runtime.progress import SILENT
from ep2sindy.trust.interruption import is_interruption

CLEAR = 4.0  # steps between the points of a path, in standard deviations of the noise
MOST_POINTS = 3000  # of a path that is looked at, the first ones
STRAIGHT = 0.95  # least cosine of the turn from one step to the next
LEAST_SINE = 0.5  # of the angle of a crossing: noise turns a path by less
LEAST_CROSSINGS = 3  # one may come from a gap or an outlier
ROADS = (
    "Name a hidden state (hidden=[...]), embed one signal (+exp=trace), or measure another state"
)
WARM = 0.1  # rho of the fits that are compared: an input half a step late shows, with all terms
BETTER = 4.0  # least fall of -2 log likelihood for which the most plausible course is left


FIRST_MAX_TERMS, MORE_TERMS = 7, 5  # of one equation, and how many more where all are used
LET_GO = 0.5  # residual, as a share of a state's spread, if the model ignores the state
# Moves of late channels (the delay model is linear), and the move, in mean steps, that ends them.
MAX_MOVES, SETTLED = 3, 0.05
MAX_WIDER = 500  # terms of a library that a late channel competes with: more would take too long


@dataclass(frozen=True, eq=False)
class Explanation:
    """The reported solution: of the samples as given, or of the aligned samples if asked for.

    max_terms: the most terms of one equation that were tried. misfit: the reason why it does not
    explain the samples; empty if it does. delays: (d,), in mean steps. pushes: (d,), scaled. said:
    remarks on how the samples were changed or explained. holds: states whose equations explain
    their samples although others do not.
    """

    problem: EstimationProblem
    solution: Solution
    max_terms: int
    misfit: str
    delays: Float[np.ndarray, " d"]
    pushes: Float[np.ndarray, " d"]
    said: tuple[str, ...] = ()
    holds: tuple[str, ...] = ()

    @property
    def rank(self) -> tuple[bool, bool, float]:
        """Order between ways in which hidden states may enter: least is best."""
        return bool(self.misfit), bool(self.pushes.any()), self.solution.score


@dataclass(frozen=True, eq=False)
class Aligned:
    """The solution for samples whose channels were brought forward by their delays.

    delays: (d,), in mean steps. score: of all samples, with the price of the delays.
    """

    problem: EstimationProblem
    solution: Solution
    delays: Float[np.ndarray, " d"]
    score: float


def explain(problem: EstimationProblem, *, max_terms: int | None, align: bool) -> Explanation:
    """The most likely support, and what beside its trajectory explains the samples, if need be.

    max_terms: of one equation; None begins with 7, and allows more where an equation needs them.
    At the limit of its time, or interrupted while its progress is shown, the search ends with the
    best that it has.
    """
    watch = problem.watch
    watch.best = None
    try:
        return _explain(problem, max_terms, align)
    except (OutOfTimeError, KeyboardInterrupt, SystemError) as stop:
        late, interrupted = isinstance(stop, OutOfTimeError), is_interruption(stop)
        # Nobody follows a silent search, which may be one of many: an interruption ends them all.
        watched = interrupted and watch.progress is not SILENT
        if watch.best is None or not (late or watched):
            if interrupted:
                raise KeyboardInterrupt("the search was interrupted") from stop
            raise
        watch.ended = True
        by = "limit_s" if late else "an interruption"
        return _unfinished(*watch.best, f"ended by {by} after {watch.elapsed_s:.3g} s", max_terms)
    finally:
        watch.best = None  # what follows is a report, which nothing ends


def _unfinished(
    problem: EstimationProblem, best: Solution | AnnealedFit, ended: str, max_terms: int | None
) -> Explanation:
    """The best so far of a search that was ended."""
    if isinstance(best, AnnealedFit):
        noise = noise_beside(problem, best.fit)
        prices = term_prices(problem, problem.n_samples * float(noise.independent.mean()))
        best = Solution(best, noise, prices, best.level.rho, astray(problem, best))
    none, limit = np.zeros(len(problem.states)), max_terms or FIRST_MAX_TERMS
    few_terms = max_terms_for(problem, limit)
    if best.fits:
        said = (f"the search was {ended}: other starts and terms were not tried",)
        words = _at_limit(problem, best, limit)
        return Explanation(problem, best, few_terms, words, none, none, said)
    words = (
        f"the search was {ended}, and nothing fits as far as the noise yet: the equations are the "
        "best so far; raise limit_s, or take fewer terms"
    )
    return Explanation(problem, best, few_terms, words, none, none)


def _explain(problem: EstimationProblem, max_terms: int | None, align: bool) -> Explanation:
    """`explain` without a limit to its time."""
    problem = on_likeliest_courses(problem, max_terms=max_terms or FIRST_MAX_TERMS)
    problem, first, max_terms = _search_by_size(problem, max_terms)
    few_terms = max_terms_for(problem, max_terms)
    best, late, pushed = _solve(problem, first, few_terms)
    none = np.zeros(len(problem.states))
    if late is not None and (words := _lacks_terms(problem, late, max_terms)):
        return Explanation(problem, best, few_terms, words, none, none)
    if late is not None and not align:
        words = late_words(problem, late.delays)
        return Explanation(problem, best, few_terms, words, late.delays, none)
    if late is not None:
        said = f"{delay_words(problem, late.delays)}: brought together with the others"
        misfit = _at_limit(late.problem, late.solution, max_terms)
        return Explanation(
            late.problem, late.solution, few_terms, misfit, late.delays, none, (said,)
        )
    part, by_pushes = problem, pushed is not None and pushed.explains
    tested = best is first if best.fits else by_pushes  # terms outside the set were, or need not be
    if not tested:
        near = best if best.fits else first
        wider, found = with_entrances(problem, near, max_terms=few_terms)
        if found.fits:
            part, best = wider, found
    if best.fits:
        limit = _at_limit(part, best, max_terms)
        return Explanation(part, best, few_terms, limit, none, none)
    # A hidden state that is pushed explains whatever there is.
    if pushed is not None and pushed.explained.any() and problem.measured.all():
        return _under_pushes(problem, pushed, max_terms)
    words = _misfit(part, best) + _roads(problem)
    return Explanation(part, best, few_terms, words, none, none)


def _under_pushes(problem: EstimationProblem, pushed: PushedFit, max_terms: int) -> Explanation:
    """The solution under random pushes, which explain all states or some of them."""
    solution = solution_under_pushes(problem, pushed)
    few_terms, none = max_terms_for(problem, max_terms), np.zeros(len(problem.states))
    process = pushed.errors.process
    if pushed.explains:
        limit, said = _at_limit(problem, solution, max_terms), (push_words(problem, pushed),)
        return Explanation(problem, solution, few_terms, limit, none, process, said)
    holds = tuple(compress(problem.states, pushed.explained))
    others = tuple(compress(problem.states, ~pushed.explained))
    misfit = (
        f"no law of this library explains {' and '.join(others)}: a term or a state is missing "
        f"there. What was measured of {' and '.join(holds)} is explained, with random pushes of "
        "the size given"
    )
    misfit += _roads(problem)
    return Explanation(problem, solution, few_terms, misfit, none, process, holds=holds)


def _roads(problem: EstimationProblem) -> str:
    """What shows that a state is missing, and what to do then; empty if nothing shows it."""
    sign = missing_state(problem)
    return f". A state is missing for certain: {sign}. {ROADS}" if sign else ""


def _search_by_size(
    problem: EstimationProblem, max_terms: int | None
) -> tuple[EstimationProblem, Solution, int]:
    """The solution from smoothed states, the problem of its working set, and the limit of terms."""
    limit = max_terms or FIRST_MAX_TERMS
    part, found = search_within(problem, max_terms=max_terms_for(problem, limit))
    # More than half of the candidates would stand in for terms that the library lacks.
    most = 0 if max_terms else int(np.bincount(problem.block).max()) // 2
    while limit < most and _full(part, found, limit):
        wider = min(limit + MORE_TERMS, most)
        tried, better = search_within(problem, max_terms=max_terms_for(problem, wider))
        if (not better.fits, better.score) >= (not found.fits, found.score):
            break
        part, found, limit = tried, better, wider
    problem.watch.best = part, found
    return part, found, limit


def _solve(
    problem: EstimationProblem, first: Solution, max_terms: int
) -> tuple[Solution, Aligned | None, PushedFit | None]:
    """The best exact solution, a better one with late channels, and one under random pushes.

    first: from smoothed states. Each of the others is None if it is not asked for, or if there is
    none.
    """
    spread = np.concatenate([record.samples for record in problem.records]).std(axis=0)

    def rank(each: Solution) -> tuple[bool, int, float]:
        # The score of states that leave the flow is no likelihood, so those that fit come first. A
        # crude model may score best by following one state exactly and ignoring another.
        let_go = each.noise.is_error & (each.noise.std > LET_GO * spread)
        return not each.fits, int((let_go & problem.measured).sum()), each.score

    best, pushed = first, None
    if not first.fits:
        with problem.watch.stage("random pushes"):
            pushed = solve_pushed(problem, max_terms=max_terms)
            exact = settle(problem, pushed.fit, pushed.level.noise, max_terms=max_terms)
        best = min([first, exact], key=rank)
        problem.watch.best = problem, best
    late = _align(problem, first, max_terms)
    if late is not None and not (best.fits and best.score < late.score):
        return best, late, pushed
    # Guesses of hidden states do not depend on how they are smoothed.
    for log10_ratio in OTHER_STARTS if problem.measured.all() else ():
        if best.fits and problem.n_samples >= ENOUGH_SAMPLES:
            break
        with problem.watch.stage("another start"):
            other = from_smooth(problem, log10_ratio, max_terms=max_terms)
        best = min([best, other], key=rank)
    return best, None if best is first else _align(problem, best, max_terms), pushed


def _align(problem: EstimationProblem, found: Solution, max_terms: int) -> Aligned | None:
    """A solution with late channels that fits and is likelier; None if there is none."""
    around = found.annealed.around
    # No model follows the samples, or a channel of its own rate cannot be moved onto the others.
    if around is None or problem.partial:
        return None
    support = found.annealed.fit.support
    step = suspect_delays(problem, around, support, found.prices, max_terms=max_terms)
    if step is None:
        return None
    here, now, late, delays = problem, found, step != 0.0, np.zeros(len(step))
    for _ in range(MAX_MOVES):
        delays = delays + step
        here = move_channels(here, now.annealed.fit.paths, step)
        if min(len(record.samples) for record in here.records) < MIN_SAMPLES:
            return None  # shifts as long as a record are no delays
        with problem.watch.stage("channels that come late"):
            now = from_smooth(here, None, max_terms=max_terms)
        if now.annealed.around is None:
            return None
        around, support = now.annealed.around, now.annealed.fit.support
        _, step, errors = fit_delays(here, around, late, support, now.prices, max_terms=max_terms)
        if np.abs(step).max() < SETTLED:
            break
    # Samples at the ends are left out: scale the likelihood to the full number of samples.
    score = now.score + now.noise.deviance * (problem.n_samples / here.n_samples - 1.0)
    score += late.sum() * delay_price(problem) + PAYS
    sure = (np.abs(delays) >= SURE * errors).all()
    return Aligned(here, now, delays, score) if sure and now.fits and score < found.score else None


def _lacks_terms(problem: EstimationProblem, late: Aligned, max_terms: int) -> str:
    """Why terms are missing rather than a sensor late; empty unless one degree more is as good.

    With a channel that is moved, wrong equations may stand in for terms that the library lacks. But
    higher products also stand in for a delay: they count if there are no more terms of them.
    """
    wider = problem.widen and problem.widen()
    if wider is None or len(wider.library) > MAX_WIDER or not enough_samples(wider):
        return ""
    _, found = search_within(wider, max_terms=max_terms)
    n_more = found.annealed.fit.support.sum() - late.solution.annealed.fit.support.sum()
    if not found.fits or found.score > late.score or n_more > 0:
        return ""
    return (
        f"this library lacks terms: with products up to degree {wider.library.degrees.max()} the "
        "samples are explained, and with no channel late; add these products. The equations are "
        "the nearest found"
    )


def _misfit(problem: EstimationProblem, found: Solution) -> str:
    if found.fits:
        return ""
    signs = []
    if not np.isfinite(found.score):
        signs.append("whatever was tried runs away between two samples")
    if found.flow_error:
        signs.append(f"the states leave the model by {found.flow_error:g} of the noise per sample")
    if not found.parting < STEERED:
        factor = np.exp(min(found.parting, 100.0) / 2.0)
        signs.append(
            f"paths beside the fit part by a factor of {factor:.2g} per sample, so it could follow "
            "any samples"
        )
    for k, state in enumerate(problem.states):
        if memory := found.noise.unexplained[k]:
            signs.append(f"what is left of {state} lasts ({memory:.2f} from sample to sample)")
        if found.noise.patterned[k]:
            signs.append(f"what is left of {state} holds a line or follows the states")
    signs += [
        f"{s} does not follow its own equation" for s in compress(problem.states, found.astray)
    ]
    return (
        "no model of this library fits these data as far as their noise: "
        + "; ".join(signs)
        + ". The equations are the nearest found; add terms or states, or judge them by free run"
    )


def _full(problem: EstimationProblem, found: Solution, max_terms: int) -> list[str]:
    """Equations with all terms allowed, though the library has more."""
    if max_terms_for(problem, max_terms) < max_terms:
        return []  # too few samples: this is reported anyway
    used = problem.coef_SI(found.annealed.fit.free) != 0.0
    n_used = np.bincount(problem.equation[used], minlength=len(problem.states))
    n_all = np.bincount(problem.candidates.equation, minlength=len(problem.states))
    full = (n_used >= max_terms) & (n_all > max_terms)
    return [f"{state}'" for state in compress(problem.states, full)]


def _at_limit(problem: EstimationProblem, found: Solution, max_terms: int) -> str:
    """Warning if an equation uses all terms allowed: many terms may stand in for a missing one."""
    full = _full(problem, found, max_terms)
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
    start, noise = start_from_smooth(part, None)

    @cache
    def unlikely(courses: tuple[str, ...]) -> float:
        fit, _ = at_level(part.on_courses(courses), start, Level(noise, WARM))
        return part.n_squares * log(max(fit.total, np.finfo(np.float64).tiny))

    best = problem.courses
    for j, options in enumerate(problem.allowed_courses):
        first, *others = [(*best[:j], course, *best[j + 1 :]) for course in options]
        best = min([first, *others], key=lambda c: unlikely(c) - BETTER * (c == first))
    return problem.on_courses(best)


# Signs that a state is missing: a state that moves by a law of its own cannot pass a value upwards
# and later downwards, and the path of two states in their plane cannot cross itself.


def missing_state(problem: EstimationProblem) -> str:
    """The sign that a state is missing; empty if there is none, inputs drive, or d is above two."""
    d = len(problem.states)
    if problem.driven or d > 2 or not problem.measured.all():
        return ""
    start = smoothed(problem, None)
    noise = start.noise[0][0]
    paths = [_clear_steps(path / noise) for path in start.paths]
    name = problem.states[0]
    if d == 1 and sum(_turns(path[:, 0]) for path in paths) >= LEAST_CROSSINGS:
        return f"{name} passes the same values up and down, which no law of {name} alone does"
    if d == 2 and sum(_crossings(path) for path in paths) >= LEAST_CROSSINGS:
        both = " and ".join(problem.states)
        return f"the path of {both} crosses itself, which no law of {both} alone does"
    return ""


def _clear_steps(path: Float[np.ndarray, "samples d"]) -> Float[np.ndarray, "points d"]:
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
