"""Data of a study: field, preparation and trajectory; what simulations and their zones tell."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.data.fields import clock_of, grid_points
from ep2sindy.data.gaps import describe_breaks, describe_gaps, usual_step
from ep2sindy.data.open import open_field
from ep2sindy.data.quantities import STEP_DOUBT, DoubtfulUnit, to_si
from ep2sindy.data.steps import records_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import Zone, ZoneAverage, describe_zone
from ep2sindy.library.library import Library
from ep2sindy.library.units import Clock
from ep2sindy.report.report import Report
from ep2sindy.runtime.screen import in_line
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.processes import IONS, NEUTRALS, Zones
from ep2sindy.studies.study import Deferred
from ep2sindy.thruster.balance import zone_balance

Step = Callable[[xr.Dataset], xr.Dataset]
# Columns by name, each as times in s and samples.
Beside = dict[str, tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]]


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
    attrs = dict(field.attrs)
    for step in prepare:
        field = step(field)
    return field.assign_attrs(attrs | field.attrs)


@dataclass(frozen=True, eq=False)
class Source:
    """A field, the steps that prepare it, and the zones that make a trajectory of it."""

    data: Deferred
    prepare: Sequence[Step]
    trajectory: ZoneAverage

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

    def opened(self, libraries: Iterable[Library], report: Report) -> tuple[xr.Dataset, Trajectory]:
        """The single record, and its trajectory as `sampled` makes it."""
        with report.watch.stage(None, "", "data"):
            field = self.field()
        return field, self.sampled(field, libraries, report)

    def sampled(
        self, field: xr.Dataset, libraries: Iterable[Library], report: Report
    ) -> Trajectory:
        """The trajectory that the libraries need, which is reported on screen, page and summary."""
        report_simulation(report, field.attrs)  # first, as it may explain later errors
        data = self.trajectory.trajectory(field, inputs=self.inputs(libraries), label=report.title)
        report_data(report, data, field, self.trajectory.place(field))
        report.summary.setdefault("data", data_summary(data))
        return data


def zone_of(source: Source) -> Zone | None:
    """The zone that the trajectory is averaged over; None for the whole field."""
    return source.trajectory.zone


def zones_of(source: Source, field: xr.Dataset, report: Report) -> Zones:
    """The zones that the trajectory is averaged over.

    Balances that cannot be made, as of a zone that reaches into the plume, are reported.
    """
    zones, reason = zones_in(source, field)
    if reason:
        report.say(f"the model has no balance of its zone next to it: {reason}")
    return zones


def zones_in(source: Source, field: xr.Dataset) -> tuple[Zones, str]:
    """The zones that the trajectory is averaged over, and why their balances cannot be made."""
    sampling = source.trajectory
    zones = sampling.parts(field) if {IONS, NEUTRALS} <= set(field.data_vars) else {}
    if any(zone.r is not None or isinstance(zone.z, float) for zone in zones.values()):
        zones = {}
    balance, reason = partial(zone_balance, field, axisymmetric=sampling.axisymmetric), ""
    try:
        balances = {name: balance(zone) for name, zone in zones.items()}
    except ValueError as error:
        balances, reason = {}, str(error)
    return Zones(balances, sampling.sizes(field)), reason


def report_field(report: Report, field: xr.Dataset) -> None:
    """Report which data are used, for a study of every grid point."""
    t, clock = grid_points(field, "time"), clock_of(field)
    _report_samples(report, field, describe_zone(None, field), t, clock)


def report_data(report: Report, data: Trajectory, field: xr.Dataset, place: str) -> None:
    """Report the data: file, zone, samples, units, missing values and warnings."""
    units = ", ".join(f"{name} in {unit}" for name, unit in data.units.items())
    frequencies = ", ".join(
        f"{name} {data.clock.frequency_text(dominant_frequency(data.t, column))}"
        for name, column in zip(data.state_names, data.states.T, strict=True)
    )
    more = [units, f"dominant frequency {frequencies}"]
    _report_samples(report, field, place, data.t, data.clock, *more)
    if data.n_samples < field.sizes["time"]:
        report.warn(describe_gaps(data.t, field.sizes["time"], data.clock))
    elif text := describe_breaks(data.t, data.clock):
        report.warn(text)


def _report_samples(
    report: Report,
    field: xr.Dataset,
    place: str,
    t: Float[np.ndarray, " samples"],
    clock: Clock,
    *more: str,
) -> None:
    """Report file, place and samples; warn of a step that contradicts the file's own times."""
    report.clock = clock
    step, start = (clock.duration_text(time, digits=4) for time in (usual_step(t), t[0]))
    samples = f"{len(t)} samples of {step} from {start}"
    words = [field.attrs.get("file", ""), place, samples, *more]
    report.say(in_line(f"data: {'; '.join(word for word in words if word)}"))
    if STEP_DOUBT in field.attrs:
        report.warn(field.attrs[STEP_DOUBT])


