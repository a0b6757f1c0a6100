"""One model at several operating points, with trends and control laws: `+exp=parametric`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Annotated, Any

import numpy as np
import pandas as pd

from ep2sindy.discovery.method import AnyMethod
from ep2sindy.figures.operating import PUBLISHED, rows_at, trends_figure
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import constraint
from ep2sindy.library.units import SECONDS
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.point_fits import (
    Case,
    PointStudy,
    Refining,
    SharedResult,
    TimeBootstrap,
    fit_points,
    search_shared,
)
from ep2sindy.operating.quantities import (
    REFINED,
    Fitted,
    PointResult,
    Quantity,
    fit_control_laws,
    fit_power_law,
    fit_trends,
)
from ep2sindy.operating.records import point_label
from ep2sindy.regression.rows import Formulation
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
from ep2sindy.report.results import percent
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers
from ep2sindy.studies.fits import Terms, terms_of
from ep2sindy.studies.law_tables import (
    Laws,
    best_fit,
    control_laws_summary,
    control_laws_table,
    law_errors,
    published_table,
)
from ep2sindy.studies.points import QUIET, GivenPoints, given_points, open_points
from ep2sindy.studies.source import Source
from ep2sindy.studies.study import Check, Count
from ep2sindy.studies.views import coefficients, display_equation, with_error

MOST_LAWS = 3  # on the screen

INTERVALS = (
    "±: half the 95 % interval; of least squares by a moving-block bootstrap over time, of "
    "refinements from their covariance. It says how far another stretch of the same record would "
    "move a value, not how far the model is from the discharge: compare R2, and the fits. Nor does "
    "it hold the bias that smoothing and differencing leave in least squares, even without noise, "
    "which may be many times as large; refinements differentiate nothing. Refined models follow "
    "trajectories: R2 is that of the derivative, and may be negative where pulses are sharp."
)
TIED = "R2 at every point, with coefficients of its own, and with those of one law for all points."
TRENDS = (
    "Exponents p of quantity ~ parameter^p, with the other parameters held, and their 95 % "
    "intervals. R2 says whether the points follow it."
)
LEFT_OUT = (
    "Errors are RMS over the mean, at points left out: of the law's terms, fitted without the "
    "point that they predict; and of terms searched without it too, the honest one of the two."
)
WORDS = {
    "n_terms": "terms",
    "text": "equation",
    "n_points": "points",
    "r2": "R2",
    "r2_free": "R2, own coefficients",
    "r2_tied": "R2, one law",
    "loo_error": "error, same terms",
    "search_error": "error, searched",
}
UNITS = "Units are SI, unless a name ends in another, such as mdot_mg_s."
CAPTION = (
    "Quantities of the fit {}, against one parameter with the others held, with 95 % intervals, "
    "which are smaller than the marks where no bars show"
)


@dataclass(frozen=True)
class CaseSettings:
    """One way to fit the terms: relations of the coefficients, and the quantities these mean."""

    relations: Sequence[str] | None
    quantities: Mapping[str, Quantity]


@dataclass(frozen=True)
class SearchLibrary:
    """A polynomial library, the same for every point."""

    variables: Sequence[str]
    degree: int
    products: Sequence[str] = ()

    def library(self) -> Library:
        return polynomial(list(self.variables), degree=self.degree, products=list(self.products))


@dataclass(frozen=True)
class LawSettings:
    """Settings for laws, which give quantities as polynomials of the parameters.

    tied_degree: degree of the polynomials that tie the coefficients of the common support.
    """

    degree: int
    max_terms: Count | None
    tied_degree: int


@dataclass(frozen=True)
class Trend:
    """A trend along one parameter, with the others held fixed."""

    along: str
    at: Mapping[str, float]


@dataclass(frozen=True)
class Drawing:
    labels: Mapping[str, str]  # of parameters, quantities and publications on axes and in legends


Cases = Annotated[
    Mapping[str, CaseSettings],
    Check(
        "like {free: {relations: [], quantities: {k: {coefficient: 'x: x'}}}}",
        lambda value: isinstance(value, dict) and bool(value),
    ),
]
Published = Mapping[str, Sequence[Mapping[str, float]]]  # fit -> points with their quantities


@dataclass(frozen=True, eq=False)
class Study:
    """Fit, refine and search every operating point; then find laws, trends and a common support.

    parameters: the place of each parameter in the data group; None if it has none. points: the
    values of all parameters at each point, and `data` for other differences from the data group;
    or the pattern of files, which names the parameters.
    model: state -> terms. thesis: published quantities by fit; they are shown beside our fit of the
    same name.
    """

    source: Source
    method: AnyMethod
    formulation: Formulation
    parallel: Workers
    parameters: Mapping[str, str | None]
    points: Sequence[Mapping[str, Any]] | str
    model: Terms
    cases: Cases
    bootstrap: TimeBootstrap
    refining: Refining
    library: SearchLibrary
    law: LawSettings
    trends: Sequence[Trend]
    figures: Drawing
    thesis: Published | None = None

    def __post_init__(self) -> None:
        names = self._given.names
        for each in self.trends:
            if {each.along, *each.at} != set(names):
                raise ValueError(
                    f"a trend goes along one parameter and holds the others of {names}: {each} "
                    "came; trends=[] leaves all out"
                )

    @cached_property
    def _given(self) -> GivenPoints:
        return given_points(self.points, self.parameters, self.source)

    def compute(self, run: Run) -> Outcome:
        # Everything but the data is built first: a misspelt setting must not cost a simulation.
        names = self._given.names
        how = self.at_every_point()
        law, tying = (polynomial(names, degree=n) for n in (self.law.degree, self.law.tied_degree))
        published = published_table(self.thesis or {}, names)
        self._given.tell(run)
        sources = self._given.sources(self.source)
        inputs = self.source.inputs([how.library, how.searched])
        points = open_points(sources, inputs, workers=self.parallel, run=run)
        alone, together = np.random.default_rng(run.seed).spawn(2)

        def tell(number: int, result: PointResult) -> None:
            """Log a point to TensorBoard; the step is the number of the point in the config."""
            run.board.scalars(live(result), step=number)

        results = fit_points(
            points, how, workers=self.parallel, rng=alone, tell=tell, progress=run.watch
        )
        if not any(result.fits for result in results):
            run.warn("none of the operating points oscillates, so there is no fit: " + QUIET)
        return Outcome(
            study=how,
            results=results,
            laws=fit_control_laws(results, law, max_terms=self.law.max_terms),
            joint=search_shared(points, results, how, tying, rng=together, progress=run.watch),
            along=[(each.along, each.at) for each in self.trends],
            published=published,
            labels=self.figures.labels,
        )

    def at_every_point(self) -> PointStudy:
        library, terms = terms_of(self.model, states=self.source.states)
        return PointStudy(
            library=library,
            cases={
                name: Case(constraint(library, terms, case.relations or ()), case.quantities)
                for name, case in self.cases.items()
            },
            bootstrap=self.bootstrap,
            refining=self.refining,
            searched=self.library.library(),
            method=self.method,
            formulation=self.formulation,
        )


@dataclass(frozen=True, eq=False)
class Outcome:
    """Results of all points, and the laws, trends and common support derived from them.

    laws: by fit and quantity. joint: the search over all points at once; None if there was none.
    along: (parameter, values of the others) of every trend. published: from `published_table`.
    """

    study: PointStudy
    results: Sequence[PointResult]
    laws: Laws
    joint: SharedResult | None
    along: Sequence[tuple[str, Mapping[str, float]]]
    published: pd.DataFrame
    labels: Mapping[str, str]

    @property
    def searches(self) -> dict[str, Sequence[Fitted | None]]:
        """Results of the searches, one entry per point; None if a point was not fitted."""
        alone = {"each point": [result.searched for result in self.results]}
        return alone | ({"all points": self.joint.fitted} if self.joint else {})

    def models(self, pattern: str = "point_{}_{}") -> dict[str, SparseModel]:
        """Models by number of the point and name of the fit."""
        return {
            pattern.format(number, name): fit.model
            for number, result in enumerate(self.results)
            for name, fit in result.fits.items()
        }

    def tables(self) -> dict[str, pd.DataFrame]:
        return dict(self._tables)

    @cached_property
    def _tables(self) -> dict[str, pd.DataFrame]:
        given = [result.fits.get(next(iter(self.study.cases))) for result in self.results]
        return {
            "points": points_table(self.results),
            "quantities": estimates_table(self.results, self.published),
            "supports": supports_table(self.results, {"given": given, **self.searches}),
            "laws": control_laws_table(self.laws),
            "trends": trends_table(self.results, self.along, self.published),
            "tied": tied_table(self.joint),
            "coefficients": coefficients(self.models("point {}, {}"), heading="model"),
        }

    def figures(self) -> dict[str, Captioned]:
        """A figure of each case that was fitted; none if no trend was asked for."""
        estimates = self._tables["quantities"]
        if estimates.empty or not self.along:
            return {}
        fitted = set(estimates[estimates["usable"]]["fit"])
        return {f"trends_{case}": self._trends(case) for case in self.study.cases if case in fitted}

    def _trends(self, case: str) -> Captioned:
        """Quantities of one case: of least squares, refined, and published."""
        kinds = {case: "least squares", case + REFINED: "refined"}
        best = best_fit(kinds, self.results, self.laws)
        ours = self._tables["quantities"].query("usable and fit in @kinds")
        ours = ours.sort_values("fit", key=lambda fit: fit != best, kind="stable")
        theirs = rows_at(self.published, {"fit": case})
        theirs = theirs.assign(low=theirs["value"], high=theirs["value"], kind=PUBLISHED)
        table = pd.concat([ours.assign(kind=ours["fit"].map(kinds)), theirs])
        laws = self.laws.get(best, {})
        published = "; beside them what the thesis found in its data" if len(theirs) else ""
        lines = (
            f"; lines are the control laws of the filled marks, the fit {_spoken(best)}"
            if laws
            else ""
        )
        draw = partial(trends_figure, table, laws, trends=self.along, labels=self.labels)
        return Captioned(draw, f"{CAPTION.format(_spoken(case))}{published}{lines}.")

    def _units(self, fit: str) -> dict[str, str]:
        """Unit of every quantity of a fit."""
        units = next(each.fits[fit].model.units for each in self.results if each.fits)
        quantities = self.study.fits[fit].quantities
        return {name: each.unit(self.study.library, units) for name, each in quantities.items()}

    def in_short(self) -> Result:
        """How many points oscillate, and the laws of the fit that predicts left-out points best."""
        n_fitted = sum(bool(result.fits) for result in self.results)
        best = best_fit(self.study.fits, self.results, self.laws)
        laws = {best: self.laws[best]} if best in self.laws else {}
        shown = [
            replace(
                row["law"],
                unit=self._units(best)[row["quantity"]],
                mark=f" ({percent(2)(row['search_error'])} off where left out)",
                on_screen=True,
            )
            for row in control_laws_table(laws).to_dict("records")
        ]
        end = f"that oscillate, by the fit {_spoken(best)}" if shown else "that oscillate"
        return Result(
            f"Found: {len(shown) or 'no'} laws over {n_fitted} operating points {end}",
            shown[:MOST_LAWS],
            load='pandas.read_csv("{}/tables/laws.csv")',
            picture=next(iter(self.figures()), ""),
        )

    def sections(self) -> list[Section]:
        oscillating = [result for result in self.results if result.fits]
        cases, fits = (self.study.cases, self.study.fits) if oscillating else ((), ())
        lines = [Text(_point_line(result), warning=not result.fits) for result in self.results]
        return [
            *(_model(oscillating[0], case) for case in cases),
            Section("Operating points", [*lines, Text(UNITS, page_only=True)]),
            *(self._fit(fit) for fit in fits),
            *([Section("Intervals", [Text(INTERVALS)], level=3)] if fits else []),
            *self._together(),
        ]

    def _fit(self, fit: str) -> Section:
        """One row per point: quantities with half their interval widths, and published values."""
        estimates = rows_at(self._tables["quantities"], {"fit": fit})
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
        return Section(f"{_spoken(fit)}{thesis}", [Table(pd.DataFrame(rows))], level=3)

    def _together(self) -> list[Section]:
        """Sections on all points together: laws, trends, common support."""
        shown = self._tables
        tied = _table(shown["tied"], ["state"], TIED)
        if self.joint and self.joint.why_no_law:
            tied = [Text(f"Not tied by a law: {self.joint.why_no_law}.")]
        laws = _table(shown["laws"], ["fit"], LEFT_OUT)
        if not self.laws:
            n = max(sum(each.usable(fit) for each in self.results) for fit in self.study.fits)
            needed = "a law needs 3, and all parameters to vary over them"
            laws = [Text(f"None: {n} points fitted; {needed}.")]
        supports = _table(shown["supports"], list(self.results[0].parameters))
        trends = _table(shown["trends"], ["along", "fit"], TRENDS)
        return [
            Section("Terms found, beside those given", supports),
            Section("One support for all points", tied),
            Section("Trends", [*trends, *pictures(self.figures())]),
            Section("Control laws", laws),
        ]

    def summary(self) -> dict[str, Any]:
        return {
            "points": [
                point_summary(
                    result, self.study.cases, {name: at[k] for name, at in self.searches.items()}
                )
                for k, result in enumerate(self.results)
            ],
            "laws": control_laws_summary(self.laws),
            "trends": self._tables["trends"].to_dict("records"),
            "joint": shared_summary(self.joint),
        }

    def headline(self) -> dict[str, float]:
        n_oscillating = float(sum(bool(result.fits) for result in self.results))
        return {"n_oscillating": n_oscillating, **law_errors(self.laws, self.study.fits)}


def _model(result: PointResult, case: str) -> Section:
    at = ", ".join(f"{name} = {value:g}" for name, value in result.parameters.items())
    model = result.fits[case].model
    equations = [display_equation(model, state, on_screen=False) for state in model.states]
    return Section(f"Model: {case}, at {at}", equations)


def _point_line(result: PointResult) -> str:
    """`V_D_V=300, mdot_mg_s=5: oscillating, 14.1 kHz; 12001 samples of 1.5e-06 s`."""
    text = f"{point_label(result.parameters)}: {result.status}"
    if result.fits:
        text += f", {SECONDS.frequency_text(result.f_Hz)}"
    if result.n_samples:
        text += f"; {result.n_samples} samples of {SECONDS.duration_text(result.dt_s, digits=4)}"
    return text if result.fits else f"{text}; left out of trends"


def _heading(name: str, unit: str) -> str:
    """`g_inj (m^-3 s^-1)`: a quantity with its unit; names such as `L_m` already end in theirs."""
    return name if unit == "1" or name.endswith(f"_{unit}") else f"{name} ({unit})"


def _spoken(fit: str) -> str:
    return fit.replace("_", ", ")


def _cell(row: Mapping[Any, Any]) -> str:
    """`0.0241 ±0.0001 (0.025)`: value, half the interval's width, published value."""
    text = with_error(row["value"], 0.5 * (row["high"] - row["low"]))
    return text if np.isnan(row["thesis"]) else f"{text} ({row['thesis']:.3g})"


