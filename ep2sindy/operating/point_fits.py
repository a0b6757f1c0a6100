"""One structure fitted to every operating point alone, and the law through these fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, product

import numpy as np
from jaxtyping import Float
from numpy.linalg import norm

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.library.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.law import LawConstraint, LawFunctions, OperatingLaw, make_basis
from ep2sindy.operating.quiet import QuietPoint, pool_quiet
from ep2sindy.refinement.assess import RefinementStatus
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.refinement.refine import Refinement, refine
from ep2sindy.regression.constrained import (
    ConstrainedSolution,
    read_coefficients,
    solve_constrained,
)
from ep2sindy.regression.pooled import (
    Rows,
    fewest_of_least,
    invert_covariance,
    residuals_left_out,
    root_of,
)
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.runtime.parallel import SURROUNDING, Workers, collect
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.signals.spectrum import dominant_frequency

Problems = Sequence[Sequence[RegressionRows]]  # for each point, the rows of every equation

# Of refinements whose coefficients tell nothing.
FAILED = (RefinementStatus.NON_FINITE, RefinementStatus.FLAT, RefinementStatus.MAX_ITER)

# Rows depend on each other over a cycle, which repeats itself: blocks of intervals hold two.
BLOCK_PERIODS = 2.0

MANY = 3  # parameters up to which all combinations of their functions are tried


@dataclass(frozen=True, eq=False)
class PointFits:
    """One structure fitted to every operating point alone, by rows or by trajectories.

    A law z(p) = W f(p) of the free coefficients minimises the sum over the points p of

        d_p^T I_p d_p  with  d_p = W f(p) - z_p

    where z_p are the point's own coefficients and I_p is their information: of rows it is
    theta_p^T theta_p, so that this is least squares over the rows of all points, and of
    trajectories the inverse covariance of the refinement. Directions that a point does not
    determine leave the law free there. Every I_p is scaled so that all points weigh alike, whatever
    the noise of their records.
    Assumes that one law holds at all points. At quiet points, of which nothing was fitted, every
    law rests as their records do (`pool_quiet`).
    points: (points, parameters). relations: that hold at every point. models: one per point.
    information: of the free coefficients, in SI; zero of a fit that failed. how: "rows" or
    "trajectories". statuses, losses: of the refinement at each point; empty for rows. rows: R_p and
    y_p of |R_p W f(p) - y_p|^2, if the law was fitted to all points at once (`follow_windows`);
    None takes those of the sum above.
    """

    parameters: tuple[str, ...]
    points: Float[np.ndarray, "points parameters"]
    relations: LawConstraint
    models: Sequence[SparseModel]
    information: Float[np.ndarray, "points free free"]
    how: str
    statuses: Sequence[str] = ()
    losses: Sequence[float] = ()
    rows: Rows | None = None
    quiet: Sequence[QuietPoint] = ()

    @property
    def n_free(self) -> int:
        """Number of coefficients that the relations leave free."""
        return len(self.relations.common.free)

    @cached_property
    def coefficients(self) -> Float[np.ndarray, "points free"]:
        """The free coefficients of each point."""
        common = self.relations.common
        return np.array([read_coefficients(model, common) for model in self.models])[:, common.free]

    def candidates(self, law: LawFunctions | Sequence[LawFunctions]) -> list[Library]:
        """Functions of the parameters that a law may be made of, the likeliest first.

        "auto" takes those that records often need: of every parameter p it is p and, or not, p^2
        and 1/p, or all products up to degree 2. Of several laws that of fewest functions comes
        first, of those whose `rate_errors` cannot be told from the least; then the best of every
        larger size.
        Raises ValueError if the points do not suffice for any of several.
        """
        if isinstance(law, int):
            return [polynomial(list(self.parameters), degree=law)]
        if isinstance(law, Library):
            return [law]
        tested, reasons = [], []
        for one in usual_functions(self.parameters) if isinstance(law, str) else law:
            try:
                functions = self.functions(one)
                tested.append((functions, self.rate_errors(functions)))
            except ValueError as error:  # too few points
                reasons.append(str(error))
        if not tested:
            raise ValueError([*reasons, "law=[...] must name degrees or functions"][0])
        place = fewest_of_least([(errors, len(own)) for own, errors in tested])
        found = [tested.pop(place)[0]]
        for own, _ in sorted(tested, key=lambda one: (len(one[0]), float(one[1].mean()))):
            if len(own) > len(found[-1]):
                found.append(own)
        return found

    def functions(self, law: LawFunctions | Sequence[LawFunctions]) -> Library:
        """The likeliest functions of a law; see `candidates`."""
        return self.candidates(law)[0]

    def columns(self, functions: Library) -> Float[np.ndarray, "points variables"]:
        """The parameters of the points in the order of the functions' variables."""
        if unknown := [v for v in functions.variables if v not in self.parameters]:
            raise ValueError(f"a law's functions must be of {list(self.parameters)}, got {unknown}")
        return self.points[:, [self.parameters.index(v) for v in functions.variables]]

    def law(self, functions: Library) -> OperatingLaw:
        """The law of all points, with its errors at points left out one at a time.

        Its covariance is the jackknife's: how far the law moves if a point is left out. It holds
        the noise of the records, and that coefficients are not exactly of this form. Both are None
        if the points do not suffice for a law without each of them.
        Source: Efron & Stein 1981, doi:10.1214/aos/1176345462, for the jackknife.
        """
        law, n = self.law_without(None, functions), len(self.models)
        with suppress(ValueError):  # too few points to leave one out
            errors = self.rate_errors(functions)
            apart = np.stack([self.law_without(k, functions).coef.ravel() for k in range(n)])
            apart -= apart[0]  # so that what is known is known exactly
            apart -= apart.mean(axis=0)
            law = replace(law, covariance=(n - 1) / n * apart.T @ apart, left_out=errors)
        return law

    def law_without(self, number: int | None, functions: Library) -> OperatingLaw:
        """The law of all points but one, or of all, without covariance."""
        free, points = self.pool(functions, without=number), self.columns(functions)
        points = points if number is None else np.delete(points, number, axis=0)
        return self.relations.make_law(self.models[0], functions, points, free, how=self.how)

    def rate_errors(self, functions: Library) -> Float[np.ndarray, " points"]:
        """Error at each point of the law of the others, as a fraction of the point's rates.

        With z_p and I_p of the point, and d_p what the law of the others misses z_p by, it is
        sqrt(d_p^T I_p d_p / z_p^T I_p z_p): for rows, the root mean square error of the rates by
        that of the rates. It counts only what the record determines. A point whose fit failed
        counts as missed whole.
        Raises ValueError if the points do not suffice for a law without each of them.
        """
        basis = make_basis(functions, self.columns(functions), n_spare=1)
        missed = residuals_left_out(self._rows, basis, self.size)
        if self.quiet:
            missed = [
                y - theta @ self.pool(functions, without=k) @ basis.values[k]
                for k, (theta, y) in enumerate(self._rows)
            ]
        pairs = zip(missed, self._rows, strict=True)
        return np.array([norm(off) / norm(y) if y.any() else 1.0 for off, (_, y) in pairs])

    def pool(
        self, functions: Library, *, without: int | None = None
    ) -> Float[np.ndarray, "free functions"]:
        """The law W of the free coefficients, of all points or without one."""
        kept = [k for k in range(len(self.models)) if k != without]
        basis = make_basis(functions, self.columns(functions)[kept])
        return pool_quiet(
            [self._rows[k] for k in kept], basis, self.size, functions=functions,
            relations=self.relations, library=self.models[0].library, quiet=self.quiet,
        )  # fmt: skip

    @cached_property
    def size(self) -> Float[np.ndarray, " free"]:
        """Root mean square of every coefficient over the points."""
        return zero_to_one(np.sqrt(np.square(self.coefficients).mean(axis=0)))

    @cached_property
    def _rows(self) -> Rows:
        """For each point, rows R and R z with R^T R its scaled information; or those given."""
        if self.rows is not None:
            return self.rows
        scale = np.outer(self.size, self.size)
        roots = [root_of(own * scale) / self.size for own in self.information]
        return [(root, root @ own) for root, own in zip(roots, self.coefficients, strict=True)]


