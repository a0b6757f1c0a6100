"""Shared search: one support for all operating points, with free coefficients at each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.coerce import Task
from ep2sindy.data.trajectory import Trajectory, check_agreement
from ep2sindy.discovery.choice import assemble_model, fit_last
from ep2sindy.discovery.method import Regression
from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.ambiguity import Ambiguity, ambiguities, usable_terms
from ep2sindy.regression.front import ParetoFront, errors_of, fit_supports, order_front
from ep2sindy.regression.gram_kernels import ROUNDING, independent_terms
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.progress import Progress, as_progress, count_pieces
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_kind
from ep2sindy.selection.criteria import EBIC, Selection


@dataclass(frozen=True, eq=False)
class SharedFront:
    """The best supports of every size for one equation at all points, the empty one first.

    errors: (supports,), geometric mean over the points of 1 - R2 (on held-out rows, if any); the
    best falls with size. points: point -> the fit of every support there, in the same order. A term
    that is zero at a point, or depends on earlier ones there, is left out of that point's fit.
    """

    equation: str
    supports: Sequence[tuple[str, ...]]
    errors: Float[np.ndarray, " supports"]
    points: Mapping[str, ParetoFront]


@dataclass(frozen=True, eq=False)
class SharedDiscovery:
    """Result of a shared search: fronts, scores and supports by state, and models by point.

    scores: for each state, one per support, summed over the points; the lowest is chosen.
    ambiguities: for each point, terms that its data cannot tell apart.
    """

    fronts: Mapping[str, SharedFront] = field(repr=False)
    scores: Mapping[str, Float[np.ndarray, " supports"]] = field(repr=False)
    chosen: Mapping[str, tuple[str, ...]]
    models: Mapping[str, SparseModel] = field(repr=False)
    ambiguities: Mapping[str, Sequence[Ambiguity]] = field(repr=False)


@one_thread()
def discover_shared(
    points: Mapping[str, Sequence[Trajectory]],
    library: Library,
    method: Regression | None = None,
    *,
    seed: int | np.random.Generator = 0,
    progress: Progress | bool = False,
) -> SharedDiscovery:
    """Find equations whose terms are the same at every operating point, with free coefficients.

    The rows of each point are assembled separately, with its own sampling, noise and scale. The
    search finds the supports whose product of residuals over the points is least: a term is in or
    out everywhere. The method's rule scores the fits at each point, and the scores are added: for
    EBIC the sum is the criterion of the joint likelihood, with the number of supports
    counted once. A term may vanish at some points, if it shows at others. For a single point the
    result is that of `discover` by the same `Regression`.
    points: name -> trajectories. Points are assembled in the order of their names. method: None
    means Regression().
    Raises ValueError for a search that cannot serve several points, bootstraps (not available for
    several points), no point, points whose states, variables or units differ, or runs of one point
    that share samples.
    Source of the idea, for thresholding: Rudy et al. 2019, doi:10.1137/18M1191944.
    """
    method = method or Regression()
    check_kind("method", method, Regression, "ep.Regression(search=ep.BestSubset())")
    search = _search_of(method)
    _check_points(points, library)
    tasks = {point: Task(runs, library) for point, runs in points.items()}
    rng = np.random.default_rng(seed)
    watch = as_progress(progress)
    problems = {
        p: method.formulation.assemble(points[p], library, rng=rng)
        for p in count_pieces(watch, sorted(points), "point", "rows of the regression")
    }
    fronts = _shared_fronts(problems, search, method.depth, watch)
    scores = _summed_scores(list(fronts.values()), method.selection, tasks)
    best = {state: int(np.argmin(each)) for state, each in zip(fronts, scores, strict=True)}
    provenance = method.provenance | {"joint": ", ".join(points)}
    del provenance["bootstraps"]
    return SharedDiscovery(
        fronts=fronts,
        scores=dict(zip(fronts, scores, strict=True)),
        chosen={state: front.supports[best[state]] for state, front in fronts.items()},
        models=_models(points, library, fronts, best, provenance),
        ambiguities={
            point: tuple(dict.fromkeys(a for part in problems[point] for a in ambiguities(part)))
            for point in points
        },
    )


def _shared_fronts(
    problems: Mapping[str, Sequence[RegressionRows]],
    search: BestSubset,
    depth: int,
    progress: Progress,
) -> dict[str, SharedFront]:
    """Shared search for every equation. problems: for each point, of the same structure."""
    equations = [
        (k, equation)
        for k, problem in enumerate(next(iter(problems.values())))
        for equation in problem.equations
    ]
    return {
        equation: _shared_front(
            {p: parts[k] for p, parts in problems.items()}, equation, search, depth
        )
        for k, equation in count_pieces(progress, equations, "equation", "search of all points")
    }


def _search_of(method: Regression) -> BestSubset:
    """The method's search, if it can weigh all points at once."""
    if not isinstance(method.search, BestSubset):
        raise ValueError(
            f"a shared search must weigh all points at once: {method.search} cannot; use BestSubset"
        )
    if method.bootstraps.n:
        raise ValueError(
            f"a shared search has no bootstraps: {method.bootstraps} came; use Bootstraps(n=0)"
        )
    return method.search


