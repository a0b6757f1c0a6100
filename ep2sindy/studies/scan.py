"""A scan of simulations: settings that take several values, each combination run and assessed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from math import nan
from operator import itemgetter
from textwrap import fill
from typing import Any

import xarray as xr

from ep2sindy.figures.breathing import curves_figure, stability_figure
from ep2sindy.report.about import setting_text
from ep2sindy.report.document import Result, Table, Text
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, ResultTable, View, percent
from ep2sindy.runtime.files import WriteError
from ep2sindy.studies.source import doubts, is_simulation, quiet
from ep2sindy.studies.study import Deferred

Simulated = Mapping[str, Any]  # attributes of a simulation: its status, and numbers in SI

FAILED = "failed"
STATUSES = ("oscillating", "transit", "steady", "decaying", "out", "diverged", FAILED)
HEADING = 9  # characters per line in a table's heading
MAP = (
    "Standard deviation of the discharge current over the scanned parameters: the colour and the "
    "first number of a cell; below it frequency and cycle (strong: a standard deviation above 90 % "
    "of the mean). Hatched: no breathing, for the reason that the cell names."
)
CURVES = (
    "Discharge current with its standard deviation as bars, frequency, thrust and anode efficiency "
    "over the scanned parameter; vertical lines: points that diverged or could not be run."
)


def number(key: str, heading: str, form: Any, view: View = View.ALL) -> Metric[Simulated]:
    """A number of a simulation; NaN if it has none, as a run that diverged."""
    return Metric(key, lambda run: float(run.get(key, nan)), view, heading, form)


def _millinewton(value: float) -> str:
    return "-" if value != value else f"{1e3 * value:.1f} mN"


def _cycles(count: float) -> str:
    return "-" if count != count else f"{count:g} cycle{'s' if count > 1 else ''}"


def _cycle(strength: str) -> str:
    return "-" if strength == "none" else strength


VERDICT: list[Metric[Simulated]] = [
    Metric("status", itemgetter("status"), View.SHOWN),
    Metric("cycle", lambda run: run.get("cycle", "none"), View.SHOWN, format=_cycle),
]
MERITS = [
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
]
BALANCE = "balance: (out + stored)/in"


def check_simulation(field: object, data: Deferred) -> None:
    """Raise ValueError unless the data group names a simulation of this package."""
    if not (isinstance(field, xr.Dataset) and is_simulation(field.attrs)):
        raise ValueError(
            "data must be a simulation, with status, current and parameters as its attributes: "
            f"{data.settings['_target_']} gave none; choose data=simulation"
        )


@dataclass(frozen=True, eq=False)
class Point:
    """Settings of one run: values by place in the data group, and the data with these values."""

    values: Mapping[str, Any]
    data: Deferred

    @property
    def label(self) -> str:
        return ", ".join(f"{name}={value_text(value)}" for name, value in self.values.items())

    @property
    def plain(self) -> dict[str, Any]:
        """Its values, as text unless they are numbers."""
        values = self.values.items()
        return {p: v if type(v) in (int, float) else value_text(v) for p, v in values}


def scan_points(data: Deferred, scan: Mapping[str, Sequence[Any]]) -> list[Point]:
    """Every combination, the last place varying fastest; ValueError for an unknown place."""
    found = []
    for values in product(*scan.values()):
        chosen = dict(zip(scan, values, strict=True))
        found.append(Point(chosen, quiet(data.changed(chosen))))
    return found


def run_point(point: Point) -> Simulated:
    """Run a point; if it cannot be run, record the reason, so that other points still run.

    Raises WriteError if the simulation cannot be kept: that is not the point's fault.
    """
    try:
        run: Any = point.data.build()
        check_simulation(run, point.data)
    except WriteError:
        raise
    except (ValueError, OSError, ArithmeticError) as error:
        return {"status": FAILED, "message": str(error) or type(error).__name__}
    return dict(run.attrs)


def value_text(value: Any) -> str:
    """A value as text in tables and on axes: `250`, `BN`, `ColdStart (n_i 1e+17)`, `null`."""
    return setting_text(value) or "null"


def add_scan(
    report: Report, points: Sequence[Point], results: Sequence[Simulated], names: Mapping[str, str]
) -> None:
    """Add all points of a scan and their results. names: of some places."""
    warn_of_points(report, points, results)
    labels = {p: names.get(p, p.replace(".", ": ").replace("_", " ")) for p in points[0].values}
    table = scan_table(points, results, labels)
    counts = Counter(result["status"] for result in results)
    statuses = ", ".join(f"{n} {status}" for status, n in counts.items())
    starts = dict.fromkeys(run["initial"] for run in results if run.get("initial"))
    report.section("Scan", f"{len(points)} points: {statuses}; from {', '.join(starts)}.")
    rows = table.csv()
    scanned = [place for place in labels if rows[place].nunique() > 1] or [*labels][:1]
    if len(scanned) == 1:
        picture, caption = "curves", CURVES
        draw = partial(curves_figure, rows, scanned[0], labels[scanned[0]])
    else:
        picture, caption = "stability", MAP
        texts = rows.assign(**{place: [*map(value_text, rows[place])] for place in scanned})
        draw = partial(stability_figure, texts, scanned, labels)
    report.figure(picture, draw, caption)
    shown = table.screen().rename(columns=partial(fill, width=HEADING, break_long_words=False))
    report.table("points", table, shown=Table(shown, note=BALANCE))
    report.summary["statuses"] = dict(counts)
    report.headline["n_points"] = float(len(points))
    report.headline |= {f"n_{status}": float(counts[status]) for status in STATUSES}
    f_kHz = rows["f_kHz"].dropna()
    ends = dict.fromkeys(f"{value:.3g}" for value in (f_kHz.min(), f_kHz.max()))
    text = f"frequencies {' to '.join(ends)} kHz" if len(f_kHz) else "nothing oscillates"
    over = ", ".join(labels[place] for place in scanned)
    report.found(
        Result(
            f"Simulated: {len(points)} points, {statuses}",
            [Text(f"over {over}: {text}")],
            load='pandas.read_csv("{}/tables/points.csv")',
            picture=picture,
        )
    )


def scan_table(
    points: Sequence[Point], results: Sequence[Simulated], labels: Mapping[str, str]
) -> ResultTable[Simulated]:
    """One record per point: its settings, verdict, numbers, and why it failed or is in doubt.

    labels: of all places. A setting that is no number is a text.
    """
    settings: list[Metric[Simulated]] = [
        Metric(p, itemgetter(p), View.SHOWN, label, value_text) for p, label in labels.items()
    ]
    metrics = [
        *settings,
        *(metric.of(dict, view=View.SHOWN) for metric in (*VERDICT, *MERITS)),  # no headlines
        Metric("initial", lambda run: run.get("initial", "")),
        Metric("message", lambda run: "; ".join(reasons(run))),
    ]
    pairs = zip(points, results, strict=True)
    return ResultTable([{**result, **point.plain} for point, result in pairs], metrics)


def warn_of_points(report: Report, points: Sequence[Point], results: Sequence[Simulated]) -> None:
    """Warn of points that could not be run, and of doubts about others; each reason once."""
    labels: dict[str, list[str]] = {}
    for point, result in zip(points, results, strict=True):
        for reason in reasons(result):
            labels.setdefault(reason, []).append(point.label)
    for reason, those in labels.items():
        more = f" and {len(those) - 2} more" if len(those) > 2 else ""
        report.warn(f"{'; '.join(those[:2])}{more}: {reason}")


def reasons(result: Simulated) -> Sequence[str]:
    """Why a point could not be run, or the doubts about its run besides its status."""
    return [result["message"]] if "message" in result else doubts(result)
