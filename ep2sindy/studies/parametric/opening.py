"""Operating points as a config gives them, and their records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ep2sindy.data.quantities import unit_doubts
from ep2sindy.data.trajectory import ConstantStateError
from ep2sindy.operating.records import PointData, naming, point_label
from ep2sindy.report.run import Run
from ep2sindy.signals.oscillation import STEADY
from ep2sindy.studies.kinds import Deferred
from ep2sindy.studies.simulated import DivergedError, amiss, is_simulation
from ep2sindy.studies.source import Source

WITHOUT_BREATHING = (STEADY, "decaying", "diverged", "transit")  # what a simulation says of itself


@dataclass(frozen=True, eq=False)
class PointSource:
    """One operating point, and where its data come from. It can be sent to another process."""

    parameters: Mapping[str, float]
    source: Source

    @property
    def label(self) -> str:
        return point_label(self.parameters)

    def open(self, inputs: Sequence[str]) -> PointData:
        """Open or simulate it; what does not breathe comes without trajectory.

        A state that stays exactly where it is makes a point steady: no trajectory may hold it.
        """
        with naming(self.parameters):
            try:
                field = self.source.field()
                if (status := field.attrs.get("status")) in WITHOUT_BREATHING:
                    return PointData(self.parameters, None, status)
                sampling = self.source.trajectory
                run = sampling.trajectory(field, inputs=inputs, label=self.label)
                notes = amiss(field.attrs) if is_simulation(field.attrs) else unit_doubts(field)
                words = [field.attrs.get("file", ""), sampling.place(field)]
                used = "; ".join(word for word in words if word)
                return PointData(self.parameters, run, notes=notes, used=used)
            except DivergedError:
                return PointData(self.parameters, None, "diverged")
            except ConstantStateError:
                return PointData(self.parameters, None, STEADY)


def point_sources(
    source: Source, places: Mapping[str, str | None], points: Sequence[Mapping[str, Any]]
) -> list[PointSource]:
    """The source once per operating point, with its parameters and data in the data group.

    places: parameter -> where the data group takes it; None for nowhere.
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


def say_used(run: Run, points: Sequence[PointData]) -> None:
    """Which data: in one line where all points are averaged alike, else one each."""
    used = {point_label(point.parameters): point.used for point in points if point.used}
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
    data = data.changed({}, more)
    try:
        return data.changed({"progress": False})  # points come side by side: bars would mix
    except ValueError:
        return data  # it shows none
