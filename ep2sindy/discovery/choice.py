"""Choice of one candidate per front by a selection rule, and the final fit of the model.

The final fit weighs the rows of the chosen terms if their noise is known, and joins the equations
into one model.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import compress

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import block_diag

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.gaps import mean_step
from ep2sindy.data.trajectory import Trajectory, spread_blocks
from ep2sindy.discovery.result import Discovery, DiscoveryMethod, NoiseTest
from ep2sindy.estimation.noise import are_white
from ep2sindy.library.relations import Constraint, Relation, binding, constraint
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.constrained import constrained_fit
from ep2sindy.regression.formulations import RandomSplit, Weak
from ep2sindy.regression.front import Candidate, ParetoFront, Residual, fit_support
from ep2sindy.regression.least_squares import LeastSquares
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.whitening import NEGLIGIBLE, whiten_terms
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.selection.criteria import Decision, cheapest_first, support_of

# Most combinations, of the fronts that relations join, to look at for one with the terms.
MAX_COMBINATIONS = 100_000


# For a correct equation chi-squared per row is 1 within its standard error, and a little more,
# since the noise is estimated from the same samples. Measured: 0.7 to 1.3 with 70 rows.
MAX_CHI_SQUARED, STANDARD_ERRORS = 1.2, 3.0

# Part of a rate of change that is too small to deny an equation for. Exact laws leave up to 2e-5 of
# records with noise of 1e-6 and 1e-5, and chi-squared is up to 21, for numerical errors. Widened by
# its root, 95 % intervals cover 88 to 97 % there.
SLIGHT = 1e-4

# Samples that are tested, and those of one block. More would say the same: the standard error of
# chi-squared is 2 % then.
MOST_TESTED, BLOCK = 20_000, 4_000

# With fewer samples, those of a state that moves may pass for white noise about a rest: one before
# may foretell a quarter of the next one's variance, at the level of the test.
TELL_REST = 35

# Steps of weighting and correction of a final fit.
N_STEPS = 8

SMALLEST = np.finfo(np.float64).tiny  # for exact fits, without residuals


def choose(
    fronts: Sequence[ParetoFront],
    method: DiscoveryMethod,
    task: DiscoveryProblem,
    *,
    provenance: Mapping[str, str],
    progress: Progress = SILENT,
) -> Discovery:
    """Select from the candidates of a regression, and fit: constrained, weighted or unchanged.

    A rule that runs whole systems has fitted the winner. For any other, under relations, only
    combinations that have the terms of the relations count. The one of least summed score wins,
    and all equations are fitted at once.
    Raises ValueError for relations that no combination has the terms for, or that tie so many
    states to each other that their combinations exceed a hundred thousand.
    """
    decision = method.selection.decide(fronts, task, progress=progress)
    if decision.model is not None:
        return choose_system(fronts, decision, method, task.runs, provenance=provenance)
    library, relations, units = fronts[0].rows.library, task.relations, task.runs[0].units
    scored = [front.with_scores(s) for front, s in zip(fronts, decision.scores, strict=True)]
    if relations:
        place = _least_sum(scored, relations)
        support = support_of(scored, place)
        bound = binding(relations, support) or ()
        held = constraint(library, support, bound)
        problems = list(dict.fromkeys(front.rows for front in scored))
        model = constrained_fit(problems, held, units=units, provenance=provenance)
        won = [f.with_scores(_won(f.scores, int(k))) for f, k in zip(scored, place, strict=True)]
        best = [front.candidates[k] for front, k in zip(won, place, strict=True)]
        test = NoiseTest(n_free=_count_free(held, bound))
        return replace(join_choice(won, best, model, method), noise_test=test, constraint=held)
    best = [front.best for front in scored]
    fits = [fit_last(*pair) for pair in zip(scored, best, strict=True)]
    blocks = [fit.covariance for fit in fits if fit.covariance is not None]
    # Errors of different equations are independent.
    covariance = block_diag(*blocks) if len(blocks) == len(fits) else None
    coef = coef_matrix(library, [fit.coef_by_term for fit in fits])
    states = [fit.equation for fit in fits]
    model = SparseModel(library, states, coef, units, provenance, covariance)
    test = NoiseTest({fit.equation: fit.left for fit in fits if fit.left is not None})
    return replace(join_choice(scored, best, model, method), noise_test=test)


def choose_system(
    fronts: Sequence[ParetoFront],
    decision: Decision,
    method: DiscoveryMethod,
    runs: Sequence[Trajectory],
    *,
    provenance: Mapping[str, str],
) -> Discovery:
    """The choice that the decision of a rule that runs systems makes, with its scores."""
    assert decision.model is not None
    scored = [f.with_scores(s) for f, s in zip(fronts, decision.scores, strict=True)]
    model = replace(decision.model, units=runs[0].units, provenance=provenance)
    best = [front.best for front in scored]
    held = decision.constraint
    if held is not None and len(held.free) == len(held.coefficients):
        held = None
    found = join_choice(scored, best, model, method)
    return replace(found, note=decision.note, constraint=held, others=decision.others)


def join_choice(
    fronts: Sequence[ParetoFront],
    chosen: Sequence[Candidate],
    model: SparseModel,
    method: DiscoveryMethod,
) -> Discovery:
    """The candidates of every equation, and those that were chosen as they are in the model."""
    terms = {each.equation: model.terms(each.equation) for each in chosen}
    coef = [np.array([terms[c.equation].get(name, 0.0) for name in c.terms]) for c in chosen]
    return Discovery(
        {front.equation: front for front in fronts},
        {c.equation: replace(c, coef=own) for c, own in zip(chosen, coef, strict=True)},
        model,
        method,
    )


def assess_noise(choice: Discovery, runs: Sequence[Trajectory]) -> NoiseTest:
    """Test the residuals of the chosen model against the noise of the samples.

    A state that the final fit has tested on its own rows keeps that result. Any other state is
    tested on weak rows of the runs, with the terms of the model. If relations hold in its equation,
    the model's own coefficients are tested. Otherwise the terms are fitted again to the weak rows,
    which are whitened, and that fit is tested: coefficients of a formulation that does not weigh
    its rows are not. A state without such rows, for example for a record of a few samples, is not
    tested. Of long records, blocks of 20,000 samples together are tested.
    An estimate of states and coefficients together has tested whole trajectories already. It counts
    only if the chosen model is its own. By whatever method, a measured state that the model leaves
    at rest must show nothing but white noise there. An equation that says what a state is, such as
    x' = v, is known, and is not tested.
    """
    estimate, (moves, still) = choice.estimate, _assess_rest(choice.model, runs)
    if estimate is not None and estimate.model is choice.model:
        lack_of_fit = estimate.lack_of_fit
        return NoiseTest(lack_of_fit=lack_of_fit, tested=True, note="" if lack_of_fit else still)
    runs = runs if estimate is None else estimate.runs  # with hidden states
    states, tested, n_free = choice.model.states, choice.noise_test.left, choice.noise_test.n_free
    states = [s for s in states if list(choice.model.terms(s).values()) != [1.0]]
    unknown = [state for state in states if state not in tested]
    found = {**tested, **(_test_on_weak_rows(choice, runs, unknown) if unknown else {})}
    ordered = {state: found[state] for state in states if state in found}
    lack_of_fit = _describe_lack_of_fit(ordered, n_free) or moves
    return NoiseTest(
        ordered, lack_of_fit, bool(ordered or lack_of_fit), n_free, "" if lack_of_fit else still
    )


def _assess_rest(model: SparseModel, runs: Sequence[Trajectory]) -> tuple[str, str]:
    """What to report of measured states that a model leaves at rest, or drifting at a rate.

    If their samples are no white noise about that, why this does not fit; and a note if they are,
    or if they are too few to tell. Samples of instants at which all states were measured count.
    """
    terms = {s: model.terms(s) for s in model.states if s in runs[0].state_names}
    rest = [s for s, own in terms.items() if set(own) <= {"1"}]
    if not rest:
        return "", ""
    rates, times, samples = [terms[s].get("1", 0.0) for s in rest], [], []
    for run in runs:
        whole = slice(None) if run.missing is None else ~run.missing.any(axis=1)
        times.append(run.t[whole])
        samples.append(run.columns(list(terms))[whole])
    step, n, own = mean_step(*times), sum(map(len, times)), [list(terms).index(s) for s in rest]
    left = [x[:, own] - np.outer(t, rates) for t, x in zip(times, samples, strict=True)]
    left = [each - each.mean(axis=0) for each in left]
    white = are_white([t / step for t in times], samples, left)
    names, moving = (" and ".join(compress(rest, each)) for each in (white, ~white))
    few = f", but {n} are too few to tell" if n < TELL_REST else ""
    return (
        moving
        and f"the model leaves {moving} at rest, but what was measured there is no white "
        "noise: intervals are not given; add terms or states, or make states of one signal "
        "(ep.embed, +exp=trace)",
        names
        and f"no law of {names} is found: about a steady course the samples pass for white "
        f"noise{few}",
    )


def _test_on_weak_rows(
    choice: Discovery, runs: Sequence[Trajectory], states: Sequence[str]
) -> dict[str, Residual]:
    """Residuals of some equations on weak rows, as far as their rows can be made and whitened."""
    model, n_free, left = choice.model, choice.noise_test.n_free, dict[str, Residual]()
    try:
        # Same result as with the whole library, at a fraction of the cost.
        used = np.isin(model.library.names, [name for s in states for name in model.terms(s)])
        used[0] |= not used.any()  # a library needs a term
        form, rng = Weak(split=RandomSplit(0.0)), np.random.default_rng(0)
        blocks = spread_blocks(runs, most=MOST_TESTED, block=BLOCK)
        rows = form.assemble(blocks, model.library.take(used), rng=rng)
    except (ValueError, np.linalg.LinAlgError):
        return {}
    problems = {problem.equations[0]: problem for problem in rows}
    for state in states:
        problem, fit = problems[state], Candidate.of(state, model.terms(state))
        with suppress(ValueError, np.linalg.LinAlgError):
            if state in n_free:
                left[state] = _test_fit(problem, fit, n_free=n_free[state])
            elif (tested := reweight(problem, fit, negligible=NEGLIGIBLE).left) is not None:
                left[state] = tested
    return left


def _count_free(held: Constraint, relations: Sequence[Relation]) -> dict[str, int]:
    """For each state that relations name, the number of free coefficients of its equation."""
    named = {state for relation in relations for _, state, _ in relation.factors}
    owners = np.array([state for state, _ in held.coefficients])
    blocks = {state: held.C[owners == state] for state in held.states if state in named}
    return {
        s: int(np.linalg.matrix_rank(block)) if block.size else 0 for s, block in blocks.items()
    }


def _describe_lack_of_fit(left: Mapping[str, Residual], related: Collection[str]) -> str:
    """Sentence on the equations whose residuals exceed the noise; empty if there are none.

    related: states whose coefficients obey relations.
    """
    left = {state: each for state, each in left.items() if not each.leaves_noise}
    if not left:
        return ""
    parts = ", ".join(each.text(f"{state}'") for state, each in left.items())
    why, what = "a term or a state is missing", "add terms or states"
    if set(left) & set(related):
        why, what = (
            f"a relation is wrong, or {why}",
            f"check the relations, weigh the rows (WeightedWeak()), {what}",
        )
    return (
        f"the equations leave a part of the rates of change unexplained, {parts}: {why}, so there "
        f"are no intervals; {what}, or judge the model by its free run"
    )


def fit_last(front: ParetoFront, candidate: Candidate) -> Candidate:
    """Final fit of a selected candidate, weighted if the noise of its rows is known."""
    return candidate if front.rows.noisy is None else reweight(front.rows, candidate)


def reweight(
    problem: RegressionRows, candidate: Candidate, *, negligible: float = 0.0
) -> Candidate:
    """Fit a candidate's terms again, with weights and corrected samples, and test the residuals.

    If the residuals exceed the noise of the rows there is no covariance: intervals would not cover
    the truth. negligible: as for `whiten_rows`.
    """
    theta, target, scale = _whiten(problem, candidate, negligible=negligible)
    fit = LeastSquares.of_rows(theta, target)
    root = fit.root * scale[:, None]
    left = _compare_with_noise(target - theta @ fit.coef, target, n_free=len(scale))
    wider = max(1.0, left.chi_squared) if left.unexplained <= SLIGHT else 1.0
    return replace(
        candidate,
        coef=fit.coef * scale,
        covariance=wider * root @ root.T if left.leaves_noise else None,
        left=left,
    )


def _whiten(
    problem: RegressionRows, candidate: Candidate, *, negligible: float
) -> tuple[
    Float[np.ndarray, "rows terms"], Float[np.ndarray, " rows"], Float[np.ndarray, " terms"]
]:
    """Columns and target of rows of variance 1 under a candidate, and the coefficients' scales."""
    places = np.array([problem.library.index(name) for name in candidate.terms], dtype=np.int64)
    scale = problem.coef_scale(0)[places]
    coef = candidate.coef / scale
    rows = whiten_terms(problem, places, coef, n_steps=N_STEPS, negligible=negligible)
    return rows.theta[:, places], rows.target, scale


