"""Physical quantities read from coefficients at each point, and their laws and trends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import pandas as pd
from jaxtyping import Float

from ep2sindy.data.numbers import least_squares
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, place_of
from ep2sindy.library.units import unit_product
from ep2sindy.model.model import SparseModel
from ep2sindy.model.scores import r2
from ep2sindy.operating.records import check_varying
from ep2sindy.regression.pooled import Basis
from ep2sindy.runtime.values import check_count, read_only

LEVEL = 0.95  # level of all intervals in this file
FITTED, SEARCHED, CONVERGED = "fitted", "searched", "converged"
REFINED = "_refined"  # suffix of the name of a case's refinement

# Share of the values' RMS: errors below it are rounding, and the law with fewer terms wins.
ROUNDING = 1e-10


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
                f"a quantity needs a coefficient such as 'n_i: n_i*u_iz': {self.coefficient!r} came"
            )
        if not np.isfinite(self.factor) or self.factor == 0.0 or self.power not in (-1, 1):
            raise ValueError(
                "a quantity is factor * coef^power, the factor not zero and the power 1 or -1: "
                f"factor={self.factor!r}, power={self.power!r} came"
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

    def slope(self, coef: float) -> float:
        """Derivative of the quantity by the coefficient."""
        return self.factor * self.power * coef ** (self.power - 1)

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


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model of one operating point.

    The model's covariance is that of the draws, or of the refinement.
    status: fitted (by least squares), searched, or the status of a refinement. r2: for each state,
    of the derivative, on training rows. loss: of a refinement, else NaN. draws: for each quantity,
    (draws,), the bootstrap draws behind the intervals of least squares.
    """

    model: SparseModel
    status: str
    r2: Mapping[str, float]
    loss: float = float("nan")
    estimates: Mapping[str, QuantityEstimate] = field(default_factory=dict)
    draws: Mapping[str, Float[np.ndarray, " draws"]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PointResult:
    """Results at one operating point; without fits unless its status is "oscillating".

    f_Hz: dominant frequency of the first state. spread: for each state, standard deviation over
    mean. fits: by the name of the case, and of the case + "_refined". searched: the model that the
    search chose.
    """

    parameters: Mapping[str, float]
    status: str
    n_samples: int = 0
    dt_s: float = float("nan")
    f_Hz: float = float("nan")
    spread: Mapping[str, float] = field(default_factory=dict)
    fits: Mapping[str, Fitted] = field(default_factory=dict)
    searched: Fitted | None = None

    def usable(self, fit: str) -> bool:
        """True if this fit exists and finished."""
        return fit in self.fits and self.fits[fit].status in (FITTED, CONVERGED)


def estimate_from_draws(
    coef: Float[np.ndarray, " coefs"],
    draws: Float[np.ndarray, "draws coefs"],
    quantities: Mapping[str, Quantity],
    constraint: Constraint,
    library: Library,
) -> tuple[dict[str, QuantityEstimate], dict[str, Float[np.ndarray, " draws"]]]:
    """Estimates with intervals from percentiles of draws, and the draws of every quantity.

    The reciprocal of a coefficient has an infinite interval if the coefficient's interval holds
    zero.
    coef, draws: in the order of the constraint's coefficients.
    """
    estimates, drawn = {}, {}
    for name, quantity in quantities.items():
        k = quantity.place(constraint, library)
        drawn[name] = quantity.evaluate(draws[:, k])
        ends = (50 * (1 - LEVEL), 50 * (1 + LEVEL))
        low, high = np.percentile(drawn[name], ends)
        if quantity.power < 0 and np.prod(np.sign(np.percentile(draws[:, k], ends))) <= 0:
            low, high = -np.inf, np.inf
        estimates[name] = QuantityEstimate(
            float(quantity.evaluate(coef[k : k + 1])[0]), float(low), float(high)
        )
    return estimates, drawn


def estimate_from_covariance(
    model: SparseModel,
    quantities: Mapping[str, Quantity],
    constraint: Constraint,
    library: Library,
) -> dict[str, QuantityEstimate]:
    """Estimates with intervals from the model's covariance, linearised in the coefficient."""
    estimates = {}
    for name, quantity in quantities.items():
        state, term = constraint.coefficients[quantity.place(constraint, library)]
        coef = model.terms(state)[term]
        low, _ = model.intervals(state, level=LEVEL)[term]
        reach = abs(quantity.slope(coef)) * (coef - low)
        value = float(quantity.evaluate(np.array([coef]))[0])
        estimates[name] = QuantityEstimate(value, value - reach, value + reach)
    return estimates


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

    Minimises the mean square of r_p / (1 - h_p) over all supports of up to `max_terms` terms, with
    r_p the residual of the point p in a least-squares fit, h_p its diagonal of the hat matrix, and
    so r_p / (1 - h_p) its residual in the fit to the other points.
    Assumes errors of equal variance at all points.
    max_terms: None allows as many terms as leave two points over; never more than that, nor more
    than the library has. A support to which one point is indispensable is left out.
    Raises ValueError for under three points, another number of parameters than variables, values
    that are not finite, or a parameter that never varies.
    Source: Allen 1974, doi:10.1080/00401706.1974.10489157.
    """
    _check(values, parameters, library, max_terms)
    theta = library.evaluate(parameters)
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


def _check(
    values: np.ndarray, parameters: np.ndarray, library: Library, max_terms: int | None
) -> None:
    names = list(library.variables)
    if len(values) < 3:
        raise ValueError(f"a law needs three points or more: {len(values)} came")
    if parameters.shape[1] != len(names):
        raise ValueError(
            f"parameters must have one column for each of {names}: {parameters.shape[1]} came"
        )
    if not (np.isfinite(values).all() and np.isfinite(parameters).all()):
        raise ValueError("values and parameters must be finite: leave out points that are not")
    check_varying(parameters, names, remedy="leave it out of the library")
    if max_terms is not None:
        check_count("max_terms", max_terms)


def _search(
    values: np.ndarray, theta: np.ndarray, max_terms: int | None
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Columns of least leave-one-out error, their coefficients, and values at points left out.

    Of supports that are equal up to rounding, the one of fewest columns is taken.
    """
    n_points, n_terms = theta.shape
    largest = max(1, min(n_terms, n_points - 2, max_terms or n_terms))
    floor = ROUNDING * np.sqrt(np.square(values).mean())
    best, lowest = ([0], np.full_like(values, np.inf)), np.inf
    for size in range(1, largest + 1):
        for support in map(list, combinations(range(n_terms), size)):
            with suppress(ValueError):  # the points do not tell these columns apart
                left_out = Basis(theta[:, support]).predict_left_out(values)
                error = max(_rms(values - left_out), floor)
                if error < lowest:
                    best, lowest = (support, left_out), error
    return best[0], least_squares(theta[:, best[0]], values), best[1]


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.square(errors).mean()))


