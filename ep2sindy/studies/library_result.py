"""What one library finds, and how its model runs beside a published one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import Discovery, discover
from ep2sindy.discovery.method import AnyMethod, Regression
from ep2sindy.library.library import Library
from ep2sindy.machine.progress import SILENT, Progress
from ep2sindy.model.free_run import FreeRun, free_run, samples_in
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.ambiguity import usable_terms
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.search.front import Candidate, fit_support
from ep2sindy.studies.held_out import first_and_last
from ep2sindy.studies.living import Living, LivingSearch, living_model
from ep2sindy.studies.term_roles import Compared, Roles, term_roles


@dataclass(frozen=True, eq=False)
class LibraryResult:
    """One library's discovery and its selected model; the published terms, fitted to our data.

    given: the published terms as printed, by state. living: a model that lives on its own; None
    where it was not asked for, or the library has inputs. roles: of its terms. elsewhere: the
    selected model over the records beside the first.
    """

    recipe: AnyMethod
    discovery: Discovery
    selected: FreeRun
    given: Mapping[str, Mapping[str, float]]
    refitted: Mapping[str, Candidate]
    published: FreeRun | None
    living: Living | None = None
    roles: Roles | None = None
    elsewhere: Sequence[FreeRun] = ()


def result_of(
    runs: Sequence[Trajectory],
    library: Library,
    recipe: AnyMethod,
    rows: Regression,
    published: Mapping[str, Mapping[str, float]],
    rollout_s: float | None,
    living: LivingSearch | None = None,
    held_out: float = 0.25,
    compared: Compared | None = None,
    length_m: float | None = None,
    *,
    rng: np.random.Generator,
    progress: Progress = SILENT,
) -> LibraryResult:
    """What one library finds in all records, and how its model and the published one run.

    They run over the first record, the model over the others as well; a model that lives is
    searched in the first. rows: whose formulation and bootstraps serve where the recipe has none.
    """
    first, *others = [
        (run, run.n_samples if rollout_s is None else samples_in(run, rollout_s)) for run in runs
    ]
    data, n_samples = first
    found = discover(list(runs), library, recipe, seed=rng, progress=progress)
    refitted = _refitted(found, published, rows, runs, rng)
    lives = roles = None
    if living is not None and not found.model.inputs:
        parts = first_and_last(data, held_out)
        lives = living_model(*parts, library, rows, living, found.model, rng=rng, progress=progress)
        if compared is not None:
            roles = term_roles(
                lives.discovery, data, *parts, compared, living.bounds,
                length_m=length_m, progress=progress,
            )  # fmt: skip
    with progress.stage(None, "", "free runs"):
        return LibraryResult(
            recipe=recipe,
            discovery=found,
            selected=free_run(found.model, data, n_samples=n_samples),
            given=published,
            refitted=refitted,
            published=_run_refitted(found, refitted, data, n_samples),
            living=lives,
            roles=roles,
            elsewhere=[free_run(found.model, run, n_samples=n) for run, n in others],
        )


def _refitted(
    found: Discovery,
    published: Mapping[str, Mapping[str, float]],
    rows: Regression,
    runs: Sequence[Trajectory],
    rng: np.random.Generator,
) -> dict[str, Candidate]:
    """Published terms fitted to our rows, where the data can tell them from others."""
    fits = {}
    problems = _rows_of(found, rows, runs, rng) if published else {}
    for state, terms in published.items():
        if state in found.fronts:
            problem = problems[state]
            at_hand = set(compress(problem.term_names, usable_terms(problem)))
            if set(terms) <= at_hand:
                fits[state] = fit_support(problem, state, list(terms))
    return fits


def _rows_of(
    found: Discovery, rows: Regression, runs: Sequence[Trajectory], rng: np.random.Generator
) -> dict[str, RegressionRows]:
    """By state the rows that were searched; of a search of trajectories, rows for a fit."""
    fronts = found.fronts.values()
    if known := {front.equation: front.problem for front in fronts if front.problem is not None}:
        return known
    problems = rows.formulation.assemble(runs, found.model.library, rng=rng)
    return {state: problem for problem in problems for state in problem.equations}


def _run_refitted(
    found: Discovery, refitted: Mapping[str, Candidate], data: Trajectory, n_samples: int
) -> FreeRun | None:
    if set(refitted) != set(data.state_names):
        return None
    coef = [refitted[state].coef_by_term for state in data.state_names]
    model = SparseModel(
        library=found.model.library,
        states=data.state_names,
        coef=coef_matrix(found.model.library, coef),
        units=data.units,
        provenance={**found.model.provenance, "search": "published terms, refitted"},
    )
    return free_run(model, data, n_samples=n_samples)
