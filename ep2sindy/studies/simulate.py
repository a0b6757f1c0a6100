"""Run the simulator, and show where the power goes and how the discharge breathes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import nan
from operator import itemgetter
from typing import Any

import numpy as np
import xarray as xr

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures import breathing
from ep2sindy.figures.series import data_figure
from ep2sindy.report.document import Result, Table, Text, places
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, ResultTable, View, percent
from ep2sindy.studies.source import is_simulation, report_simulation, status_text
from ep2sindy.studies.study import Deferred, Positive, PositiveOrAll
from ep2sindy.thruster.axial.output import POWERS
from ep2sindy.thruster.cache import write

Simulated = Mapping[str, Any]  # attributes of a simulation: its status, and numbers in SI

MIN_SAMPLES = 16  # fewer samples cannot be drawn
AVERAGED = " Averaged over r by area."
CAPTIONS = {
    "current": "Discharge current over the record, and its power spectrum, the peak dashed: "
    "breathing lies below 60 kHz, oscillations of ions in transit above.",
    "profiles": "Profiles along the axis: mean in time, the band that holds 5 to 95 % of the time, "
    "and the whole range. Dashed: the channel's exit.",
    "maps": "Currents, neutrals and ions over time and axis: neutrals fill the channel, "
    "are ionised, and fill it again. Dashed: the channel's exit.",
}
BRIEF = ("I_d_mean", "I_d_std", "thrust_N", "isp_s", "mass_balance")
BALANCE = "balance: (out + stored)/in"


def number(key: str, heading: str, form: Any, view: View = View.ALL) -> Metric[Simulated]:
    """A number of a simulation; NaN if it has none, as a run that diverged."""
    return Metric(key, lambda run: float(run.get(key, nan)), view, heading, form)


def _millinewton(value: float) -> str:
    return "-" if value != value else f"{1e3 * value:.1f} mN"


def _cycles(count: float) -> str:
    return "-" if count != count else f"{count:g} cycle{'s' if count > 1 else ''}"


def _cycle(strength: str) -> str:
    return "-" if strength == "none" else strength


PERFORMANCE: list[Metric[Simulated]] = [
    Metric("status", itemgetter("status"), View.SHOWN),
    Metric("cycle", lambda run: run.get("cycle", "none"), View.SHOWN, format=_cycle),
    Metric("initial", lambda run: run.get("initial"), View.SHOWN, "start"),
    number("I_d_mean", "mean discharge current", "{:.2f} A"),
    number("I_d_std", "its standard deviation", "{:.2f} A"),
    number("f_kHz", "frequency", "{:.2f} kHz"),
    number("peak_spread", "spread of the peaks", percent(1)),
    number("multiplicity", "peaks repeat after", _cycles),
    number("thrust_N", "thrust", _millinewton),
    number("isp_s", "specific impulse", "{:.0f} s"),
    number("anode_efficiency", "anode efficiency", percent(1)),
    number("mass_balance", "mass balance", "{:.4f}"),
    number("energy_balance", "energy balance", "{:.4f}"),
    number("std_fraction", "standard deviation over mean current", percent(0), View.SHOWN),
    number("I_beam_mean", "mean ion beam current", "{:.2f} A"),
    number("beam_fraction", "ion beam over discharge current", percent(0), View.SHOWN),
    number("I_wall_mean", "mean ion current to the walls", "{:.2f} A"),
    Metric("rates", lambda run: run.get("rates"), View.SHOWN, "rates of the propellant"),
    number("half_angle_deg", "mean half-angle of the plume", "{:.1f} degrees", View.SHOWN),
    Metric("n_samples", itemgetter("n_samples")),
]


@dataclass(frozen=True)
class Windowed:
    """The range that figures show: the record's last periods, and spectra up to a frequency."""

    periods: Positive
    f_max_Hz: PositiveOrAll