def _test_fit(problem: RegressionRows, fit: Candidate, *, n_free: int) -> Residual:
    """Residuals of a fit with its own coefficients, whitened about a free fit of its terms.

    The free fit is as close to the data as these terms allow, so the samples are corrected by it,
    not by coefficients that the data may contradict. n_free: number of free coefficients.
    """
    free = fit_support(problem, fit.equation, fit.terms)
    theta, target, scale = _whiten(problem, free, negligible=NEGLIGIBLE)
    assert free.terms == fit.terms  # both are in the order of the library
    return _compare_with_noise(target - theta @ (fit.coef / scale), target, n_free=n_free)


def _compare_with_noise(
    left: Float[np.ndarray, " rows"], target: Float[np.ndarray, " rows"], *, n_free: int
) -> Residual:
    """Compare whitened residuals with white noise of variance 1; n_free: fitted coefficients."""
    freedom = max(len(left) - n_free, 1)
    chi_squared = float(left @ left) / freedom
    most = MAX_CHI_SQUARED + STANDARD_ERRORS * np.sqrt(2.0 / freedom)
    autocorrelation = float(left[1:] @ left[:-1]) / max(float(left @ left), SMALLEST)
    unexplained = float(np.sqrt(left @ left / max(float(target @ target), SMALLEST)))
    leaves_noise = bool(chi_squared <= most or unexplained <= SLIGHT)
    return Residual(chi_squared, autocorrelation, leaves_noise, unexplained)


