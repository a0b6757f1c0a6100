"""What the parametric study leaves, and how it reads on the terminal and on the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.figures.trends import rows_at, trends_figure
from ep2sindy.library.units import SECONDS
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.point_fits import JointResult, PointStudy
from ep2sindy.operating.quantities import REFINED, Fitted, PointResult
from ep2sindy.operating.records import point_label
from ep2sindy.report.document import Block, Captioned, Equation, Picture, Section, Table, Text
from ep2sindy.studies.parametric import summary, tables
from ep2sindy.studies.shown import coefficients

INTERVALS = (
    "±: half the 95 % interval; of least squares by a moving-block bootstrap over time, of "
    "refinements from their covariance. It says how far another stretch of the same record would "
    "move a value, not how far the model is from the discharge: compare R2, and the fits. Nor does "
    "it hold the bias that smoothing and differencing leave in least squares, even without noise, "
    "which may be many times as large; refinements differentiate nothing. Refined models follow "
    "trajectories: R2 is that of the derivative, and may be negative where pulses are sharp."
)
TIED = "One support for all points: R2 with coefficients of its own at each, and tied by a law"
TRENDS = (
    "Trends: exponents p of quantity ~ parameter^p, the other parameters held, with 95 % "
    "intervals; r2: whether points follow it"
)
LAWS = "Control laws, with the RMS error at points left out, over the mean"
LEFT_OUT = (
    "loo_error: the law's terms, fitted without the point that they predict. search_error: the "
    "terms searched without it too, the honest one of the two."
)
UNITS = "Units are SI, unless a name ends in another, such as mdot_mg_s."
CAPTION = (
    "Quantities against one parameter, the others held: filled with 95 % intervals, which are "
    "smaller than the markers where no bars show"
)


@dataclass(frozen=True)
class Panels:
    """Quantities that share a panel of the figure, and what axes and legend call them."""

    panels: Sequence[Sequence[str]]
    labels: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What all points gave, and what is made of them together.

    laws: by fit and quantity. joint: the search over all points at once; None where there was
    none. along: (parameter, those held) of every trend. published: as `published_table` makes it.
    """

    study: PointStudy
    results: Sequence[PointResult]
    laws: summary.Laws
    joint: JointResult | None
    along: Sequence[tuple[str, Mapping[str, float]]]
    published: pd.DataFrame
    shown: Panels

    @property
    def searches(self) -> dict[str, Sequence[Fitted | None]]:
        """What searches chose, one entry per point, None where there was nothing to fit."""
        alone = {"each point": [result.searched for result in self.results]}
        return alone | ({"all points": self.joint.fitted} if self.joint else {})

    def models(self, pattern: str = "point_{}_{}") -> dict[str, SparseModel]:
        """By number of the point and name of the fit."""
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
            "points": tables.points_table(self.results),
            "quantities": tables.estimates_table(self.results, self.published),
            "supports": tables.supports_table(self.results, {"given": given, **self.searches}),
            "laws": tables.laws_table(self.laws),
            "trends": tables.trends_table(self.results, self.along, self.published),
            "tied": tables.tied_table(self.joint),
            "coefficients": coefficients(self.models("point {}, {}"), heading="model"),
        }

    def figures(self) -> dict[str, Captioned]:
        """None where no point oscillates or no trend was asked for: it would say nothing."""
        estimates = self._tables["quantities"]
        if estimates.empty or not self.along or not self.shown.panels:
            return {}
        published = ", open what the thesis found in its data" if len(self.published) else ""
        lines = ", lines the control laws of least squares" if self.laws else ""
        draw = partial(
            trends_figure,
            estimates[estimates["usable"]],
            self.published,
            {fit: laws for fit, laws in self.laws.items() if not fit.endswith(REFINED)},
            panels=self.shown.panels,
            trends=self.along,
            labels=self.shown.labels,
        )
        return {"trends": Captioned(draw, f"{CAPTION}{published}{lines}.")}

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
        """One row per point: its quantities with half their intervals, and the thesis's."""
        estimates = rows_at(self._tables["quantities"], {"fit": fit})
        units = next(each.fits[fit].model.units for each in self.results if each.fits)
        headings = {
            name: _heading(name, quantity.unit(self.study.library, units))
            for name, quantity in self.study.fits[fit].quantities.items()
        }
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
        """What is made of all points."""
        shown = self._tables
        tied = _table(shown["tied"], ["state"])
        if self.joint and self.joint.why_not_tied:
            tied = [Text(f"Not tied by a law: {self.joint.why_not_tied}.")]
        laws = [*_table(shown["laws"], ["fit"]), Text(LEFT_OUT)]
        if not self.laws:
            n = max(sum(each.usable(fit) for each in self.results) for fit in self.study.fits)
            needed = "a law needs 3, and all parameters to vary over them"
            laws = [Text(f"None: {n} points fitted; {needed}.")]
        supports = _table(shown["supports"], list(self.results[0].parameters))
        trends = _table(shown["trends"], ["along", "fit"])
        return [
            Section("Terms found, beside those given", supports),
            Section(TIED, tied),
            Section(TRENDS, [*trends, Picture("trends")]),
            Section(LAWS if self.laws else "Control laws", laws),
        ]

    def summary(self) -> dict[str, Any]:
        return {
            "points": [
                summary.point_summary(
                    result, self.study.cases, {name: at[k] for name, at in self.searches.items()}
                )
                for k, result in enumerate(self.results)
            ],
            "laws": summary.laws_summary(self.laws),
            "trends": self._tables["trends"].to_dict("records"),
            "joint": summary.joint_summary(self.joint),
        }

    def headline(self) -> dict[str, float]:
        n_oscillating = float(sum(bool(result.fits) for result in self.results))
        return {"n_oscillating": n_oscillating, **summary.law_errors(self.laws, self.study.fits)}


