"""Models of laws, and tables: of `+exp=predict`, and the control laws of `+exp=parametric`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.figures.operating import frequency_scale
from ep2sindy.forecasting.skill import AUTOREGRESSION, MODEL, ForecastSkill
from ep2sindy.operating.branch import Branch, StructureCase, StructureTrial
from ep2sindy.operating.fit import LeaveOneOut, error_statistics
from ep2sindy.operating.law import Known, constrain_law
from ep2sindy.operating.map import Fate, MapPoint
from ep2sindy.operating.point_fits import Case
from ep2sindy.operating.quantities import ControlLaw, PointResult
from ep2sindy.operating.records import OperatingRecord, point_label
from ep2sindy.report.document import Equation, places
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, facts, percent
from ep2sindy.runtime.progress import SILENT, Progress, count_pieces
from ep2sindy.signals.spectrum import Oscillation
from ep2sindy.studies.fits import Terms, terms_of
from ep2sindy.studies.forecasts import skill_of
from ep2sindy.studies.views import terms_text, with_error

Parameters = Mapping[str, float]
Laws = Mapping[str, Mapping[str, ControlLaw]]  # fit -> quantity -> law


@dataclass(frozen=True)
class LawModel:
    """The terms of every state, and relations and known coefficients that hold at every point."""

    terms: Terms
    relations: Sequence[str] = ()
    known: Known = field(default_factory=dict)

    def case(self, name: str, states: Sequence[str], parameters: Sequence[str]) -> StructureCase:
        key = f"models.{name}.terms"
        library, structure = terms_of(self.terms, states=states, key=key)
        if inputs := [v for v in library.variables if v not in states]:
            raise ValueError(
                f"a law's model runs freely, on its states {list(states)} alone: {inputs} came in "
                f"{key}"
            )
        try:
            constrain_law(library, structure, self.relations, self.known, parameters=parameters)
        except ValueError as error:
            raise ValueError(
                f"models.{name} cannot hold: {error} (or leave it out: ~models.{name})"
            ) from error
        return StructureCase(library, structure, self.relations, self.known, name)


def known_beside_files(models: Mapping[str, LawModel]) -> str:
    """What the models hold for known beside data of files, and how to change it; may be empty."""
    known = [
        (f"models.{name}.known.{state}.{term}.{function}", factor)
        for name, model in models.items()
        for state, terms in model.known.items()
        for term, factors in terms.items()
        for function, factor in factors.items()
    ]
    if not known:
        return ""
    place, factor = known[-1]
    name = place.split(".")[1]
    return (
        f"data are files, and models hold a known inflow, {place}={factor:g}, which as shipped is "
        "that of the package's thruster; set it to that of yours, for each model that has one, or "
        f"leave such models out: ~models.{name}"
    )


def points_table(
    points: Sequence[Parameters],
    statuses: Mapping[str, str],
    records: Sequence[OperatingRecord],
    members: Mapping[str, Sequence[Parameters]],
) -> pd.DataFrame:
    """One row per operating point: status of its record, and its cycle."""
    known = {record.label: record for record in records}
    cycle = {point_label(p): name for name, group in members.items() for p in group}
    rows = []
    for point in points:
        label = point_label(point)
        record = known.get(label)
        rows.append(
            {
                **point,
                "status": statuses[label],
                "branch": cycle.get(label, ""),
                "f_kHz": 1e-3 * record.cycle.frequency_Hz if record else np.nan,
                "relative_amplitude": record.relative_amplitude if record else np.nan,
            }
        )
    return pd.DataFrame(rows)


def laws_table(branches: Mapping[str, Branch]) -> pd.DataFrame:
    """One row per coefficient of a law, with its 95 % interval."""
    rows = []
    for name, branch in branches.items():
        law = branch.law
        known = {} if law.covariance is None else law.intervals()
        for (state, term), row in zip(law.coefficients, law.coef, strict=True):
            for function, value in zip(law.functions.names, row, strict=True):
                ends = known.get((state, term), {}).get(function, (np.nan, np.nan))
                rows.append((name, state, term, function, value, *ends))
    columns = ["branch", "state", "term", "function", "value", "low", "high"]
    return pd.DataFrame(rows, columns=columns)


def coefficients_table(branches: Mapping[str, Branch]) -> pd.DataFrame:
    """Coefficients at every point, refined alone and from the law, each with 95 % intervals."""
    rows = []
    for name, branch in branches.items():
        pairs = zip(branch.fit.records, branch.fit.fits, branch.refinement.models, strict=True)
        for record, alone, pooled in pairs:
            for state in pooled.states:
                for term, value in pooled.terms(state).items():
                    row = {**record.parameters, "branch": name, "state": state, "term": term}
                    row |= {"alone": alone.model.terms(state)[term], "law": value}
                    for kind, model in (("alone", alone.model), ("law", pooled)):
                        if model.covariance is not None:
                            low, high = model.intervals(state)[term]
                            row |= {f"{kind}_low": low, f"{kind}_high": high}
                    rows.append(row)
    return pd.DataFrame(rows)


@dataclass(frozen=True, eq=False)
class LeftOutPoint:
    """Prediction at one point by the law of the other points.

    also: other cycles whose law oscillates there. skill: of forecasts over the second half of the
    point's record, by the same law; None if there are none.
    """

    branch: str
    result: LeaveOneOut
    also: str
    skill: ForecastSkill | None = None

    @property
    def record(self) -> OperatingRecord:
        return self.result.record

    @property
    def f_kHz(self) -> float:
        return 1e-3 * self.record.cycle.frequency_Hz

    def forecast_error(self, name: str) -> float:
        """Half a period ahead, in standard deviations; NaN if there is none."""
        known = {} if self.skill is None else self.skill.at(0.5 / self.record.cycle.frequency_Hz)
        return known.get(name, float("nan"))


def skills_left_out(
    left_out: Sequence[LeaveOneOut], *, starts: int, progress: Progress = SILENT
) -> list[ForecastSkill | None]:
    """At points left out, each by the law of the others over the second half of its record."""
    skills = []
    for each in count_pieces(progress, left_out, "point", "forecasts at points left out"):
        record = each.record.run
        half = record.n_samples // 2
        skills.append(
            skill_of(each.run.model, record, n_fitted=half, starts=starts, progress=progress)
        )
    return skills


def left_out_metrics(points: Sequence[LeftOutPoint]) -> list[Metric[LeftOutPoint]]:
    """Metrics of points left out; their cycle is shown if there are several."""
    several = View.SHOWN if len({point.branch for point in points}) > 1 else View.FILES
    forecast = View.SHOWN if any(point.skill for point in points) else View.FILES
    factor, unit = frequency_scale(pd.Series([point.f_kHz for point in points]))
    relative = percent(2, sign=True)
    return [
        Metric("branch", lambda p: p.branch, several, "cycle"),
        *(_parameter(name) for name in points[0].record.parameters),
        Metric(
            "enclosed",
            lambda p: p.result.inside,
            View.SHOWN,
            format=lambda inside: "yes" if inside else "no",
        ),
        Metric("f_kHz", lambda p: p.f_kHz),
        Metric("f", lambda p: factor * p.f_kHz, View.SCREEN, f"f ({unit})", "{:.2f}"),
        Metric("f_model_kHz", lambda p: p.f_kHz * (1.0 + p.result.run.f_error)),
        Metric("f_error", lambda p: p.result.run.f_error, View.SHOWN, format=relative),
        Metric(
            "amplitude",
            lambda p: p.result.run.amplitude_ratio,
            View.SHOWN,
            "amplitude {}",
            lambda ratio: relative(ratio - 1.0),
        ),
        Metric(
            "waveform", lambda p: p.result.run.waveform_error, View.SHOWN, "waveform {}", "{:.3f}"
        ),
        Metric("verdict", lambda p: str(p.result.run.verdict), View.SHOWN),
        Metric("forecast", lambda p: p.forecast_error(MODEL), forecast, format="{:.3f}"),
        Metric(
            "autoregression", lambda p: p.forecast_error(AUTOREGRESSION), forecast, "AR", "{:.3f}"
        ),
        Metric("also", lambda p: p.also, several),
    ]


def _parameter(name: str) -> Metric[LeftOutPoint]:
    return Metric(name, lambda p: p.record.parameters[name], View.SHOWN, name, "{:g}")


def structures_table(branches: Mapping[str, Branch]) -> pd.DataFrame:
    """One row per structure and degree tried, with the weighted laws' errors at points left out."""
    tables = [
        ResultTable(branch.trials, structure_metrics(name, branch)).csv()
        for name, branch in branches.items()
    ]
    return pd.concat(tables, ignore_index=True)


