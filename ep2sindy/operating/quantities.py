"""Physical quantities read from coefficients at each point, and their laws."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import least_squares
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.library.relations import Constraint, place_of
from ep2sindy.library.units import unit_product
from ep2sindy.model.model import SparseModel
from ep2sindy.model.scores import r2
from ep2sindy.operating.records import check_varying
from ep2sindy.regression.pooled import Basis, fewest_of_least
from ep2sindy.runtime.values import read_only

LEVEL = 0.95  # level of all intervals in this file

# Fraction of the values' RMS: errors below it are rounding, and the law with fewer terms wins.
ROUNDING = 1e-10

LEAST_POINTS = 3  # of a control law
POINTS_PER_TERM = 3  # points for each term of a control law: with fewer, a search fits their errors


@dataclass(frozen=True)
class Quantity:
    """A physical quantity read from a coefficient: factor * coef^power, in SI.

    coefficient: "state: term". power: 1, or -1 for a length or a time such as L = -1/coef.
    """

    coefficient: str
    factor: float = 1.0
    power: int = 1

    def __post_init__(self) -> None:
        if self.coefficient.count(":") != 1:
            raise ValueError(
                f"a quantity needs a coefficient such as 'n_i: n_i*u_iz', got {self.coefficient!r}"
            )
        if not np.isfinite(self.factor) or self.factor == 0.0 or self.power not in (-1, 1):
            raise ValueError(
                "a quantity is factor * coef^power, the factor not zero and the power 1 or -1, got "
                f"factor={self.factor!r}, power={self.power!r}"
            )

    @property
    def state(self) -> str:
        return self.coefficient.split(":")[0].strip()

    @property
    def term(self) -> str:
        return self.coefficient.split(":")[1].strip()

    def evaluate(self, coef: Float[np.ndarray, " coefs"]) -> Float[np.ndarray, " coefs"]:
        """Values of the quantity for an array of values of the coefficient."""
        return self.factor * coef**self.power

    def place(self, constraint: Constraint, library: Library) -> int:
        """Index of its coefficient in the constraint. Raises ValueError if it is not there."""
        who = f"the quantity of {self.coefficient!r}"
        return place_of(library, constraint.coefficients, self.state, self.term, who)

    def unit(self, library: Library, units: Mapping[str, str]) -> str:
        """Unit of the quantity, from the units of the states and variables."""
        of_term = library.units(units)[library.index(self.term)]
        p = self.power
        return unit_product([(units[self.state], p), ("s", -p), (of_term, -p)])


@dataclass(frozen=True)
class QuantityEstimate:
    """A quantity with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


def estimate_quantities(
    model: SparseModel, quantities: Mapping[str, Quantity]
) -> dict[str, QuantityEstimate]:
    """Quantities of a model with intervals, the ends those of the coefficient's.

    The reciprocal of a coefficient has an infinite interval if the coefficient's interval holds
    zero. A model without covariance gives ends that are not a number.
    """
    estimates = {}
    for name, quantity in quantities.items():
        coef = model.terms(quantity.state).get(quantity.term, 0.0)
        ends = np.array([np.nan, np.nan])
        if model.covariance is not None:
            known = model.intervals(quantity.state, level=LEVEL)
            ends = np.array(known.get(quantity.term, (coef, coef)))
        if quantity.power < 0 and np.prod(np.sign(ends)) <= 0.0:
            low, high = -np.inf, np.inf
        else:
            low, high = np.sort(quantity.evaluate(ends)).tolist()
        with np.errstate(divide="ignore"):
            value = float(quantity.evaluate(np.array([coef]))[0])
        estimates[name] = QuantityEstimate(value, low, high)
    return estimates


def control_functions(names: Sequence[str], points: np.ndarray) -> Library:
    """Functions that a control law may hold: products up to degree 2, and reciprocals.

    A parameter that is zero somewhere, or changes its sign, has no reciprocal.
    """
    library = polynomial(list(names), degree=2)
    one_sign = np.abs(np.sign(points).sum(axis=0)) == len(points)
    over = [f"1/{name}" for name, keeps in zip(names, one_sign, strict=True) if keeps]
    return library + named_terms(list(names), over) if over else library


