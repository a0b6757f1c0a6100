"""A model whose coefficients are functions of the operating point, and its fit to all rows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.optimize import nnls
from scipy.special import ndtri
from scipy.stats import f as f_distribution

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.library.equations import equation_text
from ep2sindy.library.functions import UnknownFunctionError
from ep2sindy.library.library import Library, named_terms
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.model.scores import r2
from ep2sindy.model.storage import covariance_in, names_in, read_stored, texts_in
from ep2sindy.operating.records import check_varying, point_label
from ep2sindy.operating.shared_support import SharedDiscovery, SharedFront
from ep2sindy.refinement.weighted_law import Basis
from ep2sindy.regression.front import ParetoFront
from ep2sindy.regression.least_squares import LeastSquares
from ep2sindy.regression.whitening import whiten_rows
from ep2sindy.runtime.files import read_json, write_text
from ep2sindy.runtime.screen import words_of
from ep2sindy.runtime.values import read_only
from ep2sindy.selection.criteria import FLOOR

FORMAT = "ep2sindy.OperatingLaw/1"

# Steps of weighting and correction of the final fit, as in `reweight`.
N_STEPS = 8

INSIDE = 1e-6  # tolerance of the hull, in ranges of the parameters


@dataclass(frozen=True, eq=False)
class OperatingLaw:
    """One structure, coefficients by a law: coef[k] at a point = coef[k] @ functions(parameters).

    functions: of the parameters. library: of the states. coefficients: (state, term) of each row of
    coef, in SI. covariance: of coef.ravel(), None if unknown. points: the operating points of the
    fit, columns in the order of the functions' variables.
    """

    functions: Library
    library: Library
    states: tuple[str, ...]
    coefficients: tuple[tuple[str, str], ...]
    coef: Float[np.ndarray, "coefs functions"]
    points: Float[np.ndarray, "points parameters"]
    covariance: Float[np.ndarray, "_ _"] | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "coef", read_only(self.coef))
        object.__setattr__(self, "points", read_only(self.points))
        object.__setattr__(self, "units", MappingProxyType(dict(self.units)))
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        shape = (len(self.coefficients), len(self.functions))
        if self.coef.shape != shape or not np.isfinite(self.coef).all():
            raise ValueError(
                "a law must have a finite number for every coefficient and function: shape "
                f"{self.coef.shape} came for {shape}"
            )
        for state, term in self.coefficients:
            if state not in self.states or term not in self.library.names:
                raise ValueError(
                    f"a law's coefficients must be of {list(self.states)} and "
                    f"{list(self.library.names)}: {term} of {state} came"
                )
        if self.points.shape[1:] != (len(self.parameters),) or not len(self.points):
            raise ValueError(
                f"points must have a column for each of {list(self.parameters)}: shape "
                f"{self.points.shape} came"
            )
        if not np.isfinite(self.points).all():
            raise ValueError(f"points must be finite: {self.points.tolist()} came")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", read_only(self.covariance))
            if self.covariance.shape != (self.coef.size, self.coef.size):
                raise ValueError(
                    f"the covariance must be that of {self.coef.size} numbers: shape "
                    f"{self.covariance.shape} came"
                )

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(self.functions.variables)

    @property
    def numbers(self) -> dict[str, dict[str, dict[str, float]]]:
        """State -> term -> function -> the factor of that function in the term's coefficient."""
        found: dict[str, dict[str, dict[str, float]]] = {state: {} for state in self.states}
        for (state, term), row in zip(self.coefficients, self.coef.tolist(), strict=True):
            found[state][term] = dict(zip(self.functions.names, row, strict=True))
        return found

    def model_at(
        self, parameters: Mapping[str, float], *, extrapolate: bool = False
    ) -> SparseModel:
        """The model at an operating point, which need not be one of the fitted points.

        Raises ValueError unless `parameters` has a finite value for each parameter of the law. Also
        raises ValueError outside the convex hull of the fitted points, unless extrapolate=True.
        """
        values = self._values(parameters)
        if not extrapolate and not self._holds(values):
            raise ValueError(
                f"{point_label(parameters)} lies outside the points that this law was fitted to, "
                f"{self._ranges()}: pass extrapolate=True to read it off the law all the same"
            )
        functions = self.functions.evaluate(values[None])[0]
        coef, covariance = np.zeros((len(self.library), len(self.states))), None
        places = [(self.library.index(term), self.states.index(s)) for s, term in self.coefficients]
        for place, value in zip(places, self.coef @ functions, strict=True):
            coef[place] = value
        if self.covariance is not None:
            spread = np.kron(np.eye(len(self.coefficients)), functions)
            by_state = sorted(range(len(places)), key=lambda k: (places[k][1], places[k][0]))
            order = [k for k in by_state if coef[places[k]] != 0.0]
            covariance = (spread @ self.covariance @ spread.T)[np.ix_(order, order)]
        provenance = {**self.provenance, "point": point_label(parameters)}
        return SparseModel(self.library, self.states, coef, self.units, provenance, covariance)

    def is_inside(self, parameters: Mapping[str, float]) -> bool:
        """True if a point lies in the convex hull of the fitted points."""
        return self._holds(self._values(parameters))

    def intervals(self, *, level: float = 0.95) -> dict[tuple[str, str], dict[str, Any]]:
        """(state, term) -> function -> lower and upper bound of its factor, for Gaussian errors.

        Raises ValueError for a law without covariance.
        """
        if self.covariance is None:
            raise ValueError("intervals need a covariance: this law has none; fit it tied")
        std = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).reshape(self.coef.shape)
        reach = ndtri(0.5 + 0.5 * level) * std
        return {
            pair: {
                name: (low, high)
                for name, low, high in zip(
                    self.functions.names, (row - r).tolist(), (row + r).tolist(), strict=True
                )
            }
            for pair, row, r in zip(self.coefficients, self.coef, reach, strict=True)
        }

    def text(self, *, digits: int = 3) -> str:
        """One line per coefficient: `n_i: n_n = 4.83e+03 + 12.1 V_d`.

        The relations that the coefficients obey follow, each in full: `exact: n_n: 1 == 2.0 * V_d`.
        """
        numbers = self.numbers
        lines = []
        for state, term in self.coefficients:
            factors = {name: value for name, value in numbers[state][term].items() if value != 0.0}
            right = equation_text("c", factors, digits=digits).partition("= ")[2]
            lines.append(f"{state}: {term} = {right}")
        exact = self.provenance.get("exact", "")
        return "\n".join([*lines, *(f"exact: {each}" for each in exact.split("; ") if each)])

    def __repr__(self) -> str:
        head = (
            f"OperatingLaw of {len(self.coefficients)} coefficients in {list(self.parameters)}, "
            f"{self.coef.size} numbers, {len(self.points)} points"
        )
        return f"{head}\n{self.text()}"

    def to_json(self) -> str:
        """The complete law as JSON; floats in their shortest exact form."""
        content = {
            "format": FORMAT,
            "parameters": list(self.parameters),
            "functions": list(self.functions.names),
            "variables": list(self.library.variables),
            "library": list(self.library.names),
            "states": list(self.states),
            "coefficients": [list(pair) for pair in self.coefficients],
            "coef": self.coef.tolist(),
            "points": self.points.tolist(),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "units": dict(self.units),
            "provenance": dict(self.provenance),
        }
        return json.dumps(content, indent=2, allow_nan=False) + "\n"

    @staticmethod
    def from_json(text: str) -> OperatingLaw:
        """Inverse of `to_json`, exact. Raises ValueError for anything else."""
        try:
            content = read_json(text)
            if content["format"] != FORMAT:
                raise ValueError(f"format {content['format']!r}")
            known = content["covariance"]
            return OperatingLaw(
                functions=named_terms(*(names_in(content[k]) for k in ("parameters", "functions"))),
                library=named_terms(*(names_in(content[k]) for k in ("variables", "library"))),
                states=tuple(names_in(content["states"])),
                coefficients=tuple((state, term) for state, term in content["coefficients"]),
                coef=np.array(content["coef"], dtype=np.float64),
                points=np.array(content["points"], dtype=np.float64),
                covariance=None if known is None else covariance_in(known),
                units=texts_in(content["units"], "units"),
                provenance=texts_in(content["provenance"], "provenance"),
            )
        except UnknownFunctionError:
            raise  # the file is valid, but a function in it must be registered before reading
        except (KeyError, TypeError, ValueError, RecursionError, OverflowError) as error:
            raise ValueError(f"a law file must hold {FORMAT} JSON: {words_of(error)}") from error

    def save(self, path: str | Path) -> None:
        write_text(Path(path), self.to_json())

    @staticmethod
    def load(path: str | Path) -> OperatingLaw:
        return read_stored(Path(path), OperatingLaw.from_json)

    def _values(self, parameters: Mapping[str, float]) -> Float[np.ndarray, " parameters"]:
        names = list(self.parameters)
        if set(parameters) != set(names):
            raise ValueError(
                f"an operating point must have {names}, and no other: {dict(parameters)} came"
            )
        values = np.array([float(parameters[name]) for name in names])
        if not np.isfinite(values).all():
            raise ValueError(f"an operating point must be finite: {dict(parameters)} came")
        return values

    def _holds(self, values: Float[np.ndarray, " parameters"]) -> bool:
        return in_hull(self.points, values)

    def _ranges(self) -> str:
        ends = zip(self.parameters, self.points.min(axis=0), self.points.max(axis=0), strict=True)
        return ", ".join(f"{name} {low:g} to {high:g}" for name, low, high in ends)


