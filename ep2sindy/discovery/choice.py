"""The choice: one candidate per front as a rule has it, fitted as the model needs it.

The last fit weighs the rows of chosen terms where their noise is known, and joins the equations to
one model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import block_diag

from ep2sindy.constraints.fit import constrained_fit
from ep2sindy.constraints.relations import Relation, binding, constraint
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.splits import RandomSplit
from ep2sindy.regression.weak import Weak
from ep2sindy.regression.whitening import whitened_rows
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.search.front import Candidate, ParetoFront
from ep2sindy.selection.rule import (
    Selection,
    SystemSelection,
    admissible,
    combinations,
    selected,
    support_of,
)

MOST_COMBINATIONS = 1_000_000  # that relations between equations may have to be checked on


@dataclass(frozen=True, eq=False)
class Choice:
    """What a rule makes of fronts.

    scores: per front, one per candidate. chosen: per front the selected candidate, with the
    coefficients and the covariance that it has in the model. note: of a rule that refines, or that
    the model leaves more than noise.
    """

    scores: Sequence[Float[np.ndarray, " _candidates"]]
    chosen: Sequence[Candidate]
    model: SparseModel
    note: str = ""


def choose(
    fronts: Sequence[ParetoFront],
    rule: Selection,
    relations: Sequence[Relation] = (),
    *,
    units: Mapping[str, str],
    provenance: Mapping[str, str],
    estimate: Estimate | None = None,
    progress: Progress = SILENT,
) -> Choice:
    """Score the candidates, select, and fit: refined, constrained, weighted or as they are.

    A rule that judges whole systems refines the winner. Under relations the combination of least
    summed score wins that has the terms, and all equations are fitted at once. estimate: of whose
    candidates the fronts are; where its own evidence selects, its model stands as it is.
    Raises ValueError for relations that no combination has the terms for.
    """
    library = fronts[0].problem.library
    if isinstance(rule, SystemSelection):
        decision = rule.decide(fronts, relations, progress=progress)
        best = [selected(*pair) for pair in zip(fronts, decision.scores, strict=True)]
        model = replace(decision.model, units=units, provenance=provenance)
        chosen = [_as_in(model, candidate) for candidate in best]
        return Choice(decision.scores, chosen, model, decision.note)
    with progress.stage(None, "", f"candidates by {rule.label}"):
        scores = rule.scores(fronts)
    if estimate is not None:
        best = [selected(*pair) for pair in zip(fronts, scores, strict=True)]
        chosen = [_as_in(estimate.model, candidate) for candidate in best]
        return Choice(scores, chosen, estimate.model, estimate.note)
    if relations:
        place = _least_sum(fronts, scores, relations)
        support = support_of(fronts, place)
        held = constraint(library, support, binding(relations, support) or ())
        problems = list(dict.fromkeys(front.problem for front in fronts))
        model = constrained_fit(problems, held, units=units, provenance=provenance)
        scores = [_won(s, int(k)) for s, k in zip(scores, place, strict=True)]
        best = [front.candidates[k] for front, k in zip(fronts, place, strict=True)]
        return Choice(scores, [_as_in(model, candidate) for candidate in best], model)
    best = [selected(*pair) for pair in zip(fronts, scores, strict=True)]
    chosen = [last_fit(*pair) for pair in zip(fronts, best, strict=True)]
    model = assemble_model(library, chosen, units=units, provenance=provenance)
    return Choice(scores, chosen, model)


def _least_sum(
    fronts: Sequence[ParetoFront],
    scores: Sequence[Float[np.ndarray, " _candidates"]],
    relations: Sequence[Relation],
) -> Int[np.ndarray, " fronts"]:
    """The combination of candidates of least summed score that has the relations' terms."""
    places = admissible(fronts, combinations(fronts, MOST_COMBINATIONS), relations)
    sums = np.sum([s[column] for s, column in zip(scores, places.T, strict=True)], axis=0)
    return places[int(np.argmin(sums))]


def _won(scores: Float[np.ndarray, " candidates"], winner: int) -> Float[np.ndarray, " candidates"]:
    """Scores with the winner's the least: what relations chose counts as selected."""
    won = scores.copy()
    won[winner] = min(won[winner], np.nextafter(won.min(), -np.inf))
    return won


def _as_in(model: SparseModel, candidate: Candidate) -> Candidate:
    """A candidate with its coefficients and their covariance as a model has them."""
    terms = model.terms(candidate.equation)
    coef = np.array([terms.get(name, 0.0) for name in candidate.terms])
    if model.covariance is None:
        return replace(candidate, coef=coef, covariance=None)
    equation = model.states.index(candidate.equation)
    places = np.argwhere(model.coef.T != 0.0)
    own = {model.library.names[j]: k for k, (i, j) in enumerate(places) if i == equation}
    covariance = np.zeros((len(coef), len(coef)))
    known = [k for k, name in enumerate(candidate.terms) if name in own]
    at = [own[candidate.terms[k]] for k in known]
    covariance[np.ix_(known, known)] = model.covariance[np.ix_(at, at)]
    return replace(candidate, coef=coef, covariance=covariance)


