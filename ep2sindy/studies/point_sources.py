"""Operating points of a study: where their data come from, and the records made of these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import xarray as xr

from ep2sindy.data.open import inspect_file
from ep2sindy.data.quantities import STEP_DOUBT
from ep2sindy.data.readers.source import file_named
from ep2sindy.data.run_files import parameters_in, points_of, points_on_axes
from ep2sindy.data.trajectory import ConstantStateError, Trajectory, point_label
from ep2sindy.operating.records import OperatingRecord, Point, name_point
from ep2sindy.report.report import Report
from ep2sindy.runtime.parallel import Workers, collect
from ep2sindy.signals.spectrum import Oscillation, oscillation
from ep2sindy.studies.processes import NO_ZONES, Zones
from ep2sindy.studies.source import DivergedError, Source, amiss, is_simulation, quiet, zones_in
from ep2sindy.studies.study import Check, Deferred

# Statuses of a simulation whose record tells nothing of a law: neither a cycle nor a rest.
USELESS = (Oscillation.TRANSIT, Oscillation.DIVERGED, Oscillation.OUT)

Points = Annotated[
    Sequence[Mapping[str, Any] | str] | str,
    Check(
        "a list like [{V_D_V: [250,300], mdot_mg_s: [4,5]}]; files, by a pattern, "
        "'points.files=runs/V{V_D_V}_m{mdot_mg_s}.csv', or a list; or points.axes=[V] of one file",
        lambda value: isinstance(value, list | str) and len({*map(type, value)}) == 1,
    ),
]
Functions = Annotated[
    int | Sequence[str] | None,
    Check(
        "a degree of one or more, names of functions like ['1',V_D_V], or null for a choice",
        lambda value: isinstance(value, list | None) or (type(value) is int and value > 0),
    ),
]


@dataclass(frozen=True, eq=False)
class GivenPoints:
    """Operating points as they were given.

    sources: of the data of every point. left_out: files that a pattern nearly fits.
    """

    sources: Sequence[PointSource]
    left_out: Sequence[str] = ()

    @property
    def names(self) -> list[str]:
        """Names of the parameters."""
        return list(self.sources[0].parameters)


def given_points(
    points: Sequence[Mapping[str, Any] | str] | str,
    parameters: Mapping[str, str | None],
    source: Source,
) -> GivenPoints:
    """Operating points of a config: a list, files by a pattern or a list, or axes of one file.

    parameters: the place of each in the data group. Those without one, None, are looked up in the
    files, unless the braces of a pattern name them.
    Raises ValueError for files or axes next to data that are not read from files, if no file fits,
    and for a parameter that a file does not state.
    """
    settings = source.data.settings
    blocks = [each for each in points if isinstance(each, Mapping)]
    axes = blocks[0].get("axes", []) if blocks else []
    if blocks and not axes:
        return GivenPoints(point_sources(source, parameters, expand(blocks, list(parameters))))
    if "path" not in settings:
        raise ValueError(
            f"points of files need data that are read from files: got {settings['_target_']} with "
            f"{points!r}; add data=recognised, or data=NAME for a config that ep2sindy inspect "
            "--write made of them"
        )
    if axes:
        found = points_on_axes(settings["path"], axes, settings.get("units") or {})
        given = [{**point, "data": {"at": at}} for at, point in found]
        return GivenPoints(point_sources(source, dict.fromkeys(axes), given))
    files = points if isinstance(points, str) else [each for each in points if type(each) is str]
    asked = [name for name, place in parameters.items() if place is None]
    given, left_out = _of_files(files, asked, settings)
    places = dict.fromkeys(name for name in given[0] if name != "data")
    return GivenPoints(point_sources(source, places, given), left_out)


def _of_files(
    files: Sequence[str] | str, asked: Sequence[str], settings: Mapping[str, Any]
) -> tuple[list[dict[str, Any]], Sequence[str]]:
    """The points of files by their names, and by what is asked of the files; those left out."""
    found, left_out = points_of(files)
    names = list(dict.fromkeys([*next(iter(found.values())), *asked]))
    if not names:
        raise ValueError(
            "files of operating points need parameters: a name in braces for a number in their "
            "names, 'points.files=runs/V{V}.csv', or '+parameters={V: null}' for what the files "
            f"state, got {files!r}"
        )
    given, units = [], settings.get("units") or {}
    for file, named in found.items():
        point: dict[str, Any] = {**named, "data": {"path": file}}
        if missing := [name for name in names if name not in named]:
            with file_named(Path(file)):
                inside = inspect_file(file, plasma=bool(settings.get("plasma")))
                point |= {n: v.item() for n, v in parameters_in(inside, missing, units).items()}
        given.append(point)
    return sorted(given, key=lambda each: [each[name] for name in names]), left_out


@dataclass(frozen=True, eq=False)
class PointSource:
    """One operating point and the source of its data. It can be sent to another process."""

    parameters: Mapping[str, float]
    source: Source

    @property
    def label(self) -> str:
        return point_label(self.parameters)

    def run(self, field: xr.Dataset, inputs: Sequence[str]) -> Trajectory:
        """The run of the point's field, which carries the point."""
        run = self.source.trajectory.trajectory(field, inputs=inputs, label=self.label)
        return replace(run, parameters=self.parameters)

    def open(self, inputs: Sequence[str]) -> OpenedPoint:
        """Open or simulate the point; one whose record tells nothing comes without a run.

        A state that stays exactly constant makes a point steady, as no trajectory may hold it.
        """
        opened = OpenedPoint(self.parameters)
        with name_point(self.parameters):
            try:
                field = self.source.field()
                status = field.attrs.get("status", Oscillation.OSCILLATING)
                if status in USELESS:
                    return replace(opened, given=status)
                run = self.run(field, inputs)
                doubts = [field.attrs[STEP_DOUBT]] if STEP_DOUBT in field.attrs else []
                notes = amiss(field.attrs) if is_simulation(field.attrs) else doubts
                words = [field.attrs.get("file", ""), self.source.trajectory.place(field)]
                used = "; ".join(word for word in words if word)
                zones, _ = zones_in(self.source, field)
                return OpenedPoint(self.parameters, run, status, notes, used, zones)
            except DivergedError:
                return replace(opened, given=Oscillation.DIVERGED)
            except ConstantStateError:
                return replace(opened, given=Oscillation.STEADY)