def in_hull(
    points: Float[np.ndarray, "points parameters"], value: Float[np.ndarray, " parameters"]
) -> bool:
    """True if a value lies in the convex hull of points."""
    scale = zero_to_one(np.ptp(points, axis=0))
    columns = np.vstack([((points - value) / scale).T, np.ones(len(points))])
    target = np.append(np.zeros(points.shape[1]), 1.0)
    return float(nnls(columns, target)[1]) <= INSIDE


def law_basis(
    functions: Library,
    points: Float[np.ndarray, "points parameters"],
    *,
    n_spare: int = 0,
    remedy: str = "leave it out, or add points",
) -> Basis:
    """The functions of a law at the points of its fit, with the checks common to all laws.

    points: columns in the order of the functions' variables. n_spare: number of points required
    beyond the number of functions. remedy: advice on a parameter that does not vary.
    Raises ValueError if the points do not suffice, naming the parameter if one is to blame.
    """
    try:
        if n_spare and len(points) < len(functions) + n_spare:
            raise ValueError(
                f"a law of {len(functions)} functions of {list(functions.variables)} needs more "
                f"points than these, since each is left out in turn: {len(points)} came"
            )
        return Basis(functions.evaluate(points))
    except ValueError:
        check_varying(points, functions.variables, remedy=remedy)
        raise


