"""Joint estimation of states and sparse coefficients, and the report of its result.

Besides the model, the result holds data_warnings: sentences about the samples and their noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from ep2sindy.data.coerce import (
    DiscoveryProblem,
    FailedTryError,
    check_domain,
    check_repeats,
    own_result,
)
from ep2sindy.data.runs import Runs, trajectories_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.cost import SearchMonitor, check_limit_s, check_size, growing_parts
from ep2sindy.estimation.explanation import Explanation, explain, explain_under_noise
from ep2sindy.estimation.hidden import Coupling, with_guesses
from ep2sindy.estimation.likelihood import Gram, gram, hessian_on
from ep2sindy.estimation.noise import data_warning
from ep2sindy.estimation.observation import Solution
from ep2sindy.estimation.problem import (
    FIRST_MAX_TERMS,
    MIN_SAMPLES,
    SAMPLES_PER_TERM,
    ByCoefficient,
    BySample,
    ByState,
    EstimationProblem,
    by_run,
    scale_problem,
)
from ep2sindy.estimation.supports import offer_supports, penalise
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import Constraint
from ep2sindy.library.roles import constraint_of
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.gram_kernels import invert_gram
from ep2sindy.runtime.progress import Progress, as_progress, count_pieces
from ep2sindy.runtime.values import check_count

MAX_RIVALS = 5
MIN_ODDS = 1e-3  # rivals with lower posterior odds are not reported
MIN_PROBABILITY = 0.5  # of all supports; with less, the samples do not tell which it is
EVEN = 0.2  # above these posterior odds of a rival, the choice is reported as ambiguous


@dataclass(frozen=True)
class ScoredSupport:
    """A support of one equation, the other equations as chosen, with its coefficients and deviance.

    coef: term name -> coefficient, in SI.
    deviance: -2 log likelihood of the trajectories plus the penalties of all terms, minus the same
    of the chosen model. It comes from a linearisation about the chosen model, so it is accurate
    only for supports whose fit is close to it.
    """

    coef: Mapping[str, float]
    deviance: float

    @property
    def odds(self) -> float:
        """Odds against the chosen support."""
        return float(np.exp(-0.5 * self.deviance))


@dataclass(frozen=True)
class Rival:
    """Another support of one equation, and its posterior odds against the chosen one."""

    state: str
    terms: tuple[str, ...]
    odds: float


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of estimating states and coefficients together.

    model: carries the covariance of its coefficients, unless it does not fit. runs: as they were
    fitted, hidden states as estimated. paths: for each of these runs, the estimated states,
    (samples, d), in SI.
    noise_std: (d,), standard deviation of the samples' noise, in SI; NaN for hidden states. memory:
    (d,), correlation of this noise from one sample to the next, 0 for white noise.
    flow_error: size of the deviation of the states from the model over one sampling step, as a
    fraction of the noise; 0 if the residuals are nothing but noise. process_noise_std: (d,), of
    what moves every state at random over a mean step, in SI; 0 if an exact trajectory explains the
    samples. lack_of_fit: the reason why these equations do not explain the data; empty if they do.
    too_few_samples: a warning if they are too few to decide; otherwise empty. explained_states: of
    a lack of fit, the states whose equations explain their samples all the same. supports: for each
    state, the best supports of every size. rivals: other plausible supports, the most likely first.
    data_warnings: sentences on where the samples deviate from the assumptions: limits of sensors,
    noise that is correlated in time, grows with the state or has outliers, and collinear states.
    kurtosis: (d,), of the noise; 3 if it is normal, NaN if every sample is a limit. growth: (d,),
    fraction of the noise variance that grows with the state. delays_s: (d,), the delay of each
    channel. `align=True` shifts the channels back into step, and leaves out the samples at the ends
    that this costs. constraint: that the coefficients obey under roles, with the processes found.
    """

    model: SparseModel
    paths: tuple[BySample, ...] = field(repr=False)
    runs: Sequence[Trajectory] = field(repr=False)
    noise_std: ByState
    memory: ByState
    flow_error: float
    lack_of_fit: str
    too_few_samples: str
    supports: Mapping[str, Sequence[ScoredSupport]] = field(repr=False)
    rivals: Sequence[Rival]
    data_warnings: tuple[str, ...]
    kurtosis: ByState
    growth: ByState
    delays_s: ByState
    process_noise_std: ByState
    explained_states: tuple[str, ...]
    constraint: Constraint | None = field(default=None, repr=False)

    @property
    def note(self) -> str:
        """The most important warning on the fit, on one line."""
        if self.lack_of_fit:
            return self.lack_of_fit
        if not self.rivals:
            return (
                self.too_few_samples
                or "no other support of an equation has posterior odds above 1:1000"
            )
        first = self.rivals[0]
        odds = f"posterior odds of 1:{1.0 / first.odds:.3g}"
        odds = f"{first.state}' of {', '.join(first.terms)} at {odds}"
        if self.too_few_samples:
            return f"{self.too_few_samples}; next is {odds}"
        return f"{'ambiguous' if first.odds > EVEN else 'the next best'}: {odds}"