def _table(rows: pd.DataFrame, by: Sequence[str], note: str = "") -> list[Block]:
    """A table without its empty columns; a rule is drawn where the values of `by` change."""
    if rows.empty:
        return [Text("None.")]
    if "fit" in rows:
        rows = rows.assign(fit=rows["fit"].map(_spoken))
    keys = rows[list(by)]
    ends = (keys != keys.shift(-1)).any(axis=1)
    shown = rows.dropna(axis=1, how="all").round({"r2": 3, "exponent": 3})
    shown = shown.rename(columns=WORDS)
    return [Table(shown, breaks=np.flatnonzero(ends)[:-1].tolist(), note=note)]


def estimates_table(results: Sequence[PointResult], published: pd.DataFrame) -> pd.DataFrame:
    """One row per point, fit and quantity, with the published value."""
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
    if not rows:  # an empty table's columns have no types to merge on
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

    searches: one entry per point, None if the point was not fitted.
    """
    rows = []
    for k, result in enumerate(results):
        for search, found in searches.items():
            if (fitted := found[k]) is not None:
                for state, r2 in ((s, fitted.r2[s]) for s in fitted.model.states):
                    terms = fitted.model.terms(state)
                    row = (search, state, len(terms), r2, Equation(state, terms))
                    rows.append((*result.parameters.values(), *row))
    columns = [*results[0].parameters, "search", "state", "n_terms", "r2", "text"]
    return pd.DataFrame(rows, columns=columns)


def tied_table(joint: SharedResult | None) -> pd.DataFrame:
    """R2 at every point, with coefficients by one law and with its own."""
    rows = []
    if joint and joint.fit:
        for state, test in joint.fit.tests.items():
            terms = ", ".join(joint.fit.law.numbers[state])
            rows += [(state, terms, p, r2, test.r2_law[p]) for p, r2 in test.r2_free.items()]
    return pd.DataFrame(rows, columns=["state", "terms", "point", "r2_free", "r2_tied"])


def trends_table(
    results: Sequence[PointResult],
    along: Sequence[tuple[str, Mapping[str, float]]],
    published: pd.DataFrame,
) -> pd.DataFrame:
    """Exponents along each parameter with the others fixed, for our and the published values."""
    tables = [pd.DataFrame()]
    for parameter, at in along:
        table = fit_trends(results, along=parameter, at=at)
        for index, row in table.iterrows():
            known = rows_at(published, {**at, "fit": row["fit"], "quantity": row["quantity"]})
            x, values = (known[c].to_numpy(dtype=float) for c in (parameter, "value"))
            table.loc[index, "thesis"], _ = fit_power_law(x, values)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def point_summary(
    result: PointResult, cases: Mapping[str, Case], searched: Mapping[str, Fitted | None]
) -> dict[str, Any]:
    """Summary of a point; quantities are null without a fit, or if a refinement is not finite."""
    found = {name: _fit_summary(result.fits.get(name), case) for name, case in cases.items()}
    refined: dict[str, dict[str, Any]] = {}
    for name, case in cases.items():
        fit = result.fits.get(name + REFINED)
        values, ends, r2 = _fit_summary(fit, case)
        refined[name] = {"status": fit and fit.status, "loss": fit and fit.loss, **values}
        refined[name] |= {"ci95": ends, "r2": r2}
    return {
        **result.parameters,
        "status": result.status,
        "f_kHz": 1e-3 * result.f_Hz,
        "n_samples": result.n_samples,
        "dt_s": result.dt_s,
        **{name: values for name, (values, _, _) in found.items()},
        "ci95": {name: ends for name, (_, ends, _) in found.items()},
        "r2": {name: r2 for name, (_, _, r2) in found.items() if r2},
        "refined": refined,
        "searched": {
            search: {state: each.model.terms(state) for state in each.model.states}
            for search, each in searched.items()
            if each is not None
        },
    }


def _fit_summary(
    fit: Fitted | None, case: Case
) -> tuple[dict[str, float | None], dict[str, list[float]] | None, dict[str, float] | None]:
    """Values by quantity, ends of their intervals, and R2 by state."""
    if fit is None:
        return dict.fromkeys(case.quantities), None, None
    known = fit.estimates
    values = {name: known[name].value if name in known else None for name in case.quantities}
    return values, {name: [each.low, each.high] for name, each in known.items()}, dict(fit.r2)


def shared_summary(joint: SharedResult | None) -> dict[str, Any] | None:
    """The common support of all points, and its coefficients as polynomials of the parameters."""
    if joint is None:
        return None
    return {
        "terms": {state: list(terms) for state, terms in joint.found.chosen.items()},
        "tied": joint.fit and joint.fit.law.numbers,
        "why_not_tied": joint.why_no_law or None,
    }


def live(result: PointResult) -> dict[str, float]:
    """Scalars that TensorBoard shows for a point as soon as it is done."""
    scalars: dict[str, float] = {}
    for fit, fitted in result.fits.items():
        scalars |= {f"{fit}/{name}": each.value for name, each in fitted.estimates.items()}
        scalars |= {f"{fit}/r2/{state}": value for state, value in fitted.r2.items()}
    return scalars
