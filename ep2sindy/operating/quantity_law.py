"""Control laws and trends: one measured quantity as a function of operating parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pandas as pd
from jaxtyping import Float

from ep2sindy.data.numbers import least_squares
from ep2sindy.library.library import Library
from ep2sindy.model.scores import r2
from ep2sindy.operating.quantities import PointResult
from ep2sindy.operating.records import check_varying, left_out_predictions
from ep2sindy.runtime.values import check_count, read_only

# Share of the values' RMS: errors below it are rounding, and the law with fewer terms wins.
ROUNDING = 1e-10


@dataclass(frozen=True, eq=False)
class ControlLaw:
    """quantity = library(parameters) coef, with its errors.

    terms: of the library, in its order. coef: (terms,), in the units of quantity over term. r2: on
    the points of the fit; NaN for a quantity that does not vary. loo_error: leave-one-out RMS error
    with these terms, relative to the absolute mean of the quantity. search_error: the same with the
    terms searched again without the point.
    """

    library: Library
    terms: tuple[str, ...]
    coef: Float[np.ndarray, " terms"]
    r2: float
    loo_error: float
    search_error: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "coef", read_only(self.coef))

    @property
    def coef_by_term(self) -> dict[str, float]:
        return dict(zip(self.terms, self.coef.tolist(), strict=True))

    def predict(
        self, parameters: Float[np.ndarray, "points parameters"]
    ) -> Float[np.ndarray, " points"]:
        """The quantity at given points; columns in the order of the library's variables."""
        columns = [self.library.index(name) for name in self.terms]
        return self.library.evaluate(parameters)[:, columns] @ self.coef


def control_law(
    values: Float[np.ndarray, " points"],
    parameters: Float[np.ndarray, "points parameters"],
    library: Library,
    *,
    max_terms: int | None = None,
) -> ControlLaw:
    """Find the terms that predict best at points left out of their fit.

    All supports of up to `max_terms` terms are fitted by least squares, every point with the same
    weight, and judged by exact leave-one-out residuals r / (1 - h), with h the diagonal of the hat
    matrix. max_terms: None allows as many terms as leave two points over; never more than that, nor
    more than the library has. A support to which one point is indispensable has no such residual,
    and is left out.
    Raises ValueError for under three points, another number of parameters than variables, values
    that are not finite, or a parameter that never varies.
    Source: Allen 1974, doi:10.1080/00401706.1974.10489157.
    """
    _check(values, parameters, library, max_terms)
    theta = library.evaluate(parameters)
    support = _best_support(values, theta, max_terms)
    fitted, left_out = left_out_predictions(values, theta[:, support])
    coef = least_squares(theta[:, support], values)
    others = [np.delete(np.arange(len(values)), k) for k in range(len(values))]
    searched = [
        _predict_left_out(theta[k], values[rest], theta[rest], max_terms)
        for k, rest in enumerate(others)
    ]
    varies = np.ptp(values) > 0.0
    return ControlLaw(
        library=library,
        terms=tuple(library.names[j] for j in support),
        coef=coef,
        r2=float(r2(truth=values, prediction=fitted[None])[0]) if varies else float("nan"),
        loo_error=_relative(values - left_out, values),
        search_error=_relative(values - np.array(searched), values),
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


def _best_support(values: np.ndarray, theta: np.ndarray, max_terms: int | None) -> list[int]:
    """Columns of least leave-one-out error; the fewest of those equal up to rounding."""
    n_points, n_terms = theta.shape
    largest = max(1, min(n_terms, n_points - 2, max_terms or n_terms))
    floor = ROUNDING * np.sqrt(np.square(values).mean())
    best, lowest = [0], np.inf
    for size in range(1, largest + 1):
        for support in map(list, combinations(range(n_terms), size)):
            error = _rms(values - left_out_predictions(values, theta[:, support])[1])
            if max(error, floor) < lowest:
                best, lowest = support, max(error, floor)
    return best


def _predict_left_out(
    row: np.ndarray, values: np.ndarray, theta: np.ndarray, max_terms: int | None
) -> float:
    """Prediction at one more point by the law found in these."""
    support = _best_support(values, theta, max_terms)
    return float(row[support] @ least_squares(theta[:, support], values))


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.square(errors).mean()))


def _relative(errors: np.ndarray, values: np.ndarray) -> float:
    mean = abs(float(values.mean()))
    return _rms(errors) / mean if mean else float("nan")


def fit_names(results: Sequence[PointResult]) -> list[str]:
    """Names of all fits, in the order of the study."""
    return list(dict.fromkeys(name for result in results for name in result.fits))


def laws(
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
            name: control_law(_values(usable, fit, name), values, library, max_terms=max_terms)
            for name in usable[0].fits[fit].estimates
        }
    return found


def trends(results: Sequence[PointResult], *, along: str, at: Mapping[str, float]) -> pd.DataFrame:
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
                slopes = [exponent(x, draw) for draw in draws]
                low, high = np.percentile(slopes, (2.5, 97.5))
            row = {"fit": fit, "quantity": name, "along": along, "n_points": len(usable)}
            values = _values(usable, fit, name)
            row |= {"exponent": exponent(x, values), "r2": power_law_r2(x, values)}
            rows.append(row | {"low": low, "high": high})
    return pd.DataFrame(rows)


def exponent(x: Float[np.ndarray, " points"], values: Float[np.ndarray, " points"]) -> float:
    """Slope of log |values| against log x, by least squares.

    NaN unless x is positive and has two different values.
    """
    if len(x) < 2 or np.ptp(x) == 0.0 or x.min() <= 0.0:
        return float("nan")
    centred = np.log(x) - np.log(x).mean()
    return float(centred @ np.log(np.abs(values)) / np.square(centred).sum())


def power_law_r2(x: Float[np.ndarray, " points"], values: Float[np.ndarray, " points"]) -> float:
    """R2 of the line through logarithms; NaN for under three points or for equal values."""
    slope, logs = exponent(x, values), np.log(np.abs(values))
    if len(x) < 3 or np.isnan(slope) or np.ptp(logs) == 0.0:
        return float("nan")
    line = logs.mean() + slope * (np.log(x) - np.log(x).mean())
    return float(r2(truth=logs, prediction=line[None])[0])


def _values(usable: Sequence[PointResult], fit: str, name: str) -> np.ndarray:
    return np.array([each.fits[fit].estimates[name].value for each in usable])
