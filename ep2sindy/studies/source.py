"""Data of a study: the field, its preparation, its trajectory; also several operating points."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, Protocol, runtime_checkable

import xarray as xr

from ep2sindy.data.fields import grid_points
from ep2sindy.data.gaps import describe_breaks, describe_gaps
from ep2sindy.data.quantities import DoubtfulUnit, unit_doubts
from ep2sindy.data.sampling import ZoneAverage
from ep2sindy.data.steps import records_of
from ep2sindy.data.trajectory import ConstantStateError, Trajectory
from ep2sindy.data.zones import Zone, describe_zone
from ep2sindy.library.library import Library
from ep2sindy.operating.records import OperatingRecord, naming, point_label
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers, collect
from ep2sindy.runtime.screen import in_line
from ep2sindy.signals.oscillation import Oscillation
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.simulated import (
    DivergedError,
    amiss,
    check_recorded,
    is_simulation,
    quiet,
    say_simulation,
)
from ep2sindy.studies.study import Deferred
from ep2sindy.thruster.balance import zone_balance

Step = Callable[[xr.Dataset], xr.Dataset]
WITHOUT_BREATHING = (  # attributes of a simulation
    Oscillation.STEADY, Oscillation.DECAYING, Oscillation.TRANSIT, Oscillation.DIVERGED,
)  # fmt: skip


def open_prepared(data: Deferred, prepare: Sequence[Step]) -> xr.Dataset:
    """The single record of the data, after preparation; raises ValueError for several files.

    Raises DivergedError for a simulation that diverged before it could be studied.
    """
    records = _records(data)
    if len(records) > 1:
        raise ValueError(
            f"this experiment takes one record: data.path names {len(records)} files; give "
            "one, or take +exp=discover or +exp=breathing, which take several"
        )
    return _prepared(records[0], prepare)


def _records(data: Deferred) -> list[Deferred]:
    """One entry for every record that `data.path` names, or the data themselves."""
    path = data.settings.get("path")
    found = [path] if path is None else records_of(path)
    return [data] if found == [path] else [data.changed({"path": each}) for each in found]


def _prepared(data: Deferred, prepare: Sequence[Step]) -> xr.Dataset:
    """The prepared field, with the attributes of the data. Arithmetic in a step drops them, and
    a diverged run would then pass without a warning.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulUnit)  # the warning comes once, for the data used
        field: xr.Dataset = data.build()
    check_recorded(field)
    said = dict(field.attrs)
    for step in prepare:
        field = step(field)
    return field.assign_attrs(said | field.attrs)


@runtime_checkable
class Sampling(Protocol):
    """How a field becomes a trajectory. states and products are attributes of the method."""

    states: Sequence[str]
    products: Sequence[str]

    def trajectory(self, field: xr.Dataset, *, inputs: Sequence[str], label: str) -> Trajectory: ...

    def columns(self, names: Sequence[str]) -> list[str]:
        """What variables are called in the trajectory: of several zones, each has its own."""
        ...

    def place(self, field: xr.Dataset) -> str:
        """The place on the field's grid, in words; empty for a field without a grid."""
        ...


@dataclass(frozen=True, eq=False)
class Source:
    """A field, the steps that prepare it, and the method that makes a trajectory of it."""

    data: Deferred
    prepare: Sequence[Step]
    trajectory: Sampling

    @property
    def states(self) -> list[str]:
        """The states by the names that they have in the trajectory."""
        return self.trajectory.columns(self.trajectory.states)

    def field(self) -> xr.Dataset:
        """The single record; see `open_prepared`."""
        return open_prepared(self.data, self.prepare)

    def fields(self) -> list[xr.Dataset]:
        """One field for every file that `data.path` names, or the single field of the data."""
        return [_prepared(record, self.prepare) for record in _records(self.data)]

    def inputs(self, libraries: Iterable[Library]) -> list[str]:
        """Variables of the libraries that are neither states nor averages of products."""
        products = [f"<{name.replace(' ', '')}>" for name in self.trajectory.products]
        known = {*self.states, *self.trajectory.columns(products)}
        variables = dict.fromkeys(v for library in libraries for v in library.variables)
        return list(dict.fromkeys(v.partition("@")[0] for v in variables if v not in known))

    def sampled(self, field: xr.Dataset, libraries: Iterable[Library], run: Run) -> Trajectory:
        """The trajectory that the libraries need; also reports the data on screen and page."""
        say_simulation(run, field.attrs)  # first, as it may explain later errors
        data = self.trajectory.trajectory(field, inputs=self.inputs(libraries), label=run.title)
        say_data(run, data, field, self.trajectory.place(field))
        return data