def usual_functions(parameters: Sequence[str]) -> list[Library]:
    """Functions that records often need: p and, or not, p^2 and 1/p; or degree 2."""
    names = list(parameters)
    own = [[(), (f"{p}^2",), (f"1/{p}",), (f"{p}^2", f"1/{p}")] for p in names]
    sets = [[*chain(*more)] for more in product(*own)] if len(names) <= MANY else [[]]
    usual = [named_terms(names, ["1", *names, *more]) for more in sets]
    return [*usual, polynomial(names, degree=2)]


def fit_rows(
    parameters: Sequence[str],
    points: Float[np.ndarray, "points parameters"],
    problems: Problems,
    relations: LawConstraint,
    *,
    provenance: Mapping[str, str],
    quiet: Sequence[QuietPoint] = (),
) -> PointFits:
    """Fit the coefficients to the rows of each point.

    Terms that a point's rows do not tell apart are as small there as the rows allow, and the other
    points decide. Rows that know the noise of their samples are independent. Of others, the
    covariance is a sandwich with blocks of two periods as clusters, and none where the records of a
    point hold too few of these.
    """
    models, information = [], []
    for parts, constraint in zip(problems, relations.at(points), strict=True):
        solution = solve_constrained(parts, constraint)
        library, runs = parts[0].library, parts[0].trajectories
        root = None if all(each.noisy is not None for each in parts) else _blocks(solution, runs)
        model = solution.model(library, units=runs[0].units, provenance=provenance, root=root)
        if root is not None and not root.size:
            model = replace(model, covariance=None)
        models.append(model)
        information.append(solution.information)
    return PointFits(
        tuple(parameters), points, relations, models, np.array(information), "rows", quiet=quiet
    )


