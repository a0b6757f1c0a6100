"""The law of the operating point by the rows of all points, and the test whether it holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.stats import f as f_distribution

from ep2sindy.data.numbers import column_norms
from ep2sindy.discovery.choice import whiten_terms
from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel
from ep2sindy.model.scores import r2
from ep2sindy.operating.law import OperatingLaw, constrain_law, make_basis
from ep2sindy.operating.records import read_point
from ep2sindy.operating.shared_support import SharedDiscovery, SharedFront
from ep2sindy.regression.front import Candidate
from ep2sindy.regression.least_squares import LeastSquares
from ep2sindy.regression.pooled import Basis, PooledFit, pool_rows
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.selection.criteria import FLOOR


@dataclass(frozen=True, eq=False)
class LawTest:
    """Test whether the coefficients of one equation follow a law.

    r2_free, r2_law: for each point, R2 on its training rows with its own coefficients and with
    those of the law. F: growth of the residual squares per coefficient given up, in variances of a
    row. p_value: probability of a larger F if the law holds, for rows with independent Gaussian
    errors. F and p_value are NaN if the law gives up no coefficient.
    """

    r2_free: Mapping[str, float]
    r2_law: Mapping[str, float]
    F: float
    p_value: float


@dataclass(frozen=True, eq=False)
class LawFit:
    """A law fitted to the rows of all points, and for each state the test whether it holds."""

    law: OperatingLaw
    tests: Mapping[str, LawTest]


def fit_law(
    shared: SharedDiscovery, functions: Library, *, parameters: Mapping[str, Mapping[str, float]]
) -> LawFit:
    """Refit the chosen supports to the rows of all points at once, with coefficients by a law.

    The law W of an equation minimises the sum over the points p of |theta_p W f(p) - y_p|^2 / s_p^2
    with f the functions, theta_p and y_p the rows of the point, and s_p^2 the residual variance of
    its free fit: neither the units nor the noise of one point dominate. Rows are weighted by their
    covariance if it is known. Compare `r2_law` to `r2_free` and see F: a law that does not hold
    lowers R2 at the points that depart from it.
    Assumes independent rows; others (`Differential`) make F too large.
    functions: of the parameters. parameters: point -> {variable of the law: value}, in any units.
    Raises ValueError for points or variables that are missing or unknown, and for points that
    cannot tell the functions apart.
    Source: Seber & Lee 2003, Linear Regression Analysis, 4.3, for F.

    >>> runs = {f"{a}": [ep.lotka_volterra(a=a).trajectory(noise=0.02, rng=0)] for a in (0.5, 1.0)}
    >>> shared = ep.discover_shared(runs, ep.polynomial(["x", "y"]))
    >>> at = {point: {"a": float(point)} for point in runs}
    >>> ep.operating.fit_law(shared, ep.polynomial(["a"], degree=1), parameters=at).law.parameters
    ('a',)
    """
    if set(parameters) != set(shared.models):
        raise ValueError(
            "every point needs parameters, and no other: the points are "
            f"{list(shared.models)}, parameters came for {list(parameters)}"
        )
    at = {point: parameters[point] for point in shared.models}
    points = np.array([read_point(functions.variables, own) for own in at.values()])
    basis = make_basis(functions, points)
    fits = {s: _fit_equation(shared, s, basis) for s in shared.fronts}
    model = next(iter(shared.models.values()))
    known = all(each.is_known for each in fits.values())
    law = constrain_law(model.library, shared.chosen, parameters=functions.variables).make_law(
        model,
        functions,
        points,
        np.concatenate([each.fit.law for each in fits.values()]),
        block_diag(*(each.fit.covariance for each in fits.values())) if known else None,
        "least squares",
    )
    return LawFit(law, {state: _test(each, shared, law, at) for state, each in fits.items()})


@dataclass(frozen=True, eq=False)
class _EquationLaw:
    """The law of one equation. is_known: True if the noise of all rows is known.

    n_given_up: coefficients of the points' free fits that the law lacks. n_left: rows beyond those
    coefficients.
    """

    front: SharedFront
    fit: PooledFit
    is_known: bool
    n_given_up: int
    n_left: int


def _fit_equation(shared: SharedDiscovery, state: str, basis: Basis) -> _EquationLaw:
    """Fit one equation by least squares over the rows of all points, in the order of the basis."""
    front, terms = shared.fronts[state], shared.chosen[state]
    place, points = front.supports.index(terms), [front.points[p] for p in shared.models]
    fits = [(each.rows, each.candidates[place]) for each in points]
    rows = [_weigh_rows(problem, candidate, terms) for problem, candidate in fits]
    fit = pool_rows(rows, basis, 1.0 / column_norms(np.concatenate([theta for theta, _ in rows])))
    if not fit.fit.is_determined:
        raise ValueError(
            f"too few points show the terms {list(terms)} of {state!r} for a law of this "
            "many functions; use a smaller law"
        )
    n_free = sum(candidate.n_terms for _, candidate in fits)
    return _EquationLaw(
        front=front,
        fit=fit,
        is_known=all(problem.noisy is not None for problem, _ in fits),
        n_given_up=n_free - fit.law.size,
        n_left=sum(len(target) for _, target in rows) - n_free,
    )


def _weigh_rows(
    problem: RegressionRows, candidate: Candidate, terms: tuple[str, ...]
) -> tuple[Float[np.ndarray, "rows support"], Float[np.ndarray, " rows"]]:
    """Rows of one point for coefficients in SI, of unit residual variance about its free fit."""
    equation = problem.equations.index(candidate.equation)
    if problem.noisy is not None:
        theta, target, scale = whiten_terms(problem, candidate, terms=terms)
    else:
        columns = [problem.library.index(name) for name in terms]
        theta, target = problem.train_theta[:, columns], problem.scaled_target(equation)
        scale = problem.coef_scale(equation)[columns]
    left = LeastSquares.of_rows(theta, target).squares
    # For rows without noise the residuals are rounding, which is no scale to judge by.
    squares = max(left, FLOOR * float(target @ target))
    spread = np.sqrt(squares / max(len(target) - candidate.n_terms, 1))
    return theta / scale / spread, target / spread


def _test(
    equation: _EquationLaw,
    shared: SharedDiscovery,
    law: OperatingLaw,
    parameters: Mapping[str, Mapping[str, float]],
) -> LawTest:
    """F test of one equation, whose free fits leave a variance of one, and R2 at every point."""
    n_given_up, n_left = equation.n_given_up, equation.n_left
    F = max(equation.fit.fit.squares - n_left, 0.0) / n_given_up if n_given_up > 0 else np.nan
    free, pooled = {}, {}
    for point, own in equation.front.points.items():
        at_point = law.model_at(parameters[point], extrapolate=True)
        free[point] = score_rows(own.rows, shared.models[point], equation.front.equation)
        pooled[point] = score_rows(own.rows, at_point, equation.front.equation)
    return LawTest(free, pooled, F, p_value=float(f_distribution.sf(F, n_given_up, n_left)))


def score_rows(problem: RegressionRows, model: SparseModel, state: str) -> float:
    """R2 of a state's derivative on the unweighted training rows."""
    rows = ~problem.test
    predicted = problem.theta[rows] @ model.coef[:, model.states.index(state)]
    truth = problem.target[rows, problem.equations.index(state)]
    return float(r2(truth=truth, prediction=predicted[None])[0])
