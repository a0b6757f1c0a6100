"""Run the simulator once, or over any of its parameters, and show the results: `+exp=simulate`.

A single run shows where its power goes and how it breathes. A scan shows every combination of
some settings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.figures import breathing
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import (
    Block,
    Captioned,
    Result,
    Section,
    Table,
    Text,
    pictures,
    places,
)
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers, collect
from ep2sindy.signals.spectrum import power_spectrum
from ep2sindy.studies.scan import (
    FAILED,
    ScanOutcome,
    Simulated,
    check_simulation,
    run_point,
    scan_points,
)
from ep2sindy.studies.source import compile_kernels, say_simulation, status_text
from ep2sindy.studies.study import Check, Deferred, Positive, PositiveOrAll
from ep2sindy.thruster.axial.output import POWERS
from ep2sindy.thruster.cache import write
from ep2sindy.thruster.verdict import TRANSIT_HZ

MIN_SAMPLES = 16  # fewer samples cannot be drawn
AVERAGED = " Averaged over r by area."
CAPTIONS = {
    "current": "Discharge current over the record (above) and over the part that is shaded there, "
    "beside the ion beam current (below).",
    "spectrum": "Power spectrum of the discharge current; breathing lies below 60 kHz, "
    "oscillations of ions in transit above.",
    "profiles": "Profiles along the axis: mean in time, the band that holds 5 to 95 % of the time, "
    "and the whole range. Dashed: the channel's exit.",
    "maps": "Discharge current, neutrals and ions over time and axis: neutrals fill the channel, "
    "are ionised, and fill it again. Dashed: the channel's exit.",
}
NUMBERS = (
    "f_kHz", "multiplicity", "peak_spread", "I_d_mean", "I_d_std", "thrust_N", "isp_s",
    "anode_efficiency", "I_beam_mean", "I_wall_mean", "mass_balance", "energy_balance",
)  # fmt: skip


def _is_scan(value: Any) -> bool:
    if not isinstance(value, dict) or not value:
        return value is None
    lists = all(isinstance(each, list) and each for each in value.values())
    return lists and all(each not in v[:k] for v in value.values() for k, each in enumerate(v))


Scan = Annotated[
    Mapping[str, Sequence[Any]] | None,
    Check("like {operating_point.voltage: [250,300]}, each value once, or null", _is_scan),
]


@dataclass(frozen=True)
class Windowed:
    """The range that figures show: the record's last periods, and spectra up to a frequency."""

    periods: Positive
    f_max_Hz: PositiveOrAll


@dataclass(frozen=True, eq=False)
class Study:
    """Simulate once, or once for every combination of some values.

    scan: places in the data group, such as `operating_point.voltage`, and their values; None for
    one run. labels: names of the places in tables and figures; by default their own.
    Raises ValueError for a place that does not exist in the data group.
    """

    data: Deferred
    scan: Scan
    parallel: Workers
    figures: Windowed
    labels: Mapping[str, str]

    def __post_init__(self) -> None:
        scan_points(self.data, self.scan or {})  # refuses a misspelt place before any simulation

    def compute(self, run: Run) -> Outcome | ScanOutcome:
        return self._scanned(run) if self.scan else self._one(run)

    def _one(self, run: Run) -> Outcome:
        field = self.data.build()
        check_simulation(field, self.data)
        write(field, run.folder.path / "field.nc")
        say_simulation(run, field.attrs)
        return Outcome(field, periods=self.figures.periods, f_max_Hz=self.figures.f_max_Hz)

    def _scanned(self, run: Run) -> ScanOutcome:
        points = scan_points(self.data, self.scan or {})
        with run.progress(None, "", "kernels, compiled once"):
            compile_kernels([point.data for point in points])
        stage = run.progress(len(points), "simulation")
        results: list[Simulated] = collect(self.parallel, run_point, points, stage)
        if all(each.status == FAILED for each in results):
            raise ValueError(f"a scan needs a point that can be run: {results[0].message}")
        for point, result in zip(points, results, strict=True):
            for note in result.notes:
                run.warn(f"{point.label}: {note}")
        return ScanOutcome(points, results, self.labels)


