"""The algorithm on one screen: trajectories and a library in, fronts and a model out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, count, islice
from typing import TYPE_CHECKING

import numpy as np

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.runs import Runs, trajectories_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import assess_noise
from ep2sindy.discovery.method import TrajectorySearch, of_means
from ep2sindy.discovery.result import Discovery, DiscoveryMethod, join_points
from ep2sindy.library.library import Library, polynomial
from ep2sindy.operating.law import LawFunctions
from ep2sindy.operating.records import group_by_point, values_of
from ep2sindy.runtime.parallel import SURROUNDING, Workers, collect
from ep2sindy.runtime.progress import SILENT, Progress, as_progress
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_count, check_kind
from ep2sindy.signals.signal import average_long

if TYPE_CHECKING:
    from ep2sindy.discovery.several_points import LawSearch

    AnyLaw = LawFunctions | Sequence[LawFunctions] | LawSearch


@one_thread()
def discover(
    runs: Runs,
    library: Library | None = None,
    method: DiscoveryMethod | None = None,
    *,
    law: AnyLaw | None = None,
    shared: bool = False,
    hidden: Sequence[str] | int = (),
    t: object = None,
    inputs: Sequence[str] = (),
    decimate: int | str | None = "auto",
    seed: int | np.random.Generator = 0,
    workers: Workers | None = None,
    progress: Progress | bool = False,
) -> Discovery:
    """Find sparse equations for every state of the runs.

    The method proposes candidate equations, selects one per state and fits it: a `TrajectorySearch`
    by the likelihood of whole trajectories, a `Regression` by rows.

    Runs whose `parameters` differ come from several operating points. Each point is then searched
    independently, by the workers, and `points` of the result holds what was found there. `shared`
    and `law` connect the points: structures are found for all of them, by rows, and under roles by
    free runs at every point as well; a `TrajectorySearch` then refines the coefficients of every
    point on its trajectories. A law is fitted to windows of all records at once, and rests where a
    record is quiet. `law_choice` of the result holds its runs at points left out.

    Parameters
    ----------
    runs : run, or list or dict of runs
        A run is a Trajectory, a DataFrame with times, a Dataset, a tuple (t, x), or an array x with
        `t`. The keys of a dict are the runs' labels.
    library : Library, optional
        Candidate terms, with what is known of the equations (`Library.relate`, `only`, `exclude`,
        `known`, `with_roles`). None takes every product of the first run's variables and of the
        hidden states up to degree 2.
    method : DiscoveryMethod, optional
        None takes `TrajectorySearch()`, the best method that we know for noisy data.
    law : int, Library, "auto", list of these or LawSearch, optional
        Finds one structure whose coefficients are functions of the parameters: polynomials of this
        degree; those of a library such as `ep.named_terms(["V"], ["1", "1/V"])`; or with "auto"
        those, made of each parameter p, p^2 and 1/p, whose law errs least at points left out. From
        a list one is chosen. `ep.discovery.LawSearch` sets the windows of the refinements, too.
    shared : bool, default False
        True finds one support for all points, with separate coefficients at each.
    hidden : sequence of str or int, default ()
        Names of states that nobody measured, or their number, for states h, or h1, h2, ... They and
        their equations are found together with the others, by a `TrajectorySearch`.
    t : array_like or float, optional
        Times in s of runs without times, or their time step in s.
    inputs : sequence of str, default ()
        Names of the columns of a table that are inputs and not states.
    decimate : int, "auto" or None, default "auto"
        Number of samples that are replaced by their mean. "auto" leaves a hundred samples per
        period if the records hold over 20,000 samples together, and reports it. None takes all
        samples.
    seed : int or Generator, default 0
        Of all random choices, such as splits and bootstraps.
    workers : Workers, optional
        How operating points are computed (`ep.parallel`). By default as a surrounding
        `joblib.parallel_config` says, and one after the other without it.
    progress : Progress or bool, default False
        True shows progress bars.

    Returns
    -------
    Discovery
        The selected equations, all candidates with their scores, and warnings.

    Raises
    ------
    ValueError
        If a fact of the library names an unknown state, the method cannot respect the roles, states
        or units differ between runs, states or samples repeat, runs lack parameters, or there are
        too few points for the law.

    Notes
    -----
    The searches state what they minimise: see `TrajectorySearch`, `BestSubset`, `AdaptiveLasso` and
    `STLSQ`. Assumes that the equations are x' = sum_j c_j theta_j(x, u), with all their terms in
    the library.

    Examples
    --------
    >>> run = ep.lotka_volterra(a=0.7).trajectory(noise=0.02, rng=0)
    >>> print(ep.discover(run, method=ep.Regression()).model.text(digits=1))
    x' = 0.7 x - 1 x y
    y' = -0.3 y + 1 x y

    With a law, the coefficients become functions of the operating point.

    >>> from dataclasses import replace
    >>> growth = (0.5, 0.8, 1.1)
    >>> runs = [ep.lotka_volterra(a=a).trajectory(noise=0.02, rng=0) for a in growth]
    >>> runs = [replace(run, parameters={"a": a}) for run, a in zip(runs, growth)]
    >>> found = ep.discover(runs, method=ep.Regression(), law=1)
    >>> found.law.at(a=0.7).terms("x")
    {'x': 0.699..., 'x*y': -1.000...}
    """
    method = method or TrajectorySearch()
    trajectories = trajectories_of(runs, t=t, inputs=inputs, partial=True)
    trajectories, averaged = average_long(trajectories, decimate)
    if averaged and isinstance(method, TrajectorySearch):
        method = of_means(method)
    names = trajectories[0].names
    hidden = _hidden_names(hidden, names)
    library = polynomial(list(dict.fromkeys([*names, *hidden]))) if library is None else library
    check_kind("method", method, DiscoveryMethod, "ep.Regression(selection=ep.EBIC())")
    task = DiscoveryProblem(trajectories, library, hidden)
    rng, watch = np.random.default_rng(seed), as_progress(progress)
    if shared or law is not None:
        found = _discover_together(task, method, law, workers or SURROUNDING, rng, watch)
    elif all(run.parameters == task.runs[0].parameters for run in task.runs):
        found = _discover_point((task, rng), method=method, progress=watch)
    else:
        points = _points_of(task)
        streams, search = rng.spawn(len(points)), partial(_discover_point, method=method)
        pairs = zip(points.values(), streams, strict=True)
        pieces = [(replace(task, runs=own), stream) for own, stream in pairs]
        stage = watch.stage(len(pieces), "point", "discovery")
        apart = collect(workers or SURROUNDING, search, pieces, stage)
        found = join_points(dict(zip(points, apart, strict=True)), values_of(points))
    return replace(found, data_warnings=(*found.data_warnings, *averaged))


def _hidden_names(hidden: Sequence[str] | int, taken: Sequence[str]) -> Sequence[str]:
    """Names of hidden states: those given, or of a number of them h, or h1, h2, ..."""
    if not isinstance(hidden, int):
        return hidden
    n = check_count("hidden", hidden, 0)
    names = chain(["h"] * (n == 1), map("h{}".format, count(1)))
    return list(islice((name for name in names if name not in taken), n))


def _points_of(task: DiscoveryProblem) -> Mapping[str, Sequence[Trajectory]]:
    """The runs of every operating point, by its label."""
    return group_by_point(task.runs, [v for v in task.library.variables if v not in task.hidden])


def _discover_together(
    task: DiscoveryProblem,
    method: DiscoveryMethod,
    law: AnyLaw | None,
    workers: Workers,
    rng: np.random.Generator,
    progress: Progress,
) -> Discovery:
    """One structure for all points, and the law of its coefficients if one is asked for."""
    # This loads torch, only for a law or a structure of several operating points.
    from ep2sindy.discovery.several_points import LawSearch, discover_together

    asked = law if law is None or isinstance(law, LawSearch) else LawSearch(law)
    return discover_together(
        task, _points_of(task), method, asked, workers=workers, rng=rng, progress=progress
    )


def _discover_point(
    piece: tuple[DiscoveryProblem, np.random.Generator],
    *,
    method: DiscoveryMethod,
    progress: Progress = SILENT,
) -> Discovery:
    task, rng = piece
    task = replace(task, library=task.at_point) if task.facts.roles else task
    found = method.identify(task, rng=rng, progress=progress)
    test = assess_noise(found, task.runs)
    # Intervals of a model that does not explain the data would not cover the truth.
    covariance = None if test.lack_of_fit else found.model.covariance
    model = replace(found.model, clock=task.runs[0].clock, covariance=covariance)
    note = "; ".join(filter(None, [test.note, found.note or test.lack_of_fit]))
    records = task.runs if found.estimate is None else found.estimate.runs
    return replace(found, model=model, method=method, noise_test=test, note=note, records=records)