def data_summary(data: Trajectory) -> dict[str, Any]:
    """The summary of a trajectory."""
    key, factor = data.clock.key("f_kHz")
    return {
        "n_samples": data.n_samples,
        "dt_s": data.dt_s,
        "time_unit": data.clock.unit,  # of the screen; numbers are in seconds, or in steps
        key: factor * 1e-3 * dominant_frequency(data.t, data.states[:, 0]),
        "variables": list(data.names),
        "units": dict(data.units),
    }


def only(
    data: Deferred,
    signal: str,
    unit: str | None,
    *,
    inputs: Sequence[str] = (),
    without: Sequence[str] = (),
) -> Deferred:
    """Data read from a file with this variable and inputs alone, whatever else a config expects.

    without: axes that are not required. Data that are not read from a file are unchanged.
    """
    variables: Mapping[str, Any] | None = data.settings.get("variables")
    if variables is None:
        return data
    places: dict[str, Any] = {
        f"variables.{name}.name": None for name in variables if name not in (signal, *inputs)
    }
    places |= {f"{axis}.name": None for axis in without if data.settings.get(axis)}
    if unit is not None and signal in variables:
        places[f"variables.{signal}.unit"] = unit
    units = {signal: unit or "1", **dict.fromkeys(inputs, "1")}
    new = {n: {"name": n, "unit": u, "dims": None} for n, u in units.items() if n not in variables}
    return data.changed(places, {"variables": new} if new else None)


def columns_beside(data: Deferred, field: xr.Dataset, names: Sequence[str]) -> Beside:
    """Other columns of the file that a field is read from, none of these: times in s and samples.

    If the field has none, those that the file itself leaves no doubt of are taken.
    """
    path, time = data.settings.get("path"), data.settings.get("time")
    found = _columns(field, names)
    if found or not isinstance(path, str):
        return found
    with suppress(ValueError), warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulUnit)
        return _columns(open_field(path, time=time, dt_s=data.settings.get("dt_s")), names)
    return {}


def _columns(field: xr.Dataset, names: Sequence[str]) -> Beside:
    t = grid_points(field, "time")
    own = {str(name): one for name, one in field.data_vars.items() if one.dims == ("time",)}
    return {name: (t, one.values) for name, one in own.items() if name not in names}


def in_unit(field: xr.Dataset, *, signal: str, unit: str) -> xr.Dataset:
    """A field whose signal, so far without a unit, is converted from this unit to SI.

    Raises ValueError if the data already say the signal's unit.
    """
    if signal not in field:
        return field  # the trajectory reports what the data hold
    if (own := field[signal].attrs.get("units", "1")) != "1":
        raise ValueError(
            f"unit is for a signal whose unit the data do not say: {signal} comes in "
            f"{own!r}, got unit={unit}; leave unit out, or describe the file by data=file"
        )
    return field.assign({signal: to_si(field[signal], signal, unit, is_variable=True)})


LEAST_SAMPLES = 20  # of the fitted part of a record and of the rest


def n_before(run: Trajectory, held_out: float) -> int:
    """Number of samples before the last `held_out` fraction of a record."""
    return round(run.n_samples * (1.0 - held_out))


def is_short(run: Trajectory, n_fitted: int) -> bool:
    """Whether the fitted part of a record or the rest has fewer than LEAST_SAMPLES samples."""
    return min(n_fitted, run.n_samples - n_fitted) < LEAST_SAMPLES


