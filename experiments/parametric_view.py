"""How `+exp=parametric` reads: terminal and report page."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.table import Table

from ep2sindy.report import Screen, equation_html, figure_html, page_html, table_html
from ep2sindy.spectrum import frequency_text
from ep2sindy.studies.operating_points import point_label
from ep2sindy.studies.parametric import REFINED, PointResult
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
        screen.print(line if result.fits else f"[bold red]{line}; left out of trends[/bold red]")
    for case, names in _quantities(outcome).items():
        for fit in (case, case + REFINED):
            if any(fit in result.fits for result in outcome.results):
                screen.print(_rich_fit(outcome, fit, names))
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
    screen.print(LEFT_OUT)


def _point_line(result: PointResult) -> str:
    """`V_D_V=300, mdot_mg_s=5: oscillating, 14.1 kHz; 12001 samples of 1.5e-06 s`."""
    text = f"{point_label(result.parameters)}: {result.status}"
    if not result.n_samples:
        return text
    samples = f"{result.n_samples} samples of {result.dt_s:.4g} s"
    return f"{text}, {frequency_text(result.f_Hz)}; {samples}"


def _quantities(outcome: Outcome) -> dict[str, list[str]]:
    return {name: list(case.quantities) for name, case in outcome.study.cases.items()}


def _rich(title: str, table: pd.DataFrame) -> Table:
    rich = Table(*map(str, table.columns), title=title, show_edge=False, padding=(0, 1, 0, 0))
    for row in table.itertuples(index=False):
        rich.add_row(*[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row])
    return rich


def _rich_fit(outcome: Outcome, fit: str, names: Sequence[str]) -> Table:
    return _rich(f"{fit.replace('_', ', ')} (thesis)", _readable_fit(outcome, fit, names))


def _readable_fit(outcome: Outcome, fit: str, names: Sequence[str]) -> pd.DataFrame:
    """One row per point: its quantities with half the width of the interval, and the thesis's."""
    estimates = estimates_table(outcome)
    rows = []
    for result in outcome.results:
        fitted = result.fits.get(fit)
        row: dict[str, Any] = dict(result.parameters)
        here = estimates[(estimates["fit"] == fit)]
        for name, value in result.parameters.items():
            here = here[here[name] == value]
        cells = {each["quantity"]: _cell(each) for each in here.to_dict("records")}
        row |= {name: cells.get(name, "-") for name in names}
        if fitted:
            row |= {f"R2 {state}": f"{value:.2f}" for state, value in fitted.r2.items()}
        if fit.endswith(REFINED) and fitted:
            row["loss"] = f"{fitted.loss:.3f}"
        rows.append(row | {"status": fitted.status if fitted else result.status})
    return pd.DataFrame(rows).fillna("-")


def _cell(row: Mapping[Any, Any]) -> str:
    """`0.0241 +-0.0001 (0.025)`: value, half the interval, what was published."""
    text = f"{row['value']:.3g} ±{0.5 * (row['high'] - row['low']):.1g}"
    return text if np.isnan(row["thesis"]) else f"{text} ({row['thesis']:.3g})"


def _readable_trends(outcome: Outcome) -> pd.DataFrame:
    table = trends_table(outcome)
    if table.empty:
        return table
    reach = (0.5 * (table["high"] - table["low"])).map(
        lambda v: "" if np.isnan(v) else f" ±{v:.1g}"
    )
    return pd.DataFrame(
        {
            "along": table["along"],
            "fit": table["fit"].str.replace("_", ", "),
            "quantity": table["quantity"],
            "points": table["n_points"].astype(str),
            "exponent": table["exponent"].map("{:.2f}".format) + reach,
            "thesis": table["thesis"].map(lambda v: "-" if np.isnan(v) else f"{v:.2f}"),
        }
    )


def _readable_laws(outcome: Outcome) -> pd.DataFrame:
    table = laws_table(outcome)
    if table.empty:
        return table
    percent = {key: table[key].map("{:.1%}".format) for key in ("loo_error", "search_error")}
    return pd.DataFrame(
        {
            "fit": table["fit"].str.replace("_", ", "),
            "law": table["law"],
            "R2": table["r2"].map(lambda v: "-" if np.isnan(v) else f"{round(v, 2) + 0.0:.2f}"),
            "left out": percent["loo_error"],
            "search left out": percent["search_error"],
        }
    )


INTERVALS = (
    "±: half the 95 % interval; of least squares by a moving-block bootstrap over time, of "
    "refinements from their covariance. It says how far another stretch of the same record would "
    "move a value, not how far the model is from the discharge: compare R2, and the fits."
)
TIED = "one support for all points: R2 with coefficients of its own at each, and tied by a law"
TRENDS = "exponents: quantity ~ parameter^p, the other parameters held"
LAWS = "control laws, with the RMS error at points left out, over the mean"
LEFT_OUT = (
    "Left out: the law's terms, fitted without the point that they predict. Search left out: the "
    "terms searched without it too, the honest one of the two."
)
CAPTIONS = {
    "trends": "Quantities against one parameter, the others held: filled with 95 % intervals, "
    "open what the thesis found in its data, lines the control laws of least squares.",
}


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
    body += [figure_html(name, CAPTIONS[name]) for name in CAPTIONS if name in figures]
    body.append("<h2>Operating points</h2>")
    body += [f"<p>{_point_line(result)}</p>" for result in outcome.results]
    for case, names in _quantities(outcome).items():
        for fit in (case, case + REFINED):
            table = _readable_fit(outcome, fit, names)
            body += [f"<h3>{fit.replace('_', ', ')} (thesis)</h3>", table_html(table)]
    body.append(f"<p>{INTERVALS}</p>")
    for title, table in (
        ("Terms found, beside those given", supports_table(outcome)),
        (f"O{TIED[1:]}", tied_table(outcome)),
        (f"Trends: {TRENDS}", _readable_trends(outcome)),
        (f"C{LAWS[1:]}", _readable_laws(outcome)),
    ):
        body += [f"<h2>{title}</h2>", table_html(table) if len(table) else "<p>None.</p>"]
    body += [
        f"<p>{LEFT_OUT}</p>",
        "<footer>All values in SI units. Config, models and tables lie beside.</footer>",
    ]
    return page_html(outcome.title, body)