@dataclass(frozen=True, eq=False)
class Outcome:
    """A run, and the range that figures show; `field.nc` holds all of it."""

    field: xr.Dataset
    periods: float
    f_max_Hz: float | None

    @property
    def numbers(self) -> dict[str, float]:
        """Figures of merit of a run in SI; NaN for those missing because the run diverged."""
        attributes = dict(self.field.attrs)
        if "I_beam" in self.field and self.field.sizes["time"]:
            attributes["I_beam_mean"] = self.field["I_beam"].mean()
        return {name: float(attributes.get(name, np.nan)) for name in NUMBERS}

    @property
    def can_be_drawn(self) -> bool:
        return self.field.sizes["time"] >= MIN_SAMPLES

    def models(self) -> dict[str, SparseModel]:
        return {}

    def tables(self) -> dict[str, pd.DataFrame]:
        found = {"performance": self._performance(), "power": power_table(self.field)}
        if self.can_be_drawn:
            found |= {"profiles": self._profiles(), "spectrum": self._spectrum()}
        return found

    def _profiles(self) -> pd.DataFrame:
        columns = {"z": self.field["z"].values}
        for name, values in breathing.profile_table(self.field).items():
            ends = ("mean", "low", "high", "min", "max")
            columns |= {f"{name}_{end}": each for end, each in zip(ends, values, strict=True)}
        return pd.DataFrame(columns)

    def _spectrum(self) -> pd.DataFrame:
        frequency, power = power_spectrum(self.field["time"].values, self.field["I_d"].values)
        return pd.DataFrame({"frequency_Hz": frequency, "power": power})

    def figures(self) -> dict[str, Captioned]:
        if not self.can_be_drawn:
            return {}
        field, time = self.field, self.field["time"].values
        window = breathing.last_periods(time, self.numbers["f_kHz"], self.periods)
        highest = 0.5 / float(time[1] - time[0])
        up_to = {"f_max_Hz": min(self.f_max_Hz or highest, highest), "transit_Hz": TRANSIT_HZ}
        drawn = {
            "current": partial(breathing.current_figure, field, window),
            "spectrum": partial(
                breathing.current_spectrum_figure, field, f_kHz=self.numbers["f_kHz"], **up_to
            ),
            "profiles": partial(breathing.profile_figure, field),
            "maps": partial(breathing.space_time_figure, field, window),
        }
        radial = AVERAGED if "r" in field.dims else ""
        tails = {"profiles": radial, "maps": radial}
        return {n: Captioned(d, CAPTIONS[n] + tails.get(n, "")) for n, d in drawn.items()}

    def in_short(self) -> Result:
        n = self.numbers
        numbers = [
            f"discharge current {_with(places(n['I_d_mean'], 2), 'A')} on average",
            f"standard deviation {_with(places(n['I_d_std'], 2), 'A')}",
            f"thrust {_with(places(1e3 * n['thrust_N'], 1), 'mN')}",
            f"specific impulse {_with(places(n['isp_s'], 0), 's')}",
            f"mass balance {places(n['mass_balance'], 4)}",
        ]
        at = f" at {places(n['f_kHz'], 2)} kHz" if np.isfinite(n["f_kHz"]) else ""
        return Result(
            f"Simulated: {status_text(self.field.attrs)}{at}",
            [Text("; ".join(numbers))],
            load='ep.read_field("{}/field.nc")',
            picture="current",
        )

    def sections(self) -> list[Section]:
        notes: list[Block] = []
        if not self.can_be_drawn:
            n = self.field.sizes["time"]
            notes = [Text(f"The run broke after {n} samples: there is nothing to draw.")]
        return [
            Section("Run", [Table(self._performance()), *notes]),
            Section("Where the power goes", [power_text(self.field)]),
            Section("Current", pictures(["current", "spectrum"])),
            Section("Along the axis", pictures(["profiles", "maps"])),
        ]

    def _performance(self) -> pd.DataFrame:
        """Performance of the run, in words and units."""
        n, attributes = self.numbers, self.field.attrs
        mode = "transit" if attributes["status"] == "transit" else "breathing"
        share = f"{100.0 * n['I_d_std'] / n['I_d_mean']:.0f}"
        beam = f"{100.0 * n['I_beam_mean'] / n['I_d_mean']:.0f}"
        rows = {
            "status": status_text(attributes),
            "start": attributes.get("initial", "-"),
            "discharge current, mean": _with(places(n["I_d_mean"], 2), "A"),
            "discharge current, standard deviation": _with(
                places(n["I_d_std"], 2), f"A, {share} % of the mean"
            ),
            f"{mode} frequency": _with(places(n["f_kHz"], 2), "kHz"),
            "peaks of the current": _peaks(n),
            "thrust": _with(places(1e3 * n["thrust_N"], 1), "mN"),
            "specific impulse": _with(places(n["isp_s"], 0), "s"),
            "anode efficiency": _with(places(100.0 * n["anode_efficiency"], 1), "%"),
            "ion beam current, mean": _with(
                places(n["I_beam_mean"], 2), f"A, {beam} % of the discharge current"
            ),
            "ion current to the walls, mean": _with(places(n["I_wall_mean"], 2), "A"),
            "mass balance, (left + stored)/entered": places(n["mass_balance"], 4),
            "energy balance, (left + stored)/entered": places(n["energy_balance"], 4),
            "rates of the propellant": attributes.get("rates", "-"),
        }
        if "half_angle" in self.field and self.field.sizes["time"]:
            mean = float(self.field["half_angle"].mean())
            rows["half-angle of the plume, mean"] = _with(places(mean, 1), "degrees")
        return pd.DataFrame({"quantity": list(rows), "value": list(rows.values())})

    def summary(self) -> dict[str, Any]:
        attributes = self.field.attrs
        return {
            "file": "field.nc",
            "status": attributes["status"],
            "cycle": attributes.get("cycle", "none"),
            "initial": attributes.get("initial"),
            **self.numbers,
            "rates": attributes.get("rates"),
            "n_samples": self.field.sizes["time"],
            "power_W": dict(power_table(self.field)[["name", "power_W"]].to_numpy().tolist()),
        }

    def headline(self) -> dict[str, float]:
        return self.numbers