def zone_of(source: Source) -> Zone | None:
    """The zone that the trajectory is averaged over; None for the whole field or a point of it."""
    return source.trajectory.zone if isinstance(source.trajectory, ZoneAverage) else None


def zone_sizes_of(source: Source, field: xr.Dataset) -> dict[str, float]:
    """Length in m of each of several zones that the trajectory is averaged over; else empty."""
    sampling = source.trajectory
    return sampling.sizes(field) if isinstance(sampling, ZoneAverage) else {}


def balances_of(source: Source, field: xr.Dataset, run: Run) -> dict[str, xr.Dataset]:
    """Balance of ions and neutrals in every zone that is averaged over; a single one is called "".

    Balances that cannot be made, as of a zone that reaches into the plume, are reported.
    """
    sampling = source.trajectory
    if not isinstance(sampling, ZoneAverage) or not {"n_i", "n_n"} <= set(field.data_vars):
        return {}
    zones = sampling.parts(field)
    if any(zone.r is not None for zone in zones.values()):
        return {}
    try:
        axisymmetric = sampling.axisymmetric
        return {n: zone_balance(field, z, axisymmetric=axisymmetric) for n, z in zones.items()}
    except ValueError as error:
        run.say(f"the model has no balance of its zone beside it: {error}")
        return {}


def say_field(run: Run, field: xr.Dataset) -> None:
    """Report which data are used, for a study of every grid point."""
    t = grid_points(field, "time")
    words = [
        field.attrs.get("file", ""),
        describe_zone(None, field),
        f"{len(t)} samples of {(t[-1] - t[0]) / (len(t) - 1):.4g} s from {t[0]:.4g} s",
    ]
    run.say(in_line(f"data: {'; '.join(word for word in words if word)}"))
    say_doubts(run, field)


def say_doubts(run: Run, field: xr.Dataset) -> None:
    """Warn of numbers in a file that look like another unit."""
    if "file" in field.attrs:
        for text in unit_doubts(field):
            run.warn(text)


def say_data(run: Run, data: Trajectory, field: xr.Dataset, place: str) -> None:
    """Report the data: file, zone, samples, units, missing values and warnings."""
    units = ", ".join(f"{name} in {unit}" for name, unit in data.units.items())
    where = [field.attrs.get("file", ""), place]
    frequencies = ", ".join(
        f"{name} {data.clock.frequency_text(dominant_frequency(data.t, column))}"
        for name, column in zip(data.state_names, data.states.T, strict=True)
    )
    words = [
        *(text for text in where if text),
        f"{data.n_samples} samples of {data.clock.duration_text(data.dt_s, digits=4)} "
        f"from {data.clock.duration_text(data.t[0], digits=4)}",
        units,
        f"dominant frequency {frequencies}",
    ]
    run.say(in_line(f"data: {'; '.join(words)}"))
    say_doubts(run, field)
    if data.n_samples < field.sizes["time"]:
        run.warn(describe_gaps(data.t, field.sizes["time"]))
    elif text := describe_breaks(data.t):
        run.warn(text)


def data_summary(data: Trajectory) -> dict[str, Any]:
    """The summary of a trajectory."""
    return {
        "n_samples": data.n_samples,
        "dt_s": data.dt_s,
        "time_unit": data.clock.unit,  # for display only; numbers are in seconds
        "f_kHz": 1e-3 * dominant_frequency(data.t, data.states[:, 0]),
        "variables": list(data.names),
        "units": dict(data.units),
    }