@dataclass(frozen=True, eq=False)
class Study:
    """Simulate once; Hydra's multirun does so for every combination of some settings."""

    data: Deferred
    figures: Windowed

    def run(self, report: Report) -> None:
        field = self.data.build()
        check_simulation(field, self.data)
        write(field, report.folder.file("field.nc"))
        report_simulation(report, field.attrs)
        run = performance(field)
        f_kHz = float(run.get("f_kHz", np.nan))
        at = f" at {f_kHz:.2f} kHz" if np.isfinite(f_kHz) else ""
        brief = [f"{m.heading} {m.cell(m.value(run))}" for m in PERFORMANCE if m.key in BRIEF]
        report.found(
            Result(
                f"Simulated: {status_text(run)}{at}",
                [Text("; ".join(brief))],
                load='ep.data.read_field("{}/field.nc")',
                picture="current",
            )
        )
        report.summary["file"] = "field.nc"
        table = ResultTable({"run": run}, PERFORMANCE)
        report.section("Performance")
        upright = table.screen().T.reset_index().set_axis(["quantity", "value"], axis=1)
        report.table("performance", table, shown=Table(upright, note=BALANCE))
        add_power(report, field)
        if field.sizes["time"] >= MIN_SAMPLES:
            self._draw(report, field, f_kHz)
        else:
            n = field.sizes["time"]
            report.add(f"The run broke after {n} samples: there is nothing to draw.")

    def _draw(self, report: Report, field: xr.Dataset, f_kHz: float) -> None:
        """Add figures of a run, and the samples that they show."""
        time = field["time"].values
        window = breathing.last_periods(time, f_kHz, self.figures.periods)
        highest = 0.5 / float(time[1] - time[0])
        up_to_Hz = min(self.figures.f_max_Hz or highest, highest)
        current = Trajectory(time, field["I_d"].values[:, None], ["I_d"], units={"I_d": "A"})
        whole_s = float(time[-1] - time[0])
        report.section("Current")
        draw = partial(data_figure, current, duration_s=whole_s, f_max_Hz=up_to_Hz)
        report.figure("current", draw, CAPTIONS["current"])
        report.section("Along the axis")
        radial = AVERAGED if "r" in field.dims else ""
        draw = partial(breathing.profile_figure, field)
        report.figure("profiles", draw, CAPTIONS["profiles"] + radial)
        draw = partial(breathing.space_time_figure, field, window)
        report.figure("maps", draw, CAPTIONS["maps"] + radial)
        report.samples("profiles", breathing.profile_table(field))


def check_simulation(field: object, data: Deferred) -> None:
    """Raise ValueError unless the data group names a simulation of this package."""
    if not (isinstance(field, xr.Dataset) and is_simulation(field.attrs)):
        raise ValueError(
            "data must be a simulation, with status, current and parameters as its attributes: "
            f"{data.settings['_target_']} gave none; choose data=simulation"
        )


def performance(field: xr.Dataset) -> dict[str, Any]:
    """Attributes of a run, with means over its record."""
    found = {**field.attrs, "n_samples": field.sizes["time"]}
    means = {"I_beam": "I_beam_mean", "half_angle": "half_angle_deg"}
    if field.sizes["time"]:
        found |= {key: float(field[name].mean()) for name, key in means.items() if name in field}
        fractions = {"I_d_std": "std_fraction", "I_beam_mean": "beam_fraction"}
        found |= {k: found.get(name, np.nan) / found["I_d_mean"] for name, k in fractions.items()}
    return found


def add_power(report: Report, field: xr.Dataset) -> None:
    """Add the mean power in W by sink, and its fraction of the power that the plasma takes."""
    report.section("Where the power goes")
    known = [name for name in POWERS if name in field and field.sizes["time"]]
    power = {name: float(field[name].mean()) for name in known}
    text = {name: str(field[name].attrs.get("long_name", name)) for name in known}
    if not known:
        report.add("This run has no record of its power.")
    if "P_in" in power:
        power["stored"] = power["P_in"] - sum(power[name] for name in known if name != "P_in")
        text["stored"] = "stored by the electrons, or unaccounted for"
    whole = power.get("P_in", np.nan)
    metrics: list[Metric[str]] = [
        Metric("goes_to", lambda name: text[name], View.SHOWN, "power"),
        Metric("power_W", lambda name: power[name], View.SHOWN, "W", _tenths),
        Metric("fraction", lambda name: 100.0 * power[name] / whole, View.SHOWN, "%", _tenths),
    ]
    table = ResultTable({name: name for name in power}, metrics)
    shown = Table(table.screen(), breaks=[0], note="Means over the record.")
    report.table("power", table, heading="name", shown=shown)


def _tenths(value: float) -> str:
    return places(round(value, 1) + 0.0, 1)  # no -0.0
