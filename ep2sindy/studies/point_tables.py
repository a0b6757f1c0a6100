"""What a report says of operating points: records, fits, the law, quantities of coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.discovery.result import Discovery
from ep2sindy.discovery.several_points import REFINED
from ep2sindy.figures.operating import cycle_figure, laws_figure, rows_at, trends_figure
from ep2sindy.model.comparison import Status
from ep2sindy.operating.law import OperatingLaw, read_law
from ep2sindy.operating.left_out import LawChoice, LawTrial, LeftOutRun
from ep2sindy.operating.map import MapPoint, map_points
from ep2sindy.operating.point_fits import FAILED
from ep2sindy.operating.quantities import (
    LEAST_POINTS,
    ControlLaw,
    Quantity,
    control_functions,
    estimate_quantities,
    fit_control_law,
    lines_of,
)
from ep2sindy.operating.records import OperatingRecord, most_central
from ep2sindy.regression.constrained import rows_r2
from ep2sindy.report.document import Equation, Result, Table, Text
from ep2sindy.report.models import NO_ENDS, coefficients, equations, with_error
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, percent
from ep2sindy.signals.spectrum import Oscillation, dominant_frequency
from ep2sindy.studies.point_processes import of_parameter
from ep2sindy.studies.point_sources import OpenedPoint
from ep2sindy.studies.views import EVALUATION, terms_text

LAW_INTERVALS = (
    "In SI units, and the parameters in theirs. ±: half the 95 % interval by the jackknife: how "
    "far the law moves if a point is left out. It holds the noise of the records, and that "
    "coefficients are not exactly of this form."
)
LEFT_OUT = (
    "The law of the other points, run freely from the slowest sample of each record, with errors "
    "against the record's cycle. A model is sustained within 1 % of frequency, 10 % of amplitude "
    "and 0.2 standard deviations of waveform. Enclosed: by the other points. Interpolated: errors "
    "without a model, by functions fitted to frequencies and amplitudes of the other records."
)
TRIED = (
    "error: what the law of the others leaves of windows at points left out, in standard "
    "deviations of the states, in the mean and of nine in ten points. Chosen: of laws that stay on "
    "most of their records, the one whose runs deviate least at points left out; of models that "
    "inputs drive, the fewest numbers within a standard error of the least error."
)
CAPTIONS = {
    "laws": "Coefficients over the operating parameters, with 95 % intervals, at up to five values "
    "of the other parameters. Where open marks leave the lines by more than their bars, other "
    "coefficients make up for it: records determine these directions poorly, so they count little.",
    "map": "Frequency and relative amplitude (standard deviation over mean, of states that do not "
    "swing around zero) of the law's cycle over the operating parameters, and of the records. Red: "
    "the law oscillates where the record does not, or the reverse. Cycles alone tell little of "
    "where the fixed point turns stable.",
}
# What a law's model does at a point without a record of its cycle.
ALONE = {Status.SUSTAINED: "oscillates", Status.DECAYS: "rests", Status.DIVERGES: "diverges"}

N_BETWEEN = 13  # points along each parameter at which cycles are interpolated
MOST_LAWS = 3  # on the screen

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


@dataclass(frozen=True, eq=False)
class PointsFound:
    """What a study of operating points has found.

    trials: every fit that was tried, by its model. choice: the law that is taken; None if the
    points do not suffice for one. by_model: what was found for each model, whose rows say how well
    derivatives are fitted. maps: the law's models at all points that were opened, then over a
    grid; empty if the law has no free runs.
    """

    trials: Sequence[LawTrial]
    choice: LawChoice | None
    by_model: Mapping[str, Discovery]
    opened: Sequence[OpenedPoint]
    maps: Sequence[MapPoint] = ()

    @property
    def fitted(self) -> dict[str, OperatingRecord]:
        """The records that were fitted, by the label of their point."""
        return {record.label: record for record in self.trials[0].records}

    @property
    def last(self) -> dict[str, LawTrial]:
        """One trial by the name of its fit: of several laws of one fit that taken, or the last."""
        found = {trial.name: trial for trial in self.trials}
        taken = [] if self.choice is None else [self.choice.choice]
        return found | {trial.name: trial for trial in taken}

    @property
    def cycle(self) -> str:
        """Name of the cycle of the records that were fitted."""
        first = next(iter(self.by_model.values())).law_choice
        return "all" if first is None else first.cycle

    def branch(self, point: OpenedPoint) -> str:
        """The cycle that a point's record is on; empty if it is on none."""
        if point.label in self.fitted:
            return self.cycle
        if point.status != Oscillation.OSCILLATING or self.cycle == "all":
            return ""
        return {"strong": "weak", "weak": "strong"}[self.cycle]


