"""The algorithm on one screen: trajectories and a library in, fronts and a model out."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import Runs, Task, trajectories_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import NoiseTest, noise_test
from ep2sindy.discovery.method import (
    DiscoveryMethod,
    IdentifiedEquations,
    TrajectorySearch,
    method_given,
)
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import Constraint, Relation, relations_of
from ep2sindy.library.roles import Roles
from ep2sindy.model.display import model_html, model_lines
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.ambiguity import Ambiguity
from ep2sindy.regression.front import Candidate, ParetoFront
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.screen import N_LINES, one_screen
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_kind

MAX_NOTES = 6  # shown in the repr


@dataclass(frozen=True, eq=False)
class Discovery:
    """Result of a discovery: the candidates of every state, and the model of the selected ones.

    fronts: for each state, candidates with their scores, the lowest selected. chosen: for each
    state, the selected candidate with its coefficients in the model. If the noise of the samples is
    propagated into the rows, these come from a weighted refit. Their covariance is in the model.
    method: that found the model. noise_test: test of the residuals against the noise.
    ambiguities: terms that these data cannot tell apart, and warnings of too few rows for the
    terms. note: how a rule for whole systems decided, how certain a trajectory search is, or that
    the residuals exceed the noise; else empty. remarks: sentences on where the samples deviate from
    the assumptions (`Estimate.remarks`). estimate: of states and coefficients together, after a
    trajectory search. constraint: that the model's coefficients obey under relations or roles, to
    be handed to `refine`; None without.

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
    constraint: Constraint | None = field(default=None, repr=False)

    @property
    def scores(self) -> dict[str, Float[np.ndarray, " _candidates"]]:
        """For each state, one score per candidate of its front, the lowest selected."""
        return {state: front.scores for state, front in self.fronts.items()}

    @property
    def misfit(self) -> str:
        """The reason why the model does not explain the data to within their noise.

        Empty if it does, or if the model was not tested: `noise_test.tested` is then False.
        """
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
    roles: Roles | None = None,
    hidden: Sequence[str] = (),
    seed: int | np.random.Generator = 0,
    progress: Progress | bool = False,
    recipe: DiscoveryMethod | None = None,
) -> Discovery:
    """Find sparse equations for every state of the runs.

    The method makes candidates, chooses one per equation, and fits it: a `TrajectorySearch` by the
    likelihood of whole trajectories, a `Regression` by rows.
    runs: one run or a list: Trajectory, DataFrame or (t, x), see `trajectories_of`. library: None
    means every product of the first run's variables and of hidden states up to degree 2. method:
    None means TrajectorySearch(), the best method we know for noisy data. relations: between
    coefficients, such as "x: x*y == -1 * y: x*y" or "x: y == 1"; they hold in the search, in the
    selection and in the model. terms: for each state whose equation is known but for its
    coefficients, all terms of that equation. roles: of terms, for equations that conserve what
    states exchange (`Roles`); for a `Regression` by FreeRunScore or RefinedScore. hidden: names of
    states that nobody measured; they and their equations are found with the others', by a
    `TrajectorySearch`. progress: True shows bars. recipe: the old name of method, for one more
    version.
    Raises ValueError for a relation, term or role that the library or the states do not have, roles
    that the method cannot keep, runs whose states or units differ, states or samples that repeat.
    """
    method = method_given(method, recipe) or TrajectorySearch()
    trajectories = trajectories_of(runs, partial=True)
    names = dict.fromkeys([*trajectories[0].names, *hidden])
    library = polynomial(list(names)) if library is None else library
    check_kind("method", method, DiscoveryMethod, "ep.Regression(selection=ep.EBIC())")
    task = Task(trajectories, library, relations_of(relations), terms or {}, roles, hidden)
    rng, watch = np.random.default_rng(seed), as_progress(progress)
    return _discovery(method.identify(task, rng=rng, progress=watch), method, trajectories)


def _discovery(
    found: IdentifiedEquations, method: DiscoveryMethod, runs: Sequence[Trajectory]
) -> Discovery:
    choice = found.choice
    test = noise_test(choice, runs, estimate=found.estimate)
    # If residuals of its rows exceed the noise, intervals would not cover the truth.
    withheld = bool(choice.left is not None and test.left and test.misfit)
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
        constraint=choice.constraint,
    )


def _as_in(model: SparseModel, candidate: Candidate) -> Candidate:
    """A candidate with the coefficients that it has in a model."""
    terms = model.terms(candidate.equation)
    return replace(candidate, coef=np.array([terms.get(name, 0.0) for name in candidate.terms]))