@dataclass(frozen=True, eq=False)
class LawTest:
    """Test whether the coefficients of one equation follow a law.

    r2_free, r2_tied: for each point, R2 on its training rows with its own coefficients and with
    those of the law. F: growth of the residual squares per coefficient given up, in variances of a
    row. p_value: probability of a larger F if the law holds, for rows with independent Gaussian
    errors. F and p_value are NaN if the law gives up no coefficient.
    """

    r2_free: Mapping[str, float]
    r2_tied: Mapping[str, float]
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
    """Refit the chosen supports to all points at once, with coefficients tied by a law.

    coef_j(point) = sum_m coef_jm f_m(parameters of the point): one least-squares problem per
    equation with columns theta_j f_m. Rows are weighted by their covariance if it is known, and
    every point by the residual variance of its free fit, so that neither the units nor the noise of
    one point dominate. Compare `r2_tied` to `r2_free` and see F: a law that does not hold lowers R2
    at the points that depart from it. Rows that are not independent (`Differential`) make F too
    large.
    functions: of the parameters. parameters: point -> {variable of the law: value}, in any units.
    Raises ValueError for points or variables that are missing or unknown, and for points that
    cannot tell the functions apart.
    """
    names = list(shared.models)
    if set(parameters) != set(names):
        raise ValueError(
            f"every point needs parameters, and no other: the points are {names}, parameters "
            f"came for {list(parameters)}"
        )
    points = _values_at(functions, {name: parameters[name] for name in names})
    basis = law_basis(functions, points)
    law_at = dict(zip(names, basis.values, strict=True))
    tied = {state: _tied(front, shared, law_at) for state, front in shared.fronts.items()}
    blocks = [equation.covariance for equation in tied.values() if equation.covariance is not None]
    model = shared.models[names[0]]
    law = OperatingLaw(
        functions=functions,
        library=model.library,
        states=tuple(tied),
        coefficients=tuple((state, term) for state, each in tied.items() for term in each.terms),
        coef=np.concatenate([equation.coef for equation in tied.values()]),
        points=points,
        covariance=block_diag(*blocks) if len(blocks) == len(tied) else None,
        units=model.units,
        provenance={"law": f"least squares, {len(names)} points"},
    )
    return LawFit(law, {state: equation.test for state, equation in tied.items()})