def _models(
    points: Mapping[str, Sequence[Trajectory]],
    library: Library,
    fronts: Mapping[str, SharedFront],
    best: Mapping[str, int],
    provenance: Mapping[str, str],
) -> dict[str, SparseModel]:
    """For each point, the best supports with the point's own coefficients."""
    return {
        point: assemble_model(
            library,
            [
                fit_last(front.points[point], front.points[point].candidates[best[state]])
                for state, front in fronts.items()
            ],
            units=runs[0].units,
            provenance={**provenance, "point": point},
        )
        for point, runs in points.items()
    }


def _check_points(points: Mapping[str, Sequence[Trajectory]], library: Library) -> None:
    if not points or not all(points.values()):
        empty = [point for point, runs in points.items() if not runs]
        raise ValueError(
            "a shared search needs operating points with a trajectory each: "
            + (f"{empty} came without" if empty else "no point came")
        )
    first, reference = next((point, runs[0]) for point, runs in points.items())
    for point, runs in points.items():
        try:
            check_agreement([reference, *runs], library.variables)
        except ValueError as error:
            raise ValueError(
                f"points must agree: {point!r} does not with trajectory 0 of {first!r}: {error}"
            ) from error


def _shared_front(
    problems: Mapping[str, RegressionRows], equation: str, search: BestSubset, depth: int
) -> SharedFront:
    """Search the Gram matrices of all points at once, and fit the supports at each point."""
    any_problem = next(iter(problems.values()))
    k = any_problem.equations.index(equation)
    grams = [problem.train_gram for problem in problems.values()]
    # A term that repeats another at one point may stand for it there, if they differ elsewhere.
    usable = np.any([usable_terms(problem) for problem in problems.values()], axis=0)
    masks = search.shared_supports(
        np.stack([gram.xx * usable[:, None] * usable for gram in grams]),
        np.stack([gram.xy[k] * usable for gram in grams]),
        np.array([gram.yy[k] for gram in grams]),
    )
    fits = {
        p: fit_supports(each, equation, _keep_determined(each, masks))
        for p, each in problems.items()
    }
    by_point = [errors_of(fits[p]) for p in problems]
    errors = np.exp(np.log(np.maximum(by_point, ROUNDING)).mean(axis=0))
    order = order_front(masks.sum(axis=1), errors, depth=depth)
    names = np.array(any_problem.library.names)
    return SharedFront(
        equation=equation,
        supports=tuple(tuple(names[mask].tolist()) for mask in masks[order]),
        errors=errors[order],
        points={
            p: ParetoFront(equation, [fits[p][i] for i in order], each)
            for p, each in problems.items()
        },
    )


def _keep_determined(
    problem: RegressionRows, masks: Bool[np.ndarray, "supports terms"]
) -> Bool[np.ndarray, "supports terms"]:
    """Terms of each support that the rows of one point determine, earlier terms first."""
    found = masks.copy()
    for mask in found:
        columns = np.flatnonzero(mask)
        mask[columns] = independent_terms(problem.train_gram.xx[np.ix_(columns, columns)])
    return found


def _summed_scores(
    fronts: Sequence[SharedFront],
    selection: Selection,
    tasks: Mapping[str, Task],
) -> list[Float[np.ndarray, " supports"]]:
    rule = selection.shared_by(len(tasks)) if isinstance(selection, EBIC) else selection
    by_point = [
        rule.decide([front.points[p] for front in fronts], task).scores for p, task in tasks.items()
    ]
    return [np.sum(scores, axis=0) for scores in zip(*by_point, strict=True)]
