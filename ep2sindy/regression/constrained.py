"""Least squares over all equations at once, with exact relations between coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, Place
from ep2sindy.model.model import SparseModel
from ep2sindy.model.scores import r2
from ep2sindy.regression.bootstraps import Resamples
from ep2sindy.regression.gram_kernels import invert_gram
from ep2sindy.regression.least_squares import LeastSquares
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.whitening import whiten_terms

# Lower bound on the residual, as a fraction of the target's RMS; it limits the weight of an
# equation with an exact fit.
MIN_RESIDUAL = 1e-6

MIN_BLOCKS = 5  # fewest blocks of time in a record: fewer say too little about how these differ

# Number of reweighting passes. A fifth changes no coefficient by 1e-6 of its error at 20 % noise.
N_PASSES = 4


def constrained_fit(
    problems: Sequence[RegressionRows],
    constraint: Constraint,
    *,
    units: Mapping[str, str] = MappingProxyType({}),
    provenance: Mapping[str, str] = MappingProxyType({}),
) -> SparseModel:
    """Fit the free coefficients to the training rows of all equations at once.

    The weights of the equations do not depend on their units. Rows with a noise model are
    whitened to unit variance under the coefficients of the previous pass; their samples are
    corrected by a fit without relations. Rows of any other equation are divided by the standard
    deviation of its residuals without relations, or by 1e-6 of the target's RMS if that is more.

    The covariance is that of the free coefficients, propagated through C; it is singular, and
    zero for fixed values. It treats all rows as independent, although the rows of two equations
    share the noise of samples. If all rows are whitened, their variance is 1; otherwise it is
    that of the residuals.

    problems: as a formulation assembles them. The model has the constraint's states.
    Raises ValueError for a state without rows, or coefficients that these rows cannot distinguish.
    """
    solution = solve_constrained(problems, constraint)
    if not solution.fit.is_determined:
        names = [constraint.coefficients[k] for k in constraint.free[solution.fit.dependent]]
        raise ValueError(f"coefficients must be independent to be fitted: {names} are not")
    return solution.model(problems[0].library, units=units, provenance=provenance)


@dataclass(frozen=True, eq=False)
class ConstrainedSolution:
    """Least squares over the weighted rows of all equations; see `constrained_fit`.

    fit: of the free coefficients. theta, left: the weighted terms of these, and the residuals.
    groups: (rows,), number of the group of samples that each row belongs to.
    variance: of the residuals; 1 if all rows are whitened.
    """

    constraint: Constraint
    fit: LeastSquares
    theta: Float[np.ndarray, "rows free"]
    left: Float[np.ndarray, " rows"]
    groups: Int[np.ndarray, " rows"]
    variance: float

    @property
    def information(self) -> Float[np.ndarray, "free free"]:
        """Inverse of the covariance of the free coefficients, for independent rows."""
        return self.theta.T @ self.theta / (self.variance or 1.0)

    @property
    def root(self) -> Float[np.ndarray, "coefs free"]:
        """A root of the covariance of all coefficients, for independent rows."""
        return self.constraint.C @ self.fit.root * np.sqrt(self.variance)

    def clustered_root(self, block: int) -> Float[np.ndarray, "coefs clusters"]:
        """The same for rows that depend on each other within blocks of time.

        block: number of consecutive groups in a block. The covariance is a sandwich with the blocks
        as clusters: how far other segments of the record would move the coefficients.
        Raises ValueError for fewer than five blocks.
        Source: Liang & Zeger 1986, doi:10.1093/biomet/73.1.13.
        """
        numbers = np.unique(self.groups)
        n_blocks = len(numbers) // block
        if n_blocks < MIN_BLOCKS:
            raise ValueError(
                f"intervals need {MIN_BLOCKS} blocks of time or more: blocks of {block} were asked "
                f"of {len(numbers)} groups of rows; record for longer"
            )
        # Blocks of one length: what is left of a cycle at the end of the record is no cluster.
        cluster = np.searchsorted(numbers, self.groups) * n_blocks // len(numbers)
        scores = np.zeros((n_blocks, self.theta.shape[1]))
        np.add.at(scores, cluster, self.theta * self.left[:, None])
        inverse = self.fit.root @ self.fit.root.T
        factor = np.sqrt(n_blocks / (n_blocks - 1))
        return self.constraint.C @ inverse @ scores.T * factor

    def model(
        self,
        library: Library,
        *,
        units: Mapping[str, str],
        provenance: Mapping[str, str],
        root: Float[np.ndarray, "coefs _"] | None = None,
    ) -> SparseModel:
        """The model of these coefficients. root: of their covariance; None takes `root`."""
        held = self.constraint
        values = held.coef(self.fit.coef)
        coef, used = place_coefficients(library, held.states, held.coefficients, values)
        own = (self.root if root is None else root)[used]
        return SparseModel(library, held.states, coef, units, provenance, own @ own.T)


def place_coefficients(
    library: Library,
    states: Sequence[str],
    places: Sequence[Place],
    values: Float[np.ndarray, " coefs"],
) -> tuple[Float[np.ndarray, "terms states"], Int[np.ndarray, " used"]]:
    """The matrix of coefficients of (state, term), and the order in which a model has them.

    The order holds the indices of those that are not zero, as for the covariance of a SparseModel.
    """
    rows = np.array([library.index(term) for _, term in places], dtype=np.int64)
    columns = np.array([states.index(state) for state, _ in places], dtype=np.int64)
    coef, order = np.zeros((len(library), len(states))), np.lexsort([rows, columns])
    coef[rows, columns] = values
    return coef, order[values[order] != 0.0]


def read_coefficients(model: SparseModel, constraint: Constraint) -> Float[np.ndarray, " coefs"]:
    """Coefficients of a model in the order of the constraint's."""
    index, states = model.library.index, model.states.index
    return np.array([model.coef[index(term), states(s)] for s, term in constraint.coefficients])


