"""How the quantities of a parametric study go with the operating parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float

from ep2sindy.discovery.control_law import ControlLaw, control_law
from ep2sindy.library.library import Library
from ep2sindy.model.scores import r2
from ep2sindy.studies.parametric.points import PointResult


def fit_names(results: Sequence[PointResult]) -> list[str]:
    """Names of all fits, in the order of the study."""
    return list(dict.fromkeys(name for result in results for name in result.fits))


def laws(
    results: Sequence[PointResult], library: Library, *, max_terms: int | None = None
) -> dict[str, dict[str, ControlLaw]]:
    """A control law per fit and quantity, from the points whose fit came to its end.

    Fits with under three such points, or a parameter that does not vary over them, have none.
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

    One row per fit and quantity: the slope of logarithms, by least squares over the points.
    r2: of that line, whether the points are a power law at all; near zero, too, without a trend.
    low and high: its 95 % interval by the bootstraps of least-squares fits, points independent;
    it says how well the slope is known, not whether points lie on a line.
    Two points are always on a line: r2, low and high are NaN, as low and high of refined fits.
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
    """Slope of log |values| by log x, by least squares; NaN unless x is two numbers above zero."""
    if len(x) < 2 or np.ptp(x) == 0.0 or x.min() <= 0.0:
        return float("nan")
    centred = np.log(x) - np.log(x).mean()
    return float(centred @ np.log(np.abs(values)) / np.square(centred).sum())


def power_law_r2(x: Float[np.ndarray, " points"], values: Float[np.ndarray, " points"]) -> float:
    """R2 of the line through logarithms; NaN for under three points, or values all alike."""
    slope, logs = exponent(x, values), np.log(np.abs(values))
    if len(x) < 3 or np.isnan(slope) or np.ptp(logs) == 0.0:
        return float("nan")
    line = logs.mean() + slope * (np.log(x) - np.log(x).mean())
    return float(r2(truth=logs, prediction=line[None])[0])


def _values(usable: Sequence[PointResult], fit: str, name: str) -> np.ndarray:
    return np.array([each.fits[fit].estimates[name].value for each in usable])
