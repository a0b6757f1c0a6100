"""Several libraries on the same data: what each finds, and how its model runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import compress

import numpy as np
import pandas as pd
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import Discovery, discover
from ep2sindy.discovery.last_fit import assemble_model
from ep2sindy.discovery.recipe import Recipe
from ep2sindy.library.equations import equation_text
from ep2sindy.library.library import Library
from ep2sindy.model.integrated import Integrated, integrate, samples_in
from ep2sindy.regression.ambiguity import usable_terms
from ep2sindy.search.front import Candidate, ParetoFront, fit_support
from ep2sindy.selection.rule import Selection, selected


@dataclass(frozen=True)
class LibraryCase:
    """One library, the rule that selects from its fronts, and published equations if any.

    published: state -> term -> SI coefficient; where the library has its terms, and the data can
    tell them from others, they are fitted as well.
    """

    library: Library
    selection: Selection
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class LibraryResult:
    """One library's discovery and its selected model; the published terms, fitted to our data."""

    case: LibraryCase
    discovery: Discovery
    selected: Integrated
    refitted: Mapping[str, Candidate]
    published: Integrated | None


def compare_libraries(
    run: Trajectory,
    cases: Mapping[str, LibraryCase],
    *,
    recipe: Recipe,
    rollout_s: float | None,
    rng: np.random.Generator,
) -> dict[str, LibraryResult]:
    """Discover a model with every library and integrate it from the first sample.

    Each case draws from its own stream, so that adding a case changes no other.
    rollout_s: how far to integrate; None, or more than there is, means to the data's end.
    """
    n_samples = run.n_samples if rollout_s is None else samples_in(run, rollout_s)
    results = {}
    for (name, case), stream in zip(cases.items(), rng.spawn(len(cases)), strict=True):
        how = replace(recipe, selection=case.selection)
        discovery = discover(run, case.library, how, seed=stream)
        refitted = _refitted(discovery, case.published)
        results[name] = LibraryResult(
            case=case,
            discovery=discovery,
            selected=integrate(discovery.model, run, n_samples),
            refitted=refitted,
            published=_integrate_refitted(discovery, refitted, run, n_samples),
        )
    return results


def _refitted(
    discovery: Discovery, published: Mapping[str, Mapping[str, float]]
) -> dict[str, Candidate]:
    """Published terms fitted to our rows, where the data can tell them from others."""
    found = {}
    for state, terms in published.items():
        if state in discovery.fronts:
            problem = discovery.fronts[state].problem
            at_hand = set(compress(problem.term_names, usable_terms(problem)))
            if set(terms) <= at_hand:
                found[state] = fit_support(problem, state, list(terms))
    return found


def _integrate_refitted(
    discovery: Discovery, refitted: Mapping[str, Candidate], run: Trajectory, n_samples: int
) -> Integrated | None:
    if set(refitted) != set(run.state_names):
        return None
    model = assemble_model(
        discovery.model.library,
        [refitted[state] for state in run.state_names],
        units=run.units,
        provenance={**discovery.model.provenance, "search": "published terms, refitted"},
    )
    return integrate(model, run, n_samples)


def front_table(
    front: ParetoFront, scores: Float[np.ndarray, " candidates"], *, label: str
) -> pd.DataFrame:
    """A front as the thesis's Tables I-III: one row per candidate, with its equation.

    scores: one per candidate, the lowest selected, in a column called `label`.
    """
    chosen = selected(front, scores)
    return pd.DataFrame(
        {
            "equation": front.equation,
            "n_terms": [c.n_terms for c in front.candidates],
            "r2_test": [c.r2_test for c in front.candidates],
            "r2_train": [c.r2_train for c in front.candidates],
            label: scores,
            "share": [c.share for c in front.candidates],
            "selected": [c is chosen for c in front.candidates],
            "text": [candidate_text(c) for c in front.candidates],
        }
    )


def candidate_text(candidate: Candidate) -> str:
    """`n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n`."""
    return equation_text(candidate.equation, candidate.coef_by_term)