def fit_draws(
    problems: Sequence[RegressionRows], draws: Mapping[str, Resamples], constraint: Constraint
) -> Float[np.ndarray, "draws coefs"]:
    """Fit the free coefficients to all equations at once, in every bootstrap of their rows.

    draws: of every equation's rows, as many for each. Equations weigh as in `constrained_fit`, by
    their residuals on all rows; the noise of samples is not corrected. A coefficient whose terms
    are zero in a draw is zero there. Returns all coefficients, in SI.
    """
    n = len(constraint.free)
    normal, right = np.zeros((1, n, n)), np.zeros((1, n, 1))
    for equation in weigh_equations(problems, constraint):
        own, number = equation.terms, equation.number
        drawn = draws[equation.problem.equations[number]]
        scale = drawn.scale[:, own] * equation.problem.coef_scale(number)[own]
        inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale != 0.0)[:, :, None]
        gram, known = drawn.xx[:, own[:, None], own], inverse * constraint.d[equation.at, None]
        weighted = (inverse * constraint.C[equation.at]).transpose(0, 2, 1) / equation.std**2
        normal = normal + weighted @ gram @ (inverse * constraint.C[equation.at])
        right = right + weighted @ (drawn.xy[:, number, own, None] - gram @ known)
    free = invert_gram(normal) @ right
    return free[:, :, 0] @ constraint.C.T + constraint.d


@dataclass(frozen=True, eq=False)
class WeightedEquation:
    """Rows of one equation, with its part of the constraint's coefficients.

    at: indices of this equation's coefficients in the constraint; terms: their library indices.
    start: coefficients of a fit without relations, by which samples of noisy rows are corrected.
    std: standard deviation of the residuals of that fit, in units of the target's scale.
    """

    problem: RegressionRows
    number: int
    at: Int[np.ndarray, " own"]
    terms: Int[np.ndarray, " own"]
    start: Float[np.ndarray, " own"]
    std: float

    def rows(
        self, coef: Float[np.ndarray, " own"]
    ) -> tuple[Float[np.ndarray, "rows own"], Float[np.ndarray, " rows"]]:
        """Terms and target, weighted so that residuals have variance 1 for these coefficients."""
        scale = self.problem.coef_scale(self.number)[self.terms]
        if self.problem.noisy is not None:
            white = whiten_terms(self.problem, self.terms, coef / scale, n_steps=0)
            return white.theta[:, self.terms] / scale, white.target
        theta = self.problem.train_theta[:, self.terms] / self.std
        return theta / scale, self.problem.scaled_target(self.number) / self.std