def _with(number: str, unit: str) -> str:
    return number if number == "-" else f"{number} {unit}"


def _peaks(numbers: Mapping[str, float]) -> str:
    """How the current's peaks differ from cycle to cycle; `-` where nothing oscillates."""
    if not np.isfinite(numbers["peak_spread"]):
        return "-"
    again, spread = numbers["multiplicity"], places(100.0 * numbers["peak_spread"], 1)
    cycles = "every cycle" if again == 1.0 else f"after {again:g} cycles"
    repeat = f"the same {cycles}" if np.isfinite(again) else "not repeating"
    return f"{spread} % spread, {repeat}"


def power_table(field: xr.Dataset) -> pd.DataFrame:
    """Mean power in W by sink, and its share of the power that the plasma takes."""
    known = [name for name in POWERS if name in field and field.sizes["time"]]
    power = {name: float(field[name].mean()) for name in known}
    text = {name: str(field[name].attrs.get("long_name", name)) for name in known}
    if "P_in" in power:
        power["stored"] = power["P_in"] - sum(power[name] for name in known if name != "P_in")
        text["stored"] = "stored by the electrons, or unaccounted for"
    share = [100.0 * each / power.get("P_in", np.nan) for each in power.values()]
    columns = {"name": list(power), "goes_to": list(text.values()), "power_W": list(power.values())}
    return pd.DataFrame({**columns, "share": share})


def power_text(field: xr.Dataset) -> Table | Text:
    """The power table for reading."""
    table = power_table(field)
    if table.empty:
        return Text("This run has no record of its power.")
    rows = {
        "power": table["goes_to"],
        "W": [places(round(value, 1) + 0.0, 1) for value in table["power_W"]],  # no -0.0
        "%": [places(round(value, 1) + 0.0, 1) for value in table["share"]],
    }
    return Table(pd.DataFrame(rows), breaks=[0], note="Means over the record.")