def split_in_time(run: Trajectory, held_out: float) -> tuple[Trajectory, Trajectory]:
    """The first part of a record, and the last `held_out` fraction of its samples.

    Raises ValueError if either part would have fewer than LEAST_SAMPLES samples.
    """
    n_train = n_before(run, held_out)
    if is_short(run, n_train):
        raise ValueError(
            f"held_out={held_out} must leave {LEAST_SAMPLES} samples on either side: the data have "
            f"{run.n_samples}"
        )
    return run.window(0, n_train), run.window(n_train, run.n_samples)


# Checks and messages for simulations used as data.

MIN_SAMPLES = 200  # some breathing periods at the usual step; fewer cannot be assessed
BALANCE_TOLERANCE = 1e-3  # relative to the inflow; a float32 record closes to 1e-4
BALANCES = {"mass_balance": "mass", "energy_balance": "energy"}
VERDICTS = {
    "diverged": "the simulation diverged: the end of its record is no physics",
    "out": "the discharge has gone out: there is no plasma to learn from",
    "steady": "the simulation is steady: there is no oscillation to learn from",
    "transit": "the simulation oscillates at {f_kHz:.3g} kHz, above 60 kHz: that is ions in "
    "transit, not breathing",
    "decaying": "the simulation's oscillation decays: what is found describes a transient",
}


class DivergedError(ValueError):
    """A run that diverged before it had recorded enough to study."""


def is_simulation(attributes: Mapping[str, Any]) -> bool:
    """Whether these are the attributes of a run of this package's simulators."""
    return {"status", "I_d_mean", "I_d_std", "parameters"} <= set(attributes)


def check_recorded(field: xr.Dataset) -> None:
    """Raise DivergedError for a run that diverged before it had recorded enough to study."""
    n_samples = field.sizes.get("time", 0)
    diverged = is_simulation(field.attrs) and field.attrs["status"] == "diverged"
    if diverged and n_samples < MIN_SAMPLES:
        raise DivergedError(
            f"the simulation must record {MIN_SAMPLES} samples or more to be studied: it "
            f"diverged after {n_samples}; try shorter steps (++data.cfl=0.4), more cells, "
            "other parameters or another start; +exp=simulate shows what it did"
        )


def amiss(attributes: Mapping[str, Any]) -> list[str]:
    """Warnings about a simulation, empty if there are none."""
    status = attributes["status"]
    if status == "oscillating":
        return doubts(attributes)
    verdict = VERDICTS.get(status, "the simulation is {status}")
    return [verdict.format_map(attributes), *doubts(attributes)]


def doubts(attributes: Mapping[str, Any]) -> list[str]:
    """Warnings besides the status: rates used beyond their table, balances that do not close."""
    found = []
    if (rates := attributes.get("rates", "covered")) != "covered":
        found.append(str(rates))
    for name, words in BALANCES.items():
        value = attributes.get(name, 1.0)
        if not abs(value - 1.0) <= BALANCE_TOLERANCE:  # a NaN balance fails, too
            found.append(
                f"the simulation's {words} balance does not close: (out + stored)/in is {value:.4f}"
            )
    return found


def report_simulation(report: Report, attributes: Mapping[str, Any]) -> None:
    """Report a simulation in one line, with its warnings, on screen, page and in the summary."""
    if not is_simulation(attributes):
        return
    known = [name for name in BALANCES if name in attributes]
    balances = ", ".join(f"{BALANCES[name]} {attributes[name]:.4f}" for name in known)
    report.say(
        f"simulation: {status_text(attributes)}, from {attributes.get('initial', 'its start')}; "
        f"I_d {attributes['I_d_mean']:.2f} A, std {attributes['I_d_std']:.2f} A; "
        f"out/in {balances or 'unknown'}"
    )
    for text in amiss(attributes):
        report.warn(text)


def status_text(attributes: Mapping[str, Any]) -> str:
    """`oscillating, strong cycle`; the status alone if there is no cycle."""
    cycle = attributes.get("cycle", "none")
    return attributes["status"] + (f", {cycle} cycle" if cycle != "none" else "")


def quiet(data: Deferred) -> Deferred:
    """Turn off progress bars: points run in parallel, and their bars would mix."""
    try:
        return data.changed({"progress": False})
    except ValueError:
        return data  # these data show no progress