def _relative(errors: np.ndarray, values: np.ndarray) -> float:
    mean = abs(float(values.mean()))
    return _rms(errors) / mean if mean else float("nan")


def fit_names(results: Sequence[PointResult]) -> list[str]:
    """Names of all fits, in the order of the study."""
    return list(dict.fromkeys(name for result in results for name in result.fits))


def fit_control_laws(
    results: Sequence[PointResult], library: Library, *, max_terms: int | None = None
) -> dict[str, dict[str, ControlLaw]]:
    """A control law per fit and quantity, from the points at which the fit finished.

    Fits with under three such points, or with a parameter that does not vary over them, are left
    out.
    """
    found = {}
    for fit in fit_names(results):
        usable = [result for result in results if result.usable(fit)]
        values = np.array([[each.parameters[v] for v in library.variables] for each in usable])
        if len(usable) < 3 or not np.ptp(values, axis=0).all():
            continue
        found[fit] = {
            name: fit_control_law(_values(usable, fit, name), values, library, max_terms=max_terms)
            for name in usable[0].fits[fit].estimates
        }
    return found


def fit_trends(
    results: Sequence[PointResult], *, along: str, at: Mapping[str, float]
) -> pd.DataFrame:
    """Exponents p of |quantity| ~ parameter^p along one parameter, the others held.

    One row per fit and quantity: the slope of logarithms, by least squares over the points. r2: of
    that line; it tells whether the points follow a power law at all, and is also near zero without
    a trend. low and high: 95 % interval of the slope by the bootstraps of least-squares fits,
    points independent. It says how well the slope is known, not whether the points lie on a line.
    With two points, which are always on a line, r2, low and high are NaN; low and high are also NaN
    for refined fits.
    """
    held = [each for each in results if all(each.parameters[k] == v for k, v in at.items())]
    rows = []
    for fit in fit_names(results):
        usable = [each for each in held if each.usable(fit)]
        x = np.array([each.parameters[along] for each in usable])
        for name in usable[0].fits[fit].estimates if usable else ():
            low, high = np.nan, np.nan
            if len(usable) > 2 and all(each.fits[fit].draws for each in usable):
                draws = np.stack([each.fits[fit].draws[name] for each in usable], axis=1)
                slopes = [fit_power_law(x, draw)[0] for draw in draws]
                low, high = np.percentile(slopes, (2.5, 97.5))
            row = {"fit": fit, "quantity": name, "along": along, "n_points": len(usable)}
            slope, share = fit_power_law(x, _values(usable, fit, name))
            row |= {"exponent": slope, "r2": share}
            rows.append(row | {"low": low, "high": high})
    return pd.DataFrame(rows)


def fit_power_law(
    x: Float[np.ndarray, " points"], values: Float[np.ndarray, " points"]
) -> tuple[float, float]:
    """Slope of log |values| against log x by least squares, and the R2 of this line.

    Both are NaN unless x is positive and has two different values; R2 also for under three points
    or for equal values.
    """
    if len(x) < 2 or np.ptp(x) == 0.0 or x.min() <= 0.0:
        return float("nan"), float("nan")
    logs, centred = np.log(np.abs(values)), np.log(x) - np.log(x).mean()
    slope = float(centred @ logs / np.square(centred).sum())
    if len(x) < 3 or np.ptp(logs) == 0.0:
        return slope, float("nan")
    line = logs.mean() + slope * centred
    return slope, float(r2(truth=logs, prediction=line[None])[0])


def _values(usable: Sequence[PointResult], fit: str, name: str) -> np.ndarray:
    return np.array([each.fits[fit].estimates[name].value for each in usable])
