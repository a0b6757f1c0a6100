"""Data of a study: field, preparation and trajectory; what simulations and their zones tell."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.data.fields import clock_of, grid_points
from ep2sindy.data.gaps import describe_breaks, describe_gaps, usual_step
from ep2sindy.data.quantities import STEP_DOUBT, DoubtfulUnit, to_si
from ep2sindy.data.sampling import ZoneAverage
from ep2sindy.data.steps import records_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import Zone, describe_zone
from ep2sindy.library.library import Library, polynomial
from ep2sindy.model.scores import r2
from ep2sindy.report.report import Report
from ep2sindy.runtime.screen import in_line
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.study import Deferred
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

    def opened(self, libraries: Iterable[Library], report: Report) -> tuple[xr.Dataset, Trajectory]:
        """The single record, and its trajectory as `sampled` makes it."""
        with report.progress(None, "", "data"):
            field = self.field()
        return field, self.sampled(field, libraries, report)

    def sampled(
        self, field: xr.Dataset, libraries: Iterable[Library], report: Report
    ) -> Trajectory:
        """The trajectory that the libraries need, which is reported on screen, page and summary."""
        say_simulation(report, field.attrs)  # first, as it may explain later errors
        data = self.trajectory.trajectory(field, inputs=self.inputs(libraries), label=report.title)
        say_data(report, data, field, self.trajectory.place(field))
        report.summary.setdefault("data", data_summary(data))
        return data


def zone_of(source: Source) -> Zone | None:
    """The zone that the trajectory is averaged over; None for the whole field or a point of it."""
    return source.trajectory.zone if isinstance(source.trajectory, ZoneAverage) else None


def zones_of(source: Source, field: xr.Dataset, report: Report) -> Zones:
    """The zones that the trajectory is averaged over; none if it is that of a point.

    Balances that cannot be made, as of a zone that reaches into the plume, are reported.
    """
    sampling = source.trajectory
    if not isinstance(sampling, ZoneAverage):
        return Zones()
    return Zones(_balances(sampling, field, report), sampling.sizes(field))


def _balances(sampling: ZoneAverage, field: xr.Dataset, report: Report) -> dict[str, xr.Dataset]:
    if not {"n_i", "n_n"} <= set(field.data_vars):
        return {}
    zones = sampling.parts(field)
    if any(zone.r is not None for zone in zones.values()):
        return {}
    try:
        axisymmetric = sampling.axisymmetric
        return {n: zone_balance(field, z, axisymmetric=axisymmetric) for n, z in zones.items()}
    except ValueError as error:
        report.say(f"the model has no balance of its zone beside it: {error}")
        return {}


def say_field(report: Report, field: xr.Dataset) -> None:
    """Report which data are used, for a study of every grid point."""
    t, clock = grid_points(field, "time"), clock_of(field)
    words = [
        field.attrs.get("file", ""),
        describe_zone(None, field),
        f"{len(t)} samples of {clock.duration_text(usual_step(t), digits=4)} "
        f"from {clock.duration_text(t[0], digits=4)}",
    ]
    report.say(in_line(f"data: {'; '.join(word for word in words if word)}"))
    say_doubts(report, field)


def say_doubts(report: Report, field: xr.Dataset) -> None:
    """Warn of a step that contradicts the file's own times."""
    if STEP_DOUBT in field.attrs:
        report.warn(field.attrs[STEP_DOUBT])


def say_data(report: Report, data: Trajectory, field: xr.Dataset, place: str) -> None:
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
    report.say(in_line(f"data: {'; '.join(words)}"))
    say_doubts(report, field)
    if data.n_samples < field.sizes["time"]:
        report.warn(describe_gaps(data.t, field.sizes["time"]))
    elif text := describe_breaks(data.t):
        report.warn(text)


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