def _least_sum(
    fronts: Sequence[ParetoFront], relations: Sequence[Relation]
) -> Int[np.ndarray, " fronts"]:
    """The combination of least summed score among those that have the relations' terms.

    Only fronts that relations tie to each other are combined, since the other scores can be chosen
    one by one.
    """
    place = np.array([int(np.argmin(front.scores)) for front in fronts])
    for states in _related_states(relations):
        related = [k for k, front in enumerate(fronts) if front.equation in states]
        some = [fronts[k] for k in related]
        own = [r for r in relations if any(state in states for _, state, _ in r.factors)]
        scores = [front.scores for front in some]
        best = next(cheapest_first(some, scores, own, most_tried=MAX_COMBINATIONS), None)
        if best is None:
            raise ValueError(
                f"the relations {[r.text for r in own]} name terms that none of the best "
                f"{MAX_COMBINATIONS} combinations of candidates has; raise the search's "
                "max_terms, or depth, or let the relations tie fewer states to each other"
            )
        place[related] = best
    return place


def _related_states(relations: Sequence[Relation]) -> list[set[str]]:
    """Sets of states that relations tie to each other, directly or through a third state."""
    sets: list[set[str]] = []
    for relation in relations:
        related = {state for _, state, _ in relation.factors}
        related = related.union(*(other for other in sets if other & related))
        sets = [other for other in sets if not other & related] + [related]
    return sets


def _won(scores: Float[np.ndarray, " candidates"], winner: int) -> Float[np.ndarray, " candidates"]:
    """Scores with the winner's made the least, so that it counts as selected."""
    won = scores.copy()
    won[winner] = min(won[winner], np.nextafter(won.min(), -np.inf))
    return won