def _blocks(
    solution: ConstrainedSolution, runs: Sequence[Trajectory]
) -> Float[np.ndarray, "coefs clusters"]:
    """Root of the covariance by blocks of two periods; without columns if there are too few."""
    n_groups = len(np.unique(solution.groups))
    duration_s = sum(float(run.t[-1] - run.t[0]) for run in runs)
    frequency_Hz = float(np.median([dominant_frequency(run.t, run.states[:, 0]) for run in runs]))
    n_periods = frequency_Hz * duration_s
    try:
        return solution.clustered_root(max(1, round(BLOCK_PERIODS * n_groups / n_periods)))
    except (ValueError, ZeroDivisionError):  # an interval that cannot be had ends no fit
        return np.zeros((len(solution.constraint.coefficients), 0))


def fit_trajectories(
    starts: Sequence[PointFits],
    runs: Sequence[Sequence[Trajectory]],
    settings: RefinementSettings,
    *,
    first: Sequence[Sequence[SparseModel]] | None = None,
    seed: int | np.random.Generator = 0,
    workers: Workers = SURROUNDING,
    progress: Progress = SILENT,
) -> list[PointFits]:
    """Refine the coefficients of each point until integrated windows follow its runs.

    Windows are as long as the periods of their point ask. starts: the fits of several structures.
    first: models of every structure and point to begin with instead; where that fails, the
    refinement begins with the point's own. The result of a point does not depend on the others.
    """
    held = [start.relations.at(start.points) for start in starts]
    begun = [start.models for start in starts] if first is None else first
    streams = np.random.default_rng(seed).spawn(len(runs))
    pieces = [
        (own, streams[k], [
            (models[k], start.models[k], constraints[k])
            for models, start, constraints in zip(begun, starts, held, strict=True)
        ])
        for k, own in enumerate(runs)
    ]  # fmt: skip
    stage = progress.stage(len(pieces), "point", "refinement")
    found = collect(workers, partial(_refine_point, settings=settings), pieces, stage)
    refined = []
    for start, at_points in zip(starts, zip(*found, strict=True), strict=True):
        models, statuses, losses, information = zip(*at_points, strict=True)
        own = replace(start, models=models, statuses=statuses, losses=losses)
        refined.append(replace(own, information=np.array(information), how="trajectories"))
    return refined


Start = tuple[SparseModel, SparseModel, Constraint]  # the model to begin with, and the one of rows
# What is kept of a refinement, without the windows that it followed: the model, status, loss, and
# the information on the free coefficients.
Refined = tuple[SparseModel, str, float, Float[np.ndarray, "free free"]]


def _refine_point(
    piece: tuple[Sequence[Trajectory], np.random.Generator, Sequence[Start]],
    *,
    settings: RefinementSettings,
) -> list[Refined]:
    """Every structure refined on the runs of one point."""
    runs, rng, starts = piece

    def refined(models: Sequence[SparseModel], held: Sequence[Constraint]) -> list[Refined]:
        found = refine(models, [runs] * len(models), settings, constraints=held, seed=rng)
        return [
            (fit.model, str(fit.status), fit.loss, _information(fit, own))
            for fit, own in zip(found, held, strict=True)
        ]

    found = refined([first for first, _, _ in starts], [held for *_, held in starts])
    again = [
        k for k, (first, own, _) in enumerate(starts) if found[k][1] in FAILED and first is not own
    ]
    if again:
        second = refined([starts[k][1] for k in again], [starts[k][2] for k in again])
        for k, other in zip(again, second, strict=True):
            found[k] = other
    return found


def _information(fit: Refinement, held: Constraint) -> Float[np.ndarray, "free free"]:
    """Inverse covariance of the free coefficients; zero if the refinement did not converge."""
    n, free = len(held.coefficients), held.free
    covariance = np.zeros((n, n))
    if fit.covariance_naive is not None and fit.status not in FAILED:
        moved = np.flatnonzero(read_coefficients(fit.model, held))
        covariance[np.ix_(moved, moved)] = fit.covariance_naive
    return invert_covariance(covariance[np.ix_(free, free)])
