"""The law of whole models over operating points: how it is found, and its tables and texts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from ep2sindy.figures.operating import cycle_figure, frequency_scale, laws_figure, left_out_figure
from ep2sindy.model.comparison import Status
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.given_models import REFINED
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
from ep2sindy.operating.records import OperatingRecord, Point, most_central, read_points
from ep2sindy.regression.pooled import fewest_of_least
from ep2sindy.report.document import (
    Block,
    Captioned,
    Picture,
    Result,
    Section,
    Table,
    Text,
    places,
)
from ep2sindy.report.results import Metric, ResultTable, View, percent
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers, collect
from ep2sindy.studies.views import NO_ENDS, display_equation, intervals, terms_text, with_error

N_TOGETHER = 24  # points of a map computed as one piece: the records are sent with each piece

INTERVALS = (
    "In SI units, and the parameters in theirs. ±: half the 95 % interval by the jackknife: how "
    "far the law moves if a point is left out. It holds the noise of the records, and that "
    "coefficients are not exactly of this form."
)
LEFT_OUT = (
    "Each point in turn read off the law of the others, and run freely from one sample of its "
    "record, where the states move least. Errors are those against the record's cycle; a model "
    "lives within 1 % of frequency, 10 % of amplitude and 0.2 standard deviations of waveform; "
    "enclosed: whether the others enclose it."
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
    "left_out": "Points left out, each read off the law of the others. Left: frequency of the free "
    "run over the record's, the band 1 %. Right: errors of amplitude and waveform of each "
    "state, those beyond the panel filled on its edge; band and line are the bounds of a "
    "model that lives.",
    "map": "Frequency and relative amplitude (standard deviation over mean) of the law's cycle "
    "over the operating parameters, white without a cycle, and of the records in the same colours "
    "(circles); crosses: points that do not oscillate; diamonds: records of another cycle, not "
    "fitted here. Red: the law says otherwise than the record. Black line: where the law's cycle "
    "ends; dashed: where its fixed point turns stable. Faded: beyond what the points that the law "
    "was fitted to enclose, where it is extrapolated.",
    "line": "Frequency and relative amplitude (standard deviation over mean) of the law's cycle "
    "over the operating parameter (line, ending where the cycle does), and of the records "
    "(circles); crosses at zero amplitude: points that do not oscillate; diamonds: records of "
    "another cycle, not fitted here. Red: the law says otherwise than the record. Faded: beyond "
    "the points that the law was fitted to, where it is extrapolated.",
}


@dataclass(frozen=True, eq=False)
class FoundLaw:
    """The law of the records on one cycle, and what was tried for it.

    cycle: its name; "all" if there is only one. runs: of the points left out, each with the law of
    the others. at_points: the law's models at all points of the study. map: the same over a grid
    that encloses these. Of a model that inputs drive, which has no free runs, all three are empty.
    """

    cycle: str
    records: Sequence[OperatingRecord]
    trials: Sequence[LawTrial]
    choice: LawTrial
    law: OperatingLaw
    runs: Sequence[LeftOutRun]
    at_points: Sequence[MapPoint]
    map: Sequence[MapPoint]

    @property
    def parameters(self) -> list[str]:
        return list(self.records[0].parameters)

    def model_at(self, point: Point) -> SparseModel:
        return read_law(self.law, point)

    @cached_property
    def statistics(self) -> dict[str, float | int]:
        """Of the points left out: of their windows, and of their free runs if there are any."""
        errors = self.choice.errors
        windows = {"n": len(errors), "window_error": float(errors.mean())}
        return windows | (error_statistics(self.runs) if self.runs else {})

    @property
    def text(self) -> str:
        """How the law does at the points left out."""
        found, text = self.statistics, percent(2)
        windows = (
            "Left out one at a time, windows of the records are followed to "
            f"{found['window_error']:.3g} standard deviations"
        )
        if not self.runs:
            return f"{windows}."
        most = f"nine in ten within {text(found['f_90'])}"
        if not np.isfinite(found["f_90"]):
            most = "more than one in ten do not oscillate"
        return (
            f"{windows}, and run freely {found['n_lives']} of {found['n']} points live, diverging: "
            f"{found['diverging']}. Errors in the median: frequency {text(found['f_median'])} "
            f"({most}), the worst state's amplitude {text(found['amplitude_median'])} and waveform "
            f"{places(found['waveform_median'], 3)}."
        )

    @property
    def compared(self) -> str:
        """The fit of least error where left out, and what the others have."""
        others = sorted((t for t in self.trials if t is not self.choice), key=_mean_error)
        beside = ", ".join(f"{spoken(t.name)} {_mean_error(t):.3g}" for t in others)
        own = f"{spoken(self.choice.name)} {_mean_error(self.choice):.3g}"
        return f"Errors where left out: {own}" + (f"; other fits: {beside}" if beside else "")

    @property
    def advice(self) -> str:
        """What to try if no point left out lives; empty if one does."""
        if not self.runs or self.statistics["n_lives"]:
            return ""
        return (
            f"none of {len(self.runs)} points left out lives by the law of the others, so "
            "it predicts none between them: try points that lie closer together, other models, or "
            "models=null, longer records, and inputs that are states "
            "(docs/parametric.md)"
        )

    def agreement(self, statuses: Mapping[str, bool]) -> tuple[int, int]:
        """At how many points the law says rightly whether they oscillate: all, and quiet ones."""
        says = np.array([point.status is Status.SUSTAINED for point in self.at_points])
        does = np.array(list(statuses.values()))
        return int((says == does).sum()), int((~says & ~does).sum())

    def tables(self) -> dict[str, pd.DataFrame]:
        return {
            "laws": _laws_table(self.law),
            "coefficients": self.coefficients,
            "trials": ResultTable(self.trials, _trial_metrics(self.choice)).csv(),
            "left_out": ResultTable(self.runs, _left_out_metrics(self.runs)).csv(),
            "map": pd.DataFrame([point.row for point in self.map]),
        }

    @cached_property
    def coefficients(self) -> pd.DataFrame:
        """Coefficients at every point, refined alone and from the law, each with 95 % intervals."""
        rows = []
        for record, alone in zip(self.records, self.choice.fits.models, strict=True):
            pooled = self.model_at(record.parameters)
            for state in pooled.states:
                for term, value in pooled.terms(state).items():
                    row = {**record.parameters, "state": state, "term": term}
                    row |= {"alone": alone.terms(state).get(term, np.nan), "law": value}
                    for kind, model in (("alone", alone), ("law", pooled)):
                        ends = (intervals(model) or {}).get(state, {}).get(term, NO_ENDS)
                        row |= {f"{kind}_low": ends[0], f"{kind}_high": ends[1]}
                    rows.append(row)
        return pd.DataFrame(rows)

    def figures(self, points: pd.DataFrame, labels: Mapping[str, str]) -> dict[str, Captioned]:
        """Those that show something: none of runs or maps without an oscillation.

        points: status, cycle, frequency and amplitude of every point.
        """
        found: dict[str, Captioned] = {}
        left_out = self.tables()["left_out"]
        if self.runs and left_out["f_model_kHz"].notna().any():
            found["left_out"] = Captioned(partial(left_out_figure, left_out), CAPTIONS["left_out"])
        draw = partial(
            laws_figure, self.coefficients, self.law, parameters=self.parameters, labels=labels
        )
        found["laws"] = Captioned(draw, CAPTIONS["laws"])
        if any(point.status is Status.SUSTAINED for point in self.map):
            caption = CAPTIONS["map" if len(self.parameters) == 2 else "line"]
            draw = partial(
                cycle_figure, pd.DataFrame([point.row for point in self.map]), points,
                branch=self.cycle, parameters=self.parameters, labels=labels,
            )  # fmt: skip
            found["map"] = Captioned(draw, caption)
        return found

    def sections(self, statuses: Mapping[str, bool], drawn: Mapping[str, Any]) -> list[Section]:
        bold = [k for k, trial in enumerate(self.trials) if trial is self.choice]
        tried = Table(ResultTable(self.trials, _trial_metrics(self.choice)).screen(), bold=bold,
                      note=TRIED)  # fmt: skip
        found = [Section("Model and order", [tried])] if len(self.trials) > 1 else []
        found.append(self._law())
        blocks: list[Block] = [Text(self.text)]
        if self.runs:
            table = ResultTable(self.runs, _left_out_metrics(self.runs)).screen()
            blocks += [Table(table, note=LEFT_OUT), Picture("left_out")]
        found.append(Section("Points left out", blocks))
        if self.at_points:
            right, quiet = self.agreement(statuses)
            n_quiet = sum(not oscillates for oscillates in statuses.values())
            text = f"Oscillating or not, the law is right at {right} of {len(statuses)} points"
            text += f"; at {quiet} of the {n_quiet} that do not oscillate" if n_quiet else ""
            shown: Block = (
                Picture("map")
                if "map" in drawn
                else Text("Nowhere on the map does the law's model oscillate." if self.map else "")
            )
            found.append(Section("Where it oscillates", [Text(f"{text}."), shown]))
        return found

    def _law(self) -> Section:
        law, rows = self.law, _laws_table(self.law)
        middle = self.middle
        shown = [
            {
                "coefficient": f"{state}: {term}",
                **{r["function"]: _number(r) for r in group.to_dict("records")},
            }
            for (state, term), group in rows.groupby(["state", "term"], sort=False)
        ]
        text = (
            f"{len(law.coefficients)} coefficients of {len(law.functions)} functions each, "
            f"{self.choice.n_numbers} numbers, from {len(law.points)} records. At {middle.label}:"
        )
        exact = [Text(f"exact at every point: {each}") for each in self.choice.fits.relations.texts]
        model = self.model_at(middle.parameters)
        equations: list[Block] = [display_equation(model, state) for state in model.states]
        blocks = [*exact, Text(text), *equations, Table(pd.DataFrame(shown), note=INTERVALS)]
        return Section(f"Law of {spoken(self.choice.name)}", [*blocks, Picture("laws")])

    @property
    def middle(self) -> OperatingRecord:
        """The record whose parameters are nearest to the mean of all."""
        points = read_points([record.parameters for record in self.records], self.parameters)
        return self.records[most_central(points)]

    def in_short(self, statuses: Mapping[str, bool], drawn: Mapping[str, Any]) -> Result:
        """The law at the middle point, how it does at points left out, and what others do."""
        middle, numbers = self.middle, self.statistics
        model = self.model_at(middle.parameters)
        lives = f"; left out one at a time, {numbers['n_lives']} of {numbers['n']} points live"
        blocks: list[Block] = [
            *(display_equation(model, s, lead=f"at {middle.label}") for s in model.states),
            Text(self.text),
            Text(self.compared),
        ]
        if self.at_points:
            right, _ = self.agreement(statuses)
            blocks.append(Text(f"Oscillating or not, right at {right} of {len(statuses)} points"))
        head = f"Found: a law over {', '.join(self.law.parameters)}, by {spoken(self.choice.name)}"
        return Result(
            head + (lives if self.runs else ""),
            blocks,
            load='ep.operating.OperatingLaw.load("{}/law.json")',
            picture=next(name for name in ("map", "left_out", "laws") if name in drawn),
        )

    def errors_by_fit(self) -> dict[str, float]:
        """For each fit, the mean error of its law at points left out."""
        return {trial.name: _mean_error(trial) for trial in self.trials}

    def summary(self, statuses: Mapping[str, bool]) -> dict[str, Any]:
        fits = self.choice.fits
        right, quiet = self.agreement(statuses) if self.at_points else (None, None)
        return {
            "fit": self.choice.name,
            "cycle": self.cycle,
            "terms": {s: list(self.law.numbers[s]) for s in self.law.states},
            "exact": list(fits.relations.texts),
            "functions": list(self.choice.functions.names),
            "n_numbers": self.choice.n_numbers,
            "errors": self.errors_by_fit(),
            "left_out": self.statistics,
            "oscillating_or_not": {"right": right, "points": len(statuses), "quiet": quiet},
        }

    def headline(self, statuses: Mapping[str, bool]) -> dict[str, float]:
        numbers = {key: float(value) for key, value in self.statistics.items()}
        right = self.agreement(statuses)[0] / len(statuses) if self.at_points else np.nan
        return {**numbers, "map_right": right}


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
    run: Run,
) -> FoundLaw:
    """Find the law of the records, of the fit that does best at points left out.

    Of models that run freely, it is the best of those that attract at more than half of the points
    left out, if there are any: a neutral cycle keeps the amplitude of its start.
    fits: of the records, by name. functions: of the law. points: all points of the study, which the
    map encloses. periods: length of the windows that are followed where left out.
    Raises ValueError if the records do not suffice for the law of any fit.
    """
    known, reason = {}, ""
    for name, of_all in fits.items():
        try:
            own = of_all.functions(functions)
            of_all.rate_errors(own)
            known[name] = LawTrial(name, of_all, own, np.zeros(0))
        except ValueError as error:
            reason = str(error)
    if not known:
        raise ValueError(f"{n_points(len(records))} that oscillate get no law: {reason}")
    stage = run.progress(len(records), "point", "laws at points left out")
    trials, numbers = list(known.values()), list(enumerate(records))
    one = partial(_leave_out, trials=trials, periods=periods)
    errors = np.array(collect(workers, one, numbers, stage))
    trials = [replace(t, errors=own) for t, own in zip(trials, errors.T, strict=True)]
    best, runs = _choose(trials, records)
    law = best.fits.law(best.functions)
    at_points: list[MapPoint] = []
    grid: list[MapPoint] = []
    if runs:
        at_points = _follow(law, records, points, workers, run)
        grid = _follow(law, records, map_points(points, n_map), workers, run) if n_map else []
    return FoundLaw(cycle, records, trials, best, law, runs, at_points, grid)


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


def _follow(
    law: OperatingLaw,
    records: Sequence[OperatingRecord],
    points: Sequence[Point],
    workers: Workers,
    run: Run,
) -> list[MapPoint]:
    pieces = [points[first : first + N_TOGETHER] for first in range(0, len(points), N_TOGETHER)]
    stage = run.progress(len(points), "point", "map of the law")
    maps = collect(workers, partial(law_map, law, records), pieces, stage, size=len)
    return [point for piece in maps for point in piece]


def _laws_table(law: OperatingLaw) -> pd.DataFrame:
    """One row per coefficient and function of a law, with its 95 % interval."""
    known = {} if law.covariance is None else law.intervals()
    rows = [
        (state, term, function, value, *known.get((state, term), {}).get(function, NO_ENDS))
        for (state, term), row in zip(law.coefficients, law.coef.tolist(), strict=True)
        for function, value in zip(law.functions.names, row, strict=True)
    ]
    return pd.DataFrame(rows, columns=["state", "term", "function", "value", "low", "high"])


def _number(row: Mapping[Any, Any]) -> str:
    """A number of a law with its error; one that is exact has none."""
    reach = 0.5 * (row["high"] - row["low"])
    return with_error(row["value"], reach) if reach else f"{row['value']:g}"


def _mean_error(trial: LawTrial) -> float:
    return float(trial.errors.mean())


def _trial_metrics(choice: LawTrial) -> list[Metric[LawTrial]]:
    def terms(trial: LawTrial) -> str:
        common = trial.fits.relations.common
        return terms_text(
            {s: [t for state, t in common.coefficients if state == s] for s in common.states}
        )

    def marked(trial: LawTrial) -> str:
        return spoken(trial.name) + ("  <- chosen" if trial is choice else "")

    return [
        Metric("fit", lambda trial: trial.name),
        Metric("fit", marked, View.SCREEN),
        Metric("terms", terms),
        Metric("functions", lambda trial: ", ".join(trial.functions.names), View.SHOWN),
        Metric("numbers", lambda trial: trial.n_numbers, View.SHOWN),
        Metric("error", _mean_error, View.SHOWN, format="{:.3g}"),
        Metric(
            "nine_in_ten",
            lambda trial: float(np.quantile(trial.errors, 0.9)),
            View.SHOWN,
            format="{:.3g}",
        ),
        Metric("chosen", lambda trial: trial is choice),
    ]


def spoken(fit: str) -> str:
    """A fit's name as it is said: `free (refined)`."""
    return fit.removesuffix(REFINED) + (" (refined)" if fit.endswith(REFINED) else "")


