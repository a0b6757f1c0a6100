"""How `+exp=parametric` reads: terminal and report page."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.table import Table

from ep2sindy.library.equations import equation_html
from ep2sindy.report.page import figure_html, page_html, table_html
from ep2sindy.report.screen import Screen
from ep2sindy.signals.spectrum import frequency_text
from ep2sindy.studies.parametric.oscillation import point_label
from ep2sindy.studies.parametric.points import REFINED, PointResult
from ep2sindy.studies.parametric.trends import fit_names
from experiments.parametric_tables import (
    Outcome,
    estimates_table,
    laws_table,
    supports_table,
    tied_table,
    trends_table,
)


def print_outcome(screen: Screen, outcome: Outcome) -> None:
    for result in outcome.results:
        line = _point_line(result)
        screen.print(line if result.fits else f"[bold red]{line}[/bold red]")
    for case, names in _quantities(outcome).items():
        for fit in (case, case + REFINED):
            if any(fit in result.fits for result in outcome.results):
                table = _readable_fit(outcome, fit, names)
                screen.print(_rich(_fit_title(outcome, fit), table))
    if any(result.fits for result in outcome.results):
        screen.print(f"{INTERVALS}\n")
    for title, table in (
        ("terms found, beside those given", supports_table(outcome)),
        (TIED, tied_table(outcome)),
        (TRENDS, _readable_trends(outcome)),
        (LAWS, _readable_laws(outcome)),
    ):
        if len(table):
            screen.print(_rich(title, table))
    if outcome.joint and outcome.joint.why_not_tied:
        screen.print(f"not tied by a law: {outcome.joint.why_not_tied}")
    screen.print(LEFT_OUT if outcome.laws else f"control laws: {_no_laws(outcome)}")


def _point_line(result: PointResult) -> str:
    """`V_D_V=300, mdot_mg_s=5: oscillating, 14.1 kHz; 12001 samples of 1.5e-06 s`."""
    text = f"{point_label(result.parameters)}: {result.status}"
    if result.fits:
        text += f", {frequency_text(result.f_Hz)}"
    if result.n_samples:
        text += f"; {result.n_samples} samples of {result.dt_s:.4g} s"
    return text if result.fits else f"{text}; left out of trends"


def _no_laws(outcome: Outcome) -> str:
    n_points = max(
        (sum(r.usable(fit) for r in outcome.results) for fit in fit_names(outcome.results)),
        default=0,
    )
    return f"none: {n_points} points fitted; a law needs 3, and all parameters to vary over them"


def _quantities(outcome: Outcome) -> dict[str, list[str]]:
    return {name: list(case.quantities) for name, case in outcome.study.cases.items()}


def _rich(title: str, table: pd.DataFrame) -> Table:
    rich = Table(*map(str, table.columns), title=title, show_edge=False, padding=(0, 1, 0, 0))
    for row in table.itertuples(index=False):
        rich.add_row(*[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row])
    return rich


def _fit_title(outcome: Outcome, fit: str) -> str:
    """`free (thesis)` where the thesis has values of this fit, whose cells then show them."""
    title = fit.replace("_", ", ")
    return f"{title} (thesis)" if (outcome.published["fit"] == fit).any() else title


def _heading(outcome: Outcome, fit: str, name: str) -> str:
    """`g_inj (m^-3 s^-1)`: a quantity with its unit, unless its name ends in that: `L_m`."""
    case = outcome.study.cases[fit.removesuffix(REFINED)]
    units = next(result.fits[fit].model.units for result in outcome.results if fit in result.fits)
    unit = case.quantities[name].unit(outcome.study.library, units)
    return name if unit == "1" or name.endswith(f"_{unit}") else f"{name} ({unit})"


def _readable_fit(outcome: Outcome, fit: str, names: Sequence[str]) -> pd.DataFrame:
    """One row per point: its quantities with half the width of the interval, and the thesis's."""
    estimates = estimates_table(outcome)
    headings = {name: _heading(outcome, fit, name) for name in names}
    rows = []
    for result in outcome.results:
        fitted = result.fits.get(fit)
        row: dict[str, Any] = dict(result.parameters)
        here = estimates[(estimates["fit"] == fit)]
        for name, value in result.parameters.items():
            here = here[here[name] == value]
        cells = {each["quantity"]: _cell(each) for each in here.to_dict("records")}
        row |= {headings[name]: cells.get(name, "-") for name in names}
        if fitted:
            row |= {f"R2 {state}": f"{value:.2f}" for state, value in fitted.r2.items()}
        if fit.endswith(REFINED) and fitted:
            row["loss"] = f"{fitted.loss:.3f}"
        rows.append(row | {"status": fitted.status if fitted else result.status})
    return pd.DataFrame(rows).fillna("-")


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