def _values_at(
    functions: Library, parameters: Mapping[str, Mapping[str, float]]
) -> Float[np.ndarray, "points parameters"]:
    names = list(functions.variables)
    for point, known in parameters.items():
        if set(known) != set(names) or not np.isfinite(list(known.values())).all():
            raise ValueError(
                f"{point!r} needs one finite value for each of {names}: {dict(known)} came"
            )
    return np.array([[float(known[name]) for name in names] for known in parameters.values()])


@dataclass(frozen=True, eq=False)
class _Tied:
    """One equation's part of a law. covariance: None if the noise of the rows is unknown."""

    terms: tuple[str, ...]
    coef: Float[np.ndarray, "support functions"]
    covariance: Float[np.ndarray, "coefs coefs"] | None
    test: LawTest


def _tied(
    front: SharedFront,
    shared: SharedDiscovery,
    law_at: Mapping[str, Float[np.ndarray, " functions"]],
) -> _Tied:
    """Fit one equation by least squares over the rows of all points."""
    terms = shared.chosen[front.equation]
    fits = {
        p: _FreeFit.of(each, front.supports.index(terms), terms) for p, each in front.points.items()
    }
    design = np.concatenate([np.kron(own.theta, law_at[p][None]) for p, own in fits.items()])
    target = np.concatenate([own.target for own in fits.values()])
    fit = LeastSquares.of_rows(design, target)
    if not fit.is_determined:
        raise ValueError(
            f"too few points show the terms {list(terms)} of {front.equation!r} to tie them by a "
            "law of this many terms; use a smaller law"
        )
    coef = fit.coef.reshape(len(terms), len(next(iter(law_at.values()))))
    growth = fit.squares - sum(each.squares for each in fits.values())
    n_free = sum(own.n_terms for own in fits.values())
    n_given_up, n_left = n_free - coef.size, len(target) - n_free
    F = max(float(growth), 0.0) / n_given_up if n_given_up > 0 else np.nan
    known = all(each.rows.noisy is not None for each in front.points.values())
    test = LawTest(
        r2_free={
            p: _r2(each, shared.models[p].terms(front.equation)) for p, each in front.points.items()
        },
        r2_tied={
            p: _r2(each, dict(zip(terms, coef @ law_at[p], strict=True)))
            for p, each in front.points.items()
        },
        F=F,
        p_value=float(f_distribution.sf(F, n_given_up, n_left)) if n_given_up > 0 else np.nan,
    )
    return _Tied(terms, coef, fit.root @ fit.root.T if known else None, test)


@dataclass(frozen=True, eq=False)
class _FreeFit:
    """Rows of one point for coefficients in SI, scaled to unit residual variance of its free fit.

    n_terms: terms that the point determines. squares: of the residuals of its free fit.
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
            white = whiten_rows(problem, mask, coef, n_steps=N_STEPS)
            theta, target = white.theta, white.target
        columns = [problem.library.index(name) for name in terms]
        theta = theta[:, columns]
        left = LeastSquares.of_rows(theta, target).squares
        # For rows without noise the residuals are rounding, which is no scale to judge by.
        squares = max(left, FLOOR * float(target @ target))
        spread = np.sqrt(squares / max(len(target) - candidate.n_terms, 1))
        return _FreeFit(
            theta=theta / scale[columns] / spread,
            target=target / spread,
            n_terms=candidate.n_terms,
            squares=left / spread**2,
        )


def _r2(front: ParetoFront, coef: Mapping[str, float]) -> float:
    """R2 of SI coefficients on the training rows of one point."""
    problem = front.rows
    equation = problem.equations.index(front.equation)
    scale = problem.coef_scale(equation)
    scaled = coef_matrix(problem.library, [coef])[:, 0] / scale
    truth, prediction = problem.train_target(equation), scaled @ problem.train_theta.T
    return float(r2(truth=truth, prediction=prediction[None])[0])
