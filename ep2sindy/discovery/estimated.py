"""Fronts of a search that estimates states and coefficients together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.recipe import Asked, Recipe
from ep2sindy.estimation.estimate import Estimate, Weighed, estimate
from ep2sindy.estimation.solver import Joint
from ep2sindy.library.library import Library
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.search.front import Candidate, ParetoFront, fit_supports


def estimated(
    runs: Sequence[Trajectory],
    library: Library,
    recipe: Recipe,
    asked: Asked,
    *,
    rng: np.random.Generator,
    progress: Progress = SILENT,
) -> tuple[Estimate, dict[str, ParetoFront]]:
    """The estimate, and by state its front: R2 of its candidates is that of the recipe's rows."""
    assert isinstance(recipe.search, Joint)
    found = estimate(
        runs,
        library,
        recipe.search,
        relations=asked.relations,
        terms=asked.terms,
        units=runs[0].units,
        provenance=recipe.provenance | {"trajectories": ", ".join(run.label for run in runs)},
        progress=progress,
    )
    with progress.stage(None, "", "rows of the regression"):
        problems = recipe.formulation.assemble(runs, library, rng=rng)
    fronts = {
        state: _front(problem, state, found.weighed[state], recipe.depth)
        for problem in problems
        for state in problem.equations
    }
    return found, fronts


def _front(
    problem: RegressionRows, state: str, weighed: Sequence[Weighed], depth: int
) -> ParetoFront:
    """The likeliest `depth` candidates of every size, the empty one first."""
    kept = [w for k, w in enumerate(weighed) if _rank(weighed, k) < depth or w.deviance == 0.0]
    if not kept or kept[0].coef:
        kept = [Weighed({}, float("inf")), *kept]
    masks = np.array([np.isin(problem.term_names, list(w.coef)) for w in kept])
    rows = fit_supports(problem, state, masks)
    return ParetoFront(state, [_candidate(*pair) for pair in zip(rows, kept, strict=True)], problem)


def _rank(weighed: Sequence[Weighed], k: int) -> int:
    """How many of its size come before one; they are sorted."""
    return sum(len(w.coef) == len(weighed[k].coef) for w in weighed[:k])


def _candidate(row: Candidate, weighed: Weighed) -> Candidate:
    coef = np.array([weighed.coef[name] for name in row.terms])
    return replace(row, coef=coef, deviance=weighed.deviance)
