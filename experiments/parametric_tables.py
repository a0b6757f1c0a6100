"""Tables of `+exp=parametric`: estimates, points, supports, laws, trends."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.discovery.control_law import ControlLaw
from ep2sindy.library.equations import equation_text
from ep2sindy.studies.parametric.all_points import JointResult
from ep2sindy.studies.parametric.points import Fitted, PointResult, Study
from ep2sindy.studies.parametric.trends import exponent, trends

EACH_POINT, ALL_POINTS = "each point", "all points"


@dataclass(frozen=True)
class Outcome:
    """What the tables, the figures and the page are made from.

    searches: what a search chose, one entry per point, None where there was nothing to fit.
    joint: the search over all points at once; None where there was none.
    trends: (parameter, those held). published: as `published_table` makes it.
    """

    title: str
    study: Study
    parameters: Sequence[str]
    results: Sequence[PointResult]
    laws: Mapping[str, Mapping[str, ControlLaw]]
    searches: Mapping[str, Sequence[Fitted | None]]
    joint: JointResult | None
    trends: Sequence[tuple[str, Mapping[str, float]]]
    published: pd.DataFrame


def published_table(thesis: Any, parameters: Sequence[str]) -> pd.DataFrame:
    """One row per published value: parameters, fit, quantity, value. thesis: None for nothing.

    Raises ValueError for a published point without all parameters.
    """
    for points in (thesis or {}).values():
        for point in points:
            if not set(parameters) < set(point):
                raise ValueError(
                    f"thesis must give {list(parameters)} and quantities at every point, or be "
                    f"null: {point} came"
                )
    rows = [
        {**{p: float(point[p]) for p in parameters}, "fit": fit, "quantity": name, "value": value}
        for fit, points in (thesis or {}).items()
        for point in points
        for name, value in point.items()
        if name not in parameters
    ]
    columns = [*parameters, "fit", "quantity", "value"]
    return pd.DataFrame(rows, columns=columns).astype(dict.fromkeys(parameters, float))


def estimates_table(outcome: Outcome) -> pd.DataFrame:
    """One row per point, fit and quantity, beside what was published. usable: see `laws`."""
    rows = [
        {
            **result.parameters,
            "fit": fit,
            "usable": result.usable(fit),
            "quantity": name,
            "value": estimate.value,
            "low": estimate.low,
            "high": estimate.high,
        }
        for result in outcome.results
        for fit, fitted in result.fits.items()
        for name, estimate in fitted.estimates.items()
    ]
    keys = [*outcome.parameters, "fit", "quantity"]
    columns = [*outcome.parameters, "fit", "usable", "quantity", "value", "low", "high"]
    table = pd.DataFrame(rows, columns=columns)
    published = outcome.published.rename(columns={"value": "thesis"})
    return table.merge(published, how="left", on=keys) if rows else table.assign(thesis=np.nan)


def points_table(outcome: Outcome) -> pd.DataFrame:
    """One row per point and fit; a point without fits has one row with its status."""
    rows = []
    for result in outcome.results:
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


def supports_table(outcome: Outcome) -> pd.DataFrame:
    """Terms that searches chose at each point, and those given, with R2 of the derivative."""
    rows = []
    first = next(iter(outcome.study.cases))
    for k, result in enumerate(outcome.results):
        if not result.fits:
            continue
        found = {"given": result.fits[first]}
        for name, each in outcome.searches.items():
            if (chosen := each[k]) is not None:
                found[name] = chosen
        for search, fitted in found.items():
            for state in fitted.model.states:
                terms = fitted.model.terms(state)
                row = {**result.parameters, "search": search, "state": state}
                text = equation_text(state, terms)
                rows.append(row | {"n_terms": len(terms), "r2": fitted.r2[state], "text": text})
    columns = [*outcome.parameters, "search", "state", "n_terms", "r2", "text"]
    return pd.DataFrame(rows, columns=columns)


def tied_table(outcome: Outcome) -> pd.DataFrame:
    """What it costs to tie the coefficients of the support for all points: R2 at each of them."""
    columns = ["state", "terms", "point", "r2_free", "r2_tied"]
    if outcome.joint is None or outcome.joint.tied is None:
        return pd.DataFrame(columns=columns)
    rows = [
        (state, ", ".join(equation.terms), point, r2, equation.r2_tied[point])
        for state, equation in outcome.joint.tied.equations.items()
        for point, r2 in equation.r2_free.items()
    ]
    return pd.DataFrame(rows, columns=columns)


def laws_table(outcome: Outcome) -> pd.DataFrame:
    rows = [
        {
            "fit": fit,
            "quantity": name,
            "law": law_text(name, law),
            "r2": law.r2,
            "loo_error": law.loo_error,
            "search_error": law.search_error,
        }
        for fit, laws in outcome.laws.items()
        for name, law in laws.items()
    ]
    return pd.DataFrame(rows, columns=["fit", "quantity", "law", "r2", "loo_error", "search_error"])


def law_text(name: str, law: ControlLaw) -> str:
    """`L_m = 0.00816 + 5.37e-05 V_D_V`: like an equation, but no derivative."""
    return equation_text(name, law.coef_by_term).replace("'", "", 1)


def trends_table(outcome: Outcome) -> pd.DataFrame:
    """Exponents along each parameter, and those of the published values."""
    tables = []
    for along, at in outcome.trends:
        table = trends(outcome.results, along=along, at=at)
        for index, row in table.iterrows():
            known = outcome.published
            for key, value in {**at, "fit": row["fit"], "quantity": row["quantity"]}.items():
                known = known[known[key] == value]
            table.loc[index, "thesis"] = exponent(
                known[along].to_numpy(dtype=float), known["value"].to_numpy(dtype=float)
            )
        tables.append(table)
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()