def estimate(
    runs: Runs,
    library: Library,
    *,
    max_terms: int | None = None,
    align: bool = False,
    hidden: Sequence[str] = (),
    courses: Mapping[str, str] | None = None,
    provenance: Mapping[str, str] | None = None,
    limit_s: float | None = None,
    progress: Progress | bool = False,
) -> Estimate:
    """Estimate the states at every sample and sparse coefficients together, by maximum likelihood.

    `discover` with a `TrajectorySearch` calls this function and adds candidates and scores.

    Parameters
    ----------
    runs : run, or list or dict of runs
        As `discover` takes them. All runs share the coefficients. Samples may be spaced unequally.
        Inputs are taken as exact.
    library : Library
        Candidate terms, with what is known of the equations, as for `discover`.
    max_terms : int, optional
        The most terms of one equation. None allows seven, and more where an equation of a large
        library needs them.
    align : bool, default False
        True shifts channels that lag forward. False counts a channel delay as a lack of fit of the
        model, and reports the delay.
    hidden : sequence of str, default ()
        States that nobody measured, which the library contains. All ways in which they may enter
        are compared.
    courses : mapping of str to str, optional
        How each input goes from one sample to the next: "held", "linear" or "smooth". For other
        inputs the likeliest course is taken.
    provenance : mapping of str to str, optional
        Entries added to the model's record of its origin.
    limit_s : float, optional
        Wall time in s after which the search ends with the best model that it has, and reports so.
        Long records are then searched in parts first.
    progress : Progress or bool, default False
        True shows bars. An interruption (Ctrl-C) then ends the search in the same way as `limit_s`.

    Returns
    -------
    Estimate
        The model, the estimated states and noise, rival supports, and warnings.

    Raises
    ------
    ValueError
        If max_terms is below one, the limit is not positive, the library needs more samples or
        memory than there is, an input or a course is unknown, or the runs do not go together.

    Notes
    -----
    Minimises over the states x at all samples, the coefficients c and their support

        sum_k |(y_k - x_k) / sigma|^2 + sum_k |(F(x_k; c) - x_(k+1)) / (rho sigma)|^2
        + sum_j penalty_j

    with the samples y, their noise sigma, and the flow F of the equations over one step. rho falls
    from 0.3 (relaxed states) to 1e-4 (an exact trajectory). The penalty of a term is that of
    `ep.discovery.Evidence`. Assumes independent, normal noise, white or correlated over some
    samples.

    Source: de Jong 1991, doi:10.1214/aos/1176348139, for the filter; docs/estimation.md.

    Examples
    --------
    >>> run = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
    >>> found = ep.estimate(run, ep.polynomial(["x", "y"], degree=2))
    >>> sorted(found.model.terms("x"))
    ['x', 'x*y']
    """
    task = DiscoveryProblem(trajectories_of(runs, partial=True), library, hidden)
    if max_terms is not None:
        max_terms = check_count("max_terms", max_terms)
    check_limit_s(limit_s)
    facts = task.facts
    coupled = bool(facts.relations or facts.known or facts.roles or task.hidden)
    bytes_each = check_size(task.runs, task.library, facts.only, coupled=coupled, limit_s=limit_s)
    watch = as_progress(progress)
    monitor, found, part = SearchMonitor(watch, limit_s), None, task.runs
    failed = FailedTryError()
    settings = _Settings(max_terms, align, courses, monitor)
    for larger in growing_parts(task.runs, bytes_each, monitor):
        try:
            latest = _answer(replace(task, runs=larger), settings)
        except FailedTryError as error:
            failed = error
            continue
        if found is None or not monitor.ended:  # a larger part tells more, once it is done with
            found, part = latest, larger
    if found is None:
        raise failed
    answer, fitted = found
    some, n = (sum(run.n_samples for run in each) for each in (part, task.runs))
    if some < n:
        words = (
            f"the equations come from {some} of {n} samples, {len(part)} blocks spread over the "
            f"record: limit_s={limit_s:g} leaves no time for more, or memory does not hold them"
        )
        answer = replace(answer, data_warnings=(words, *answer.data_warnings))
    library, constraint = task.library.with_known_terms(task.states), None
    if facts.roles is not None:
        played = compress(answer.solution.problem.processes, answer.solution.fit.free != 0.0)
        constraint = constraint_of(library, task.states, list(played), facts.roles.known_processes)
    model = _model(answer, library, fitted[0][0].units, provenance or {})
    return replace(_report(answer, model, fitted, watch), constraint=constraint)