def only(data: Deferred, signal: str, unit: str | None, *, without: Sequence[str] = ()) -> Deferred:
    """Data read from a file with this variable alone, whatever other variables a config expects.

    without: axes that are not required. Data that are not read from a file are unchanged.
    """
    variables: Mapping[str, Any] | None = data.settings.get("variables")
    if variables is None:
        return data
    places: dict[str, Any] = {
        f"variables.{name}.name": None for name in variables if name != signal
    }
    places |= {f"{axis}.name": None for axis in without if data.settings.get(axis)}
    if signal not in variables:
        new = {"name": signal, "unit": unit or "1", "dims": None}
        return data.changed(places, {"variables": {signal: new}})
    if unit is not None:
        places[f"variables.{signal}.unit"] = unit
    return data.changed(places)


def in_unit(field: xr.Dataset, *, signal: str, unit: str) -> xr.Dataset:
    """A field whose signal, so far without a unit, is converted from this unit to SI.

    Raises ValueError if the data already say the signal's unit.
    """
    if signal not in field:
        return field  # the trajectory reports what the data hold
    if (stated := field[signal].attrs.get("units", "1")) != "1":
        raise ValueError(
            f"unit is for a signal whose unit the data do not say: {signal} comes in {stated!r}, "
            f"and unit={unit} came; leave unit out, or describe the file by data=file"
        )
    return field.assign({signal: to_si(field[signal], signal, unit, is_variable=True)})


LEAST_SAMPLES = 20  # of the fitted part of a record and of the rest


def n_before(run: Trajectory, held_out: float) -> int:
    """Number of samples before the last `held_out` share of a record."""
    return round(run.n_samples * (1.0 - held_out))


def is_short(run: Trajectory, n_fitted: int) -> bool:
    """Whether the fitted part of a record or the rest has fewer than LEAST_SAMPLES samples."""
    return min(n_fitted, run.n_samples - n_fitted) < LEAST_SAMPLES


def split_in_time(run: Trajectory, held_out: float) -> tuple[Trajectory, Trajectory]:
    """The first part of a record, and the last `held_out` share of its samples.

    Raises ValueError if either part would have fewer than LEAST_SAMPLES samples.
    """
    n_train = n_before(run, held_out)
    if is_short(run, n_train):
        raise ValueError(
            f"held_out={held_out} must leave {LEAST_SAMPLES} samples on either side: the data have "
            f"{run.n_samples}"
        )
    return run.window(0, n_train), run.window(n_train, run.n_samples)


# Checks and messages for simulations used as data, and compilation of their kernels.

MIN_SAMPLES = 200  # some breathing periods at the usual step; fewer cannot be judged
GLIMPSE_SAMPLES = 20
BALANCE_TOLERANCE = 1e-3  # relative to the inflow; a float32 record closes to 1e-4
BALANCES = {"mass_balance": "mass", "energy_balance": "energy"}
VERDICTS = {
    "diverged": "the simulation diverged: the end of its record is no physics",
    "out": "the discharge has gone out: there is no plasma to learn from",
    "steady": "the simulation is steady: there is no oscillation to learn from",
    "decaying": "the simulation's oscillation dies out: what is found describes a transient",
}


class DivergedError(ValueError):
    """A run that diverged before it had recorded enough to study."""


def is_simulation(attributes: Mapping[str, Any]) -> bool:
    """Whether these are the attributes of a run of this package's simulators."""
    return {"status", "I_d_mean", "I_d_std", "parameters"} <= set(attributes)


def check_recorded(field: xr.Dataset) -> None:
    """Raise DivergedError for a run that diverged before it had recorded enough to study."""
    if is_simulation(field.attrs) and field.attrs["status"] == "diverged":
        n_samples = field.sizes["time"]
        if n_samples < MIN_SAMPLES:
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
    if status == "transit":
        verdict = (
            f"the simulation oscillates at {attributes['f_kHz']:.3g} kHz, above 60 kHz: that is "
            "ions in transit, not breathing"
        )
    else:
        verdict = VERDICTS.get(status, f"the simulation is {status}")
    return [verdict, *doubts(attributes)]


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


