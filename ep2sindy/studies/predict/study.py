"""One structure and one law for many operating points, and the models between: `+exp=predict`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Annotated, Any

from ep2sindy.library.library import polynomial
from ep2sindy.machine.parallel import Workers
from ep2sindy.operating.choice import Branch, How, Searched, branch_of, grouped
from ep2sindy.operating.fit import Windows
from ep2sindy.operating.records import OperatingRecord, PointData, point_label
from ep2sindy.report.run import Run
from ep2sindy.studies.kinds import Count, Counts, Kind, Positive
from ep2sindy.studies.known_terms import Terms, terms_of
from ep2sindy.studies.parametric.opening import PointSource, point_sources, say_used
from ep2sindy.studies.predict.view import Outcome, n_points
from ep2sindy.studies.simulate_scan import compile_kernels
from ep2sindy.studies.source import Source


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


Points = Annotated[
    Sequence[Mapping[str, Any]],
    Kind(
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
        given = expanded(self.points, list(self.parameters))
        sources = point_sources(self.source, self.parameters, given)
        _check_enough([source.parameters for source in sources], min(self.degrees))

    def compute(self, run: Run) -> Outcome:
        how = self._how(run.seed)
        given = expanded(self.points, list(self.parameters))
        sources = point_sources(self.source, self.parameters, given)
        with run.progress(None, "", "kernels, compiled once"):
            compile_kernels([source.source.data for source in sources])
        opened = self._opened(sources, run)
        records, statuses = _records(opened, run)
        if not records:
            raise ValueError("a law needs operating points that oscillate: none of these does")
        found: dict[str, Branch] = {}
        reasons: dict[str, str] = {}
        everywhere = [source.parameters for source in sources]
        groups = grouped(records)
        for name, members in groups.items():
            cycle = "" if len(groups) == 1 else f" on the {name} cycle"
            run.say(f"fitting a law to {n_points(len(members))}{cycle} ...")
            try:
                found[name] = branch_of(
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

    def _opened(self, sources: Sequence[PointSource], run: Run) -> list[PointData]:
        found = {}
        with run.progress(len(sources), "point") as came:
            opening = self.parallel.run(partial(PointSource.open, inputs=()), sources)
            for number, point in opening:
                found[number] = point
                came(1)
        return [found[number] for number in range(len(sources))]


def expanded(
    blocks: Sequence[Mapping[str, Any]], parameters: Sequence[str]
) -> list[dict[str, Any]]:
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


def _check_enough(points: Sequence[Mapping[str, float]], degree: int) -> None:
    """Raise ValueError for points that bear no law even if all of them oscillate."""
    for name in points[0]:
        values = {point[name] for point in points}
        if len(values) == 1:
            raise ValueError(
                f"points must vary in every parameter: {name} is {values.pop():g} at all "
                f"{len(points)}; give it more values, or leave it out (~parameters.{name})"
            )
    functions = polynomial(list(points[0]), degree=degree)
    if len(points) <= len(functions):
        raise ValueError(
            f"a law of degree {degree} has {len(functions)} functions of {list(points[0])} and "
            f"needs more points than these, since each is left out in turn: {len(points)} came"
        )


def _records(opened: Sequence[PointData], run: Run) -> tuple[list[OperatingRecord], dict[str, str]]:
    """Records that hold enough periods, and the status of every point by its label."""
    records, statuses = [], {}
    say_used(run, opened)
    for point in opened:
        label = point_label(point.parameters)
        for note in point.notes:
            run.warn(f"{label}: {note}")
        statuses[label] = point.status
        if point.trajectory is None:
            continue
        try:
            records.append(OperatingRecord.of(point.parameters, point.trajectory))
        except ValueError as error:
            statuses[label] = "no period"
            run.warn(str(error))
    return records, statuses
