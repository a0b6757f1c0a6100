"""Tables of the parametric study: estimates, points, supports, laws, trends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.discovery.control_law import ControlLaw
from ep2sindy.library.equations import equation_text
from ep2sindy.model.model import SparseModel
from ep2sindy.studies.parametric.all_points import JointResult
from ep2sindy.studies.parametric.points import Fitted, PointResult, PointStudy
from ep2sindy.studies.parametric.trends import exponent, trends
from ep2sindy.studies.shown import coefficients

EACH_POINT, ALL_POINTS = "each point", "all points"


@dataclass(frozen=True, eq=False)
class Findings:
    """What all points gave, and what is made of them together.

    laws: by fit and quantity. joint: the search over all points at once; None where there was
    none. along: (parameter, those held) of every trend. published: as `published_table` makes it.
    """

    study: PointStudy
    parameters: Sequence[str]
    results: Sequence[PointResult]
    laws: Mapping[str, Mapping[str, ControlLaw]]
    joint: JointResult | None
    along: Sequence[tuple[str, Mapping[str, float]]]
    published: pd.DataFrame

    @property
    def searches(self) -> dict[str, Sequence[Fitted | None]]:
        """What searches chose, one entry per point, None where there was nothing to fit."""
        alone = {EACH_POINT: [result.searched for result in self.results]}
        return alone | ({ALL_POINTS: self.joint.fitted} if self.joint else {})

    @property
    def models(self) -> dict[tuple[int, str], SparseModel]:
        """By number of the point and name of the fit."""
        return {
            (number, name): fit.model
            for number, result in enumerate(self.results)
            for name, fit in result.fits.items()
        }

    @cached_property
    def estimates(self) -> pd.DataFrame:
        """One row per point, fit and quantity, with what was published."""
        keys = [*self.parameters, "fit", "quantity"]
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
            for result in self.results
            for fit, fitted in result.fits.items()
            for name, estimate in fitted.estimates.items()
        ]
        columns = [*self.parameters, "fit", "usable", "quantity", "value", "low", "high"]
        table = pd.DataFrame(rows, columns=columns)
        published = self.published.rename(columns={"value": "thesis"})
        return table.merge(published, how="left", on=keys) if rows else table.assign(thesis=np.nan)

    @cached_property
    def trends(self) -> pd.DataFrame:
        """Exponents along each parameter, and those of the published values."""
        tables = []
        for along, at in self.along:
            table = trends(self.results, along=along, at=at)
            for index, row in table.iterrows():
                known = self.published
                for key, value in {**at, "fit": row["fit"], "quantity": row["quantity"]}.items():
                    known = known[known[key] == value]
                table.loc[index, "thesis"] = exponent(
                    known[along].to_numpy(dtype=float), known["value"].to_numpy(dtype=float)
                )
            tables.append(table)
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    def tables(self) -> dict[str, pd.DataFrame]:
        models = {f"point {number}, {fit}": model for (number, fit), model in self.models.items()}
        return {
            "points": points_table(self.results),
            "quantities": self.estimates,
            "supports": supports_table(self),
            "laws": laws_table(self.laws),
            "trends": self.trends,
            "tied": tied_table(self.joint),
            "coefficients": coefficients(models, heading="model"),
        }


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


def supports_table(found: Findings) -> pd.DataFrame:
    """Terms that searches chose at each point, and those given, with R2 of the derivative."""
    given = [result.fits.get(next(iter(found.study.cases))) for result in found.results]
    rows = []
    for k, result in enumerate(found.results):
        for search, each in {"given": given, **found.searches}.items():
            if (fitted := each[k]) is not None:
                for state in fitted.model.states:
                    terms = fitted.model.terms(state)
                    row = {**result.parameters, "search": search, "state": state}
                    row |= {"n_terms": len(terms), "r2": fitted.r2[state]}
                    rows.append(row | {"text": equation_text(state, terms)})
    columns = [*found.parameters, "search", "state", "n_terms", "r2", "text"]
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
        (fit, name, law_text(name, law), law.r2, law.loo_error, law.search_error)
        for fit, by_quantity in laws.items()
        for name, law in by_quantity.items()
    ]
    return pd.DataFrame(rows, columns=["fit", "quantity", "law", "r2", "loo_error", "search_error"])


def law_text(name: str, law: ControlLaw) -> str:
    """`L_m = 0.00816 + 5.37e-05 V_D_V`: like an equation, but no derivative."""
    return equation_text(name, law.coef_by_term).replace("'", "", 1)
