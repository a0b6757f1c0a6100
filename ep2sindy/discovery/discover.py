"""The algorithm on one screen: trajectories and a library in, fronts and a model out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ep2sindy.data.coerce import Task
from ep2sindy.data.runs import Runs, trajectories_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import IdentifiedEquations, judge_noise
from ep2sindy.discovery.method import DiscoveryMethod, TrajectorySearch
from ep2sindy.discovery.result import Discovery
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import Relation, relations_of
from ep2sindy.library.roles import Roles
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.front import Candidate
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_kind


@one_thread()
def discover(
    runs: Runs,
    library: Library | None = None,
    method: DiscoveryMethod | None = None,
    *,
    t: object = None,
    inputs: Sequence[str] = (),
    relations: Sequence[Relation | str] = (),
    terms: Mapping[str, Sequence[str]] | None = None,
    roles: Roles | None = None,
    hidden: Sequence[str] = (),
    exclude: Mapping[str, Sequence[str]] | None = None,
    seed: int | np.random.Generator = 0,
    progress: Progress | bool = False,
) -> Discovery:
    """Find sparse equations for every state of the runs.

    The method makes candidates, chooses one per equation, and fits it: a `TrajectorySearch` by the
    likelihood of whole trajectories, a `Regression` by rows.
    runs: one run, or a list or dict of runs: Trajectory, DataFrame, Dataset, (t, x), or x with t,
    its times or its step in s; inputs: columns that are inputs; see `trajectories_of`. library:
    None means every product of the first run's variables and of hidden states up to degree 2.
    method: None means TrajectorySearch(), the best method we know for noisy data. relations:
    between coefficients, such as "x: x*y == -1 * y: x*y" or "x: y == 1"; they hold in the search,
    in the selection and in the model. terms: for each state whose equation is known but for its
    coefficients, all terms of that equation. roles: of terms, for equations that conserve what
    states exchange (`Roles`); for a `Regression` by FreeRunScore or RefinedScore. hidden: names of
    states that nobody measured; they and their equations are found with the others', by a
    `TrajectorySearch`. exclude: for each state that is named, terms of the library that its
    equation may not have, such as {"x": ["x^2"]}. progress: True shows bars.
    Raises ValueError for a relation, term or role that the library or the states do not have, roles
    that the method cannot keep, runs whose states or units differ, states or samples that repeat.
    """
    method = method or TrajectorySearch()
    trajectories = trajectories_of(runs, t=t, inputs=inputs, partial=True)
    names = dict.fromkeys([*trajectories[0].names, *hidden])
    library = polynomial(list(names)) if library is None else library
    check_kind("method", method, DiscoveryMethod, "ep.Regression(selection=ep.EBIC())")
    terms, exclude = ({} if given is None else given for given in (terms, exclude))
    task = Task(trajectories, library, relations_of(relations), terms, roles, hidden, exclude)
    rng, watch = np.random.default_rng(seed), as_progress(progress)
    return _discovery(method.identify(task, rng=rng, progress=watch), method, trajectories)


def _discovery(
    found: IdentifiedEquations, method: DiscoveryMethod, runs: Sequence[Trajectory]
) -> Discovery:
    test = judge_noise(found, runs)
    # Intervals of a model that does not explain the data would not cover the truth.
    model = replace(found.model, clock=runs[0].clock)
    return Discovery(
        fronts={front.equation: front for front in found.fronts},
        chosen={each.equation: _as_in(found.model, each) for each in found.chosen},
        model=replace(model, covariance=None) if test.misfit else model,
        method=method,
        ambiguities=found.ambiguities,
        noise_test=test,
        note=found.note or test.misfit,
        remarks=found.remarks,
        estimate=found.estimate,
        constraint=found.constraint,
        others=found.others,
    )


def _as_in(model: SparseModel, candidate: Candidate) -> Candidate:
    """A candidate with the coefficients that it has in a model."""
    terms = model.terms(candidate.equation)
    return replace(candidate, coef=np.array([terms.get(name, 0.0) for name in candidate.terms]))
