"""How the parametric study reads: terminal, page and `summary.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.figures.trends import trends_figure
from ep2sindy.report.document import Block, Captioned, Equation, Picture, Section, Table, Text
from ep2sindy.signals.spectrum import frequency_text
from ep2sindy.studies.parametric.all_points import JointResult
from ep2sindy.studies.parametric.oscillation import point_label
from ep2sindy.studies.parametric.points import REFINED, PointResult
from ep2sindy.studies.parametric.tables import Findings, laws_table, supports_table, tied_table

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
    "Trends: exponents p of quantity ~ parameter^p, the other parameters held; R2: whether points "
    "follow it"
)
LAWS = "Control laws, with the RMS error at points left out, over the mean"
LEFT_OUT = (
    "Left out: the law's terms, fitted without the point that they predict. Search left out: the "
    "terms searched without it too, the honest one of the two."
)
UNITS = "Units are SI, unless a name ends in another, such as mdot_mg_s."


def sections(found: Findings) -> list[Section]:
    fitted = [result for result in found.results if result.fits]
    lines = [Text(_point_line(result), warning=not result.fits) for result in found.results]
    points = [Section("Operating points", [*lines, Text(UNITS, page_only=True)])]
    for fit in found.study.fits if fitted else ():
        points.append(Section(_fit_title(found, fit), [Table(_readable_fit(found, fit))], level=3))
    if fitted:
        points.append(Section("Intervals", [Text(INTERVALS)], level=3))
    together = {
        "Terms found, beside those given": _table(supports_table(found)),
        TIED: _tied(found.joint),
        TRENDS: [*_table(_readable_trends(found)), Picture("trends")],
        LAWS if found.laws else "Control laws": _laws(found),
    }
    models = [_model(fitted[0], case) for case in found.study.cases] if fitted else []
    return [
        *models,
        *points,
        *(Section(title, blocks) for title, blocks in together.items()),
    ]


def _model(result: PointResult, case: str) -> Section:
    """The model of a case at one point."""
    at = ", ".join(f"{name} = {value:g}" for name, value in result.parameters.items())
    model = result.fits[case].model
    equations = [Equation(state, model.terms(state)) for state in model.states]
    return Section(f"Model: {case}, at {at}", equations)


def _point_line(result: PointResult) -> str:
    """`V_D_V=300, mdot_mg_s=5: oscillating, 14.1 kHz; 12001 samples of 1.5e-06 s`."""
    text = f"{point_label(result.parameters)}: {result.status}"
    if result.fits:
        text += f", {frequency_text(result.f_Hz)}"
    if result.n_samples:
        text += f"; {result.n_samples} samples of {result.dt_s:.4g} s"
    return text if result.fits else f"{text}; left out of trends"


def _table(rows: pd.DataFrame) -> list[Block]:
    return [Table(rows) if len(rows) else Text("None.")]


def _tied(joint: JointResult | None) -> list[Block]:
    if joint and joint.why_not_tied:
        return [Text(f"Not tied by a law: {joint.why_not_tied}.")]
    return _table(tied_table(joint))


def _fit_title(found: Findings, fit: str) -> str:
    """`free (thesis)` where the thesis has values of this fit, whose cells then show them."""
    title = fit.replace("_", ", ")
    return f"{title} (thesis)" if (found.published["fit"] == fit).any() else title


def _heading(found: Findings, fit: str, name: str) -> str:
    """`g_inj (m^-3 s^-1)`: a quantity with its unit, unless its name ends in that: `L_m`."""
    units = next(result.fits[fit].model.units for result in found.results if fit in result.fits)
    unit = found.study.fits[fit].quantities[name].unit(found.study.library, units)
    return name if unit == "1" or name.endswith(f"_{unit}") else f"{name} ({unit})"


def _readable_fit(found: Findings, fit: str) -> pd.DataFrame:
    """One row per point: its quantities with half the width of the interval, and the thesis's."""
    headings = {name: _heading(found, fit, name) for name in found.study.fits[fit].quantities}
    estimates = found.estimates[found.estimates["fit"] == fit]
    rows = []
    for result in found.results:
        fitted = result.fits.get(fit)
        here = estimates
        for name, value in result.parameters.items():
            here = here[here[name] == value]
        cells = {each["quantity"]: _cell(each) for each in here.to_dict("records")}
        row: dict[str, Any] = dict(result.parameters)
        row |= {heading: cells.get(name, "-") for name, heading in headings.items()}
        if fitted:
            row |= {f"R2 {state}": f"{value:.2f}" for state, value in fitted.r2.items()}
            if fit.endswith(REFINED):
                row["loss"] = f"{fitted.loss:.3f}"
        rows.append(row | {"status": fitted.status if fitted else result.status})
    return pd.DataFrame(rows)


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


def _readable_trends(found: Findings) -> pd.DataFrame:
    table = found.trends
    if table.empty:
        return table
    half = 0.5 * (table["high"] - table["low"])
    readable = pd.DataFrame(
        {
            "along": table["along"],
            "fit": table["fit"].str.replace("_", ", "),
            "quantity": table["quantity"],
            "points": table["n_points"],
            "exponent": table["exponent"].map(_two_places),
            "±": half.map(lambda v: "-" if np.isnan(v) else f"{v:.1g}"),
            "R2": table["r2"].map(_two_places),
            "thesis": table["thesis"].map(_two_places),
        }
    )
    return readable if len(found.published) else readable.drop(columns="thesis")


def _two_places(value: float) -> str:
    return "-" if np.isnan(value) else f"{round(value, 2) + 0.0:.2f}"


def _laws(found: Findings) -> list[Block]:
    if not found.laws:
        usable = (sum(r.usable(fit) for r in found.results) for fit in found.study.fits)
        return [
            Text(
                f"None: {max(usable)} points fitted; a law needs 3, and all parameters to vary "
                "over them."
            )
        ]
    table = laws_table(found.laws)
    readable = pd.DataFrame(
        {
            "fit": table["fit"].str.replace("_", ", "),
            "law": table["law"],
            "R2": table["r2"].map(_two_places),
            "left out": table["loo_error"].map("{:.1%}".format),
            "search left out": table["search_error"].map("{:.1%}".format),
        }
    )
    return [Table(readable), Text(LEFT_OUT)]


def drawings(
    found: Findings, *, panels: Sequence[Sequence[str]], labels: Mapping[str, str]
) -> dict[str, Captioned]:
    """None where no point oscillates or no trend was asked for: an empty figure says nothing."""
    if found.estimates.empty or not found.along or not panels:
        return {}
    draw = partial(
        trends_figure,
        found.estimates[found.estimates["usable"]],
        found.published,
        {fit: laws for fit, laws in found.laws.items() if not fit.endswith(REFINED)},
        panels=panels,
        trends=found.along,
        labels=labels,
    )
    return {"trends": Captioned(draw, _caption(found))}


def _caption(found: Findings) -> str:
    parts = [
        "Quantities against one parameter, the others held: filled with 95 % intervals, which are "
        "smaller than the markers where no bars show"
    ]
    if len(found.published):
        parts.append("open what the thesis found in its data")
    if found.laws:
        parts.append("lines the control laws of least squares")
    return f"{', '.join(parts)}."