def structure_metrics(name: str, branch: Branch) -> list[Metric[StructureTrial]]:
    def is_chosen(trial: StructureTrial) -> bool:
        return trial is branch.choice

    def marked(trial: StructureTrial) -> str:
        text = trial.case.name or terms_text(trial.fit.structure)
        return text + ("  <- chosen" if is_chosen(trial) else "")

    return [
        Metric("branch", lambda trial: name),
        Metric("model", lambda trial: trial.case.name),
        Metric("terms", lambda trial: terms_text(trial.fit.structure)),
        Metric("model" if branch.choice.case.name else "terms", marked, View.SCREEN),
        Metric("degree", lambda trial: trial.degree, View.SHOWN),
        Metric("numbers", lambda trial: trial.n_numbers, View.SHOWN),
        Metric("error", lambda trial: float(trial.errors.mean()), View.SHOWN),
        Metric(
            "f_error",
            lambda trial: error_statistics(trial.left_out)["f_median"],
            View.SHOWN,
            format=percent(2),
        ),
        Metric(
            "diverging", lambda trial: error_statistics(trial.left_out)["diverging"], View.SHOWN
        ),
        Metric("chosen", is_chosen),
    ]


def map_table(branches: Mapping[str, Branch], which: str) -> pd.DataFrame:
    """The law's models over the map, or at the points of the study (`at_points`)."""
    rows = []
    for name, branch in branches.items():
        points: Sequence[MapPoint] = branch.map if which == "map" else branch.at_points
        for point in points:
            rows.append({"branch": name, **point.row})
    return pd.DataFrame(rows)


