"""Tables of the parametric study: estimates, points, supports, laws, trends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from ep2sindy.figures.trends import rows_at
from ep2sindy.library.equations import equation_text
from ep2sindy.operating.point_fits import JointResult
from ep2sindy.operating.quantities import Fitted, PointResult
from ep2sindy.operating.quantity_law import ControlLaw, exponent, trends


def published_table(
    thesis: Mapping[str, Sequence[Mapping[str, float]]], parameters: Sequence[str]
) -> pd.DataFrame:
    """One row per published value: parameters, fit, quantity, value.

    thesis: fit -> points, each with its parameters and quantities.
    Raises ValueError for a published point without all parameters, or with nothing else.
    """
    rows = []
    for fit, points in thesis.items():
        for point in points:
            if not set(parameters) < set(point):
                raise ValueError(
                    f"thesis must give {list(parameters)} and quantities at every point, or be "
                    f"null: {point} came"
                )
            at = {name: point[name] for name in parameters}
            found = {name: value for name, value in point.items() if name not in at}
            rows += [{**at, "fit": fit, "quantity": q, "value": v} for q, v in found.items()]
    table = pd.DataFrame(rows, columns=[*parameters, "fit", "quantity", "value"])
    return table.astype(dict.fromkeys(parameters, float))


def estimates_table(results: Sequence[PointResult], published: pd.DataFrame) -> pd.DataFrame:
    """One row per point, fit and quantity, with what was published."""
    parameters = list(results[0].parameters)
    rows = [
        (*result.parameters.values(), fit, result.usable(fit), name, e.value, e.low, e.high)
        for result in results
        for fit, fitted in result.fits.items()
        for name, e in fitted.estimates.items()
    ]
    columns = [*parameters, "fit", "usable", "quantity", "value", "low", "high"]
    table = pd.DataFrame(rows, columns=columns)
    known = published.rename(columns={"value": "thesis"})
    if not rows:  # without rows columns have no types to merge on
        return table.assign(thesis=float("nan"))
    return table.merge(known, how="left", on=[*parameters, "fit", "quantity"])


def points_table(results: Sequence[PointResult]) -> pd.DataFrame:
    """One row per point and fit; a point without fits has one row with its status."""
    rows = []
    for result in results:
        row: dict[str, Any] = {
            **result.parameters,
            "point_status": result.status,
            "f_Hz": result.f_Hz,
            "n_samples": result.n_samples,
            "dt_s": result.dt_s,
            **{f"spread_{state}": value for state, value in result.spread.items()},
        }
        for fit, fitted in result.fits.items():
            of_fit = {"fit": fit, "fit_status": fitted.status, "loss": fitted.loss}
            rows.append(row | of_fit | {f"r2_{s}": value for s, value in fitted.r2.items()})
        if not result.fits:
            rows.append(row)
    return pd.DataFrame(rows)


def supports_table(
    results: Sequence[PointResult], searches: Mapping[str, Sequence[Fitted | None]]
) -> pd.DataFrame:
    """Terms of every search at each point, with R2 of the derivative.

    searches: one entry per point, None where there was nothing to fit.
    """
    rows = []
    for k, result in enumerate(results):
        for search, found in searches.items():
            if (fitted := found[k]) is not None:
                for state, r2 in ((s, fitted.r2[s]) for s in fitted.model.states):
                    terms = fitted.model.terms(state)
                    row = (search, state, len(terms), r2, equation_text(state, terms))
                    rows.append((*result.parameters.values(), *row))
    columns = [*results[0].parameters, "search", "state", "n_terms", "r2", "text"]
    return pd.DataFrame(rows, columns=columns)


def tied_table(joint: JointResult | None) -> pd.DataFrame:
    """What it costs to tie the coefficients of the support for all points: R2 at each of them."""
    tied = joint.tied.equations if joint and joint.tied else {}
    rows = [
        (state, ", ".join(equation.terms), point, r2, equation.r2_tied[point])
        for state, equation in tied.items()
        for point, r2 in equation.r2_free.items()
    ]
    return pd.DataFrame(rows, columns=["state", "terms", "point", "r2_free", "r2_tied"])


def laws_table(laws: Mapping[str, Mapping[str, ControlLaw]]) -> pd.DataFrame:
    rows = [
        (fit, name, _law_text(name, law), law.r2, law.loo_error, law.search_error)
        for fit, by_quantity in laws.items()
        for name, law in by_quantity.items()
    ]
    return pd.DataFrame(rows, columns=["fit", "quantity", "law", "r2", "loo_error", "search_error"])


def _law_text(name: str, law: ControlLaw) -> str:
    """A law reads like an equation, but no derivative: `L_m = 0.00816 + 5.37e-05 V_D_V`."""
    return equation_text(name, law.coef_by_term).replace("'", "", 1)


def trends_table(
    results: Sequence[PointResult],
    along: Sequence[tuple[str, Mapping[str, float]]],
    published: pd.DataFrame,
) -> pd.DataFrame:
    """Exponents along each parameter, the others held, and those of the published values."""
    tables = [pd.DataFrame()]
    for parameter, at in along:
        table = trends(results, along=parameter, at=at)
        for index, row in table.iterrows():
            known = rows_at(published, {**at, "fit": row["fit"], "quantity": row["quantity"]})
            table.loc[index, "thesis"] = exponent(
                known[parameter].to_numpy(dtype=float), known["value"].to_numpy(dtype=float)
            )
        tables.append(table)
    return pd.concat(tables, ignore_index=True)
