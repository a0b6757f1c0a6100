"""Quantities read from coefficients over operating points: their tables, control laws, trends."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtri

from ep2sindy.figures.operating import PUBLISHED, rows_at, trends_figure
from ep2sindy.library.library import Library
from ep2sindy.operating.given_models import REFINED, GivenModel, PointResult
from ep2sindy.operating.quantities import (
    LEVEL,
    ControlLaw,
    control_functions,
    fit_control_law,
    fit_trend,
    lines_of,
)
from ep2sindy.operating.records import read_points
from ep2sindy.report.document import (
    Block,
    Captioned,
    Equation,
    Result,
    Section,
    Table,
    Text,
    pictures,
)
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, percent
from ep2sindy.studies.law_tables import spoken
from ep2sindy.studies.views import with_error

MOST_LAWS = 3  # on the screen
LEAST_POINTS = 3  # of a control law

INTERVALS = (
    "±: half the 95 % interval, a sandwich: of least squares with blocks of two periods as "
    "clusters, of refinements with windows. It says how far another stretch of the same record "
    "would move a value, not how far the model is from the discharge: compare R2, and the fits. "
    "Nor does it hold the bias that smoothing and differencing leave in least squares, even "
    "without noise, which may be many times as large; refinements differentiate nothing. Refined "
    "models follow trajectories: R2 is that of the derivative, and may be negative where pulses "
    "are sharp."
)
TRENDS = (
    "Exponents p of quantity ~ parameter^p, with the other parameters held, and their 95 % "
    "intervals. R2 says whether the points follow it."
)
CONTROL = (
    "Errors are RMS over the mean, at points left out: of the law's terms, fitted without the "
    "point that they predict; and of terms searched without it too, the honest one of the two."
)
CAPTION = (
    "Quantities of the fit {}, against one parameter with the others held, with 95 % intervals, "
    "which are smaller than the marks where no bars show"
)
WORDS = {
    "n_points": "points",
    "r2": "R2",
    "loo_error": "error, same terms",
    "search_error": "error, searched",
}

# A control law with its fit and quantity. Its errors are those at points left out.
CONTROL_LAW: Metrics[tuple[str, str, ControlLaw]] = [
    Metric("fit", lambda row: row[0], View.CSV),
    Metric("quantity", lambda row: row[1], View.CSV),
    Metric("law", lambda row: Equation(row[1], row[2].coef_by_term, rate=False), View.CSV),
    Metric("r2", lambda row: row[2].r2, View.CSV),
    Metric("loo_error", lambda row: row[2].loo_error, View.CSV),
    Metric("search_error", lambda row: row[2].search_error, View.CSV),
]


@dataclass(frozen=True, eq=False)
class FoundQuantities:
    """Quantities of every model at every point, by least squares and refined.

    models: by name. errors: for each fit, the mean error of its law at points left out; empty if
    the points do not suffice for laws. published: values by fit -> points with their parameters and
    quantities. labels: of parameters, quantities and publications on axes and in legends.
    """

    library: Library
    models: Mapping[str, GivenModel]
    results: Sequence[PointResult]
    errors: Mapping[str, float]
    published: Mapping[str, Sequence[Mapping[str, float]]]
    labels: Mapping[str, str]

    @property
    def parameters(self) -> list[str]:
        return list(self.results[0].parameters)

    @property
    def fits(self) -> dict[str, GivenModel]:
        """All fits of a point by name: every model with quantities, and its refinement."""
        return {
            name + end: model
            for name, model in self.models.items()
            for end in ("", REFINED)
            if model.quantities
        }

    @cached_property
    def laws(self) -> dict[str, dict[str, ControlLaw]]:
        """A control law per fit and quantity, from the points at which the fit finished."""
        found = {}
        for fit, model in self.fits.items():
            used = [result for result in self.results if result.is_usable(fit)]
            points = read_points([each.parameters for each in used], self.parameters)
            if len(used) < LEAST_POINTS or not np.ptp(points, axis=0).all():
                continue
            functions = control_functions(self.parameters, points)
            found[fit] = {
                name: fit_control_law(_values(used, fit, name), points, functions)
                for name in model.quantities
            }
        return found

    @property
    def best(self) -> str | None:
        """The fit of least error at points left out, of those that have control laws."""
        return min(self.laws, key=lambda fit: self.errors.get(fit, np.inf), default=None)

    def tables(self) -> dict[str, pd.DataFrame]:
        laws = [(fit, name, law) for fit, of in self.laws.items() for name, law in of.items()]
        return {
            "quantities": self.estimates,
            "control_laws": ResultTable(laws, CONTROL_LAW).csv(),
            "trends": self.trends,
        }

    @cached_property
    def estimates(self) -> pd.DataFrame:
        """One row per point, fit and quantity, with the published value."""
        rows = [
            {**result.parameters, "fit": fit, "usable": result.is_usable(fit), "quantity": name,
             "value": each.value, "low": each.low, "high": each.high}
            for result in self.results
            for fit, fitted in result.fits.items()
            for name, each in fitted.estimates.items()
        ]  # fmt: skip
        columns = [*self.parameters, "fit", "usable", "quantity", "value", "low", "high"]
        table = pd.DataFrame(rows, columns=columns)
        known = self._published.rename(columns={"value": "thesis"})
        if not rows:  # an empty table's columns have no types to merge on
            return table.assign(thesis=float("nan"))
        return table.merge(known, how="left", on=[*self.parameters, "fit", "quantity"])

    @cached_property
    def _published(self) -> pd.DataFrame:
        rows = [
            {
                **{name: point[name] for name in self.parameters},
                "fit": fit,
                "quantity": q,
                "value": v,
            }
            for fit, points in self.published.items()
            for point in points
            for q, v in point.items()
            if q not in self.parameters
        ]
        table = pd.DataFrame(rows, columns=[*self.parameters, "fit", "quantity", "value"])
        return table.astype(dict.fromkeys(self.parameters, float))

    @property
    def lines(self) -> list[tuple[str, dict[str, float]]]:
        """The lines of points that trends go along: a parameter, and the others held."""
        return lines_of([result.parameters for result in self.results if result.fits] or [{}])

    @cached_property
    def trends(self) -> pd.DataFrame:
        """Exponents along each parameter with the others held, for our and the published values."""
        rows = []
        for along, at in self.lines:
            held = [r for r in self.results if all(r.parameters[k] == v for k, v in at.items())]
            for fit, model in self.fits.items():
                used = [result for result in held if result.is_usable(fit)]
                x = np.array([result.parameters[along] for result in used])
                for name in model.quantities:
                    trend = fit_trend(x, _values(used, fit, name), _std(used, fit, name))
                    where = {**at, "fit": fit, "quantity": name}
                    known = rows_at(self._published, where)
                    xs, values = (known[c].to_numpy(dtype=float) for c in (along, "value"))
                    row = {"fit": fit, "quantity": name, "along": along, **vars(trend)}
                    rows.append(row | {"thesis": fit_trend(xs, values).exponent})
        return pd.DataFrame(rows)

    def figures(self) -> dict[str, Captioned]:
        """A figure of each model that was fitted, along every line of points."""
        if self.estimates.empty or not self.lines:
            return {}
        fitted = set(self.estimates[self.estimates["usable"]]["fit"])
        return {f"trends_{name}": self._figure(name) for name in self.models if name in fitted}

    def _figure(self, model: str) -> Captioned:
        """Quantities of one model: of least squares, refined, and published."""
        kinds = {model: "least squares", model + REFINED: "refined"}
        best = min(kinds, key=lambda fit: self.errors.get(fit, np.inf))
        ours = self.estimates.query("usable and fit in @kinds")
        ours = ours.sort_values("fit", key=lambda fit: fit != best, kind="stable")
        theirs = rows_at(self._published, {"fit": model})
        theirs = theirs.assign(low=theirs["value"], high=theirs["value"], kind=PUBLISHED)
        table = pd.concat([ours.assign(kind=ours["fit"].map(kinds)), theirs])
        laws = self.laws.get(best, {})
        published = "; beside them what the thesis found in its data" if len(theirs) else ""
        lines = f"; lines are the control laws of the filled marks, the fit {spoken(best)}"
        draw = partial(trends_figure, table, laws, trends=self.lines, labels=self.labels)
        return Captioned(
            draw, f"{CAPTION.format(spoken(model))}{published}{lines if laws else ''}."
        )

    def _units(self, fit: str) -> dict[str, str]:
        """Unit of every quantity of a fit."""
        units = next(each.fits[fit].model.units for each in self.results if each.fits)
        return {n: q.unit(self.library, units) for n, q in self.fits[fit].quantities.items()}

    def in_short(self, compared: str) -> Result:
        """The control laws of the fit that does best at points left out.

        compared: the errors of all fits, in words.
        """
        best, shown = self.best, list[Block]()
        if best is not None:
            units = self._units(best)
            shown += [
                Equation(
                    name,
                    law.coef_by_term,
                    rate=False,
                    unit=units[name],
                    mark=f" ({percent(2)(law.search_error)} off where left out)",
                    on_screen=True,
                )
                for name, law in self.laws[best].items()
            ]
        end = f", by the fit {spoken(best)}" if best else ""
        n_fitted = sum(bool(result.fits) for result in self.results)
        return Result(
            f"Found: {len(shown) or 'no'} control laws over {n_fitted} operating points that "
            f"oscillate{end}",
            [*shown[:MOST_LAWS], *([Text(compared)] if compared else [])],
            load='pandas.read_csv("{}/tables/control_laws.csv")',
            picture=next(iter(self.figures()), ""),
        )

    def sections(self) -> Iterator[Section]:
        for fit in self.fits:
            yield self._fit(fit)
        yield Section("Intervals", [Text(INTERVALS)], level=3)
        trends = _table(self.trends, ["along", "fit"], TRENDS)
        yield Section("Trends", [*trends, *pictures(self.figures())])
        laws = self.tables()["control_laws"]
        needed = f"a law needs {LEAST_POINTS} points, and all parameters to vary over them"
        none = [Text(f"None: {needed}.")]
        yield Section("Control laws", _table(laws, ["fit"], CONTROL) if len(laws) else none)

    def _fit(self, fit: str) -> Section:
        """One row per point: quantities with half their interval widths, and published values."""
        estimates = rows_at(self.estimates, {"fit": fit})
        headings = {name: _heading(name, unit) for name, unit in self._units(fit).items()}
        rows = []
        for result in self.results:
            here = rows_at(estimates, result.parameters).to_dict("records")
            cells = {each["quantity"]: _cell(each) for each in here}
            row: dict[str, Any] = dict(result.parameters)
            row |= {heading: cells.get(name, "-") for name, heading in headings.items()}
            if fitted := result.fits.get(fit):
                row |= {f"R2 {state}": f"{value:.2f}" for state, value in fitted.r2.items()}
                row |= {"loss": f"{fitted.loss:.3f}"} if fit.endswith(REFINED) else {}
            rows.append(row | {"status": fitted.status if fitted else result.status})
        thesis = " (thesis)" if estimates["thesis"].notna().any() else ""
        return Section(f"{spoken(fit)}{thesis}", [Table(pd.DataFrame(rows))], level=3)

    def headline(self) -> dict[str, float]:
        """Prediction error of the laws by fit and quantity; NaN for a law that was not found."""
        found = {}
        for fit, model in self.fits.items():
            for name in model.quantities:
                law = self.laws.get(fit, {}).get(name)
                found[f"law/{fit}/{name}/loo_error"] = law.loo_error if law else np.nan
                found[f"law/{fit}/{name}/search_error"] = law.search_error if law else np.nan
        return found


def check_published(
    published: Mapping[str, Sequence[Mapping[str, float]]], parameters: Sequence[str]
) -> None:
    """Raise ValueError for a published point without all parameters, or with nothing else."""
    for points in published.values():
        for point in points:
            if not set(parameters) < set(point):
                raise ValueError(
                    f"thesis must give {list(parameters)} and quantities at every point, or be "
                    f"null: {point} came"
                )


def _values(used: Sequence[PointResult], fit: str, name: str) -> np.ndarray:
    return np.array([result.fits[fit].estimates[name].value for result in used])


def _std(used: Sequence[PointResult], fit: str, name: str) -> np.ndarray:
    """Standard deviations by the intervals."""
    ends = [result.fits[fit].estimates[name] for result in used]
    return np.array([each.high - each.low for each in ends]) / (2.0 * ndtri(0.5 + 0.5 * LEVEL))


def _heading(name: str, unit: str) -> str:
    """`g_inj (m^-3 s^-1)`: a quantity with its unit; names such as `L_m` already end in theirs."""
    return name if unit == "1" or name.endswith(f"_{unit}") else f"{name} ({unit})"


def _cell(row: Mapping[Any, Any]) -> str:
    """`0.0241 ±0.0001 (0.025)`: value, half the interval's width, published value."""
    text = with_error(row["value"], 0.5 * (row["high"] - row["low"]))
    return text if np.isnan(row["thesis"]) else f"{text} ({row['thesis']:.3g})"


def _table(rows: pd.DataFrame, by: Sequence[str], note: str = "") -> list[Block]:
    """A table without its empty columns; a rule is drawn where the values of `by` change."""
    if rows.empty:
        return [Text("None.")]
    rows = rows.assign(fit=rows["fit"].map(spoken))
    keys = rows[list(by)]
    ends = (keys != keys.shift(-1)).any(axis=1)
    shown = rows.dropna(axis=1, how="all").round({"r2": 3, "exponent": 3}).rename(columns=WORDS)
    return [Table(shown, breaks=np.flatnonzero(ends)[:-1].tolist(), note=note)]