@dataclass(frozen=True, eq=False)
class ControlLaw:
    """One quantity as a function of the operating point p: y(p) = w f(p), with its errors.

    functions: f, of the parameters. coef: w, in the units of the quantity over those of f. r2: on
    the points of the fit; NaN for a quantity that does not vary. loo_error: leave-one-out RMS error
    with these functions, relative to the absolute mean of the quantity. search_error: the same with
    the functions searched again without the point.
    """

    functions: Library
    coef: Float[np.ndarray, " functions"]
    r2: float
    loo_error: float
    search_error: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "coef", read_only(self.coef))

    @property
    def coef_by_term(self) -> dict[str, float]:
        return dict(zip(self.functions.names, self.coef.tolist(), strict=True))

    def predict(
        self, parameters: Float[np.ndarray, "points parameters"]
    ) -> Float[np.ndarray, " points"]:
        """The quantity at given points; columns in the order of the functions' variables."""
        return self.functions.evaluate(parameters) @ self.coef


def fit_control_law(
    values: Float[np.ndarray, " points"],
    parameters: Float[np.ndarray, "points parameters"],
    library: Library,
    *,
    max_terms: int | None = None,
) -> ControlLaw:
    """Find the terms of a library that predict best at points left out of their fit.

    Minimises the mean of |r_p| / (1 - h_p) over all supports of up to `max_terms` terms, with r_p
    the residual of the point p in a least-squares fit, h_p its diagonal of the hat matrix, and so
    r_p / (1 - h_p) its residual in the fit to the other points. Of supports within one standard
    error of the least, point by point, the one of fewest terms is taken.
    Assumes errors of equal variance at all points.
    max_terms: None allows one term for every three points; never more than leave two points over,
    nor more than the library has. A support to which one point is indispensable is left out.
    Raises ValueError for under three points, or a parameter that never varies.
    Source: Allen 1974, doi:10.1080/00401706.1974.10489157.
    """
    if len(values) < LEAST_POINTS:
        raise ValueError(f"a law needs three points or more, got {len(values)}")
    check_varying(parameters, library.variables, remedy="leave it out of the library")
    theta = library.evaluate(parameters)
    max_terms = max_terms or max(1, len(values) // POINTS_PER_TERM)
    support, coef, left_out = _search(values, theta, max_terms)
    fitted = theta[:, support] @ coef
    searched = np.empty_like(values)
    for k in range(len(values)):
        others, own, _ = _search(np.delete(values, k), np.delete(theta, k, axis=0), max_terms)
        searched[k] = theta[k, others] @ own
    varies = np.ptp(values) > 0.0
    return ControlLaw(
        functions=library.take(np.array(support)),
        coef=coef,
        r2=float(r2(truth=values, prediction=fitted[None])[0]) if varies else float("nan"),
        loo_error=_relative(values - left_out, values),
        search_error=_relative(values - searched, values),
    )


def _search(
    values: np.ndarray, theta: np.ndarray, max_terms: int
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Columns of a law, their coefficients, and values at points left out.

    Of all supports up to a size, one of fewest terms whose error cannot be distinguished from the
    least.
    """
    n_points, n_terms = theta.shape
    largest = max(1, min(n_terms, n_points - 2, max_terms))
    floor = ROUNDING * np.sqrt(np.square(values).mean())
    found: list[tuple[list[int], np.ndarray]] = []
    for size in range(1, largest + 1):
        for support in map(list, combinations(range(n_terms), size)):
            with suppress(ValueError):  # the points do not tell these columns apart
                left_out = Basis(theta[:, support]).predict_left_out(values)
                if np.isfinite(left_out).all():
                    found.append((support, left_out))
    if not found:
        return [0], least_squares(theta[:, :1], values), np.full_like(values, np.inf)
    errors = [np.maximum(np.abs(values - left_out), floor) for _, left_out in found]
    best = fewest_of_least(
        [(own, len(support)) for own, (support, _) in zip(errors, found, strict=True)]
    )
    support, left_out = found[best]
    return support, least_squares(theta[:, support], values), left_out


def _relative(errors: np.ndarray, values: np.ndarray) -> float:
    mean = abs(float(values.mean()))
    return float(np.sqrt(np.square(errors).mean())) / mean if mean else float("nan")


def lines_of(
    points: Sequence[Mapping[str, float]], *, least: int = 2
) -> list[tuple[str, dict[str, float]]]:
    """The lines of points along one parameter with the others held: (parameter, the others).

    Of every parameter, the line with most points, of at least as many.
    """
    found = []
    for along in points[0]:
        counts = Counter(
            tuple((name, value) for name, value in point.items() if name != along)
            for point in points
        )
        held, n = counts.most_common(1)[0]
        if n >= least:
            found.append((along, dict(held)))
    return found
