"""Shared search: one support for all operating points, with free coefficients at each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.discovery.method import Regression
from ep2sindy.regression.ambiguity import usable_terms
from ep2sindy.regression.front import ParetoFront, errors_of, fit_supports, order_front
from ep2sindy.regression.gram_kernels import ROUNDING, independent_terms
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.progress import Progress, count_pieces
from ep2sindy.selection.criteria import EBIC

Problems = Mapping[str, Sequence[RegressionRows]]  # point -> rows of every equation


@dataclass(frozen=True, eq=False)
class SharedFront:
    """The best supports of every size for one equation at all points, the empty one first.

    points: point -> the fit of every support there, in the same order, with the scores that are
    summed over the points; the lowest is chosen. A term that is zero at a point, or depends on
    earlier ones there, is left out of that point's fit.
    """

    equation: str
    supports: Sequence[tuple[str, ...]]
    points: Mapping[str, ParetoFront]

    @property
    def chosen(self) -> tuple[str, ...]:
        front = next(iter(self.points.values()))
        return self.supports[int(np.argmin(front.scores))]

    def with_scores(self, scores: Float[np.ndarray, " supports"]) -> SharedFront:
        points = {point: front.with_scores(scores) for point, front in self.points.items()}
        return replace(self, points=points)


def check_shared(method: Regression) -> BestSubset:
    """The method's search. Raises ValueError for a method that cannot weigh all points at once."""
    if not isinstance(method.search, BestSubset):
        raise ValueError(
            f"a shared search must weigh all points at once: {method.search} cannot; use BestSubset"
        )
    if method.bootstraps.n:
        raise ValueError(
            f"a shared search has no bootstraps, got {method.bootstraps}; use Bootstraps(n=0)"
        )
    return method.search


def search_shared(
    problems: Problems, task: DiscoveryProblem, method: Regression, *, progress: Progress
) -> list[SharedFront]:
    """Find the supports whose terms are the same at every operating point, for every equation.

    The supports minimise the product of the points' residuals: a term is in or out everywhere. The
    method's rule scores the fits at each point, and the scores are added: for EBIC the sum is the
    criterion of the joint likelihood, with the number of supports counted once. A term may vanish
    at some points, if it shows at others.
    problems: rows of each point. task: of the runs of all points, whose relations, terms and
    excluded terms the supports keep.
    Raises ValueError for a method that cannot weigh all points at once.
    Source of the idea, for thresholding: Rudy et al. 2019, doi:10.1137/18M1191944.
    """
    search = check_shared(method)
    equations = [
        (k, equation)
        for k, problem in enumerate(next(iter(problems.values())))
        for equation in problem.equations
    ]
    fronts = [
        _shared_front(
            {p: parts[k] for p, parts in problems.items()}, equation, search, method, task
        )
        for k, equation in count_pieces(progress, equations, "equation", "search of all points")
    ]
    rule, nothing = method.selection, np.zeros((1, len(task.library)), dtype=np.bool_)
    rule = rule.shared_by(len(problems)) if isinstance(rule, EBIC) else rule
    by_point = [rule.decide([front.points[p] for front in fronts], task).scores for p in problems]
    scored = []
    for front, own in zip(fronts, zip(*by_point, strict=True), strict=True):
        scores = np.sum(own, axis=0)
        (kept,) = task.complete(front.equation, [nothing])
        if kept.any(axis=1).all():  # what is known puts terms into every support
            scores[0] = np.inf
        scored.append(front.with_scores(scores))
    return scored


def _shared_front(
    problems: Mapping[str, RegressionRows],
    equation: str,
    search: BestSubset,
    method: Regression,
    task: DiscoveryProblem,
) -> SharedFront:
    """Search the Gram matrices of all points at once, and fit the supports at each point."""
    any_problem = next(iter(problems.values()))
    k = any_problem.equations.index(equation)
    grams = [problem.train_gram for problem in problems.values()]
    # A term that repeats another at one point may stand for it there, if they differ elsewhere.
    usable = np.any([usable_terms(problem) for problem in problems.values()], axis=0)
    usable &= task.library.allowed(equation)
    nothing = found = np.zeros((1, len(usable)), dtype=np.bool_)
    if equation not in task.facts.only:
        found = search.shared_supports(
            np.stack([gram.xx * usable[:, None] * usable for gram in grams]),
            np.stack([gram.xy[k] * usable for gram in grams]),
            np.array([gram.yy[k] for gram in grams]),
        )
    (masks,) = task.complete(equation, [found])
    masks = np.unique(np.concatenate([nothing, masks]), axis=0)  # a front begins with nothing
    fits = {
        p: fit_supports(each, equation, _keep_determined(each, masks))
        for p, each in problems.items()
    }
    by_point = [errors_of(fits[p]) for p in problems]
    errors = np.exp(np.log(np.maximum(by_point, ROUNDING)).mean(axis=0))
    order = order_front(masks.sum(axis=1), errors, depth=method.depth)
    names = np.array(any_problem.library.names)
    return SharedFront(
        equation=equation,
        supports=tuple(tuple(names[mask].tolist()) for mask in masks[order]),
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
