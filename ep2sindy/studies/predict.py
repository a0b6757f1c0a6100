"""One structure and one law for many operating points, and the models between: `+exp=predict`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from typing import Annotated, Any

import numpy as np
import pandas as pd
from scipy.special import ndtri

from ep2sindy.data.scales import zero_to_one
from ep2sindy.figures.operating import (
    cycle_line_figure,
    cycle_map_figure,
    frequency_scale,
    laws_figure,
    left_out_figure,
)
from ep2sindy.library.library import polynomial
from ep2sindy.model.likeness import Verdict
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.choice import (
    Branch,
    How,
    Searched,
    StructureTrial,
    find_branch,
    group_by_cycle,
)
from ep2sindy.operating.fit import LeaveOneOut, Windows
from ep2sindy.operating.law import law_basis
from ep2sindy.operating.map import Fate, MapPoint
from ep2sindy.operating.records import OperatingRecord, point_label, values_of
from ep2sindy.report.document import (
    Block,
    Captioned,
    Equation,
    Picture,
    Section,
    Table,
    Text,
    places,
)
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers
from ep2sindy.signals.oscillation import Oscillation
from ep2sindy.studies.fits import Terms, terms_of
from ep2sindy.studies.simulated import compile_kernels
from ep2sindy.studies.source import Source, open_points, point_sources
from ep2sindy.studies.study import Check, Count, Counts, Positive

INTERVALS = (
    "In SI units, and the parameters in theirs. ±: half the 95 % interval, from a sandwich with "
    "the windows of all points as clusters: how far other windows of the same records would move a "
    "number, not how far a law of this form is from the truth; for that see the points left out."
)
LEFT_OUT = (
    "Each point in turn read off the law of the others, tied in one refinement, and run freely "
    "from one sample of its record, where the states move least. Errors are those against the "
    "record's cycle; a model lives within 1 % of frequency, 10 % of amplitude and 0.2 standard "
    "deviations of waveform; enclosed: whether the others enclose it."
)
ALSO = " also: other cycles whose law oscillates there, inside its points."
TRIED = (
    "error: mean over the points left out of the largest deviation from the cycle, in units of its "
    "bound (1 % of frequency, 10 % of amplitude, 0.2 of waveform), 10 at most; f error: median; "
    "numbers: of the law; laws through separate refinements. Chosen: the fewest numbers within a "
    "standard error of the least."
)
CAPTIONS = {
    "laws": "Coefficients over the operating parameters: refined at each point alone (open, with "
    "95 % intervals) and by the law that all points share (lines), at up to five values of the "
    "other parameters. Where the open points leave the lines by more than their bars, other "
    "coefficients make up for it: points are sloppy in some directions, and the law is fitted to "
    "the records, not to them.",
    "left_out": "Points left out, each read off the law of the others. Left: frequency of the free "
    "run over the record's, the band 1 %. Right: errors of amplitude and waveform of each "
    "state, those beyond the panel filled on its edge; band and line are the bounds of a "
    "model that lives.",
    "map": "Frequency and relative amplitude (standard deviation over mean) of the law's cycle "
    "over the operating parameters, and of the records in the same colours (circles); crosses: "
    "points that do not oscillate; diamonds: records of another cycle, not fitted here. Black "
    "line: where the model's cycle ends; dashed: where its fixed point turns stable; grey: what "
    "the points that the law was fitted to enclose, beyond which it is extrapolated. White: no "
    "cycle.",
    "line": "Frequency and relative amplitude (standard deviation over mean) of the law's cycle "
    "over the operating parameter (line, ending where the cycle does), and of the records "
    "(circles); crosses: points that do not oscillate; diamonds: records of another cycle, not "
    "fitted here. Shaded: between the points that the law was fitted to.",
}


@dataclass(frozen=True)
class Followed:
    """Windows of every record: so many, of so many periods of the median frequency."""

    n_windows: Count
    periods: Positive


@dataclass(frozen=True)
class SearchSettings:
    """Where no model is given: all products of the states to this degree, and how many terms."""

    degree: Count
    max_terms: Count


Parameters = Mapping[str, float]
Points = Annotated[
    Sequence[Mapping[str, Any]],
    Check(
        "a list like [{V_D_V: [250,300], mdot_mg_s: [4,5]}], every combination being a point",
        lambda value: isinstance(value, list) and bool(value),
    ),
]


@dataclass(frozen=True, eq=False)
class Study:
    """Fit one law to all operating points that oscillate, and judge it where it was not fitted.

    parameters: where the data group takes each; None for nowhere. points: blocks, each with one
    value or a list of values for all parameters, and `data`: what else differs from the data
    group. model: state -> terms; None has them chosen. degrees: of the polynomials, one chosen.
    map_points: along each parameter. labels: what figures call parameters.
    """

    source: Source
    parallel: Workers
    parameters: Mapping[str, str | None]
    points: Points
    model: Terms | None
    structures: SearchSettings
    degrees: Counts
    windows: Followed
    map_points: Count
    labels: Mapping[str, str]

    def __post_init__(self) -> None:
        self._how(0)
        given = expand(self.points, list(self.parameters))
        sources = point_sources(self.source, self.parameters, given)
        names = list(self.parameters)
        # What cannot bear a law even if all points oscillate must cost no simulation.
        law_basis(
            polynomial(names, degree=min(self.degrees)),
            np.array([[source.parameters[name] for name in names] for source in sources]),
            n_spare=1,
            remedy="give it more values, or leave it out (~parameters.{name})",
        )

    def compute(self, run: Run) -> Outcome:
        how = self._how(run.seed)
        given = expand(self.points, list(self.parameters))
        sources = point_sources(self.source, self.parameters, given)
        with run.progress(None, "", "kernels, compiled once"):
            compile_kernels([source.source.data for source in sources])
        opened = open_points(sources, (), workers=self.parallel, run=run)
        records, statuses = _records(opened, run)
        if not records:
            raise ValueError("a law needs operating points that oscillate: none of these does")
        found: dict[str, Branch] = {}
        reasons: dict[str, str] = {}
        everywhere = [source.parameters for source in sources]
        groups = group_by_cycle(records)
        for name, members in groups.items():
            cycle = "" if len(groups) == 1 else f" on the {name} cycle"
            run.say(f"fitting a law to {n_points(len(members))}{cycle} ...")
            try:
                found[name] = find_branch(
                    name, members, everywhere, how, self.parallel, progress=run.watch
                )
            except ValueError as error:
                reasons[name] = str(error)
                if len(groups) > 1:
                    run.warn(f"two cycles coexist, and the {name} one gets no law: {error}")
        if not found:
            raise ValueError(f"no law: {'; '.join(reasons.values())}")
        for name, branch in found.items():
            run.write(f"law_{name}.json", branch.law.save)
        members_of = {name: [r.parameters for r in group] for name, group in groups.items()}
        return Outcome(everywhere, statuses, records, members_of, found, self.labels)

    def _how(self, seed: int) -> How:
        states = self.source.states
        searched = Searched(self.structures.degree, self.structures.max_terms)
        structure = None
        library = polynomial(states, degree=searched.degree)
        if self.model is not None:
            library, structure = terms_of(self.model, states=states)
            if inputs := [name for name in library.variables if name not in states]:
                raise ValueError(
                    f"a law's model runs freely, on its states {states} alone: {inputs} came in "
                    "model"
                )
        windows = Windows(self.windows.n_windows, self.windows.periods)
        return How(library, structure, searched, self.degrees, windows, self.map_points, seed)


def expand(blocks: Sequence[Mapping[str, Any]], parameters: Sequence[str]) -> list[dict[str, Any]]:
    """Every combination of the values in each block; a point that comes again comes once.

    That is, with the same data. 300 and 300.0 are one, in whatever order a block names parameters.
    """
    found: dict[str, dict[str, Any]] = {}
    for block in blocks:
        lists = {
            name: value if isinstance(value, list) else [value]
            for name, value in block.items()
            if name in parameters
        }
        rest = {name: value for name, value in block.items() if name not in lists}
        for values in product(*lists.values()):
            point = {**dict(zip(lists, values, strict=True)), **rest}
            same = {name: float(v) if type(v) is int else v for name, v in point.items()}
            found.setdefault(str(sorted(same.items(), key=lambda item: item[0])), point)
    return list(found.values())


def _records(
    opened: Sequence[OperatingRecord], run: Run
) -> tuple[list[OperatingRecord], dict[str, str]]:
    """Records that hold enough periods, and the status of every point by its label."""
    records, statuses = [], {}
    for point in opened:
        statuses[point.label] = point.status
        if point.trajectory is None:
            continue
        try:
            records.append(OperatingRecord.of(point.parameters, point.trajectory))
        except ValueError as error:
            statuses[point.label] = Oscillation.NO_PERIOD
            run.warn(str(error))
    return records, statuses


@dataclass(frozen=True, eq=False)
class Outcome:
    """Operating points, the law of each cycle, and what it says of points that it has not seen.

    statuses: of every point, by its label. members: parameters of the records, by cycle.
    branches: by cycle, those that have a law. labels: what figures call parameters.
    """

    points: Sequence[Mapping[str, float]]
    statuses: Mapping[str, str]
    records: Sequence[OperatingRecord]
    members: Mapping[str, Sequence[Mapping[str, float]]]
    branches: Mapping[str, Branch]
    labels: Mapping[str, str]

    @property
    def parameters(self) -> list[str]:
        return list(self.points[0])

    def models(self) -> dict[str, SparseModel]:
        """By cycle and number of the record: what the law says there."""
        return {
            f"{name}_{number}": model
            for name, branch in self.branches.items()
            for number, model in enumerate(branch.tied.models)
        }

    def tables(self) -> dict[str, pd.DataFrame]:
        return dict(self._tables)

    @cached_property
    def _tables(self) -> dict[str, pd.DataFrame]:
        return {
            "points": points_table(self.points, self.statuses, self.records, self.members),
            "laws": laws_table(self.branches),
            "coefficients": coefficients_table(self.branches),
            "structures": structures_table(self.branches),
            "left_out": left_out_table(self.branches),
            "at_points": map_table(self.branches, "at_points"),
            "map": map_table(self.branches, "map"),
        }

    def figures(self) -> dict[str, Captioned]:
        found = {
            "left_out": Captioned(
                partial(left_out_figure, self._tables["left_out"]), CAPTIONS["left_out"]
            )
        }
        for name, branch in self.branches.items():
            at_points = self._of("coefficients", name)
            draw = partial(
                laws_figure, at_points, branch.law, parameters=self.parameters, labels=self.labels
            )
            found[f"laws_{name}"] = Captioned(draw, CAPTIONS["laws"])
            if branch.map:
                drawn, caption = (cycle_map_figure, "map") if len(self.parameters) == 2 else (
                    cycle_line_figure, "line",
                )  # fmt: skip
                draw = partial(
                    drawn, self._of("map", name), self._tables["points"], branch.law.points,
                    branch=name, parameters=self.parameters, labels=self.labels,
                )  # fmt: skip
                found[f"map_{name}"] = Captioned(draw, CAPTIONS[caption])
        return found

    def _of(self, table: str, branch: str) -> pd.DataFrame:
        rows = self._tables[table]
        return rows[rows["branch"] == branch]

    def sections(self) -> list[Section]:
        return [
            Section("Operating points", self._point_lines()),
            *(self._structures(name) for name, b in self.branches.items() if len(b.trials) > 1),
            *(self._law(name, branch) for name, branch in self.branches.items()),
            Section("Points left out", self._left_out()),
            Section("Where it oscillates", self._map()),
        ]

    def _point_lines(self) -> list[Block]:
        groups: dict[str, list[Mapping[str, float]]] = {}
        for point in self.points:
            groups.setdefault(self.statuses[point_label(point)], []).append(point)
        lines = [
            f"{len(points)} {status}{'' if status == Oscillation.OSCILLATING else self._at(points)}"
            for status, points in groups.items()
        ]
        if len(self.members) > 1:
            counts = [f"{n_points(len(group))} on the {n}" for n, group in self.members.items()]
            few = min(self.members.values(), key=len)
            lines.append(f"two cycles: {' one, '.join(counts)} one{self._at(few)}")
        return [Text(line) for line in lines]

    def _at(self, points: Sequence[Mapping[str, float]]) -> str:
        """` at V_D_V, mdot_mg_s = (150, 3), (175, 2)`."""
        texts = [", ".join(f"{value:g}" for value in point.values()) for point in points]
        if len(self.parameters) > 1:
            texts = [f"({text})" for text in texts]
        return f" at {', '.join(self.parameters)} = {', '.join(texts)}"

    def _cycle(self, name: str) -> str:
        """Of a heading: nothing where there is but one cycle."""
        return "" if len(self.members) == 1 else f" of the {name} cycle"

    def _structures(self, name: str) -> Section:
        rows = self._of("structures", name).sort_values("error", kind="stable")
        bold = np.flatnonzero(rows["chosen"]).tolist()
        shown = rows.drop(columns=["branch", "chosen"]).rename(columns={"f_error": "f error"})
        shown["f error"] = [_percent(value) for value in rows["f_error"]]
        marks = np.where(rows["chosen"], "  <- chosen", "")
        shown["terms"] = [text + mark for text, mark in zip(rows["terms"], marks, strict=True)]
        title = f"Structure and order{self._cycle(name)}"
        return Section(title, [Table(shown, bold=bold, note=TRIED)])

    def _law(self, name: str, branch: Branch) -> Section:
        law, found = branch.law, branch.tied
        middle = _middle(branch.fit.records)
        model = law.model_at(middle.parameters)
        equations: list[Block] = [
            Equation(state, model.terms(state), on_screen=True) for state in model.states
        ]
        rows = self._of("laws", name)
        shown = [
            {
                "coefficient": f"{state}: {term}",
                **{r["function"]: _with_error(r) for r in group.to_dict("records")},
            }
            for (state, term), group in rows.groupby(["state", "term"], sort=False)
        ]
        text = (
            f"{len(law.coefficients)} coefficients of {len(law.functions)} functions each, "
            f"{law.coef.size} numbers, from {len(law.points)} records; {found.status}, loss "
            f"{found.loss.mean():.3g} of a constant's. At {middle.label}:"
        )
        blocks = [Text(text), *equations, Table(pd.DataFrame(shown), note=INTERVALS)]
        return Section(f"Law{self._cycle(name)}", [*blocks, Picture(f"laws_{name}")])

    def _left_out(self) -> list[Block]:
        rows = self._tables["left_out"]
        rows = rows.sort_values(["branch", *self.parameters], kind="stable")
        several = len(self.branches) > 1
        columns: dict[str, list[str]] = {"cycle": rows["branch"].tolist()} if several else {}
        columns |= {name: [f"{value:g}" for value in rows[name]] for name in self.parameters}
        columns["enclosed"] = ["yes" if value else "no" for value in rows["enclosed"]]
        factor, unit = frequency_scale(rows["f_kHz"])
        columns[f"f ({unit})"] = [places(factor * value, 2) for value in rows["f_kHz"]]
        columns["f error"] = [_percent(value, sign=True) for value in rows["f_error"]]
        for state in states_of(rows):
            ratios = rows[f"amplitude_{state}"]
            columns[f"amplitude {state}"] = [_percent(r - 1.0, sign=True) for r in ratios]
        for state in states_of(rows):
            columns[f"waveform {state}"] = [places(v, 3) for v in rows[f"waveform_{state}"]]
        columns["verdict"] = rows["verdict"].tolist()
        if several:
            columns["also"] = rows["also"].tolist()
        lines: list[Block] = [Text(self._spread(name)) for name in self.branches]
        table = Table(pd.DataFrame(columns), note=LEFT_OUT + (ALSO if several else ""))
        return [*lines, table, Picture("left_out")]

    def _spread(self, name: str) -> str:
        found = self._numbers(name)
        smooth_f, smooth_amplitude = self.branches[name].smooth
        lead = f"{name} cycle: " if len(self.members) > 1 else ""
        most = f"nine in ten within {_percent(found['f_90'])}"
        if not np.isfinite(found["f_90"]):
            most = "more than one in ten do not oscillate"
        return (
            f"{lead}{found['n_lives']} of {found['n']} live, diverging: {found['diverging']}. "
            f"Errors in the median: frequency {_percent(found['f_median'])} ({most}), the worst "
            "state's amplitude "
            f"{_percent(found['amplitude_median'])} and waveform "
            f"{places(found['waveform_median'], 3)}. The records' own frequencies and amplitudes, "
            f"interpolated by the same functions, miss by {_percent(float(np.median(smooth_f)))} "
            f"and {_percent(float(np.median(smooth_amplitude)))} in the median."
        )

    def _numbers(self, name: str) -> dict[str, float | int]:
        found = self.branches[name].left_out
        f = np.array([abs(each.run.f_error) for each in found])
        f[np.isnan(f)] = np.inf
        ratios = [np.array(list(each.run.amplitude_ratio.values())) for each in found]
        amplitude = np.array([np.abs(each - 1.0).max() for each in ratios])
        waveform = np.array([max(each.run.waveform_error.values()) for each in found])
        return {
            "n": len(found),
            "n_lives": sum(each.run.verdict is Verdict.LIVES for each in found),
            "diverging": sum(each.run.rollout.diverged for each in found),
            "f_median": float(np.median(f)),
            "f_90": float(np.quantile(f, 0.9, method="higher")),
            "amplitude_median": _median(amplitude),
            "waveform_median": _median(waveform),
        }

    def _map(self) -> list[Block]:
        right, n, quiet_right, quiet = agreement(self.branches, self.statuses)
        text = f"Oscillating or not, the laws are right at {right} of {n} points"
        if quiet:
            text += (
                f"; at {quiet_right} of the {quiet} that do not oscillate, which no fit has seen"
            )
        pictures = [Picture(f"map_{name}") for name in self.branches]
        drawn = [p for p in pictures if p.name in self.figures()]
        return [Text(f"{text}."), *drawn]

    def summary(self) -> dict[str, Any]:
        right, n, quiet_right, quiet = agreement(self.branches, self.statuses)
        return {
            "points": self._tables["points"].to_dict("records"),
            "branches": {
                name: {
                    "structure": {s: list(t) for s, t in branch.fit.structure.items()},
                    "degree": branch.choice.degree,
                    "status": branch.tied.status,
                    "loss": float(branch.tied.loss.mean()),
                    "left_out": self._numbers(name),
                }
                for name, branch in self.branches.items()
            },
            "oscillating_or_not": {"right": right, "points": n, "quiet": quiet_right, "of": quiet},
        }

    def headline(self) -> dict[str, float]:
        right, n, _, _ = agreement(self.branches, self.statuses)
        numbers = self._numbers(next(iter(self.branches)))
        first = {key: float(value) for key, value in numbers.items()}
        return {"n_points": float(len(self.points)), **first, "map_right": right / n}


def n_points(n: int) -> str:
    """`1 point`, `3 points`."""
    return f"{n} point" if n == 1 else f"{n} points"


def _middle(records: Sequence[OperatingRecord]) -> OperatingRecord:
    """The one nearest to the mean of all."""
    values = values_of(records)
    off = (values - values.mean(axis=0)) / zero_to_one(np.ptp(values, axis=0))
    return records[int(np.argmin(np.linalg.norm(off, axis=1)))]


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else float("nan")


def _percent(value: float, *, sign: bool = False) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{100.0 * value:{'+' if sign else ''}.2f} %"


def _with_error(row: Mapping[Any, Any]) -> str:
    reach = 0.5 * (row["high"] - row["low"])
    return f"{row['value']:.3g}" + ("" if np.isnan(reach) else f" ±{reach:.1g}")


def points_table(
    points: Sequence[Parameters],
    statuses: Mapping[str, str],
    records: Sequence[OperatingRecord],
    members: Mapping[str, Sequence[Parameters]],
) -> pd.DataFrame:
    """One row per operating point: what its record is, and on which cycle."""
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
    """One row per number of a law, with its 95 % interval."""
    rows = []
    for name, branch in branches.items():
        law = branch.law
        reach = np.full(law.coef.shape, np.nan)
        if law.covariance is not None:
            std = np.sqrt(np.maximum(np.diag(law.covariance), 0.0)).reshape(law.coef.shape)
            reach = ndtri(0.975) * std
        for (state, term), row, half in zip(law.coefficients, law.coef, reach, strict=True):
            for function, value, r in zip(law.functions.names, row, half, strict=True):
                rows.append((name, state, term, function, value, value - r, value + r))
    columns = ["branch", "state", "term", "function", "value", "low", "high"]
    return pd.DataFrame(rows, columns=columns)


def coefficients_table(branches: Mapping[str, Branch]) -> pd.DataFrame:
    """Coefficients at every point: refined alone, and by the law, each with 95 % intervals."""
    rows = []
    for name, branch in branches.items():
        pairs = zip(branch.fit.records, branch.fit.fits, branch.tied.models, strict=True)
        for record, alone, tied in pairs:
            for state in tied.states:
                for term, value in tied.terms(state).items():
                    row = {**record.parameters, "branch": name, "state": state, "term": term}
                    row |= {"alone": alone.model.terms(state)[term], "law": value}
                    for kind, model in (("alone", alone.model), ("law", tied)):
                        if model.covariance is not None:
                            low, high = model.intervals(state)[term]
                            row |= {f"{kind}_low": low, f"{kind}_high": high}
                    rows.append(row)
    return pd.DataFrame(rows)


def left_out_table(branches: Mapping[str, Branch]) -> pd.DataFrame:
    """One row per point: what the law of the others makes of it, and which cycles are there."""
    rows: list[dict[str, Any]] = []
    for name, branch in branches.items():
        for each in branch.left_out:
            rows.append({"branch": name, **_left_out_row(each, branches, name)})
    return pd.DataFrame(rows)


def _left_out_row(each: LeaveOneOut, branches: Mapping[str, Branch], own: str) -> dict[str, Any]:
    run, record = each.run, each.record
    f_kHz = 1e-3 * record.cycle.frequency_Hz
    label = record.label
    also = [
        name
        for name, branch in branches.items()
        for point in branch.at_points
        if name != own
        and point_label(point.parameters) == label
        and point.inside
        and point.fate is Fate.OSCILLATES
    ]
    return {
        **record.parameters,
        "enclosed": each.inside,
        "f_kHz": f_kHz,
        "f_model_kHz": f_kHz * (1.0 + run.f_error),
        "f_error": run.f_error,
        **{f"amplitude_{state}": ratio for state, ratio in run.amplitude_ratio.items()},
        **{f"waveform_{state}": error for state, error in run.waveform_error.items()},
        "verdict": str(run.verdict),
        "also": ", ".join(also),
    }


def states_of(left_out: pd.DataFrame) -> list[str]:
    """States of a table of points left out."""
    names = [str(name) for name in left_out]
    return [n.removeprefix("amplitude_") for n in names if n.startswith("amplitude_")]


def structures_table(branches: Mapping[str, Branch]) -> pd.DataFrame:
    """One row per structure and degree that was tried, with weighted laws at points left out."""
    rows = []
    for name, branch in branches.items():
        for each in branch.trials:
            rows.append({"branch": name, **_tried_row(each), "chosen": each is branch.choice})
    return pd.DataFrame(rows)


def _tried_row(each: StructureTrial) -> dict[str, Any]:
    f_error = np.array([abs(one.run.f_error) for one in each.found])
    return {
        "terms": "; ".join(f"{s}: {', '.join(t)}" for s, t in each.fit.structure.items()),
        "degree": each.degree,
        "numbers": each.n_numbers,
        "error": float(each.errors.mean()),
        "f_error": float(np.median(np.where(np.isnan(f_error), np.inf, f_error))),
        "diverging": sum(one.run.rollout.diverged for one in each.found),
    }


def map_table(branches: Mapping[str, Branch], which: str) -> pd.DataFrame:
    """The law's models over the map, or at the points of the study (`at_points`)."""
    rows = []
    for name, branch in branches.items():
        points: Sequence[MapPoint] = branch.map if which == "map" else branch.at_points
        for point in points:
            rows.append(
                {
                    "branch": name,
                    **point.parameters,
                    "inside": point.inside,
                    "fate": str(point.fate),
                    "f_kHz": 1e-3 * point.frequency_Hz,
                    "relative_amplitude": point.relative_amplitude,
                    "growth_per_s": point.growth_per_s,
                    "second_multiplier": point.second,
                }
            )
    return pd.DataFrame(rows)


def agreement(
    branches: Mapping[str, Branch], statuses: Mapping[str, str]
) -> tuple[int, int, int, int]:
    """Points where some law says rightly whether it oscillates, of all; quiet ones, of these."""
    says = dict.fromkeys(statuses, False)
    for branch in branches.values():
        for point in branch.at_points:
            label = point_label(point.parameters)
            says[label] = says[label] or point.fate is Fate.OSCILLATES
    quiet = [label for label, status in statuses.items() if status != Oscillation.OSCILLATING]
    right = [says[label] == (statuses[label] == Oscillation.OSCILLATING) for label in statuses]
    return sum(right), len(right), sum(not says[label] for label in quiet), len(quiet)