def _model(result: PointResult, case: str) -> Section:
    at = ", ".join(f"{name} = {value:g}" for name, value in result.parameters.items())
    model = result.fits[case].model
    equations = [Equation(state, model.terms(state)) for state in model.states]
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
    """`g_inj (m^-3 s^-1)`: a quantity with its unit, unless its name ends in that: `L_m`."""
    return name if unit == "1" or name.endswith(f"_{unit}") else f"{name} ({unit})"


def _spoken(fit: str) -> str:
    return fit.replace("_", ", ")


def _cell(row: Mapping[Any, Any]) -> str:
    """`0.0241 ±0.0001 (0.025)`: value, half the interval, what was published."""
    text = with_error(row["value"], 0.5 * (row["high"] - row["low"]))
    return text if np.isnan(row["thesis"]) else f"{text} ({row['thesis']:.3g})"


def with_error(value: float, reach: float) -> str:
    """`0.03640 ±2e-05`: the value down to the digit of its error, three digits or more."""
    digits = 3
    if np.isfinite(reach) and reach > 0.0 and value != 0.0:
        # Of the error as it is printed: 9.6e-05 reads 1e-04.
        places = np.floor(np.log10([abs(value), float(f"{reach:.1g}")]))
        digits = int(np.clip(places[0] - places[1] + 1, 3, 8))
    return f"{f'{value:#.{digits}g}'.removesuffix('.')} ±{reach:.1g}"


def _table(rows: pd.DataFrame, by: Sequence[str]) -> list[Block]:
    """Without columns that say nothing; a rule follows where those of `by` change."""
    if rows.empty:
        return [Text("None.")]
    if "fit" in rows:
        rows = rows.assign(fit=rows["fit"].map(_spoken))
    keys = rows[list(by)]
    ends = (keys != keys.shift(-1)).any(axis=1)
    shown = rows.dropna(axis=1, how="all").round({"r2": 3, "exponent": 3})
    return [Table(shown, breaks=np.flatnonzero(ends)[:-1].tolist())]
