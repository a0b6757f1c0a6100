"""One structure and one law for many operating points, and predictions between: `+exp=predict`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.figures.operating import cycle_figure, laws_figure, left_out_figure
from ep2sindy.forecasting.skill import ForecastSkill
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.branch import Branch, BranchSettings, find_branch, group_by_cycle
from ep2sindy.operating.fit import SETTINGS, error_statistics
from ep2sindy.operating.law import make_basis
from ep2sindy.operating.map import Fate
from ep2sindy.operating.records import OperatingRecord, most_central, point_label
from ep2sindy.report.document import Block, Captioned, Picture, Result, Section, Table, Text
from ep2sindy.report.results import ResultTable
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers
from ep2sindy.signals.spectrum import Oscillation
from ep2sindy.studies.forecasts import TypicalSkill
from ep2sindy.studies.law_tables import (
    LawModel,
    LeftOutPoint,
    advice_if_none_lives,
    agreement,
    coefficients_table,
    known_beside_files,
    laws_table,
    left_out_metrics,
    left_out_text,
    map_table,
    n_points,
    number_text,
    points_table,
    skills_left_out,
    structure_metrics,
    structures_table,
)
from ep2sindy.studies.points import (
    QUIET,
    GivenPoints,
    Points,
    PointSource,
    expand,
    given_points,
    open_points,
    oscillating_records,
)
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.source import Source, compile_kernels
from ep2sindy.studies.study import Count, Counts, Positive, Starts
from ep2sindy.studies.views import display_equation

INTERVALS = (
    "In SI units, and the parameters in theirs. ±: half the 95 % interval, from a sandwich with "
    "the windows of all points as clusters: how far other windows of the same records would move a "
    "number, not how far a law of this form is from the truth; for that see the points left out."
)
LEFT_OUT = (
    "Each point in turn read off the law of the others, refined over all of them, and run freely "
    "from one sample of its record, where the states move least. Errors are those against the "
    "record's cycle; a model lives within 1 % of frequency, 10 % of amplitude and 0.2 standard "
    "deviations of waveform; enclosed: whether the others enclose it; forecast, AR: half a period."
)
ALSO = " also: other cycles whose law oscillates there, inside its points."
TRIED = (
    "error: mean over the points left out of the largest deviation from the cycle, in units of its "
    "bound (1 % of frequency, 10 % of amplitude, 0.2 of waveform), 10 at most; f error: median; "
    "numbers: of the law; laws through separate refinements. Chosen: the fewest numbers within a "
    "standard error of the least."
)
CAPTIONS = {
    "laws": "Coefficients over the operating parameters, with 95 % intervals: by the law that all "
    "points share (lines, filled at its points) and refined at each point alone (open), at up to "
    "five values of the other parameters. The law is fitted to the records, not to the open "
    "points: where these leave the lines by more than their bars, other coefficients make up for "
    "it, as points are sloppy in some directions.",
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


@dataclass(frozen=True)
class Followed:
    """Windows of every record: number, and length in periods of the median frequency."""

    n_windows: Count
    periods: Positive


@dataclass(frozen=True)
class SearchSettings:
    """Search without given models: all products of the states to a degree, and how many terms."""

    degree: Count
    max_terms: Count


@dataclass(frozen=True, eq=False)
class Study:
    """Fit one law to all operating points that oscillate, and test it at points left out.

    parameters: the place of each parameter in the data group; None if it has none. points: blocks,
    each with one value or a list of values for all parameters, and `data` for other differences
    from the data group; or the pattern of files, which names the parameters.
    models: of which one is selected, by name; None searches for terms.
    degrees: candidate degrees of the polynomials, of which one is selected. map_points: number of
    points along each parameter. labels: names of the parameters in figures.
    forecasts: number of starts over the second half of every record left out; 0 for none. keep:
    whether a run goes on with the finished pieces of one that was broken off.
    """

    source: Source
    parallel: Workers
    parameters: Mapping[str, str | None]
    points: Points
    models: Mapping[str, LawModel] | None
    structures: SearchSettings
    degrees: Counts
    windows: Followed
    map_points: Count
    labels: Mapping[str, str]
    forecasts: Starts = 0
    keep: bool = True

    def __post_init__(self) -> None:
        self._how(0)
        given = self._given
        sources, names = given.sources(self.source), given.names
        # Points too few for a law, even if all oscillate, are refused before any simulation.
        make_basis(
            polynomial(names, degree=min(self.degrees)),
            np.array([[source.parameters[name] for name in names] for source in sources]),
            n_spare=1,
            remedy="give it more values, or leave it out (~parameters.{name})",
        )

    def compute(self, run: Run) -> Outcome:
        how = self._how(run.seed)
        given = self._given
        given.tell(run)
        if "path" in self.source.data.settings and (words := known_beside_files(self.models or {})):
            run.say(words)
        sources = given.sources(self.source)
        with run.progress(None, "", "kernels, compiled once"):
            compile_kernels([source.source.data for source in sources])
        with resumed(self.keep, run, self.parallel) as workers:
            return self._found(sources, how, workers, run)

    def _found(
        self, sources: Sequence[PointSource], how: BranchSettings, workers: Workers, run: Run
    ) -> Outcome:
        opened = open_points(sources, (), workers=workers, run=run)
        records, statuses = oscillating_records(opened, run)
        if not records:
            raise ValueError(
                "a law needs operating points that oscillate: none of these does; " + QUIET
            )
        found: dict[str, Branch] = {}
        reasons: dict[str, str] = {}
        everywhere = [source.parameters for source in sources]
        groups = group_by_cycle(records)
        for name, members in groups.items():
            cycle = "" if len(groups) == 1 else f" on the {name} cycle"
            run.say(f"fitting a law to {n_points(len(members))}{cycle} ...")
            try:
                found[name] = find_branch(
                    name, members, everywhere, how, workers, progress=run.watch
                )
            except ValueError as error:
                reasons[name] = str(error)
                if len(groups) > 1:
                    run.warn(f"two cycles coexist, and the {name} one gets no law: {error}")
        if not found:
            raise ValueError(f"no law: {'; '.join(reasons.values())}")
        for name, branch in found.items():
            run.write(f"law_{name}.json", branch.law.save)
            if advice := advice_if_none_lives(branch, self.degrees, searched=self.models is None):
                run.warn(advice)
        members_of = {name: [r.parameters for r in group] for name, group in groups.items()}
        skills = {
            name: skills_left_out(branch.left_out, starts=self.forecasts, progress=run.watch)
            for name, branch in found.items()
        }
        return Outcome(everywhere, statuses, records, members_of, found, skills, self.labels)

    @cached_property
    def _given(self) -> GivenPoints:
        given = given_points(self.points, self.parameters, self.source)
        return replace(given, points=expand(given.points, given.names))

    def _how(self, seed: int) -> BranchSettings:
        states, parameters = self.source.states, self._given.names
        models = self.models or {}
        settings = replace(SETTINGS, n_windows=self.windows.n_windows, periods=self.windows.periods)
        return BranchSettings(
            library=polynomial(states, degree=self.structures.degree),
            cases=[model.case(name, states, parameters) for name, model in models.items()],
            max_terms=self.structures.max_terms,
            degrees=self.degrees,
            settings=settings,
            n_map=self.map_points,
            seed=seed,
        )


@dataclass(frozen=True, eq=False)
class Outcome:
    """Operating points, the law of each cycle, and its predictions at points left out.

    statuses: of every point, by its label. members: parameters of the records, by cycle. branches:
    by cycle, for the cycles that have a law. skills: of forecasts at the points left out, by cycle.
    labels: names of the parameters in figures.
    """

    points: Sequence[Mapping[str, float]]
    statuses: Mapping[str, str]
    records: Sequence[OperatingRecord]
    members: Mapping[str, Sequence[Mapping[str, float]]]
    branches: Mapping[str, Branch]
    skills: Mapping[str, Sequence[ForecastSkill | None]]
    labels: Mapping[str, str]

    @property
    def parameters(self) -> list[str]:
        return list(self.points[0])

    def models(self) -> dict[str, SparseModel]:
        """The law's models at the records, named by cycle and number of the record."""
        return {
            f"{name}_{number}": model
            for name, branch in self.branches.items()
            for number, model in enumerate(branch.refinement.models)
        }

    def tables(self) -> dict[str, pd.DataFrame]:
        return dict(self._tables)

    @cached_property
    def _points_left_out(self) -> list[LeftOutPoint]:
        return [
            LeftOutPoint(
                name, result, ", ".join(self._also_there(result.record.label, name)), skill
            )
            for name, branch in self.branches.items()
            for result, skill in zip(branch.left_out, self.skills[name], strict=True)
        ]

    def _also_there(self, label: str, own: str) -> list[str]:
        """Other cycles whose law oscillates at a point within the range of that law's points."""
        return [
            name
            for name, branch in self.branches.items()
            for point in branch.at_points
            if name != own
            and point_label(point.parameters) == label
            and point.inside
            and point.fate is Fate.OSCILLATES
        ]

    @cached_property
    def _tables(self) -> dict[str, pd.DataFrame]:
        left_out = self._points_left_out
        return {
            "points": points_table(self.points, self.statuses, self.records, self.members),
            "laws": laws_table(self.branches),
            "coefficients": coefficients_table(self.branches),
            "structures": structures_table(self.branches),
            "left_out": ResultTable(left_out, left_out_metrics(left_out)).csv(),
            "at_points": map_table(self.branches, "at_points"),
            "map": map_table(self.branches, "map"),
        }

    def figures(self) -> dict[str, Captioned]:
        """Those that show something: none of runs or maps without an oscillation."""
        found: dict[str, Captioned] = {}
        left_out = self._tables["left_out"]
        if left_out["f_model_kHz"].notna().any():
            found["left_out"] = Captioned(partial(left_out_figure, left_out), CAPTIONS["left_out"])
        for name, branch in self.branches.items():
            at_points = self._of("coefficients", name)
            draw = partial(
                laws_figure, at_points, branch.law, parameters=self.parameters, labels=self.labels
            )
            found[f"laws_{name}"] = Captioned(draw, CAPTIONS["laws"])
            if any(point.fate is Fate.OSCILLATES for point in branch.map):
                caption = CAPTIONS["map" if len(self.parameters) == 2 else "line"]
                draw = partial(
                    cycle_figure, self._of("map", name), self._tables["points"], branch=name,
                    parameters=self.parameters, labels=self.labels,
                )  # fmt: skip
                found[f"map_{name}"] = Captioned(draw, caption)
        return found

    def _of(self, table: str, branch: str) -> pd.DataFrame:
        rows = self._tables[table]
        return rows[rows["branch"] == branch]

    def in_short(self) -> Result:
        """The law, how it does at points left out, and where it says that models oscillate."""
        right, n, _, _ = agreement(self.branches, self.statuses)
        name, branch = next(iter(self.branches.items()))
        middle, numbers = most_central(branch.fit.records), error_statistics(branch.left_out)
        model, drawn = branch.law.model_at(middle.parameters), self.figures()
        return Result(
            f"Found: a law over {', '.join(self.parameters)}; "
            f"left out one at a time, {numbers['n_lives']} of {numbers['n']} points live",
            [
                *(display_equation(model, s, lead=f"at {middle.label}") for s in model.states),
                Text(left_out_text(branch).partition(". The records")[0]),
                Text(f"Oscillating or not, right at {right} of {n} points"),
            ],
            load=f'ep.operating.OperatingLaw.load("{{}}/law_{name}.json")',
            picture=next(p for p in (f"map_{name}", "left_out", f"laws_{name}") if p in drawn),
        )

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
        """The cycle's name for a heading; empty if there is only one cycle."""
        return "" if len(self.members) == 1 else f" of the {name} cycle"

    def _structures(self, name: str) -> Section:
        branch = self.branches[name]
        trials = sorted(branch.trials, key=lambda trial: float(trial.errors.mean()))
        shown = ResultTable(trials, structure_metrics(name, branch)).screen()
        bold = [k for k, trial in enumerate(trials) if trial is branch.choice]
        title = f"Structure and order{self._cycle(name)}"
        return Section(title, [Table(shown, bold=bold, note=TRIED)])

    def _law(self, name: str, branch: Branch) -> Section:
        law, found = branch.law, branch.refinement
        middle = most_central(branch.fit.records)
        model = law.model_at(middle.parameters)
        equations: list[Block] = [display_equation(model, state) for state in model.states]
        rows = self._of("laws", name)
        shown = [
            {
                "coefficient": f"{state}: {term}",
                **{
                    r["function"]: number_text(r["value"], 0.5 * (r["high"] - r["low"]))
                    for r in group.to_dict("records")
                },
            }
            for (state, term), group in rows.groupby(["state", "term"], sort=False)
        ]
        text = (
            f"{len(law.coefficients)} coefficients of {len(law.functions)} functions each, "
            f"{branch.choice.n_numbers} numbers, from {len(law.points)} records; {found.status}, "
            f"loss {found.loss.mean():.3g} of a constant's. At {middle.label}:"
        )
        exact = [Text(f"exact at every point: {each}") for each in branch.fit.relations.texts]
        blocks = [*exact, Text(text), *equations, Table(pd.DataFrame(shown), note=INTERVALS)]
        return Section(f"Law{self._cycle(name)}", [*blocks, Picture(f"laws_{name}")])

    def _left_out(self) -> list[Block]:
        points = self._points_left_out
        shown = sorted(points, key=lambda point: (point.branch, *point.record.parameters.values()))
        lines: list[Block] = [
            Text(f"{self._lead(name)}{left_out_text(branch)}")
            for name, branch in self.branches.items()
        ]
        for name, skills in self.skills.items():
            if typical := TypicalSkill.of(skills):
                lines.append(Text(f"{self._lead(name)}{typical.text}."))
        note = LEFT_OUT + (ALSO if len(self.branches) > 1 else "")
        table = Table(ResultTable(shown, left_out_metrics(points)).screen(), note=note)
        return [*lines, table, Picture("left_out")]

    def _lead(self, name: str) -> str:
        return f"{name} cycle: " if len(self.members) > 1 else ""

    def _map(self) -> list[Block]:
        right, n, quiet_right, quiet = agreement(self.branches, self.statuses)
        text = f"Oscillating or not, the laws are right at {right} of {n} points"
        if quiet:
            text += (
                f"; at {quiet_right} of the {quiet} that do not oscillate, which no fit has seen"
            )
        still = [
            Text(f"{self._lead(name)}nowhere on the map does the law's model oscillate")
            for name, branch in self.branches.items()
            if branch.map and f"map_{name}" not in self.figures()
        ]
        return [Text(f"{text}."), *still, *(Picture(f"map_{name}") for name in self.branches)]

    def summary(self) -> dict[str, Any]:
        right, n, quiet_right, quiet = agreement(self.branches, self.statuses)
        return {
            "points": self._tables["points"].to_dict("records"),
            "branches": {
                name: {
                    "model": branch.choice.case.name,
                    "structure": {s: list(t) for s, t in branch.fit.structure.items()},
                    "exact": list(branch.fit.relations.texts),
                    "degree": branch.choice.degree,
                    "status": branch.refinement.status,
                    "loss": float(branch.refinement.loss.mean()),
                    "left_out": error_statistics(branch.left_out),
                    "forecast": (each := TypicalSkill.of(self.skills[name])) and asdict(each),
                }
                for name, branch in self.branches.items()
            },
            "oscillating_or_not": {"right": right, "points": n, "quiet": quiet_right, "of": quiet},
        }

    def headline(self) -> dict[str, float]:
        right, n, _, _ = agreement(self.branches, self.statuses)
        numbers = error_statistics(next(iter(self.branches.values())).left_out)
        first = {key: float(value) for key, value in numbers.items()}
        return {"n_points": float(len(self.points)), **first, "map_right": right / n}
