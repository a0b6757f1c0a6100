"""Data of a study: the field, its preparation and its trajectory."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import xarray as xr

from ep2sindy.data.fields import clock_of, grid_points
from ep2sindy.data.gaps import describe_breaks, describe_gaps, usual_step
from ep2sindy.data.quantities import STEP_DOUBT, DoubtfulUnit
from ep2sindy.data.sampling import ZoneAverage
from ep2sindy.data.steps import records_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import Zone, describe_zone
from ep2sindy.library.library import Library
from ep2sindy.report.run import Run
from ep2sindy.runtime.screen import in_line
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.simulated import check_recorded, say_simulation
from ep2sindy.studies.study import Deferred
from ep2sindy.studies.told import Zones
from ep2sindy.thruster.balance import zone_balance

Step = Callable[[xr.Dataset], xr.Dataset]


def open_prepared(data: Deferred, prepare: Sequence[Step]) -> xr.Dataset:
    """The single record of the data, after preparation; raises ValueError for several files.

    Raises DivergedError for a simulation that diverged before it could be studied.
    """
    records = _records(data)
    if len(records) > 1:
        raise ValueError(
            f"this experiment takes one record: data.path names {len(records)} files; give "
            "one, or take +exp=discover or +exp=breathing, which take several of one system, or "
            "+exp=parametric or +exp=predict with points.files=PATTERN for operating points"
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


def zones_of(source: Source, field: xr.Dataset, run: Run) -> Zones:
    """The zones that the trajectory is averaged over; none if it is that of a point.

    Balances that cannot be made, as of a zone that reaches into the plume, are reported.
    """
    sampling = source.trajectory
    if not isinstance(sampling, ZoneAverage):
        return Zones()
    return Zones(_balances(sampling, field, run), sampling.sizes(field))


def _balances(sampling: ZoneAverage, field: xr.Dataset, run: Run) -> dict[str, xr.Dataset]:
    if not {"n_i", "n_n"} <= set(field.data_vars):
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
    t, clock = grid_points(field, "time"), clock_of(field)
    words = [
        field.attrs.get("file", ""),
        describe_zone(None, field),
        f"{len(t)} samples of {clock.duration_text(usual_step(t), digits=4)} "
        f"from {clock.duration_text(t[0], digits=4)}",
    ]
    run.say(in_line(f"data: {'; '.join(word for word in words if word)}"))
    say_doubts(run, field)


def say_doubts(run: Run, field: xr.Dataset) -> None:
    """Warn of a step that contradicts the file's own times."""
    if STEP_DOUBT in field.attrs:
        run.warn(field.attrs[STEP_DOUBT])


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
        f"{data.n_samples} samples of {data.clock.duration_text(usual_step(data.t), digits=4)} "
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