# What was found, and every run as it was fitted, with its path.
Answer = tuple[Explanation, Sequence[tuple[Trajectory, BySample]]]


class _Settings(NamedTuple):
    """Of a search, see `estimate`; monitor: shows and limits it."""

    max_terms: int | None
    align: bool
    courses: Mapping[str, str] | None
    monitor: SearchMonitor


def _answer(task: DiscoveryProblem, settings: _Settings) -> Answer:
    """Answer a task from all of its runs.

    The ways in which hidden states may enter are tried under process noise first. Those that
    explain the samples then are followed to an exact trajectory, and those that ran away, of which
    that says nothing; if none of these explains them, so is the likeliest of the others, with few
    terms.
    Raises FailedTryError if no way leads to states that can be used.
    """
    if not task.hidden:
        return _Way.of(task, task, (), settings).answer(settings)
    tried: list[Answer] = []
    doubtful: list[tuple[Explanation, _Way]] = []
    failed: list[FailedTryError] = []

    def follow(way: _Way, under_noise: Explanation, settings: _Settings) -> None:
        try:
            tried.append(way.answer(settings, under_noise))
        except FailedTryError as error:
            failed.append(error)

    for group in with_guesses(task):
        ways = [_Way.of(task, known, couplings, settings) for known, couplings in group]
        for under_noise, way in [(way.begin(settings), way) for way in ways]:
            if not under_noise.solution.fits and np.isfinite(under_noise.solution.deviance):
                doubtful.append((under_noise, way))
            elif not settings.monitor.ended:
                follow(way, under_noise, settings)
        if settings.monitor.ended or any(not answer.lack_of_fit for answer, _ in tried):
            break
    else:
        for under_noise, way in sorted(doubtful, key=lambda each: each[0].solution.deviance)[:1]:
            few = settings._replace(max_terms=settings.max_terms or FIRST_MAX_TERMS)
            follow(way, under_noise, few)
    if not tried:
        raise failed[0]
    return min(tried, key=lambda each: (bool(each[0].lack_of_fit), each[0].solution.rank))