def points_table(opened: Sequence[OpenedPoint], found: PointsFound | None = None) -> pd.DataFrame:
    """One row per operating point: status of its record, its cycle, and what the law does there."""
    rows = []
    for point in opened:
        branch = "" if found is None else found.branch(point)
        row: dict[str, Any] = {**point.parameters, "status": point.status, "branch": branch}
        row |= {"f_kHz": np.nan, "n_samples": 0, "dt_s": np.nan, "relative_amplitude": np.nan}
        if (run := point.run) is not None:
            row |= {"n_samples": run.n_samples, "dt_s": run.dt_s}
            row["f_kHz"] = 1e-3 * dominant_frequency(run.t, run.states[:, 0])
            record = OperatingRecord(run)
            if point.status == Oscillation.OSCILLATING and record.repeats:
                row["f_kHz"] = 1e-3 * record.cycle.frequency_Hz
                row["relative_amplitude"] = record.relative_amplitude
        rows.append(row)
    table = pd.DataFrame(rows)
    if found is not None and found.maps and found.choice is not None:
        table["law"] = _outcomes(found, found.choice)
    return table


def _outcomes(found: PointsFound, choice: LawChoice) -> list[str]:
    """By point: the law next to the record that it was fitted to, or by itself."""
    pairs = zip(choice.records, choice.fitted, strict=True)
    runs = {record.label: run.text for record, run in pairs}
    runs |= {
        label: ALONE[Status.DECAYS if rests else Status.SUSTAINED]
        for label, rests in choice.quiet.items()
    }
    at_points = zip(found.opened, found.maps, strict=False)
    return [runs.get(point.label, ALONE[at.status]) for point, at in at_points]


def fits_table(found: PointsFound) -> pd.DataFrame:
    """One row per point and fit: its status, loss and R2 of the derivatives."""
    rows = []
    for k, (label, record) in enumerate(found.fitted.items()):
        for name, trial in found.last.items():
            fits, only = trial.fits, found.by_model.get("")  # of terms that were searched
            fronts = (only or found.by_model[name.removesuffix(REFINED)]).points[label].fronts
            problems = list(dict.fromkeys(front.rows for front in fronts.values()))
            status, loss = ("fitted", np.nan)
            if fits.statuses:
                status, loss = fits.statuses[k], fits.losses[k]
            row = {**record.parameters, "fit": name, "status": status, "loss": loss}
            r2 = rows_r2(fits.models[k], problems)
            rows.append(row | {f"r2_{state}": value for state, value in r2.items()})
    return pd.DataFrame(rows)