@dataclass(frozen=True, eq=False)
class PointSource:
    """One operating point and the source of its data. It can be sent to another process."""

    parameters: Mapping[str, float]
    source: Source

    @property
    def label(self) -> str:
        return point_label(self.parameters)

    def open(self, inputs: Sequence[str]) -> OperatingRecord:
        """Open or simulate the point; a point that does not breathe comes without a trajectory.

        A state that stays exactly constant makes a point steady, as no trajectory may hold it.
        """
        with naming(self.parameters):
            try:
                field = self.source.field()
                if (status := field.attrs.get("status")) in WITHOUT_BREATHING:
                    return OperatingRecord(self.parameters, None, status)
                sampling = self.source.trajectory
                run = sampling.trajectory(field, inputs=inputs, label=self.label)
                notes = amiss(field.attrs) if is_simulation(field.attrs) else unit_doubts(field)
                words = [field.attrs.get("file", ""), sampling.place(field)]
                used = "; ".join(word for word in words if word)
                return OperatingRecord(self.parameters, run, notes=notes, used=used)
            except DivergedError:
                return OperatingRecord(self.parameters, None, Oscillation.DIVERGED)
            except ConstantStateError:
                return OperatingRecord(self.parameters, None, Oscillation.STEADY)


def expand(blocks: Sequence[Mapping[str, Any]], parameters: Sequence[str]) -> list[dict[str, Any]]:
    """Every combination of the values in each block; repeated points count once.

    Points are repeated if they have the same values and the same data. 300 and 300.0 are equal, and
    the order of parameters in a block does not matter.
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


def point_sources(
    source: Source, places: Mapping[str, str | None], points: Sequence[Mapping[str, Any]]
) -> list[PointSource]:
    """The source once per operating point, with its parameters and data in the data group.

    places: parameter -> its place in the data group; None if it has none.
    Raises ValueError for points without all parameters, or that would open the same data twice.
    """
    names = list(places)
    if not points:
        raise ValueError(f"points must be a list with all of {names} each: {points!r} came")
    found, seen = [], dict[str, str]()
    for given in points:
        parameters = _parameters(given, names)
        changes = {place: parameters[name] for name, place in places.items() if place is not None}
        data = _changed(source.data, changes, given.get("data", {}))
        point = PointSource(parameters, replace(source, data=data))
        if point.label in seen.values():
            raise ValueError(f"an operating point may come once: {point.label} comes again")
        if (same := str(data)) in seen:
            raise ValueError(
                f"operating points must differ in their data: {point.label} has that of "
                f"{seen[same]}; say in parameters where the data group takes them, or give each "
                "point its data"
            )
        seen[same] = point.label
        found.append(point)
    return found


def open_points(
    sources: Sequence[PointSource], inputs: Sequence[str], *, workers: Workers, run: Run
) -> list[OperatingRecord]:
    """Open or simulate all points, and report their data and warnings."""
    stage = run.progress(len(sources), "point opened")
    points = collect(workers, partial(PointSource.open, inputs=inputs), sources, stage)
    _say_used(run, points)
    for point in points:
        for note in point.notes:
            run.warn(f"{point.label}: {note}")
    return points


def _say_used(run: Run, points: Sequence[OperatingRecord]) -> None:
    """Report which data are used: one line if all points are averaged alike, else one line each."""
    used = {point.label: point.used for point in points if point.used}
    if len({*used.values()}) == 1:
        run.say(f"data: {next(iter(used.values()))}")
        return
    for label, words in used.items():
        run.say(f"data: {label}: {words}")


def _parameters(given: Mapping[str, Any], names: Sequence[str]) -> dict[str, float]:
    if set(given) - {"data"} != set(names) or not isinstance(given.get("data", {}), Mapping):
        raise ValueError(f"a point must have {names}, and data where they differ: {given!r} came")
    for name in names:
        if type(given[name]) not in (int, float):
            raise ValueError(f"points must give {name} as a number: {given[name]!r} came")
    return {name: float(given[name]) for name in names}


def _changed(data: Deferred, places: Mapping[str, float], more: Mapping[str, Any]) -> Deferred:
    try:
        data = data.changed(places)
    except ValueError as error:
        raise ValueError(
            f"parameters must name numbers of the data group, or be null: {error}"
        ) from error
    return quiet(data.changed({}, more))