def say_simulation(report: Report, attributes: Mapping[str, Any]) -> None:
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


def compile_kernels(data: Sequence[Deferred]) -> None:
    """Run a few samples in this process, so that workers find the compiled kernels on disk."""
    for each in data:
        sample_s = each.settings.get("sample_s") or 1e-6
        brief = {"duration_s": GLIMPSE_SAMPLES * sample_s, "warm_up_s": 0.0, "cache": None}
        try:
            each.changed({"sample_s": sample_s, **brief}).build()
        except ValueError:
            continue  # the point reports the reason when it is run
        return


IONS, NEUTRALS = "n_i", "n_n"

# Role -> what the balance calls it, and the terms that tell it: neutrals leave the faster the more
# ions there are, and walls and anode give back what reaches them.
TELLING: Mapping[str, tuple[str, Sequence[str]]] = {
    f"{NEUTRALS} out": ("exit_n", [NEUTRALS, f"{IONS}*{NEUTRALS}"]),
    f"{IONS} to {NEUTRALS}": ("returned", [IONS]),
}


@dataclass(frozen=True)
class Zones:
    """The zones of a record: balances of ions and neutrals, and lengths in m if there are several.

    balances: by name, from `ep.thruster.zone_balance`; a single one is called "".
    """

    balances: Mapping[str, xr.Dataset] = field(default_factory=dict)
    sizes: Mapping[str, float] = field(default_factory=dict)


NO_ZONES = Zones()


@dataclass(frozen=True)
class FittedRate:
    """A recorded rate by terms, their coefficients in SI, with R2 at each instant."""

    terms: Mapping[str, float]
    r2: float = float("nan")


def told_roles(balances: Mapping[str, xr.Dataset], run: Trajectory) -> dict[str, FittedRate]:
    """What the balances of zones tell about roles, over the samples of a run.

    balances: by zone, from `ep.thruster.zone_balance`; a single one is called "". The inflow is the
    mean supply of neutrals. In a single zone the neutrals that leave, and what walls and anode give
    back, are told by least squares. A role that a balance does not give is left out.
    """
    found = {}
    for zone, balance in balances.items():
        if "supply" in balance:
            name = f"{NEUTRALS}@{zone} in" if zone else f"{NEUTRALS} in"
            found[name] = FittedRate({"1": float(balance["supply"].mean())})
    if "" not in balances or not {IONS, NEUTRALS} <= set(run.state_names):
        return found
    known, library = recorded_rates(balances[""], run), polynomial(run.state_names, degree=2)
    for role, (rate, terms) in TELLING.items():
        if rate in known:
            columns = library.evaluate(run.states)[:, [library.index(term) for term in terms]]
            found[role] = fitted_rate(known[rate], columns, terms)
    return found


def fitted_rate(
    rate: Float[np.ndarray, " samples"],
    columns: Float[np.ndarray, "samples terms"],
    terms: Sequence[str],
) -> FittedRate:
    """A rate by least squares on terms, whose values are the columns."""
    size = np.abs(columns).max(axis=0)
    coef = np.linalg.lstsq(columns / size, rate, rcond=None)[0] / size
    return FittedRate(dict(zip(terms, coef.tolist(), strict=True)), rate_r2(rate, columns @ coef))


def rate_r2(
    recorded: Float[np.ndarray, " samples"], modelled: Float[np.ndarray, " samples"]
) -> float:
    """R2 at each instant; NaN for a recorded rate that varies by no more than rounding."""
    if np.ptp(recorded) <= 1e-6 * np.abs(recorded).max():
        return float("nan")
    return float(r2(truth=recorded, prediction=modelled[None])[0])


def recorded_rates(balance: xr.Dataset, data: Trajectory) -> dict[str, np.ndarray]:
    """Terms of the balance at the samples of the trajectory."""
    there = np.isin(balance["time"].values, data.t)
    return {str(name): balance[name].values[there] for name in balance.data_vars}