def add_law(
    report: Report, found: PointsFound, points: pd.DataFrame, labels: Mapping[str, str], remedy: str
) -> Result:
    """Add the law, how it does at points left out, where it oscillates, and what was tried.

    points: status, cycle, frequency and amplitude of every point, and what the law does there.
    remedy: another choice of terms, to try if the law fails. Returns what was found, in short.
    """
    taken = found.choice
    assert taken is not None
    law, choice, parameters = taken.law, taken.choice, list(taken.records[0].parameters)
    exact = list(choice.fits.relations.texts)
    report.write("law.json", law.save)
    report.summary["law"] = {"fit": choice.name, "cycle": found.cycle, "exact": exact}
    report.headline |= taken.statistics
    report.section(
        f"Law of {choice.name}",
        *(f"exact at every point: {each}" for each in exact),
        f"{len(law.coefficients)} coefficients of {len(law.functions)} functions each, "
        f"{choice.n_numbers} numbers, from {len(law.points)} records",
    )
    rows, alone = _law_rows(law), _coefficients(taken)
    report.table("laws", rows, shown=Table(_by_function(rows), note=LAW_INTERVALS))
    report.samples("law_coefficients", alone)
    by_values = sorted(parameters, key=lambda name: alone[name].nunique())  # the most on the axis
    draw = partial(laws_figure, alone, law, parameters=by_values, labels=labels)
    report.figure("laws", draw, CAPTIONS["laws"])
    shown, head = [], f"Law of {choice.name} over {', '.join(law.parameters)}"
    shown += [Text(text) for text in (taken.text, law.doubt) if text]
    if taken.runs:
        heading = taken.heading
        head = f"Law of {choice.name}: {heading}" if taken.is_trusted else heading.capitalize()
        _add_left_out(report, taken, remedy)
        _add_interpolation(report, taken)
        shown.append(Text(_add_map(report, found, points, labels)))
    report.section("Structures and laws compared")
    bold = [k for k, trial in enumerate(found.trials) if trial is choice]
    report.table("trials", ResultTable(found.trials, _metrics(taken)), note=TRIED, bold=bold)
    place = most_central(choice.fits.points)
    middle, held = taken.records[place], choice.fits.relations.at(choice.fits.points)[place]
    model = read_law(law, middle.parameters)
    return Result(
        head,
        [*equations(model, held=held, lead=f"at {middle.label}"), *shown],
        load='ep.operating.OperatingLaw.load("{}/law.json")',
        picture=next(name for name in ("map", "laws") if name in report.figures),
    )


def _law_rows(law: OperatingLaw) -> pd.DataFrame:
    """One row per coefficient and function of a law, with its 95 % interval."""
    known = {} if law.covariance is None else law.intervals()
    rows = [
        (state, term, function, value, *known.get((state, term), {}).get(function, NO_ENDS))
        for (state, term), row in zip(law.coefficients, law.coef.tolist(), strict=True)
        for function, value in zip(law.functions.names, row, strict=True)
    ]
    return pd.DataFrame(rows, columns=["state", "term", "function", "value", "low", "high"])


