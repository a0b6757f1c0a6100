"""One structure fitted to every operating point alone, and the law through these fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.law import LawConstraint, OperatingLaw, make_basis, read_coefficients
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.refinement.refine import Refinement, refine
from ep2sindy.regression.constrained import solve_constrained
from ep2sindy.regression.pooled import Basis, invert_covariance, pool_coefficients
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.runtime.progress import SILENT, Progress

Problems = Sequence[Sequence[RegressionRows]]  # for each point, the rows of every equation

LawFunctions = int | Library  # the degree of polynomials of the parameters, or functions of them


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

    @property
    def usable(self) -> PointFits:
        """The points whose fit tells something of the coefficients."""
        return self.take(np.flatnonzero(self.information.any(axis=(1, 2))).tolist())

    def take(self, numbers: Sequence[int]) -> PointFits:
        """The same for some of the points."""
        return replace(
            self,
            points=self.points[list(numbers)],
            models=[self.models[k] for k in numbers],
            information=self.information[list(numbers)],
        )

    def functions(self, law: LawFunctions) -> Library:
        """Functions of the parameters that a law is made of: polynomials, if a degree is given."""
        return polynomial(list(self.parameters), degree=law) if isinstance(law, int) else law

    def basis(self, functions: Library) -> Basis:
        """The functions at the points. Raises ValueError if the points do not suffice for them."""
        return make_basis(functions, self.columns(functions))

    def columns(self, functions: Library) -> Float[np.ndarray, "points variables"]:
        """The parameters of the points in the order of the functions' variables."""
        if unknown := [v for v in functions.variables if v not in self.parameters]:
            raise ValueError(
                f"a law's functions must be of {list(self.parameters)}: {unknown} came"
            )
        return self.points[:, [self.parameters.index(v) for v in functions.variables]]

    def law(self, functions: Library) -> OperatingLaw:
        """The law of all points, with its errors at points left out one at a time.

        Its covariance is the jackknife's: how far the law moves if a point is left out. It holds
        the noise of the records, and that coefficients are not exactly of this form. Both are None
        if the points do not suffice for a law without each of them.
        Source: Efron & Stein 1981, doi:10.1214/aos/1176345462, for the jackknife.
        """
        free, columns = self._pool(functions), self.columns(functions)
        covariance, errors = None, None
        laws = self._laws_without_each(functions)
        if laws is not None:
            apart = (laws - laws.mean(axis=0)).reshape(len(laws), -1)
            covariance = (len(laws) - 1) / len(laws) * apart.T @ apart
            errors = self._rate_errors(laws, functions)
        return self.relations.make_law(
            self.models[0], functions, columns, free, covariance, self.how, errors
        )

    def law_without(self, number: int, functions: Library) -> OperatingLaw:
        """The law of all points but one, without covariance."""
        others = self.take([k for k in range(len(self.models)) if k != number])
        columns, free = others.columns(functions), others._pool(functions)
        return self.relations.make_law(
            self.models[0], functions, columns, free, None, self.how, None
        )

    def rate_errors(self, functions: Library) -> Float[np.ndarray, " points"]:
        """Error at each point of the law of the others, as a share of the point's rates.

        With z_p and I_p of the point, and d_p what the law of the others misses z_p by, it is
        sqrt(d_p^T I_p d_p / z_p^T I_p z_p): for rows, the root mean square error of the rates by
        that of the rates. It counts only what the record determines.
        Raises ValueError if the points do not suffice for a law without each of them.
        """
        laws = self._laws_without_each(functions)
        if laws is None:
            raise ValueError(
                f"a law of {len(functions)} functions of {list(functions.variables)} needs more "
                f"points than these, since each is left out in turn: {len(self.models)} came"
            )
        return self._rate_errors(laws, functions)

    def _rate_errors(
        self, laws: Float[np.ndarray, "points free functions"], functions: Library
    ) -> Float[np.ndarray, " points"]:
        at_points = np.einsum("pcf,pf->pc", laws, functions.evaluate(self.columns(functions)))
        off, own = at_points - self.coefficients, self.coefficients
        missed = np.einsum("pc,pcd,pd->p", off, self.information, off)
        whole = np.einsum("pc,pcd,pd->p", own, self.information, own)
        return np.sqrt(np.maximum(missed, 0.0) / zero_to_one(whole))

    def _laws_without_each(
        self, functions: Library
    ) -> Float[np.ndarray, "points free functions"] | None:
        """The factors of the law without each point; None if the points do not suffice."""
        numbers = range(len(self.models))
        try:
            return np.stack(
                [self.take([k for k in numbers if k != j])._pool(functions) for j in numbers]
            )
        except ValueError:
            return None

    def _pool(self, functions: Library) -> Float[np.ndarray, "free functions"]:
        return pool_coefficients(self.coefficients, self.information, self.basis(functions))


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
    return of_refinements(start.parameters, start.points, start.relations, fits)


def of_refinements(
    parameters: Sequence[str],
    points: Float[np.ndarray, "points parameters"],
    relations: LawConstraint,
    fits: Sequence[Refinement],
) -> PointFits:
    """Refinements of all points; one that failed tells nothing of the coefficients."""
    information = [information_of(fit, relations.common) for fit in fits]
    models = [fit.model for fit in fits]
    return PointFits(
        tuple(parameters), points, relations, models, np.array(information), "trajectories"
    )


def information_of(fit: Refinement, common: Constraint) -> Float[np.ndarray, "free free"]:
    """Inverse covariance of the free coefficients; zero if the refinement failed."""
    free = common.free
    if fit.covariance_naive is None:
        return np.zeros((len(free), len(free)))
    covariance = np.zeros((len(common.coefficients), len(common.coefficients)))
    moved = np.flatnonzero(read_coefficients(fit.model, common))
    covariance[np.ix_(moved, moved)] = fit.covariance_naive
    return invert_covariance(covariance[np.ix_(free, free)])
