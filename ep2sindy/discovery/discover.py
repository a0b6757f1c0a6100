"""The algorithm on one screen: trajectories and a library in, fronts and a model out."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.constraints.relations import Relation, relations_of
from ep2sindy.data.given import Runs, trajectories_of
from ep2sindy.data.repeats import check_repeats
from ep2sindy.data.sensor import bounds_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import Choice, choose, judged, misfit_of
from ep2sindy.discovery.estimated import estimated
from ep2sindy.discovery.recipe import Asked, Recipe, check_asked, check_kind
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.estimation.solver import Joint
from ep2sindy.library.library import Library, polynomial
from ep2sindy.model.display import model_html, model_lines
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.ambiguity import Ambiguity, ambiguities, few_rows
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.screen import N_LINES, one_screen
from ep2sindy.runtime.threads import one_thread
from ep2sindy.search.front import Candidate, ParetoFront
from ep2sindy.selection.rule import SystemSelection

MOST_NOTES = 6  # on a screen


@dataclass(frozen=True, eq=False)
class Discovery:
    """What a search leaves: per state a front, scores and the last fit of what was selected.

    scores: by state, one per candidate of its front, the lowest selected.
    chosen: by state, the selected candidate as it stands in the model: where the noise of the
    samples is followed into the rows, fitted again with weights, with its covariance.
    ambiguities: terms that these data cannot tell apart, and rows that are few for the terms.
    note: how a rule that judges whole systems of equations came to its model, how sure a joint
    search is, or that a model leaves more than noise; else empty.
    remarks: what the samples show that is not as assumed, in sentences (`Estimate.remarks`).
    estimate: of states and coefficients together, where the search was joint.

    >>> run = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
    >>> found = ep.discover(run)
    >>> found.model.terms("x")
    {'x': 0.66..., 'x*y': -0.99...}
    >>> found.fronts["y"].candidates[2].terms
    ('y', 'x*y')
    """

    fronts: Mapping[str, ParetoFront] = field(repr=False)
    scores: Mapping[str, Float[np.ndarray, " _candidates"]] = field(repr=False)
    chosen: Mapping[str, Candidate]
    model: SparseModel = field(repr=False)
    ambiguities: Sequence[Ambiguity]
    note: str = ""
    remarks: Sequence[str] = ()
    estimate: Estimate | None = field(default=None, repr=False)

    @property
    def misfit(self) -> str:
        """Why the model does not explain the data as far as their noise; empty where it does, or
        where the noise is not followed into the rows."""
        return (
            misfit_of(list(self.chosen.values())) if self.estimate is None else self.estimate.misfit
        )

    def __repr__(self) -> str:
        notes = [f"note: {each}" for each in self._notes()[:MOST_NOTES]]
        left = len(self._notes()) - len(notes)
        tail = [*notes, *([f"... {left} more notes"] if left else [])]
        head = [self._headline(), *([self.note] if self.note else [])]
        body = model_lines(self.model, n_lines=N_LINES - len(head) - len(tail))
        return one_screen([*head, *body, *tail])

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{html.escape(each)}</li>" for each in self._notes())
        lines = [self._headline(), *([self.note] if self.note else [])]
        head = "".join(f"<div>{html.escape(line)}</div>" for line in lines)
        return head + model_html(self.model) + (f"<ul>{notes}</ul>" if notes else "")

    def _notes(self) -> list[str]:
        return [*self.remarks, *(each.message for each in self.ambiguities)]

    def _headline(self) -> str:
        rule = self.model.provenance.get("selection", "a rule unknown")
        return f"Discovery of {len(self.chosen)} equations, chosen by {rule}"


@one_thread()
def discover(
    runs: Runs,
    library: Library | None = None,
    recipe: Recipe | None = None,
    *,
    relations: Sequence[Relation | str] = (),
    terms: Mapping[str, Sequence[str]] | None = None,
    seed: int | np.random.Generator = 0,
    progress: Progress | bool = False,
) -> Discovery:
    """Find sparse equations for every state of the runs.

    The recipe's formulation assembles rows; its search proposes supports in every bootstrap; each
    support is fitted to all training rows, and the best of every size make the front; its rule
    selects one per equation. Where the noise of the samples is followed into the rows, selected
    terms are fitted again with weights. A `Joint` search does without rows.
    runs: one run or a list: Trajectory, DataFrame or (t, x), see `trajectories_of`.
    library: None means every product of the variables of the first run up to degree 2.
    recipe: None means Recipe(), the route for noisy data that we know to be best.
    relations: between coefficients, such as "x: x*y == -1 * y: x*y" or "x: y == 1"; they hold in
    the search, in the selection and in the model. terms: by state, all the terms of an equation
    that is known but for its coefficients. progress: True shows bars; see `Progress`.
    Raises ValueError for a relation or a term that the library or the states do not have.
    """
    trajectories = trajectories_of(runs)
    library = polynomial(trajectories[0].names, degree=2) if library is None else library
    recipe = Recipe() if recipe is None else recipe
    check_kind("library", library, Library, "ep.polynomial(['x', 'y'], degree=2)")
    check_kind("recipe", recipe, Recipe, "ep.Recipe(selection=ep.EBIC())")
    asked = Asked(relations_of(relations), terms or {})
    check_asked(asked, library, trajectories[0].state_names)
    watch = as_progress(progress)
    estimate, fronts = _searched(trajectories, library, recipe, asked, seed, watch)
    choice = choose(
        list(fronts.values()), recipe.selection, asked.relations, units=trajectories[0].units,
        provenance=recipe.provenance | {"trajectories": ", ".join(r.label for r in trajectories)},
        estimate=estimate, progress=watch,
    )  # fmt: skip
    choice = _judged(choice, trajectories, library, recipe)
    return Discovery(
        fronts=fronts,
        scores=dict(zip(fronts, choice.scores, strict=True)),
        chosen=dict(zip(fronts, choice.chosen, strict=True)),
        model=choice.model,
        ambiguities=_findings([front.problem for front in fronts.values()], recipe, asked),
        note=choice.note,
        remarks=_limits(trajectories) if estimate is None else estimate.remarks,
        estimate=estimate,
    )


def _judged(choice: Choice, runs: Sequence[Trajectory], library: Library, recipe: Recipe) -> Choice:
    """A choice among rows that says what it leaves of the noise, without intervals where that is
    more than noise. Estimates, and rules that judge whole systems, have judged by then."""
    if isinstance(recipe.search, Joint) or isinstance(recipe.selection, SystemSelection):
        return choice
    chosen = judged(choice.chosen, runs, library)
    misfit = misfit_of(chosen)
    model = replace(choice.model, covariance=None) if misfit else choice.model
    return replace(choice, chosen=chosen, model=model, note=choice.note or misfit)


def _limits(runs: Sequence[Trajectory]) -> tuple[str, ...]:
    """What is said of clipped or rounded samples where rows are regressed on them."""
    found = [bounds_of(run.states, run.state_names) for run in runs]
    words = dict.fromkeys(each for bounds in found if bounds for each in bounds.words)
    way_out = "rows take them for values; Recipe(search=Joint()) reads them as limits"
    return tuple(f"{each}: {way_out}" for each in words)


def _findings(
    problems: Sequence[RegressionRows], recipe: Recipe, asked: Asked
) -> tuple[Ambiguity, ...]:
    """What is to be said of the rows, each once; those of a joint search hold nothing down."""
    found: list[Ambiguity] = []
    for problem in problems:
        if not isinstance(recipe.search, Joint) and not set(problem.equations) <= set(asked.terms):
            found += few_rows(problem)
        found += ambiguities(problem)
    return tuple(dict.fromkeys(found))


def _searched(
    runs: Sequence[Trajectory],
    library: Library,
    recipe: Recipe,
    asked: Asked,
    seed: int | np.random.Generator,
    progress: Progress,
) -> tuple[Estimate | None, dict[str, ParetoFront]]:
    """Fronts by state, and the estimate that they come from, if any."""
    rng = np.random.default_rng(seed)
    if isinstance(recipe.search, Joint):
        return estimated(runs, library, recipe, asked, rng=rng, progress=progress)
    check_repeats(runs)
    equations = recipe.searched(runs, library, asked, rng=rng, progress=progress)
    return None, {equation.front.equation: equation.front for equation in equations}