@dataclass(frozen=True, eq=False)
class _Way:
    """A task by one way in which its hidden states may enter. words: on it and on what is left out.

    runs: with guesses of these states.
    """

    problem: EstimationProblem
    runs: Sequence[Trajectory]
    words: tuple[str, ...]

    @staticmethod
    def of(
        task: DiscoveryProblem,
        known: DiscoveryProblem,
        couplings: Sequence[Coupling],
        settings: _Settings,
    ) -> _Way:
        """known: the task with guesses of hidden states, which are no states of it."""
        check_runs(known)
        measured = task.runs[0].state_names

        def problem_of(library: Library) -> EstimationProblem:
            return scale_problem(
                known.runs, library, measured=measured, courses=settings.courses,
                monitor=settings.monitor,
            )  # fmt: skip

        def widen() -> EstimationProblem:
            more = polynomial(known.library.variables, degree=int(known.library.degrees.max()) + 1)
            return problem_of(known.library + more)

        problem = replace(problem_of(known.library), widen=widen)
        n_samples = sum(run.n_samples for run in known.runs)
        lonely = (
            f"{n_samples - problem.n_samples} of {n_samples} samples are left out: fewer than "
            f"{MIN_SAMPLES} stand together between gaps"
        )
        words = [lonely] * (problem.n_samples < n_samples) + [each.words for each in couplings]
        return _Way(problem, known.runs, tuple(words))

    def begin(self, settings: _Settings) -> Explanation:
        """Answer under process noise."""
        return self._with_warnings(explain_under_noise(self.problem, max_terms=settings.max_terms))

    def answer(self, settings: _Settings, under_noise: Explanation | None = None) -> Answer:
        """Answer by an exact trajectory, if one explains the samples; with the runs as fitted."""
        found = explain(
            self.problem, max_terms=settings.max_terms, align=settings.align,
            under_noise=under_noise,
        )  # fmt: skip
        problem = found.solution.problem
        # A fit follows the flow but for a little, which must not take a nonnegative state below
        # zero.
        paths = [
            np.where(problem.nonnegative, np.maximum(path, 0.0), path)
            for path in found.solution.fit.paths
        ]
        with own_result("no states fit the data"):
            fitted = list(by_run(problem, paths, self.runs))
            if not problem.measured.all():
                check_repeats([run for run, _ in fitted])
        return self._with_warnings(found), fitted

    def _with_warnings(self, found: Explanation) -> Explanation:
        return replace(found, data_warnings=(*self.words, *found.data_warnings))


def _report(
    answer: Explanation,
    model: SparseModel,
    fitted: Sequence[tuple[Trajectory, BySample]],
    progress: Progress,
) -> Estimate:
    """Convert the solution to SI, and add its rivals."""
    problem, found = answer.solution.problem, answer.solution
    pair = gram(found.fit)
    supports = {
        state: _score_supports(problem, pair, found, block)
        for block, state in count_pieces(
            progress, list(enumerate(problem.states)), "equation", "rivals"
        )
    }
    runs, paths = zip(*fitted, strict=True)
    return Estimate(
        model=model,
        paths=paths,
        runs=runs,
        noise_std=np.where(problem.measured, found.noise.std * problem.scale, np.nan),
        memory=found.noise.memory,
        flow_error=found.flow_error,
        lack_of_fit=answer.lack_of_fit,
        too_few_samples=_report_too_few(problem) or _open_choice(problem, supports),
        supports=supports,
        rivals=_rivals(problem, found, supports),
        data_warnings=(*answer.data_warnings, *data_warning(problem, found.noise)),
        kurtosis=found.noise.kurtosis,
        growth=found.noise.growth,
        delays_s=answer.delays * problem.step_s,
        process_noise_std=found.observation.process * problem.scale,
        explained_states=() if found.fits else tuple(compress(problem.states, found.explained)),
    )


def check_runs(task: DiscoveryProblem) -> None:
    """Raise ValueError for too few samples, or some outside the domain of a library's function."""
    n_samples = sum(run.n_samples for run in task.runs)
    if n_samples <= len(task.library):
        raise ValueError(
            f"a library of {len(task.library)} terms needs more samples than terms, got {n_samples}"
            "; use a smaller library or more data"
        )
    check_domain(task.runs, task.library, smooth=True)
    for run in task.runs:
        if run.n_samples < MIN_SAMPLES:
            raise ValueError(
                f"a run must have five samples or more: {run.label or 'one'} has "
                f"{run.n_samples}; leave it out, or join what belongs together"
            )


