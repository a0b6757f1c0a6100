"""The choice: one candidate per front as a recipe's rule has it, fitted as the model needs it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.constraints.fit import constrained_fit
from ep2sindy.constraints.relations import Relation, constraint
from ep2sindy.constraints.support import binding
from ep2sindy.discovery.last_fit import assemble_model, last_fit
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.model.model import SparseModel
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