def weigh_equations(
    problems: Sequence[RegressionRows], constraint: Constraint
) -> list[WeightedEquation]:
    """The constraint's equations that depend on at least one free coefficient."""
    places = {name: (p, k) for p in problems for k, name in enumerate(p.equations)}
    equations = []
    for state in constraint.states:
        if state not in places:
            raise ValueError(f"unknown state {state!r}; these problems have {list(places)}")
        problem, number = places[state]
        at = np.flatnonzero([s == state for s, _ in constraint.coefficients])
        names = [constraint.coefficients[k][1] for k in at]
        terms = np.array([problem.library.index(name) for name in names], dtype=np.int64)
        if constraint.C[at].any():
            equations.append(_fit_alone(problem, number, at, terms))
    return equations


def _fit_alone(
    problem: RegressionRows, number: int, at: np.ndarray, terms: np.ndarray
) -> WeightedEquation:
    theta, target = problem.train_theta[:, terms], problem.scaled_target(number)
    fit = LeastSquares.of_rows(theta, target)
    variance = fit.squares / max(len(target) - len(terms), 1)
    least = MIN_RESIDUAL**2 * np.square(target).mean()
    if problem.noisy is not None:
        white = whiten_terms(problem, terms, fit.coef, n_steps=8)
        problem = replace(problem, noisy=replace(problem.noisy, smoothed=white.corrected))
        fit = LeastSquares.of_rows(white.theta[:, terms], white.target)
    return WeightedEquation(
        problem=problem,
        number=number,
        at=at,
        terms=terms,
        start=fit.coef * problem.coef_scale(number)[terms],
        std=float(np.sqrt(max(variance, least))) or 1.0,
    )


def solve_constrained(
    problems: Sequence[RegressionRows], constraint: Constraint
) -> ConstrainedSolution:
    """Free coefficients that fit all equations at once; noisy rows are reweighted in each pass.

    Coefficients that the rows do not determine are as small as the rows allow.
    """
    C, d = constraint.C, constraint.d
    equations = weigh_equations(problems, constraint)
    coef = d.copy()
    for equation in equations:
        coef[equation.at] = equation.start
    noisy = [equation.problem.noisy is not None for equation in equations]
    for _ in range(N_PASSES if any(noisy) else 1):
        theta, target = np.zeros((0, C.shape[1])), np.zeros(0)
        for equation in equations:
            terms, slope = equation.rows(coef[equation.at])
            theta = np.concatenate([theta, terms @ C[equation.at]])
            target = np.concatenate([target, slope - terms @ d[equation.at]])
        fit = LeastSquares.of_rows(theta, target)
        coef = constraint.coef(fit.coef)
    return ConstrainedSolution(
        constraint=constraint,
        fit=fit,
        theta=theta,
        left=target - theta @ fit.coef,
        groups=np.concatenate(
            [np.zeros(0, np.int64), *(e.problem.groups[~e.problem.test] for e in equations)]
        ),
        variance=1.0 if all(noisy) else fit.squares / max(len(target) - C.shape[1], 1),
    )


def rows_r2(model: SparseModel, problems: Sequence[RegressionRows]) -> dict[str, float]:
    """R2 of the derivative by state, on the unweighted training rows of a fit."""
    found = {}
    for problem in problems:
        rows = ~problem.test
        for k, state in enumerate(problem.equations):
            fitted = problem.theta[rows] @ model.coef[:, model.states.index(state)]
            found[state] = float(r2(truth=problem.target[rows, k], prediction=fitted[None])[0])
    return found