def _named_coef(problem: EstimationProblem, free: ByCoefficient, block: int) -> dict[str, float]:
    """Term -> SI coefficient of one equation, for the coefficients that are not zero."""
    values = problem.coef_SI(free)
    own = (problem.equation == block) & (values != 0.0)
    names = [problem.term_names[j] for j in problem.column[own]]
    return dict(zip(names, values[own].tolist(), strict=True))


def _model(
    answer: Explanation, library: Library, units: Mapping[str, str], provenance: Mapping[str, str]
) -> SparseModel:
    problem, found = answer.solution.problem, answer.solution
    fit = found.fit
    values = problem.coef_SI(fit.free)
    coef = np.zeros((len(library), len(problem.states)))
    column = problem.candidates.column[problem.places]
    coef[column, problem.equation] = values
    used = values != 0.0
    order = np.lexsort((column[used], problem.equation[used]))
    C = np.eye(problem.n_free) if problem.C is None else problem.C
    rows = (C[used][:, fit.support] * problem.to_SI[used, None])[order]
    hessian, cov = hessian_on(fit, fit.support)[0], None
    # If the residuals exceed the noise, intervals would not cover the truth.
    if found.fits and not answer.lack_of_fit and np.isfinite(hessian).all():
        cov = rows @ invert_gram(hessian) @ rows.T
    courses = dict(zip(problem.inputs, problem.courses, strict=True))
    return SparseModel(library, problem.states, coef, units, provenance, cov, courses=courses)


def _score_supports(
    problem: EstimationProblem, pair: Gram, found: Solution, block: int
) -> list[ScoredSupport]:
    """Supports of one equation, by size and then by deviance."""
    fit = found.fit
    if not pair.finite:
        return [ScoredSupport(_named_coef(problem, fit.free, block), 0.0)]
    own = problem.block == block
    offered = offer_supports(problem, pair, found.penalties, fit.support, own)
    others = [each.support for each in offered if not np.array_equal(each.support, fit.support)]
    chosen, *rest = (penalise(pair, mask, found.penalties) for mask in [fit.support, *others])
    rows = [
        ScoredSupport(_named_coef(problem, free, block), max(score - chosen.score, 0.0))
        for free, score in [(fit.free, chosen.score), *((each.free, each.score) for each in rest)]
    ]
    return sorted(rows, key=lambda w: (len(w.coef), w.deviance))


def _rivals(
    problem: EstimationProblem, found: Solution, supports: Mapping[str, Sequence[ScoredSupport]]
) -> tuple[Rival, ...]:
    rivals = []
    for block, state in enumerate(problem.states):
        chosen = set(_named_coef(problem, found.fit.free, block))
        for each in supports[state]:
            if set(each.coef) != chosen and each.odds >= MIN_ODDS:
                rivals.append(Rival(state, tuple(each.coef), each.odds))
    return tuple(sorted(rivals, key=lambda r: -r.odds)[:MAX_RIVALS])


def _report_too_few(problem: EstimationProblem) -> str:
    if problem.enough_samples or problem.candidates.required.all():  # or all terms are given
        return ""
    n_terms = len(problem.candidates.library)
    return (
        f"{problem.n_samples} samples do not tell which of {n_terms} terms "
        f"({SAMPLES_PER_TERM * n_terms} would): {problem.max_terms} an equation at most were "
        "tried; name the terms that you know (Library.only), or take a smaller library"
    )


def _open_choice(
    problem: EstimationProblem, supports: Mapping[str, Sequence[ScoredSupport]]
) -> str:
    """A warning if the chosen supports are less likely than all others that were weighed together.

    Penalties of terms are log prior odds, so scores give posterior probabilities (Schwarz 1978,
    doi:10.1214/aos/1176344136).
    """
    chance = 1.0
    for weighed in supports.values():
        chance /= sum(each.odds for each in weighed)
    if chance >= MIN_PROBABILITY:
        return ""
    return (
        f"{problem.n_samples} samples do not tell these equations from others: the chance that all "
        f"terms are right is {100.0 * chance:.0f} %; name the terms that you know "
        "(Library.only), take a smaller library, or a longer record"
    )
