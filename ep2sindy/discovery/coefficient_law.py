"""Coefficients tied by a law: one fit of all operating points, as functions of their parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.stats import f as f_distribution

from ep2sindy.data.scales import column_norms
from ep2sindy.discovery.shared_support import JointDiscovery, JointFront
from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.model.scores import r2
from ep2sindy.regression.whitening import whitened_rows
from ep2sindy.search.front import ParetoFront
from ep2sindy.selection.rule import FLOOR

# Steps of weighting and correction of the last fit, as `reweight` takes them.
N_STEPS = 8


@dataclass(frozen=True, eq=False)
class TiedEquation:
    """One equation whose coefficients follow a law: coef_j(point) = sum_m coef_jm law_m(point).

    coef: (support, law terms), in SI. r2_free, r2_tied: by point, on its training rows, with
    coefficients of its own and with those of the law. F: growth of the residual per coefficient
    given up, in variances of a row; p_value: the chance of more if the law holds, for rows with
    independent Gaussian errors; both NaN if the law gives up none.
    covariance: of the coefficients, row by row, where noise has been followed to them.
    """

    terms: tuple[str, ...]
    coef: Float[np.ndarray, "support law_terms"]
    r2_free: Mapping[str, float]
    r2_tied: Mapping[str, float]
    F: float
    p_value: float
    covariance: Float[np.ndarray, "coefs coefs"] | None


@dataclass(frozen=True, eq=False)
class TiedFit:
    """Equations by state, and what they say at any operating point."""

    law: Library
    equations: Mapping[str, TiedEquation]
    library: Library
    units: Mapping[str, str]

    def model_at(self, parameters: Mapping[str, float]) -> SparseModel:
        """The model at one operating point, which need not be among those of the fit.

        Raises ValueError unless `parameters` are exactly the variables of the law.
        """
        law = _law_terms(self.law, {"this point": parameters})[0]
        coef = [dict(zip(e.terms, e.coef @ law, strict=True)) for e in self.equations.values()]
        blocks = []
        for equation in self.equations.values():
            spread = np.kron(np.eye(len(equation.terms)), law)
            if equation.covariance is not None:
                blocks.append(spread @ equation.covariance @ spread.T)
        return SparseModel(
            library=self.library,
            states=list(self.equations),
            coef=coef_matrix(self.library, coef),
            units=self.units,
            provenance={"point": ", ".join(f"{k}={v:g}" for k, v in parameters.items())},
            covariance=block_diag(*blocks) if len(blocks) == len(coef) else None,
        )


def tied_fit(
    found: JointDiscovery, law: Library, *, parameters: Mapping[str, Mapping[str, float]]
) -> TiedFit:
    """Fit the chosen supports again, all points at once, their coefficients tied by a law.

    coef_j(point) = sum_m coef_jm law_m(parameters of the point): one least squares per equation
    with columns theta_j law_m. Rows are weighted by their covariance where it is known, and every
    point by the residual variance of its free fit, so that neither units nor noise of one point
    lead. Compare `r2_tied` to `r2_free` and see F: a law that does not hold costs R2 at the
    points that depart from it. Rows that are not independent (`Differential`) make F too large.
    parameters: point -> {variable of the law: value}, in any units.
    Raises ValueError for points or variables that are missing or unknown, and for points that
    cannot tell the terms of the law apart.
    """
    points = list(found.models)
    if set(parameters) != set(points):
        raise ValueError(
            f"every point needs parameters, and no other: the points are {points}, parameters "
            f"came for {list(parameters)}"
        )
    values = _law_terms(law, {point: parameters[point] for point in points})
    _check_law(law, values, {point: parameters[point] for point in points})
    model = found.models[points[0]]
    return TiedFit(
        law=law,
        equations={
            state: _tied(front, found, dict(zip(points, values, strict=True)))
            for state, front in found.fronts.items()
        },
        library=model.library,
        units=model.units,
    )


def _law_terms(
    law: Library, parameters: Mapping[str, Mapping[str, float]]
) -> Float[np.ndarray, "points law_terms"]:
    for point, known in parameters.items():
        if set(known) != set(law.variables) or not np.isfinite(list(known.values())).all():
            raise ValueError(
                f"{point!r} needs one finite value for each of {list(law.variables)}: "
                f"{dict(known)} came"
            )
    return law.evaluate(
        np.array([[float(known[v]) for v in law.variables] for known in parameters.values()])
    )


def _check_law(
    law: Library,
    values: Float[np.ndarray, "points law_terms"],
    parameters: Mapping[str, Mapping[str, float]],
) -> None:
    if len(values) < len(law):
        raise ValueError(
            f"a law of {len(law)} terms needs as many points: {len(values)} came; use a law of "
            "fewer terms"
        )
    if np.linalg.matrix_rank(values / column_norms(values)) < len(law):
        same = [v for v in law.variables if len({p[v] for p in parameters.values()}) == 1]
        raise ValueError(
            f"the points must tell the terms {list(law.names)} of the law apart: "
            + (f"{same} do not vary" if same else "some are combinations of others there")
            + "; leave some out"
        )


def _tied(
    front: JointFront, found: JointDiscovery, law_at: Mapping[str, Float[np.ndarray, " law_terms"]]
) -> TiedEquation:
    """One least squares over the rows of all points."""
    terms = found.chosen[front.equation]
    fits = {
        p: _FreeFit.of(each, front.supports.index(terms), terms) for p, each in front.points.items()
    }
    design = np.concatenate([np.kron(fit.theta, law_at[p][None]) for p, fit in fits.items()])
    target = np.concatenate([fit.target for fit in fits.values()])
    norms = column_norms(design)
    columns = design / norms
    solution, _, rank, _ = np.linalg.lstsq(columns, target)
    if rank < len(norms):
        raise ValueError(
            f"too few points show the terms {list(terms)} of {front.equation!r} to tie them by a "
            "law of this many terms; use a smaller law"
        )
    coef = (solution / norms).reshape(len(terms), len(next(iter(law_at.values()))))
    root = np.linalg.inv(np.linalg.qr(columns, mode="r")) / norms[:, None]
    growth = np.square(target - columns @ solution).sum() - sum(f.squares for f in fits.values())
    n_given_up = sum(fit.n_terms for fit in fits.values()) - coef.size
    n_left = len(target) - sum(fit.n_terms for fit in fits.values())
    F = max(float(growth), 0.0) / n_given_up if n_given_up > 0 else np.nan
    known = all(each.rows.noisy is not None for each in front.points.values())
    return TiedEquation(
        terms=terms,
        coef=coef,
        r2_free={
            p: _r2(each, found.models[p].terms(front.equation)) for p, each in front.points.items()
        },
        r2_tied={
            p: _r2(each, dict(zip(terms, coef @ law_at[p], strict=True)))
            for p, each in front.points.items()
        },
        F=F,
        p_value=float(f_distribution.sf(F, n_given_up, n_left)) if n_given_up > 0 else np.nan,
        covariance=root @ root.T if known else None,
    )


@dataclass(frozen=True, eq=False)
class _FreeFit:
    """Rows of one point, for coefficients in SI, whose own fit leaves residuals of variance 1.

    n_terms: terms that the point determines. squares: of the residuals of its own fit.
    """

    theta: Float[np.ndarray, "rows support"]
    target: Float[np.ndarray, " rows"]
    n_terms: int
    squares: float

    @staticmethod
    def of(front: ParetoFront, k: int, terms: Sequence[str]) -> _FreeFit:
        problem, candidate = front.rows, front.candidates[k]
        equation = problem.equations.index(front.equation)
        scale = problem.coef_scale(equation)
        theta, target = problem.train_theta, problem.train_target(equation)
        if problem.noisy is not None:
            coef = coef_matrix(problem.library, [candidate.coef_by_term])[:, 0] / scale
            mask = np.isin(problem.term_names, candidate.terms)
            white = whitened_rows(problem, mask, coef, n_steps=N_STEPS)
            theta, target = white.theta, white.target
        columns = [problem.library.index(name) for name in terms]
        theta = theta[:, columns]
        left = target - theta @ np.linalg.lstsq(theta, target)[0]
        # Rows without noise: what is left is rounding, and no scale to judge by.
        squares = max(float(left @ left), FLOOR * float(target @ target))
        spread = np.sqrt(squares / max(len(target) - candidate.n_terms, 1))
        return _FreeFit(
            theta=theta / scale[columns] / spread,
            target=target / spread,
            n_terms=candidate.n_terms,
            squares=float(left @ left) / spread**2,
        )


def _r2(front: ParetoFront, coef: Mapping[str, float]) -> float:
    """R2 of SI coefficients on the training rows of one point."""
    problem = front.rows
    equation = problem.equations.index(front.equation)
    scale = problem.coef_scale(equation)
    scaled = coef_matrix(problem.library, [coef])[:, 0] / scale
    truth, prediction = problem.train_target(equation), scaled @ problem.train_theta.T
    return float(r2(truth=truth, prediction=prediction[None])[0])