@dataclass(frozen=True, eq=False)
class OpenedPoint:
    """One operating point, and the run that was recorded there.

    run: None if the record tells nothing of a law. given: what the source says of the record.
    notes: data-quality warnings on problems of the data. used: description of the data. zones: of
    the run, with their recorded balances.
    """

    parameters: Point
    run: Trajectory | None = None
    given: str = Oscillation.OSCILLATING
    notes: Sequence[str] = ()
    used: str = ""
    zones: Zones = NO_ZONES

    @cached_property
    def status(self) -> str:
        """Whether the record oscillates; else what its source says, or the record itself."""
        if self.run is None or self.given != Oscillation.OSCILLATING:
            return self.given
        found = oscillation(self.run.t, self.run.states)
        # A cycle may be small next to a large mean, such as that of an absolute pressure.
        is_cycle = found is Oscillation.STEADY and OperatingRecord(self.run).repeats
        return Oscillation.OSCILLATING if is_cycle else found

    @property
    def label(self) -> str:
        return point_label(self.parameters)


def expand(blocks: Sequence[Mapping[str, Any]], parameters: Sequence[str]) -> list[dict[str, Any]]:
    """Every combination of the values of each block, with what else it holds."""
    found: list[dict[str, Any]] = []
    for block in blocks:
        given = {name: block[name] for name in parameters if name in block}
        lists = [value if isinstance(value, list) else [value] for value in given.values()]
        found += [{**block, **dict(zip(given, at, strict=True))} for at in product(*lists)]
    return found


def point_sources(
    source: Source, places: Mapping[str, str | None], points: Sequence[Mapping[str, Any]]
) -> list[PointSource]:
    """The source once per operating point, with its parameters and data in the data group.

    places: parameter -> its place in the data group; None if it has none. A point that comes again
    with the same data counts once.
    Raises ValueError for points without all parameters, one that comes with other data, or two that
    would open the same data.
    """
    names = list(places)
    if not points:
        raise ValueError(f"points must be a list with all of {names} each: got {points!r}")
    found, seen = [], dict[str, str]()
    for given in points:
        parameters = _parameters(given, names)
        changes = {place: parameters[name] for name, place in places.items() if place is not None}
        data = _changed(source.data, changes, given.get("data", {}))
        point, same = PointSource(parameters, replace(source, data=data)), str(data)
        if seen.get(same) == point.label:
            continue
        if point.label in seen.values():
            raise ValueError(f"an operating point may come once: {point.label} comes again")
        if same in seen:
            raise ValueError(
                f"operating points must differ in their data: {point.label} has that of "
                f"{seen[same]}; say in parameters where the data group takes them, or give each "
                "point its data"
            )
        seen[same] = point.label
        found.append(point)
    return found


def open_points(
    sources: Sequence[PointSource], inputs: Sequence[str], *, workers: Workers, report: Report
) -> list[OpenedPoint]:
    """Open or simulate all points, and report their data and warnings."""
    stage = report.watch.stage(len(sources), "point opened")
    points = collect(workers, partial(PointSource.open, inputs=inputs), sources, stage)
    used = {point.label: point.used for point in points if point.used}
    if len(alike := {*used.values()}) == 1:  # all points are averaged alike
        report.say(f"data: {alike.pop()}")
    else:
        for label, words in used.items():
            report.say(f"data: {label}: {words}")
    for point in points:
        for note in point.notes:
            report.warn(f"{point.label}: {note}")
    return points


def nothing_moves(statuses: Sequence[str]) -> str:
    """Why there is nothing to fit where no point oscillates, and what to try."""
    return (
        f"none of the {len(statuses)} operating points oscillates "
        f"({', '.join(sorted(set(statuses)))}), so there is no fit: try the part of the records "
        "behind the start-up ('prepare=[{_target_:ep2sindy.data.crop,start_s:...}]'), another zone "
        "(trajectory.zone.z=...), or other points"
    )


def _parameters(given: Mapping[str, Any], names: Sequence[str]) -> dict[str, float]:
    are_numbers = all(type(given.get(name)) in (int, float) for name in names)
    if {*given} - {"data"} != {*names} or not are_numbers:
        raise ValueError(
            f"a point must have numbers for {names}, and data where they differ: got {given!r}"
        )
    return {name: float(given[name]) for name in names}


def _changed(data: Deferred, places: Mapping[str, float], more: Mapping[str, Any]) -> Deferred:
    try:
        return quiet(data.changed(places, more))
    except ValueError as error:
        raise ValueError(
            f"parameters must name numbers of the data group, or be null: {error}"
        ) from error