def _readable_trends(outcome: Outcome) -> pd.DataFrame:
    table = trends_table(outcome)
    if table.empty:
        return table
    readable = pd.DataFrame(
        {
            "along": table["along"],
            "fit": table["fit"].str.replace("_", ", "),
            "quantity": table["quantity"],
            "points": table["n_points"].astype(str),
            "exponent": table["exponent"].map(_two_places),
            "±": (0.5 * (table["high"] - table["low"])).map(
                lambda v: "-" if np.isnan(v) else f"{v:.1g}"
            ),
            "R2": table["r2"].map(_two_places),
            "thesis": table["thesis"].map(_two_places),
        }
    )
    return readable if len(outcome.published) else readable.drop(columns="thesis")


def _two_places(value: float) -> str:
    return "-" if np.isnan(value) else f"{round(value, 2) + 0.0:.2f}"


def _readable_laws(outcome: Outcome) -> pd.DataFrame:
    table = laws_table(outcome)
    if table.empty:
        return table
    percent = {key: table[key].map("{:.1%}".format) for key in ("loo_error", "search_error")}
    return pd.DataFrame(
        {
            "fit": table["fit"].str.replace("_", ", "),
            "law": table["law"],
            "R2": table["r2"].map(_two_places),
            "left out": percent["loo_error"],
            "search left out": percent["search_error"],
        }
    )


INTERVALS = (
    "±: half the 95 % interval; of least squares by a moving-block bootstrap over time, of "
    "refinements from their covariance. It says how far another stretch of the same record would "
    "move a value, not how far the model is from the discharge: compare R2, and the fits. Nor does "
    "it hold the bias that smoothing and differencing leave in least squares, even without noise, "
    "which may be many times as large; refinements differentiate nothing. Refined models follow "
    "trajectories: R2 is that of the derivative, and may be negative where pulses are sharp."
)
TIED = "one support for all points: R2 with coefficients of its own at each, and tied by a law"
TRENDS = (
    "exponents p of quantity ~ parameter^p, the other parameters held; R2: whether points follow it"
)
LAWS = "control laws, with the RMS error at points left out, over the mean"
LEFT_OUT = (
    "Left out: the law's terms, fitted without the point that they predict. Search left out: the "
    "terms searched without it too, the honest one of the two."
)
UNITS = "Units are SI, unless a name ends in another, such as mdot_mg_s."


def _caption(outcome: Outcome) -> str:
    parts = [
        "Quantities against one parameter, the others held: filled with 95 % intervals, which are "
        "smaller than the markers where no bars show"
    ]
    if len(outcome.published):
        parts.append("open what the thesis found in its data")
    if outcome.laws:
        parts.append("lines the control laws of least squares")
    return f"{', '.join(parts)}."


def page(outcome: Outcome, figures: Mapping[str, Figure]) -> str:
    body = ["<h2>Model</h2>"]
    shown = next((result for result in outcome.results if result.fits), None)
    if shown is not None:
        at = ", ".join(f"{name} = {value:g}" for name, value in shown.parameters.items())
        for case in outcome.study.cases:
            model = shown.fits[case].model
            body.append(f"<h3>{case}, at {at}</h3>")
            body += [
                f'<p class="equation">{equation_html(s, model.terms(s))}</p>' for s in model.states
            ]
    body += [figure_html(name, _caption(outcome)) for name in figures]
    body.append("<h2>Operating points</h2>")
    body += [f"<p>{_point_line(result)}</p>" for result in outcome.results]
    for case, names in _quantities(outcome).items():
        for fit in (case, case + REFINED):
            if shown is not None:
                table = _readable_fit(outcome, fit, names)
                body += [f"<h3>{_fit_title(outcome, fit)}</h3>", table_html(table)]
    if shown is not None:
        body.append(f"<p>{INTERVALS}</p>")
    return page_html(outcome.title, [*body, *_found_html(outcome)])


def _found_html(outcome: Outcome) -> list[str]:
    """What is made of all points: terms, trends and laws."""
    body = []
    for title, table in (
        ("Terms found, beside those given", supports_table(outcome)),
        (f"O{TIED[1:]}", tied_table(outcome)),
        (f"Trends: {TRENDS}", _readable_trends(outcome)),
    ):
        body += [f"<h2>{title}</h2>", table_html(table) if len(table) else "<p>None.</p>"]
    if outcome.laws:
        body += [f"<h2>C{LAWS[1:]}</h2>", table_html(_readable_laws(outcome)), f"<p>{LEFT_OUT}</p>"]
    else:
        body.append(f"<h2>Control laws</h2><p>N{_no_laws(outcome)[1:]}.</p>")
    return [*body, f"<footer>{UNITS} Config, models and tables lie beside.</footer>"]
