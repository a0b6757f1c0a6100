"""The search of a pointwise study at one point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.coerce import Task
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.method import Regression, SearchedEquation
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, Relation, constraint, relations_of
from ep2sindy.model.scores import r2
from ep2sindy.regression.constrained import fit_draws
from ep2sindy.runtime.values import check_kind, check_list

# Dimensions of every result, followed by those of space.
LAYOUT: Mapping[str, tuple[str, ...]] = {
    "coef": ("equation", "term"),
    "inclusion": ("equation", "term"),
    "weight": ("equation", "term"),
    "coef_draws": ("draw", "equation", "term"),
    "weight_draws": ("draw", "equation", "term"),
    "r2_train": ("equation",),
    "r2_test": ("equation",),
    "n_terms": ("equation",),
}


@dataclass(frozen=True, eq=False)
class PointSearch:
    """Settings of the search at every point, whose spread is taken over the bootstraps.

    relations: between coefficients, such as "n_i: S == -1 * n_n: S" for ionization S, which makes
    of a neutral an ion; the same at every point.
    least_variation: standard deviation of every state, as a share of its root mean square, below
    which a point counts as having no dynamics. seed: every point has the same split and the same
    draws, so that results differ by place alone.
    """

    states: Sequence[str]
    library: Library
    method: Regression
    least_variation: float = 1e-3
    seed: int = 0
    relations: Sequence[Relation | str] = ()

    def __post_init__(self) -> None:
        check_list("states", self.states)
        check_kind("library", self.library, Library, "ep.polynomial(['x', 'y'], degree=2)")
        object.__setattr__(self, "states", tuple(self.states))
        if not 0.0 <= self.least_variation < 1.0:
            raise ValueError(
                f"least_variation must lie in [0, 1): {self.least_variation} came; it is a share"
            )
        check_kind("method", self.method, Regression, "ep.Regression(bootstraps=ep.Bootstraps())")
        if not (n := self.method.bootstraps.n):
            raise ValueError(f"a pointwise study needs bootstraps for its spread: n={n} came")
        object.__setattr__(self, "relations", relations_of(self.relations))
        every_term = dict.fromkeys(self.states, self.library.names)
        constraint(self.library, every_term, self.relations)  # refuses those that cannot hold
        if self.relations and (n_culled := self.method.bootstraps.n_culled):
            raise ValueError(
                "relations need all their terms in every bootstrap: n_culled must be 0, "
                f"{n_culled} came"
            )

    @cached_property
    def variables(self) -> tuple[str, ...]:
        """States, then the other variables that the library needs."""
        others = (v for v in self.library.variables if v not in self.states)
        return (*self.states, *others)


def nothing(search: PointSearch) -> dict[str, np.ndarray]:
    sizes = (search.method.bootstraps.n, len(search.states), len(search.library))
    first = {"draw": 0, "equation": 1, "term": 2}
    return {name: np.full([sizes[first[d]] for d in dims], np.nan) for name, dims in LAYOUT.items()}


def search_point(run: Trajectory, search: PointSearch) -> dict[str, np.ndarray]:
    """Search, select and fit at one point, and the spread over the bootstraps."""
    rng = np.random.default_rng(search.seed)
    task = Task([run], search.library, relations_of(search.relations))
    equations = search.method.search_equations(task, rng=rng)
    fronts = [equation.front for equation in equations]
    choice = search.method.choose(fronts, task)
    point = nothing(search)
    for row, (equation, chosen) in enumerate(zip(equations, choice.chosen, strict=True)):
        problem = equation.front.rows
        mask: Bool[np.ndarray, " terms"] = np.isin(search.library.names, chosen.terms)
        point["coef"][row] = choice.model.coef[:, row]
        point["inclusion"][row] = equation.supports.inclusion[chosen.n_terms]
        point["weight"][row] = shares(point["coef"][row] * problem.theta_scale)
        fits = equation.draws.fits(equation.number, equation.found, mask)
        point["coef_draws"][:, row] = problem.coef_SI(fits, equation.number)
        point["weight_draws"][:, row] = shares(fits)
        point["r2_train"][row], point["r2_test"][row] = chosen.r2_train, chosen.r2_test
        point["n_terms"][row] = chosen.n_terms
    return point if choice.constraint is None else _constrained(point, equations, choice.constraint)


def _constrained(
    point: Mapping[str, np.ndarray], equations: Sequence[SearchedEquation], held: Constraint
) -> dict[str, np.ndarray]:
    """A point's results with draws and R2 of coefficients that obey the constraint."""
    problems = list(dict.fromkeys(equation.front.rows for equation in equations))
    draws = {equation.front.equation: equation.draws for equation in equations}
    found = fit_draws(problems, draws, held)
    drawn, weights = np.zeros((2, *point["coef_draws"].shape))
    scores = np.full((2, len(equations)), np.nan)
    for row, equation in enumerate(equations):
        problem, target = equation.front.rows, equation.front.rows.target[:, equation.number]
        for k, (state, term) in enumerate(held.coefficients):
            if state == equation.front.equation:
                drawn[:, row, problem.library.index(term)] = found[:, k]
        weights[:, row] = shares(drawn[:, row] * problem.theta_scale)
        for held_out in sorted({False, bool(problem.test.any())}):
            at = problem.test == held_out
            fitted = problem.theta[at] @ point["coef"][row]
            scores[int(held_out), row] = r2(truth=target[at], prediction=fitted[None])[0]
    return {
        **point, "coef_draws": drawn, "weight_draws": weights,
        "r2_train": scores[0], "r2_test": scores[1],
    }  # fmt: skip


def shares(contributions: Float[np.ndarray, "*draws terms"]) -> Float[np.ndarray, "*draws terms"]:
    """Each term's part in the sum of absolute values, with its sign; zeros if all are zero."""
    total = np.abs(contributions).sum(axis=-1, keepdims=True)
    return contributions / np.where(total > 0.0, total, 1.0)