def agreement(
    branches: Mapping[str, Branch], statuses: Mapping[str, str]
) -> tuple[int, int, int, int]:
    """How often laws predict rightly whether a point oscillates, over all points and quiet ones.

    Returns (right, all points, right among the quiet points, quiet points).
    """
    says = dict.fromkeys(statuses, False)
    for branch in branches.values():
        for point in branch.at_points:
            label = point_label(point.parameters)
            says[label] = says[label] or point.fate is Fate.OSCILLATES
    quiet = [label for label, status in statuses.items() if status != Oscillation.OSCILLATING]
    right = [says[label] == (statuses[label] == Oscillation.OSCILLATING) for label in statuses]
    return sum(right), len(right), sum(not says[label] for label in quiet), len(quiet)


def advice_if_none_lives(branch: Branch, degrees: Sequence[int], *, searched: bool) -> str:
    """What to try if no point left out lives; empty if one does.

    degrees: that were tried. searched: whether terms were searched for, and not given.
    """
    if error_statistics(branch.left_out)["n_lives"]:
        return ""
    n = len(branch.left_out)
    lower = "" if min(degrees) == 1 else "degrees=[1], "
    terms = "more terms, structures.max_terms" if searched else "other models, or models=null"
    return (
        f"none of {n_points(n)} left out lives by the law of the others, so it predicts none "
        f"between them: try points that lie closer together, {lower}{terms}, longer records, and "
        "inputs that are states (docs/predict.md)"
    )


def left_out_text(branch: Branch) -> str:
    """How the law does at the points left out, in the median, and beside plain interpolation."""
    found = error_statistics(branch.left_out)
    smooth_f, smooth_amplitude = branch.smooth
    text = percent(2)
    most = f"nine in ten within {text(found['f_90'])}"
    if not np.isfinite(found["f_90"]):
        most = "more than one in ten do not oscillate"
    return (
        f"Left out one at a time, {found['n_lives']} of {found['n']} points live, diverging: "
        f"{found['diverging']}. Errors in the median: frequency {text(found['f_median'])} "
        f"({most}), the worst state's amplitude "
        f"{text(found['amplitude_median'])} and waveform {places(found['waveform_median'], 3)}. "
        "The records' own frequencies and amplitudes, interpolated by the same functions, miss by "
        f"{text(float(np.median(smooth_f)))} and {text(float(np.median(smooth_amplitude)))} in the "
        "median."
    )


def best_fit(fits: Iterable[str], results: Sequence[PointResult], laws: Laws) -> str:
    """The fit whose laws miss left-out points least, of those done at the most points."""

    def rank(fit: str) -> tuple[int, float]:
        n_done = sum(result.usable(fit) for result in results)
        errors = [law.search_error for law in laws.get(fit, {}).values()]
        mean = float(np.mean(errors)) if errors else np.inf
        return -n_done, mean if np.isfinite(mean) else np.inf

    return min(fits, key=rank)


# A control law with its fit and quantity. Its errors are those at points left out.
CONTROL_LAW: Metrics[tuple[str, str, ControlLaw]] = [
    Metric("fit", lambda row: row[0], View.CSV),
    Metric("quantity", lambda row: row[1], View.CSV),
    Metric("law", lambda row: Equation(row[1], row[2].coef_by_term, rate=False), View.CSV),
    Metric("terms", lambda row: row[2].coef_by_term, View.JSON),
    Metric("r2", lambda row: row[2].r2),
    Metric("loo_error", lambda row: row[2].loo_error),
    Metric("search_error", lambda row: row[2].search_error),
]


def control_laws_table(laws: Laws) -> pd.DataFrame:
    """One row per control law."""
    rows = [(fit, name, law) for fit, of_fit in laws.items() for name, law in of_fit.items()]
    return ResultTable(rows, CONTROL_LAW).csv()


def control_laws_summary(laws: Laws) -> dict[str, Any]:
    """Terms and errors of every control law, by fit and quantity."""
    return {
        fit: {name: facts((fit, name, law), CONTROL_LAW) for name, law in of_fit.items()}
        for fit, of_fit in laws.items()
    }


def law_errors(laws: Laws, fits: Mapping[str, Case]) -> dict[str, float]:
    """Prediction error of the laws by fit and quantity; NaN for a law that was not found."""
    found = control_laws_summary(laws)
    return {
        f"law/{fit}/{name}/{key}": found.get(fit, {}).get(name, {}).get(key, np.nan)
        for fit, case in fits.items()
        for name in case.quantities
        for key in ("loo_error", "search_error")
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


def number_text(value: float, reach: float) -> str:
    """A number of a law with its error; one that is exact has none."""
    return with_error(value, reach) if reach else f"{value:g}"


def n_points(n: int) -> str:
    """`1 point`, `3 points`."""
    return f"{n} point" if n == 1 else f"{n} points"
