"""The search of a pointwise study at one point: by its method, or compiled with the same results.

The compiled way serves what studies usually ask. What depends on the times alone -- filter, split
and draws -- is made once for all points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from ep2sindy.data.coerce import Task
from ep2sindy.data.numbers import LEAST
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.method import Regression, SearchedEquation
from ep2sindy.discovery.point_kernels import (
    add_steps,
    alike,
    best_of_sizes,
    count_terms,
    differentiate,
    fill_rows,
    fill_running_sums,
    fit_best,
    fit_draws,
    gram,
    smooth,
    supports_of_draws,
)
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, Relation, constraint, relations_of
from ep2sindy.model.scores import r2
from ep2sindy.regression.ambiguity import SAME, row_limit, simplest_first
from ep2sindy.regression.constrained import constrained_draws
from ep2sindy.regression.differential import Differential
from ep2sindy.regression.front import REFINED, front_order
from ep2sindy.regression.gram_kernels import all_usable
from ep2sindy.regression.row_kernels import fill_products, scale_draws
from ep2sindy.regression.searches import MOST_WORK, BestSubset
from ep2sindy.runtime.values import check_kind, check_list
from ep2sindy.selection.criteria import EBIC, Fits, Knee
from ep2sindy.signals.smoothers import NoSmoothing, SavitzkyGolay, Smoother, difference
from ep2sindy.signals.spectrum import is_uniform

MOST_TERMS = 30  # beyond, the arithmetic outweighs the calls of NumPy

# Correlation of two states from which on they may be the same, which takes a closer look.
CLOSE = 0.99

# Sums over draws are made from running sums if this many weights come to one change of a weight.
FEW_STEPS = 8


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
    found = constrained_draws(problems, draws, held)
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


class Draws(NamedTuple):
    """The weight of every training row in every bootstrap, and the terms that were not culled.

    weights: (rows, draws). steps: (draws, rows + 1), where weights change: that of the row before,
    less that of the row. n_drawn: (draws,), sums of weights. kept: (draws, terms).
    """

    weights: Float[np.ndarray, "rows draws"]
    steps: csr_array
    n_drawn: Float[np.ndarray, " draws"]
    kept: Bool[np.ndarray, "draws terms"]


@dataclass(frozen=True, eq=False)
class CompiledPoints:
    """Search, selection and fits at points that share their times, as `Regression` makes them.

    Results agree with those of `Regression` to rounding. Made by `compiled_points`.
    """

    search: PointSearch
    rule: Knee | EBIC
    max_terms: int
    smooth_library: bool
    filter: Filter
    train: Int[np.ndarray, " train"]
    test: Int[np.ndarray, " test"]
    draws: Draws

    def at(self, values: Float[np.ndarray, "variables samples"]) -> dict[str, np.ndarray] | None:
        """Results at a point; None where its samples are special, and `Regression` must look.

        Special are states that may repeat each other, terms that cannot be told apart, values
        that overflow or underflow, and supports that are not proven best.
        """
        levels = np.abs(values).max(axis=1)
        n_states, n_terms = len(self.search.states), len(self.search.library)
        if ((levels > 0.0) & (levels < LEAST)).any() or alike(values[:n_states], CLOSE):
            return None
        rows = self._rows(values)
        if not (np.isfinite(rows.judge).all() and all_usable(rows.gram, self._simplest, SAME)):
            return None
        grams = self._grams(rows)
        codes = np.empty((n_states, len(grams.xx), n_terms + 1), dtype=np.int64)
        largest = row_limit(n_terms, len(self.train))
        if not supports_of_draws(*grams[:3], largest, self.max_terms, MOST_WORK, codes):
            return None
        fits = self._fits(rows, codes)
        sizes = [self._select(fits, e) for e in range(n_states)]
        return self._point(rows, grams, codes, fits, sizes)

    def _rows(self, values: Float[np.ndarray, "variables samples"]) -> PointRows:
        """Scaled rows at a point, and their Gram matrices."""
        n_states, library = len(self.search.states), self.search.library
        known = np.empty((len(values) + 1, values.shape[1]))
        rates = np.empty_like(values[:n_states])
        smooth(values, *self.filter.smoothing, known[:-1])
        differentiate(known[:n_states], self.filter.difference, rates)
        known[-1] = 1.0
        if not self.smooth_library:
            known[:-1] = values
        n_columns = len(library) + n_states
        train, scale = np.empty((n_columns, len(self.train))), np.empty(n_columns)
        test = np.empty((n_columns, len(self.test)))
        fill_rows(known, self._table, rates, self.train, self.test, train, test, scale)
        grams = np.empty((2, n_columns, n_columns))
        gram(train, grams[0])
        gram(test if len(self.test) else train, grams[1])
        return PointRows(train, test, scale, *grams)

    def _grams(self, rows: PointRows) -> DrawnGrams:
        """Gram matrices of all draws."""
        n_columns, n_rows = rows.train.shape
        n_pairs, (n_draws, n_terms) = n_columns * (n_columns + 1) // 2, self.draws.kept.shape
        steps = self.draws.steps
        if FEW_STEPS * steps.nnz < self.draws.weights.size:
            sums, running = np.empty((n_draws, n_pairs)), np.empty((n_rows + 1, n_pairs))
            means = rows.gram[self._pairs] / n_rows
            fill_running_sums(rows.train, means, running)
            places = steps.indptr, steps.indices, steps.data
            add_steps(*places, running, means, self.draws.n_drawn, sums)
        else:
            products = np.empty((n_pairs, n_rows))
            fill_products(rows.train, 0, n_rows, products)
            sums = np.ascontiguousarray((products @ self.draws.weights).T)
        n_equations = n_columns - n_terms
        found = DrawnGrams(
            xx=np.empty((n_draws, n_terms, n_terms)),
            xy=np.empty((n_draws, n_equations, n_terms)),
            yy=np.empty((n_draws, n_equations)),
            scale=np.empty((n_draws, n_terms)),
        )
        scale_draws(sums, self.draws.kept, *found)
        return found

    def _fits(self, rows: PointRows, codes: Int[np.ndarray, "equations draws sizes"]) -> SizeFits:
        """The best support of every size on all training rows."""
        n_equations, _, n_sizes = codes.shape
        shape = (n_equations, n_sizes)
        best = np.full(shape, -1)
        best_of_sizes(codes, rows.gram, rows.judge, best)
        fits = SizeFits(best, np.empty((*shape, n_sizes - 1)), *np.full((3, *shape), np.nan))
        fit_best(best, rows.gram, rows.train, rows.test, REFINED, *fits[1:])
        return fits

    def _select(self, fits: SizeFits, equation: int) -> int:
        """Size that the rule selects from the front of one equation."""
        library = self.search.library
        sizes = np.flatnonzero(fits.best[equation] >= 0)
        r2 = (fits.r2_test if len(self.test) else fits.r2_train)[equation]
        sizes = sizes[front_order(sizes, -r2[sizes], depth=1)]
        codes = fits.best[equation, sizes].tolist()
        candidates = Fits(
            library=library,
            terms=[[n for j, n in enumerate(library.names) if code >> j & 1] for code in codes],
            errors=1.0 - r2[sizes],
            squares=fits.squares[equation, sizes],
            n_rows=len(self.train),
        )
        return int(sizes[np.argmin(self.rule.score(candidates))])

    def _point(
        self,
        rows: PointRows,
        grams: DrawnGrams,
        codes: Int[np.ndarray, "equations draws sizes"],
        fits: SizeFits,
        sizes: list[int],
    ) -> dict[str, np.ndarray]:
        """Results of the selected sizes, as named in `pointwise`."""
        chosen = np.arange(len(sizes)), np.array(sizes)
        n_terms = len(self.search.library)
        scaled, draws = fits.coef[chosen], np.empty((len(grams.xx), len(sizes), n_terms))
        fit_draws(codes, fits.best[chosen], grams.xx, grams.xy, grams.scale, draws)
        inclusion = np.empty((*fits.best.shape, n_terms))
        count_terms(codes, self.draws.kept, inclusion)
        factor = rows.scale[n_terms:, None] / rows.scale[:n_terms]
        return {
            "coef": scaled * factor,
            "inclusion": inclusion[chosen],
            "weight": shares(scaled),
            "coef_draws": draws * factor,
            "weight_draws": shares(draws),
            "r2_train": fits.r2_train[chosen],
            "r2_test": fits.r2_test[chosen],
            "n_terms": chosen[1].astype(np.float64),
        }

    @cached_property
    def _table(self) -> Int[np.ndarray, "terms degree"]:
        return self.search.library.over(self.search.variables).table

    @cached_property
    def _pairs(self) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
        return np.triu_indices(len(self.search.library) + len(self.search.states))

    @cached_property
    def _simplest(self) -> Int[np.ndarray, " terms"]:
        return simplest_first(self.search.library)


class PointRows(NamedTuple):
    """Scaled rows of a point, terms and then targets, (columns, rows), and their Gram matrices.

    judge: of the held-out rows, or of the training rows if none are held out.
    """

    train: Float[np.ndarray, "columns train"]
    test: Float[np.ndarray, "columns test"]
    scale: Float[np.ndarray, " columns"]
    gram: Float[np.ndarray, "columns columns"]
    judge: Float[np.ndarray, "columns columns"]


class DrawnGrams(NamedTuple):
    """Gram matrices of all draws, as in `Resamples`."""

    xx: Float[np.ndarray, "draws terms terms"]
    xy: Float[np.ndarray, "draws equations terms"]
    yy: Float[np.ndarray, "draws equations"]
    scale: Float[np.ndarray, "draws terms"]


class SizeFits(NamedTuple):
    """For every equation, the best support of each size, as a code, and its fit."""

    best: Int[np.ndarray, "equations sizes"]
    coef: Float[np.ndarray, "equations sizes terms"]
    squares: Float[np.ndarray, "equations sizes"]
    r2_train: Float[np.ndarray, "equations sizes"]
    r2_test: Float[np.ndarray, "equations sizes"]


class Filter(NamedTuple):
    """Weights of samples in the smoothed ones, and of these in the derivatives.

    smoothing: at the first samples, in the middle and at the last ones; see `smooth`.
    difference: (3, samples); see `differentiate`.
    """

    smoothing: tuple[np.ndarray, np.ndarray, np.ndarray]
    difference: Float[np.ndarray, "3 samples"]


def compiled_points(search: PointSearch, t: Float[np.ndarray, " samples"]) -> CompiledPoints | None:
    """The compiled search, or None for settings and times that it does not serve."""
    method, library = search.method, search.library
    form, proposer, rule = method.formulation, method.search, method.selection
    if library.functions or len(library) > MOST_TERMS or method.depth > 1 or search.relations:
        return None
    if not isinstance(form, Differential) or not isinstance(rule, Knee | EBIC):
        return None
    if not isinstance(proposer, BestSubset) or proposer.n_best > 1:
        return None
    rng, all_terms = np.random.default_rng(search.seed), np.ones(len(library), dtype=np.bool_)
    try:
        if not is_uniform(t):
            return None
        test = form.split.held_out(len(t), rng)
        weights, kept = method.bootstraps.draw_groups(int((~test).sum()), all_terms, rng)
        weights_in_time = _filter(form.smoother, t)
    except ValueError:  # which `Regression` explains at every point
        return None
    if weights_in_time is None:
        return None
    padded = np.pad(weights, ((0, 0), (1, 1)))
    weights_of_rows = np.ascontiguousarray(weights.T)
    draws = Draws(
        weights_of_rows, csr_array(padded[:, :-1] - padded[:, 1:]), weights.sum(axis=1), kept
    )
    rows = np.flatnonzero(~test), np.flatnonzero(test)
    return CompiledPoints(
        search, rule, proposer.max_terms, form.smooth_library, weights_in_time, *rows, draws
    )


def _filter(smoother: Smoother, t: Float[np.ndarray, " samples"]) -> Filter | None:
    """Weights of a smoother and of second-order differences, read off their action on a window.

    None for a smoother that sees more than a window. Raises ValueError for too few samples.
    """
    if not isinstance(smoother, SavitzkyGolay | NoSmoothing):
        return None
    width = smoother.window if isinstance(smoother, SavitzkyGolay) else 1
    half = width // 2
    smoother.smooth(t, np.zeros((len(t), 1)))
    window = smoother.smooth(t[:width], np.eye(width))
    # Of three combs, each with every third sample, one holds each neighbour of a sample.
    combs = np.arange(len(t))[:, None] % 3 == np.arange(3)
    response = difference(t, combs.astype(np.float64))
    left = np.clip(np.arange(len(t)) - 1, 0, len(t) - 3)
    weights = np.take_along_axis(response, (left[:, None] + np.arange(3)) % 3, axis=1)
    return Filter(
        (window[:half].copy(), window[half].copy(), window[half + 1 :].copy()),
        np.ascontiguousarray(weights.T),
    )
