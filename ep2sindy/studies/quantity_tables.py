"""Quantities read from coefficients over operating points: their tables and control laws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd

from ep2sindy.figures.operating import rows_at, trends_figure
from ep2sindy.library.library import Library
from ep2sindy.operating.given_models import REFINED, GivenModel, PointResult
from ep2sindy.operating.quantities import ControlLaw, control_functions, fit_control_law, lines_of
from ep2sindy.report.document import Equation, Result
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, percent

MOST_LAWS = 3  # on the screen
LEAST_POINTS = 3  # of a control law

INTERVALS = (
    "Intervals of 95 % are sandwiches: of least squares with blocks of two periods as clusters, of "
    "refinements with windows. It says how far another segment of the same record would move a "
    "value, not how far the model is from the discharge: compare R2, and the fits. Nor does it "
    "hold the bias that smoothing and differencing leave in least squares, even without noise, "
    "which may be many times as large; refinements differentiate nothing. Refined models follow "
    "trajectories: R2 is that of the derivative, and may be negative where pulses are sharp."
)
CONTROL = (
    "Errors are RMS over the mean, at points left out: of the law's terms, fitted without the "
    "point that they predict; and of terms searched without it too, the honest one of the two."
)
CAPTION = (
    "Quantities of the fit {}, against one parameter with the others held, with 95 % intervals, "
    "which are smaller than the marks where no bars show{}{}."
)

Published = Mapping[str, Mapping[str, Sequence[float]]]  # fit -> parameter or quantity -> values
Laws = Mapping[tuple[str, str], ControlLaw]  # by fit and quantity

# A control law with its fit and quantity. Its errors are those at points left out.
CONTROL_LAW: Metrics[tuple[str, str, ControlLaw]] = [
    Metric("fit", lambda row: row[0], View.SHOWN),
    Metric("quantity", lambda row: row[1], View.SHOWN),
    Metric("law", lambda row: str(_equation(*row[1:]))),
    Metric("law", lambda row: _equation(*row[1:]), View.SCREEN),
    Metric("r2", lambda row: row[2].r2, View.SHOWN, "R2", "{:.3f}"),
    Metric("loo_error", lambda row: row[2].loo_error, View.ALL, "error, same terms", percent(1)),
    Metric("search_error", lambda row: row[2].search_error, View.ALL, "searched", percent(1)),
]


def add_quantities(
    report: Report,
    library: Library,
    models: Mapping[str, GivenModel],
    results: Sequence[PointResult],
    errors: Mapping[str, float],
    published: pd.DataFrame,
    labels: Mapping[str, str],
) -> Result:
    """Add control laws and figures of quantities, and their values at every point.

    errors: for each fit, the mean error of its law at points left out; empty if the points do not
    suffice for laws. published: see `read_published`. labels: of parameters and quantities on axes.
    Returns the control laws of the fit that does best at points left out.
    """
    known = next((each.model.units for r in results for each in r.fits.values()), None)
    units = {
        (model + end, name): quantity.unit(library, known) if known else ""
        for model, given in models.items()
        for end in ("", REFINED)
        for name, quantity in given.quantities.items()
    }
    estimates = estimates_of(results, published)
    laws = control_laws(estimates, list(results[0].parameters))
    best = min((fit for fit, _ in laws), key=lambda fit: errors.get(fit, np.inf), default="")
    report.summary["best_fit"] = best or None
    missing = f"a law needs {LEAST_POINTS} points, and all parameters to vary over them"
    report.section("Control laws", *([] if laws else [f"None: {missing}."]))
    for key in ("loo_error", "search_error"):  # also of laws that are not found
        report.headline |= {f"{fit}/{name}/{key}": np.nan for fit, name in units}
    rows = {f"{fit}/{name}": (fit, name, law) for (fit, name), law in laws.items()}
    bold = [k for k, (fit, _) in enumerate(laws) if fit == best]
    report.table("control_laws", ResultTable(rows, CONTROL_LAW), note=CONTROL, bold=bold)
    lines = lines_of([result.parameters for result in results if result.fits] or [{}])
    report.section("Quantities", INTERVALS)
    _add_figures(report, estimates, laws, published, lines, errors, labels)
    report.table("quantities", estimates, shown=False)
    shown = [
        _equation(name, law, units[fit, name], percent(2)(law.search_error))
        for (fit, name), law in laws.items()
        if fit == best
    ]
    n_fitted = sum(bool(result.fits) for result in results)
    picture = f"trends_{best.removesuffix(REFINED)}"
    return Result(
        f"{len(shown) or 'No'} control laws over {n_fitted} operating points"
        f"{best and f', by {best}'}",
        shown[:MOST_LAWS],
        load='pandas.read_csv("{}/tables/control_laws.csv")',
        picture=picture if picture in report.figures else "",
    )


def read_published(published: Published, parameters: Sequence[str]) -> pd.DataFrame:
    """Published values: one row per fit, point and quantity.

    published: columns of equal length by fit. Raises ValueError if a parameter has none, or nothing
    else has.
    """
    rows: list[tuple[object, ...]] = []
    for fit, columns in published.items():
        if not set(parameters) < set(columns) or len({*map(len, columns.values())}) > 1:
            raise ValueError(
                f"thesis must give {list(parameters)} and quantities at every point, or be null, "
                f"got {dict(columns)} for {fit}"
            )
        for name in columns:
            if name not in parameters:
                used = [columns[key] for key in (*parameters, name)]
                rows += [(fit, name, *point) for point in zip(*used, strict=True)]
    numbers = [*parameters, "value"]
    table = pd.DataFrame(rows, columns=["fit", "quantity", *numbers])
    return table.astype(dict.fromkeys(numbers, float))


def estimates_of(results: Sequence[PointResult], published: pd.DataFrame) -> pd.DataFrame:
    """One row per point, fit and quantity, with the published value."""
    rows = [
        {**result.parameters, "fit": fit, "usable": fitted.is_usable, "quantity": name,
         "value": each.value, "low": each.low, "high": each.high}
        for result in results
        for fit, fitted in result.fits.items()
        for name, each in fitted.estimates.items()
    ]  # fmt: skip
    parameters = list(results[0].parameters)
    columns = [*parameters, "fit", "usable", "quantity", "value", "low", "high"]
    table = pd.DataFrame(rows, columns=columns).astype(dict.fromkeys(parameters, float))
    known = published.rename(columns={"value": "thesis"})
    return table.merge(known, how="left", on=[*parameters, "fit", "quantity"])


def control_laws(
    estimates: pd.DataFrame, parameters: list[str]
) -> dict[tuple[str, str], ControlLaw]:
    """A control law per fit and quantity, from the points at which the fit finished."""
    found = {}
    for (fit, name), rows in estimates.groupby(["fit", "quantity"], sort=False):
        used = rows[rows["usable"]]
        points = used[parameters].to_numpy(float)
        if len(used) >= LEAST_POINTS and np.ptp(points, axis=0).all():
            functions = control_functions(parameters, points)
            found[str(fit), str(name)] = fit_control_law(
                used["value"].to_numpy(), points, functions
            )
    return found


def _add_figures(
    report: Report,
    estimates: pd.DataFrame,
    laws: Laws,
    published: pd.DataFrame,
    lines: Sequence[tuple[str, Mapping[str, float]]],
    errors: Mapping[str, float],
    labels: Mapping[str, str],
) -> None:
    """Add a figure of each model: its quantities by least squares, refined, and published."""
    usable = estimates[estimates["usable"].astype(bool)]
    for model in dict.fromkeys(fit.removesuffix(REFINED) for fit in usable["fit"] if lines):
        kinds = {model: "least squares", model + REFINED: "refined"}
        best = min(kinds, key=lambda fit: errors.get(fit, np.inf))
        ours = usable[usable["fit"].isin(list(kinds))]
        ours = pd.concat([ours[ours["fit"] == best], ours[ours["fit"] != best]])
        theirs = rows_at(published, {"fit": model}).assign(kind="thesis")
        table = pd.concat([ours.assign(kind=ours["fit"].map(kinds)), theirs])
        own = {name: law for (fit, name), law in laws.items() if fit == best}
        beside = "; next to them what the thesis found in its data" if len(theirs) else ""
        line = f"; lines are the control laws of the filled marks, the fit {best}" if own else ""
        report.figure(
            f"trends_{model}",
            partial(trends_figure, table, own, trends=lines, labels=labels),
            CAPTION.format(model, beside, line),
        )


def _equation(name: str, law: ControlLaw, unit: str = "", error: str = "") -> Equation:
    mark = f" ({error} off where left out)" if error else ""
    shown = "" if unit == "1" else unit
    return Equation(name, law.coef_by_term, rate=False, unit=shown, mark=mark, on_screen=True)