def n_points(n: int) -> str:
    """`1 point`, `3 points`."""
    return f"{n} point" if n == 1 else f"{n} points"


def _parameter(name: str) -> Metric[LeftOutRun]:
    return Metric(name, lambda p: p.record.parameters[name], View.SHOWN, name, "{:g}")


def _left_out_metrics(runs: Sequence[LeftOutRun]) -> list[Metric[LeftOutRun]]:
    def f_kHz(left_out: LeftOutRun) -> float:
        return 1e-3 * left_out.record.cycle.frequency_Hz

    factor, unit = frequency_scale(pd.Series([f_kHz(each) for each in runs] or [1.0]))
    relative = percent(2, sign=True)
    names = list(runs[0].record.parameters) if runs else []
    return [
        *(_parameter(name) for name in names),
        Metric(
            "enclosed",
            lambda p: p.inside,
            View.SHOWN,
            format=lambda inside: "yes" if inside else "no",
        ),
        Metric("f_kHz", f_kHz),
        Metric("f", lambda p: factor * f_kHz(p), View.SCREEN, f"f ({unit})", "{:.2f}"),
        Metric("f_model_kHz", lambda p: f_kHz(p) * (1.0 + p.run.f_error)),
        Metric("f_error", lambda p: p.run.f_error, View.SHOWN, format=relative),
        Metric(
            "amplitude",
            lambda p: p.run.amplitude_ratio,
            View.SHOWN,
            "amplitude {}",
            lambda ratio: relative(ratio - 1.0),
        ),
        Metric("waveform", lambda p: p.run.waveform_error, View.SHOWN, "waveform {}", "{:.3f}"),
        Metric("status", lambda p: str(p.run.status), View.SHOWN),
    ]
