"""One structure fitted to every operating point alone, and the law through these fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
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
from ep2sindy.refinement.assess import RefinementStatus
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.refinement.refine import Refinement, refine
from ep2sindy.regression.constrained import read_coefficients, solve_constrained
from ep2sindy.regression.pooled import invert_covariance, pool_rows, residuals_left_out, root_of
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.runtime.progress import SILENT, Progress

Problems = Sequence[Sequence[RegressionRows]]  # for each point, the rows of every equation

# Of refinements whose coefficients tell nothing.
FAILED = (RefinementStatus.NON_FINITE, RefinementStatus.FLAT, RefinementStatus.MAX_ITER)

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
    Assumes that one law holds at all points.
    points: (points, parameters). relations: that hold at every point. models: one per point.
    information: of the free coefficients, in SI. how: "rows" or "trajectories".
    """

    parameters: tuple[str, ...]
    points: Float[np.ndarray, "points parameters"]
    relations: LawConstraint
    models: Sequence[SparseModel]
    information: Float[np.ndarray, "points free free"]
    how: str

    @property
    def n_free(self) -> int:
        """Number of coefficients that the relations leave free."""
        return len(self.relations.common.free)

    @cached_property
    def coefficients(self) -> Float[np.ndarray, "points free"]:
        """The free coefficients of each point."""
        common = self.relations.common
        return np.array([read_coefficients(model, common) for model in self.models])[:, common.free]

    def functions(self, law: LawFunctions) -> Library:
        """Functions of the parameters that a law is made of; "auto" takes `choose_functions`."""
        if law == "auto":
            return self.choose_functions()
        if isinstance(law, int):
            return polynomial(list(self.parameters), degree=law)
        assert isinstance(law, Library)
        return law

    def choose_functions(self) -> Library:
        """The functions whose law errs least at points left out, of those that records often need.

        Of every parameter p these are p and, or not, p^2 and 1/p, or all products up to degree 2.
        The errors are `rate_errors`, in the root mean square over the points.
        Raises ValueError if the points do not suffice for a law that is linear in all parameters.
        """
        names = list(self.parameters)
        own = [[(), (f"{p}^2",), (f"1/{p}",), (f"{p}^2", f"1/{p}")] for p in names]
        sets = [[*chain(*more)] for more in product(*own)] if len(names) <= MANY else [[]]
        candidates = [named_terms(names, ["1", *names, *more]) for more in sets]
        candidates.append(polynomial(names, degree=2))
        tested, reasons = self.test_laws(candidates)
        if not tested:
            raise ValueError(reasons[0])
        return min(tested, key=lambda law: np.square(law[1]).mean())[0]

    def test_laws(
        self, laws: Sequence[LawFunctions]
    ) -> tuple[list[tuple[Library, Float[np.ndarray, " points"]]], list[str]]:
        """The functions and `rate_errors` of each law, and why other laws have too few points."""
        tested, reasons = [], []
        for law in laws:
            try:
                functions = self.functions(law)
                tested.append((functions, self.rate_errors(functions)))
            except ValueError as error:
                reasons.append(str(error))
        return tested, reasons

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
        free, covariance, errors = self._pool(functions), None, None
        with suppress(ValueError):  # too few points to leave one out
            errors = self.rate_errors(functions)
            laws = np.stack([self._pool(functions, without=k) for k in range(len(self.models))])
            apart = (laws - laws.mean(axis=0)).reshape(len(laws), -1)
            covariance = (len(laws) - 1) / len(laws) * apart.T @ apart
        columns = self.columns(functions)
        return self.relations.make_law(
            self.models[0], functions, columns, free, covariance, self.how, errors
        )

    def law_without(self, number: int, functions: Library) -> OperatingLaw:
        """The law of all points but one, without covariance."""
        columns = np.delete(self.columns(functions), number, axis=0)
        free = self._pool(functions, without=number)
        return self.relations.make_law(
            self.models[0], functions, columns, free, None, self.how, None
        )

    def rate_errors(self, functions: Library) -> Float[np.ndarray, " points"]:
        """Error at each point of the law of the others, as a fraction of the point's rates.

        With z_p and I_p of the point, and d_p what the law of the others misses z_p by, it is
        sqrt(d_p^T I_p d_p / z_p^T I_p z_p): for rows, the root mean square error of the rates by
        that of the rates. It counts only what the record determines. A point whose fit failed
        counts as missed whole.
        Raises ValueError if the points do not suffice for a law without each of them.
        """
        basis = make_basis(functions, self.columns(functions), n_spare=1)
        missed = residuals_left_out(self._rows, basis, self._size)
        pairs = zip(missed, self._rows, strict=True)
        return np.array([norm(off) / norm(y) if y.any() else 1.0 for off, (_, y) in pairs])

    def _pool(
        self, functions: Library, *, without: int | None = None
    ) -> Float[np.ndarray, "free functions"]:
        kept = [k for k in range(len(self.models)) if k != without]
        basis = make_basis(functions, self.columns(functions)[kept])
        return pool_rows([self._rows[k] for k in kept], basis, self._size)

    @cached_property
    def _size(self) -> Float[np.ndarray, " free"]:
        """Root mean square of every coefficient over the points."""
        return zero_to_one(np.sqrt(np.square(self.coefficients).mean(axis=0)))

    @cached_property
    def _rows(self) -> list[tuple[Float[np.ndarray, "free free"], Float[np.ndarray, " free"]]]:
        """For each point, rows R and R z with R^T R its scaled information."""
        scale = np.outer(self._size, self._size)
        roots = [root_of(own * scale) / self._size for own in self.information]
        return [(root, root @ own) for root, own in zip(roots, self.coefficients, strict=True)]


def fit_rows(
    parameters: Sequence[str],
    points: Float[np.ndarray, "points parameters"],
    problems: Problems,
    relations: LawConstraint,
    *,
    provenance: Mapping[str, str],
) -> PointFits:
    """Fit the coefficients to the rows of each point.

    Terms that a point's rows do not tell apart are as small there as the rows allow, and the other
    points decide.
    """
    models, information = [], []
    for parts, constraint in zip(problems, relations.at(points), strict=True):
        solution = solve_constrained(parts, constraint)
        library, units = parts[0].library, parts[0].trajectories[0].units
        models.append(solution.model(library, units=units, provenance=provenance))
        information.append(solution.information)
    return PointFits(tuple(parameters), points, relations, models, np.array(information), "rows")


def fit_trajectories(
    start: PointFits,
    runs: Sequence[Sequence[Trajectory]],
    settings: RefinementSettings,
    *,
    seed: int | np.random.Generator = 0,
    progress: Progress = SILENT,
) -> PointFits:
    """Refine the coefficients of each point until integrated windows follow its runs."""
    constraints = start.relations.at(start.points)
    fits = refine(
        start.models, runs, settings, constraints=constraints, seed=seed, progress=progress
    )
    return replace(
        start,
        models=[fit.model for fit in fits],
        information=np.array([information_of(fit, start.relations.common) for fit in fits]),
        how="trajectories",
    )


def information_of(fit: Refinement, common: Constraint) -> Float[np.ndarray, "free free"]:
    """Inverse covariance of the free coefficients; zero if the refinement did not converge."""
    free = common.free
    if fit.covariance_naive is None or fit.status in FAILED:
        return np.zeros((len(free), len(free)))
    covariance = np.zeros((len(common.coefficients), len(common.coefficients)))
    moved = np.flatnonzero(read_coefficients(fit.model, common))
    covariance[np.ix_(moved, moved)] = fit.covariance_naive
    return invert_covariance(covariance[np.ix_(free, free)])
