"""The law of whole models over operating points: how it is found, and what a report says of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import isfinite

import numpy as np
import pandas as pd
from jaxtyping import Float

from ep2sindy.data.trajectory import point_label
from ep2sindy.figures.operating import cycle_figure, laws_figure
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.model.comparison import Status
from ep2sindy.operating.law import LawFunctions, OperatingLaw, read_law
from ep2sindy.operating.left_out import (
    LawTrial,
    LeftOutRun,
    error_statistics,
    run_left_out,
    window_errors,
)
from ep2sindy.operating.map import MapPoint, law_map, map_points
from ep2sindy.operating.point_fits import PointFits
from ep2sindy.operating.records import OperatingRecord, Point, most_central
from ep2sindy.regression.pooled import fewest_of_least
from ep2sindy.report.document import Result, Table, Text, places
from ep2sindy.report.models import NO_ENDS, coefficients, equations, with_error
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, ResultTable, View, percent
from ep2sindy.runtime.parallel import Workers, collect
from ep2sindy.signals.spectrum import Oscillation
from ep2sindy.studies.views import EVALUATION, terms_text

N_TOGETHER = 24  # points of a map computed as one piece: the records are sent with each piece

INTERVALS = (
    "In SI units, and the parameters in theirs. ±: half the 95 % interval by the jackknife: how "
    "far the law moves if a point is left out. It holds the noise of the records, and that "
    "coefficients are not exactly of this form."
)
LEFT_OUT = (
    "Each point in turn read off the law of the others, and run freely from one sample of its "
    "record, where the states move least. Errors are those against the record's cycle; a model "
    "sustained, within 1 % of frequency, 10 % of amplitude and 0.2 standard "
    "deviations of waveform; enclosed: whether the others enclose it. Interpolated: errors of "
    "frequency and amplitude without a model, by the functions of the law fitted to those of the "
    "other records; of enclosed points."
)
TRIED = (
    "error: mean over the points left out, by the law of the others, of what windows of the record "
    "leave, in standard deviations of the states; nine in ten: of the points. It tells fits apart, "
    "also if their coefficients have a bias that is as smooth as the truth. numbers: of the law. "
    "Chosen: the fewest numbers within a standard error of the least, of models whose cycles "
    "attract at points left out."
)
CAPTIONS = {
    "laws": "Coefficients over the operating parameters, with 95 % intervals: by the law that all "
    "points share (lines, filled at its points) and refined at each point alone (open), at up to "
    "five values of the other parameters. Where the open points leave the lines by more than their "
    "bars, other coefficients make up for it: points are sloppy in some directions, and those "
    "count little.",
    "map": "Frequency and relative amplitude (standard deviation over mean, of states that do not "
    "swing around zero) of the law's cycle over the operating parameters, none where it rests, and "
    "of the records (circles); crosses: points that do not oscillate; diamonds: records of another "
    "cycle, not fitted here. Red: the law oscillates where the record does not, or the reverse. "
    "Black line on a map: where the law's cycle ends; dashed: where its fixed point turns stable, "
    "of which cycles alone tell little. Faded: beyond what the points that the law was fitted to "
    "enclose, where it is extrapolated.",
}
# What a law's model does at a point without a record of its cycle.
ALONE = {Status.SUSTAINED: "oscillates", Status.DECAYS: "rests", Status.DIVERGES: "diverges"}
QUIET = (Oscillation.STEADY, Oscillation.DECAYING)


@dataclass(frozen=True, eq=False)
class FoundLaw:
    """The law of the records on one cycle, and what was tried for it.

    cycle: its name; "all" if there is only one. runs: of the points left out, each with the law of
    the others. fitted: of the law of all points over each record. at_points: its models at all
    points of the study. map: the same over a grid that encloses these. Of a model that inputs
    drive, which has no free runs, all four are empty.
    """

    cycle: str
    records: Sequence[OperatingRecord]
    trials: Sequence[LawTrial]
    choice: LawTrial
    law: OperatingLaw
    runs: Sequence[LeftOutRun]
    fitted: Sequence[Evaluation]
    at_points: Sequence[MapPoint]
    map: Sequence[MapPoint]

    @cached_property
    def statistics(self) -> dict[str, float | int]:
        """Of the points left out: of their windows, and of their free runs if there are any."""
        errors = self.choice.errors
        windows = {"n": len(errors), "window_error": float(errors.mean())}
        return windows | (error_statistics(self.runs) if self.runs else {})

    @property
    def errors(self) -> dict[str, float]:
        """Mean error of the law of each fit at points left out."""
        return {trial.name: float(trial.errors.mean()) for trial in self.trials}

    @property
    def outcomes(self) -> list[str]:
        """By point of the study: the law next to the record of its cycle, or by itself."""
        runs = {point_label(run.record.parameters): run.text for run in self.fitted}
        return [runs.get(point_label(p.parameters), ALONE[p.status]) for p in self.at_points]

    @property
    def text(self) -> str:
        """How the law does at the points left out."""
        found, text = self.statistics, percent(3)
        windows = (
            "Left out one at a time, windows of the records are followed to "
            f"{found['window_error']:.3g} standard deviations"
        )
        if not self.runs:
            return f"{windows}."
        lost = f"{found['n'] - found['n_cycles']} of {found['n']} have no frequency"
        said = (
            f"{windows}, and run freely {found['n_sustained']} of {found['n']} points are "
            f"sustained, diverging: {found['diverging']}. "
        )
        if not isfinite(found["f_median"]):
            return f"{said}{lost}."
        spread = f"nine in ten within {text(found['f_90'])}" if isfinite(found["f_90"]) else lost
        said += (
            f"Errors in the median: frequency {text(found['f_median'])} ({spread}), the worst "
            f"state's amplitude {text(found['amplitude_median'])} and waveform "
            f"{places(found['waveform_median'], 3)}. "
        )
        if not found["n_enclosed"]:
            return f"{said}No point is enclosed by the others, so that none can be interpolated."
        law, between = (
            f"by {text(found[f'f_{kind}'])} in frequency and {text(found[f'amplitude_{kind}'])} in "
            "amplitude"
            for kind in ("enclosed", "interpolated")
        )
        return (
            f"{said}At the {found['n_enclosed']} that the others enclose it errs {law}; "
            f"interpolation between the other records, without a model, {between}."
        )


def find_law(
    fits: Mapping[str, PointFits],
    records: Sequence[OperatingRecord],
    functions: LawFunctions,
    points: Sequence[Point],
    *,
    cycle: str,
    periods: float,
    n_map: int | None,
    workers: Workers,
    report: Report,
) -> FoundLaw:
    """Find the law of the records, of the fit that does best at points left out.

    Of models that run freely, it is the best of those that attract at more than half of the points
    left out, if there are any: a neutral cycle keeps the amplitude of its start.
    fits: of the records, by name. functions: of the law. points: all points of the study, which the
    map encloses. periods: length of the windows that are followed where left out.
    Raises ValueError if the records do not suffice for the law of any fit.
    """
    trials, reason = [], ""
    for name, of_all in fits.items():
        try:
            own = of_all.functions(functions)
            of_all.rate_errors(own)
            trials.append(LawTrial(name, of_all, own, np.zeros(0)))
        except ValueError as error:
            reason = str(error)
    if not trials:
        n = len(records)
        raise ValueError(f"{n} point{'s' * (n > 1)} that oscillate get no law: {reason}")
    stage = report.watch.stage(len(records), "point", "laws at points left out")
    one = partial(_leave_out, trials=trials, periods=periods)
    errors = np.array(collect(workers, one, list(enumerate(records)), stage))
    trials = [replace(t, errors=own) for t, own in zip(trials, errors.T, strict=True)]
    best, runs = _choose(trials, records)
    law, fitted = best.fits.law(best.functions), []
    at, maps = [*points, *(map_points(points, n_map) if n_map else [])], []
    if runs:
        fitted = [evaluate(read_law(law, r.parameters), r.from_slowest) for r in records]
        pieces = [at[first : first + N_TOGETHER] for first in range(0, len(at), N_TOGETHER)]
        stage = report.watch.stage(len(at), "point", "map of the law")
        maps = collect(workers, partial(law_map, law, records), pieces, stage, size=len)
    known = [point for piece in maps for point in piece]
    n = len(points)
    return FoundLaw(cycle, records, trials, best, law, runs, fitted, known[:n], known[n:])


def _choose(
    trials: Sequence[LawTrial], records: Sequence[OperatingRecord]
) -> tuple[LawTrial, list[LeftOutRun]]:
    """The best fit, and its free runs at points left out; none of a model that inputs drive."""
    left, first = list(trials), None
    while left:
        best = left.pop(fewest_of_least([(trial.errors, trial.n_numbers) for trial in left]))
        if best.fits.models[0].inputs:
            return best, []
        runs = run_left_out(best, records)
        first = first or (best, runs)
        if 2 * sum(run.attracts for run in runs) > len(runs):
            return best, runs
    assert first is not None
    return first


def _leave_out(
    numbered: tuple[int, OperatingRecord], *, trials: Sequence[LawTrial], periods: float
) -> Float[np.ndarray, " trials"]:
    """Errors of the laws of all fits at one point, each of the other points."""
    number, record = numbered
    laws = [trial.fits.law_without(number, trial.functions) for trial in trials]
    models = [read_law(law, record.parameters) for law in laws]
    return window_errors(models, record.run, periods=periods)


def add_law(
    report: Report, found: FoundLaw, points: pd.DataFrame, labels: Mapping[str, str], remedy: str
) -> Result:
    """Add the law, how it does at points left out, where it oscillates, and what was tried.

    points: status, cycle, frequency and amplitude of every point, and what the law does there.
    remedy: another choice of terms, to try if the law fails. Returns what was found, in short.
    """
    law, choice, parameters = found.law, found.choice, list(found.records[0].parameters)
    exact = list(choice.fits.relations.texts)
    report.write("law.json", law.save)
    report.summary["law"] = {"fit": choice.name, "cycle": found.cycle, "exact": exact}
    report.headline |= found.statistics
    report.section(
        f"Law of {choice.name}",
        *(f"exact at every point: {each}" for each in exact),
        f"{len(law.coefficients)} coefficients of {len(law.functions)} functions each, "
        f"{choice.n_numbers} numbers, from {len(law.points)} records",
    )
    rows, alone = _law_rows(law), _coefficients(found)
    report.table("laws", rows, shown=Table(_by_function(rows), note=INTERVALS))
    report.samples("law_coefficients", alone)
    draw = partial(laws_figure, alone, law, parameters=parameters, labels=labels)
    report.figure("laws", draw, CAPTIONS["laws"])
    shown = [Text(found.text)]
    head = f"Found: a law of {choice.name} over {', '.join(law.parameters)}"
    if found.runs:
        n, n_sustained = len(found.runs), found.statistics["n_sustained"]
        head = f"Found: a law of {choice.name}; {n_sustained} of {n} left-out points sustained"
        if not n_sustained:
            head = f"Nothing found: {choice.name} sustains none of {n} left-out points"
        _add_left_out(report, found, remedy)
        shown.append(Text(_add_map(report, found, points, labels)))
    report.section("Structures and laws compared")
    bold = [k for k, trial in enumerate(found.trials) if trial is choice]
    report.table("trials", ResultTable(found.trials, _metrics(found)), note=TRIED, bold=bold)
    middle = found.records[most_central(choice.fits.points)]
    model = read_law(law, middle.parameters)
    return Result(
        head,
        [*equations(model, lead=f"at {middle.label}"), *shown],
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


def _coefficients(found: FoundLaw) -> pd.DataFrame:
    """Coefficients at every point, refined alone and from the law, each with 95 % intervals."""
    points = {record.label: record.parameters for record in found.records}
    kinds = {
        "alone": dict(zip(points, found.choice.fits.models, strict=True)),
        "law": {label: read_law(found.law, point) for label, point in points.items()},
    }
    alone, law = (
        coefficients(models).rename(
            columns={"coef": kind, "lower": f"{kind}_low", "upper": f"{kind}_high"}
        )
        for kind, models in kinds.items()
    )
    at = pd.DataFrame.from_dict(points, orient="index")
    both = law.merge(alone, how="left", on=["model", "state", "term"])
    return at.merge(both, left_index=True, right_on="model").drop(columns="model")


def _add_left_out(report: Report, found: FoundLaw, remedy: str) -> None:
    metrics: list[Metric[LeftOutRun]] = [
        *map(_parameter, found.records[0].parameters),
        Metric("enclosed", lambda p: p.inside, View.SHOWN),
        Metric("f_kHz", lambda p: 1e-3 * p.record.cycle.frequency_Hz),
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


def _parameter(name: str) -> Metric[LeftOutRun]:
    return Metric(name, lambda p: p.record.parameters[name], View.SHOWN, name, "{:g}")


def _add_map(
    report: Report, found: FoundLaw, points: pd.DataFrame, labels: Mapping[str, str]
) -> str:
    """Add the map, if there is one; returns at how many points the law of all is right."""
    parameters, table = list(found.records[0].parameters), pd.DataFrame([p.row for p in found.map])
    report.section("Where the model oscillates")
    report.samples("map", table)
    if any(point.status is Status.SUSTAINED for point in found.map):
        draw = partial(
            cycle_figure, table, points, branch=found.cycle, parameters=parameters, labels=labels
        )
        report.figure("map", draw, CAPTIONS["map"])
    elif found.map:
        report.add("Nowhere on the map does the law's model oscillate.")
    quiet = points["status"].isin(QUIET)
    n_right = sum(run.holds for run in found.fitted)
    n_rests = int((points["law"][quiet] == ALONE[Status.DECAYS]).sum())
    report.headline |= {"n_fitted_sustained": n_right, "n_rests": n_rests}
    text = f"The law of all points sustains {n_right} of the {len(found.fitted)} it was fitted to"
    if quiet.any():
        text += f", and rests at {n_rests} of {quiet.sum()} whose record is steady or decays"
    rest = points["status"][~quiet & (points["branch"] != found.cycle)]
    return f"{text}; not counted: {', '.join(rest)}." if len(rest) else f"{text}."


def _metrics(found: FoundLaw) -> list[Metric[LawTrial]]:
    def terms(trial: LawTrial) -> str:
        common = trial.fits.relations.common
        return terms_text(
            {s: [t for state, t in common.coefficients if state == s] for s in common.states}
        )

    def nine_in_ten(trial: LawTrial) -> float:
        return float(np.quantile(trial.errors, 0.9))

    return [
        Metric("fit", lambda trial: trial.name, View.SHOWN),
        Metric("terms", terms),
        Metric("functions", lambda trial: ", ".join(trial.functions.names), View.SHOWN),
        Metric("numbers", lambda trial: trial.n_numbers, View.SHOWN),
        Metric("error", lambda trial: found.errors[trial.name], View.SHOWN, format="{:.3g}"),
        Metric("nine_in_ten", nine_in_ten, View.SHOWN, format="{:.3g}"),
        Metric("chosen", lambda trial: trial is found.choice, View.SHOWN),
    ]
