"""The algorithm on one screen: trajectories and a library in, fronts and a model out."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import Runs, trajectories_of
from ep2sindy.discovery.choice import NoiseTest, noise_test
from ep2sindy.discovery.method import DiscoveryMethod, Known, TrajectorySearch, check_kind, old_name
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import Relation, relations_of
from ep2sindy.model.display import model_html, model_lines
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.ambiguity import Ambiguity
from ep2sindy.regression.front import Candidate, ParetoFront
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.screen import N_LINES, one_screen
from ep2sindy.runtime.threads import one_thread

MAX_NOTES = 6  # on a screen


@dataclass(frozen=True, eq=False)
class Discovery:
    """What a search leaves: per state the candidates, and the model of those that were selected.

    fronts: by state, candidates with their scores, the lowest selected. chosen: by state, the
    selected one, with the coefficients that it has in the model: where the noise of the samples is
    followed into the rows, fitted again with weights. Their covariance is the model's.
    method: that it was found by. noise_test: what the model leaves of the noise.
    ambiguities: terms that these data cannot tell apart, and rows that are few for the terms.
    note: how a rule that judges whole systems of equations came to its model, how sure a search of
    trajectories is, or that a model leaves more than noise; else empty.
    remarks: what the samples show that is not as assumed, in sentences (`Estimate.remarks`).
    estimate: of states and coefficients together, where trajectories were searched.

    >>> run = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
    >>> found = ep.discover(run)
    >>> found.model.terms("x")
    {'x': 0.66..., 'x*y': -0.99...}
    >>> found.fronts["y"].candidates[2].terms
    ('y', 'x*y')
    """

    fronts: Mapping[str, ParetoFront] = field(repr=False)
    chosen: Mapping[str, Candidate]
    model: SparseModel = field(repr=False)
    method: DiscoveryMethod
    ambiguities: Sequence[Ambiguity]
    noise_test: NoiseTest = field(default_factory=NoiseTest)
    note: str = ""
    remarks: Sequence[str] = ()
    estimate: Estimate | None = field(default=None, repr=False)

    @property
    def scores(self) -> dict[str, Float[np.ndarray, " _candidates"]]:
        """By state, one per candidate of its front, the lowest selected."""
        return {state: front.scores for state, front in self.fronts.items()}

    @property
    def misfit(self) -> str:
        """Why the model does not explain the data as far as their noise; empty where it does, or
        where the noise is not followed into the rows."""
        return self.noise_test.misfit

    def __repr__(self) -> str:
        notes = [f"note: {each}" for each in self._notes()[:MAX_NOTES]]
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
        return f"Discovery of {len(self.chosen)} equations, chosen by {self.method.selection!r}"


@one_thread()
def discover(
    runs: Runs,
    library: Library | None = None,
    method: DiscoveryMethod | None = None,
    *,
    relations: Sequence[Relation | str] = (),
    terms: Mapping[str, Sequence[str]] | None = None,
    seed: int | np.random.Generator = 0,
    progress: Progress | bool = False,
    recipe: DiscoveryMethod | None = None,
) -> Discovery:
    """Find sparse equations for every state of the runs.

    The method makes candidates of the runs, chooses one per equation, and fits what it chose: a
    `TrajectorySearch` by the likelihood of whole trajectories, a `Regression` by rows.
    runs: one run or a list: Trajectory, DataFrame or (t, x), see `trajectories_of`.
    library: None means every product of the variables of the first run up to degree 2.
    method: None means TrajectorySearch(), the route for noisy data that we know to be best.
    relations: between coefficients, such as "x: x*y == -1 * y: x*y" or "x: y == 1"; they hold in
    the search, in the selection and in the model. terms: by state, all the terms of an equation
    that is known but for its coefficients. progress: True shows bars; see `Progress`.
    recipe: the old name of method, for one version more.
    Raises ValueError for a relation or a term that the library or the states do not have.
    """
    method = method or old_name(recipe) or TrajectorySearch()
    trajectories = trajectories_of(runs)
    library = polynomial(trajectories[0].names, degree=2) if library is None else library
    check_kind("library", library, Library, "ep.polynomial(['x', 'y'], degree=2)")
    check_kind("method", method, DiscoveryMethod, "ep.Regression(selection=ep.EBIC())")
    known = Known(relations_of(relations), terms or {})
    known.check(library, trajectories[0].state_names)
    rng, watch = np.random.default_rng(seed), as_progress(progress)
    found = method.identify(trajectories, library, known, rng=rng, progress=watch)
    choice = found.choice
    test = noise_test(choice.model, trajectories, left=choice.left, estimate=found.estimate)
    # Intervals of a model that leaves more of its rows than noise would not hold the truth.
    withheld = bool(test.left and test.misfit)
    return Discovery(
        fronts={front.equation: front for front in choice.fronts},
        chosen={each.equation: _as_in(choice.model, each) for each in choice.chosen},
        model=replace(choice.model, covariance=None) if withheld else choice.model,
        method=method,
        ambiguities=found.ambiguities,
        noise_test=test,
        note=choice.note or test.misfit,
        remarks=found.remarks,
        estimate=found.estimate,
    )


def _as_in(model: SparseModel, candidate: Candidate) -> Candidate:
    """A candidate with its coefficients as a model has them."""
    terms = model.terms(candidate.equation)
    return replace(candidate, coef=np.array([terms.get(name, 0.0) for name in candidate.terms]))