def _by_function(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per coefficient, its factors with their errors; one that is exact has none."""
    reach = 0.5 * (rows["high"] - rows["low"])
    shown = [
        with_error(value, error) if error else f"{value:g}"
        for value, error in zip(rows["value"], reach, strict=True)
    ]
    names = rows["state"] + ": " + rows["term"]
    wide = rows.assign(coefficient=names, shown=shown).set_index(["coefficient", "function"])
    return wide["shown"].unstack(sort=False).reset_index()


def _coefficients(found: LawChoice) -> pd.DataFrame:
    """Coefficients at every point, refined alone and from the law, each with 95 % intervals."""
    points = {record.label: record.parameters for record in found.records}
    of_law = [read_law(found.law, point) for point in points.values()]
    both = pd.DataFrame.from_dict(points, orient="index").rename_axis("model").reset_index()
    for kind, models in {"law": of_law, "alone": found.choice.fits.models}.items():
        names = {"coef": kind, "lower": f"{kind}_low", "upper": f"{kind}_high"}
        own = coefficients(dict(zip(points, models, strict=True))).rename(columns=names)
        both = both.merge(own, how="left")
    return both.drop(columns="model")


def _add_left_out(report: Report, found: LawChoice, remedy: str) -> None:
    metrics: list[Metric[LeftOutRun]] = [
        *map(of_parameter, found.records[0].parameters),
        Metric("enclosed", lambda p: p.inside, View.SHOWN),
        Metric("f_kHz", lambda p: p.record.repeats and 1e-3 * p.record.cycle.frequency_Hz),
        *(metric.of(lambda p: p.run, view=View.SHOWN) for metric in EVALUATION),
        Metric("interpolated", lambda p: p.interpolated, View.SHOWN, "interpolated {}", percent(3)),
    ]
    report.section("Prediction of points left out")
    report.table("left_out", ResultTable(found.runs, metrics), note=LEFT_OUT)
    if not found.statistics["n_sustained"]:
        report.warn(
            f"none of {len(found.runs)} points left out is sustained by the law of the others: do "
            "not trust it at a point without a record; try points that lie closer together, longer "
            f"records, or {remedy} (docs/points.md)"
        )


def _add_interpolation(report: Report, found: LawChoice) -> None:
    """Frequency and amplitudes between the records without a model, with their half-widths."""
    if found.interpolation is None:
        return
    rows = []
    for point in map_points([record.parameters for record in found.records], N_BETWEEN):
        with suppress(ValueError):  # beyond the records
            names = found.interpolation.functions.variables
            cycle = found.interpolation.at(**{name: point[name] for name in names})
            row = {**point, "f_kHz": 1e-3 * cycle.frequency_Hz[0]}
            row["f_kHz_within"] = 1e-3 * cycle.frequency_Hz[1]
            for state, (value, within) in cycle.amplitude.items():
                row |= {f"std_{state}": value, f"std_{state}_within": within}
            rows.append(row)
    report.samples("interpolation", pd.DataFrame(rows))


def _add_map(
    report: Report, found: PointsFound, points: pd.DataFrame, labels: Mapping[str, str]
) -> str:
    """Add the map, if there is one; returns at how many points the law of all is right."""
    choice = found.choice
    assert choice is not None
    parameters, over = list(choice.records[0].parameters), found.maps[len(found.opened) :]
    table = pd.DataFrame([point.row for point in over])
    report.section("Where the model oscillates")
    report.samples("map", table)
    if any(point.status is Status.SUSTAINED for point in over):
        draw = partial(
            cycle_figure, table, points, branch=found.cycle, parameters=parameters, labels=labels
        )
        report.figure("map", draw, CAPTIONS["map"])
    elif over:
        report.add("Nowhere on the map does the law's model oscillate.")
    n_right, n_quiet = sum(run.holds for run in choice.fitted), len(choice.quiet)
    n_rests = sum(choice.quiet.values())
    report.headline |= {"n_fitted_sustained": n_right, "n_quiet": n_quiet, "n_rests": n_rests}
    text = f"The law of all points holds at {n_right} of the {len(choice.fitted)} it was fitted to"
    if n_quiet:
        text += f", and rests at {n_rests} of {n_quiet} whose record is quiet"
    known = {*found.fitted, *choice.quiet}
    rest = [point.status for point in found.opened if point.label not in known]
    return f"{text}; not counted: {', '.join(rest)}." if rest else f"{text}."


def _metrics(found: LawChoice) -> list[Metric[LawTrial]]:
    def nine_in_ten(trial: LawTrial) -> float:
        return float(np.quantile(trial.errors, 0.9)) if len(trial.errors) else np.nan

    return [
        Metric("fit", lambda trial: trial.name, View.SHOWN),
        Metric("terms", lambda trial: terms_text(trial.fits.relations.common.support)),
        Metric("functions", lambda trial: ", ".join(trial.functions.names), View.SHOWN),
        Metric("numbers", lambda trial: trial.n_numbers, View.SHOWN),
        Metric("error", lambda trial: trial.error, View.SHOWN, format="{:.3g}"),
        Metric("nine_in_ten", nine_in_ten, View.SHOWN, format="{:.3g}"),
        Metric("chosen", lambda trial: trial is found.choice, View.SHOWN),
    ]


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
    found: PointsFound,
    quantities: Mapping[str, Mapping[str, Quantity]],
    published: pd.DataFrame,
    labels: Mapping[str, str],
) -> Result:
    """Add control laws and figures of quantities, and their values at every point.

    quantities: by model. published: see `read_published`. labels: of parameters and quantities on
    axes. Returns the control laws of the fit that does best at points left out.
    """
    own = {name: quantities[name.removesuffix(REFINED)] for name in found.last}
    models = {name: trial.fits.models[0] for name, trial in found.last.items()}
    units = {
        (fit, name): quantity.unit(models[fit].library, models[fit].units)
        for fit, several in own.items()
        for name, quantity in several.items()
    }
    errors = {name: trial.error for name, trial in found.last.items() if len(trial.errors)}
    estimates = estimates_of(found.last, own, published)
    usable = estimates[estimates["usable"].astype(bool) & np.isfinite(estimates["value"])]
    laws = control_laws(usable, list(found.opened[0].parameters))
    best = min((fit for fit, _ in laws), key=lambda fit: errors.get(fit, np.inf), default="")
    report.summary["best_fit"] = best or None
    missing = f"a law needs {LEAST_POINTS} points, and all parameters to vary over them"
    report.section("Control laws", *([] if laws else [f"None: {missing}."]))
    for key in ("loo_error", "search_error"):  # also of laws that are not found
        report.headline |= {f"{fit}/{name}/{key}": np.nan for fit, name in units}
    rows = {f"{fit}/{name}": (fit, name, law) for (fit, name), law in laws.items()}
    bold = [k for k, (fit, _) in enumerate(laws) if fit == best]
    report.table("control_laws", ResultTable(rows, CONTROL_LAW), note=CONTROL, bold=bold)
    lines = lines_of([record.parameters for record in found.fitted.values()])
    report.section("Quantities", INTERVALS)
    _add_figures(report, usable, laws, published, lines, errors, labels)
    report.table("quantities", estimates, shown=False)
    shown = [
        _equation(name, law, units[fit, name], percent(2)(law.search_error))
        for (fit, name), law in laws.items()
        if fit == best
    ]
    n_fitted = len(found.fitted)
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


def estimates_of(
    trials: Mapping[str, LawTrial],
    quantities: Mapping[str, Mapping[str, Quantity]],
    published: pd.DataFrame,
) -> pd.DataFrame:
    """One row per point, fit and quantity, with the published value."""
    rows = [
        {**record.parameters, "fit": fit, "quantity": name, "value": each.value,
         "usable": not trial.fits.statuses or trial.fits.statuses[k] not in FAILED,
         "low": each.low, "high": each.high}
        for fit, trial in trials.items()
        for k, record in enumerate(trial.records)
        for name, each in estimate_quantities(trial.fits.models[k], quantities[fit]).items()
    ]  # fmt: skip
    parameters = list(next(iter(trials.values())).fits.parameters)
    columns = [*parameters, "fit", "usable", "quantity", "value", "low", "high"]
    table = pd.DataFrame(rows, columns=columns).astype(dict.fromkeys(parameters, float))
    known = published.rename(columns={"value": "thesis"})
    return table.merge(known, how="left", on=[*parameters, "fit", "quantity"])


def control_laws(usable: pd.DataFrame, parameters: list[str]) -> dict[tuple[str, str], ControlLaw]:
    """A control law per fit and quantity, where the points suffice. usable: rows of estimates."""
    found = {}
    for (fit, name), rows in usable.groupby(["fit", "quantity"], sort=False):
        points, values = rows[parameters].to_numpy(float), rows["value"].to_numpy()
        with suppress(ValueError):  # too few points, or a parameter that is the same at all
            functions = control_functions(parameters, points)
            found[str(fit), str(name)] = fit_control_law(values, points, functions)
    return found


def _add_figures(
    report: Report,
    usable: pd.DataFrame,
    laws: Laws,
    published: pd.DataFrame,
    lines: Sequence[tuple[str, Mapping[str, float]]],
    errors: Mapping[str, float],
    labels: Mapping[str, str],
) -> None:
    """Add a figure of each model: its quantities by least squares, refined, and published."""
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