# Of a right equation chi-squared per row is 1, give or take a standard error, and a little more:
# the noise is estimated from the samples that it judges. Measured: 0.7 to 1.3 with 70 rows.
MOST_CHI_SQUARED, STANDARD_ERRORS = 1.2, 3.0

SMALLEST = np.finfo(np.float64).tiny  # an exact fit leaves nothing


def last_fit(front: ParetoFront, candidate: Candidate) -> Candidate:
    """A selected candidate as it goes into the model: weighted, where the noise is known."""
    return candidate if front.problem.noisy is None else reweighted(front.problem, candidate)


def judged(
    chosen: Sequence[Candidate], runs: Sequence[Trajectory], library: Library
) -> list[Candidate]:
    """Candidates with what their terms leave of the noise, also where their rows do not know it.

    Then weak rows of the same runs are asked; coefficients stay as they are. Where there are none,
    as of a record of a few samples, nothing is said.
    """
    unknown = [c for c in chosen if c.chi_squared is None]
    if not unknown or not runs:
        return list(chosen)
    try:
        # The same numbers as with all terms, at a fraction of their cost.
        used = np.isin(library.names, [name for c in unknown for name in c.terms])
        used[0] |= not used.any()  # a library needs a term
        form, rng = Weak(split=RandomSplit(0.0)), np.random.default_rng(0)
        rows = form.assemble(runs, library.take(used), rng=rng)
        found = {problem.equations[0]: problem for problem in rows}
        fitted = {c.equation: reweighted(found[c.equation], c) for c in unknown}
    except (ValueError, np.linalg.LinAlgError):
        return list(chosen)
    return [_as_judged(c, fitted.get(c.equation, c)) for c in chosen]


def _as_judged(candidate: Candidate, fitted: Candidate) -> Candidate:
    return replace(
        candidate,
        covariance=candidate.covariance if fitted.leaves_noise else None,
        chi_squared=fitted.chi_squared,
        autocorrelation=fitted.autocorrelation,
        leaves_noise=fitted.leaves_noise,
    )


def misfit_of(chosen: Sequence[Candidate]) -> str:
    """Which equations leave more than noise, in a sentence; empty where none does."""
    left = {c.equation: c.chi_squared for c in chosen if c.leaves_noise is False}
    if not left:
        return ""
    parts = ", ".join(f"{state}' ({value:.3g} times its size)" for state, value in left.items())
    return (
        f"no equation of this library leaves white noise of {parts}: intervals are not given; "
        "add terms or states, or judge the model by free run"
    )


def assemble_model(
    library: Library,
    candidates: Sequence[Candidate],
    *,
    units: Mapping[str, str],
    provenance: Mapping[str, str],
) -> SparseModel:
    """Join one candidate per equation into a model, as if errors of equations were independent."""
    blocks = [c.covariance for c in candidates if c.covariance is not None]
    return SparseModel(
        library=library,
        states=[c.equation for c in candidates],
        coef=coef_matrix(library, [c.coef_by_term for c in candidates]),
        units=units,
        provenance=provenance,
        covariance=block_diag(*blocks) if len(blocks) == len(candidates) else None,
    )


def reweighted(problem: RegressionRows, candidate: Candidate, *, n_steps: int = 8) -> Candidate:
    """Fit a candidate's terms again, with weights and corrected samples, and say how well.

    Returns it with new coefficients, their covariance, in SI, and chi-squared; its scores stay.
    What leaves more than the noise of its rows has no covariance: it would not hold the truth.
    """
    terms = np.isin(problem.term_names, candidate.terms)
    scale = problem.coef_scale(0)
    coef = np.zeros(len(terms))
    order = [problem.library.index(name) for name in candidate.terms]
    coef[order] = candidate.coef / scale[order]
    rows = whitened_rows(problem, terms, coef, n_steps=n_steps)
    theta = rows.theta[:, order]
    upper = np.linalg.qr(theta, mode="r")
    root = np.linalg.inv(upper) * scale[order, None]
    fitted = np.linalg.lstsq(theta, rows.target, rcond=None)[0]
    left = rows.target - theta @ fitted
    freedom = max(len(left) - len(order), 1)
    chi_squared = float(left @ left) / freedom
    leaves_noise = chi_squared <= MOST_CHI_SQUARED + STANDARD_ERRORS * np.sqrt(2.0 / freedom)
    return replace(
        candidate,
        coef=fitted * scale[order],
        covariance=root @ root.T if leaves_noise else None,
        chi_squared=chi_squared,
        autocorrelation=float(left[1:] @ left[:-1]) / max(float(left @ left), SMALLEST),
        leaves_noise=bool(leaves_noise),
    )
