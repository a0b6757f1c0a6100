"""A scan of simulations: settings that take several values, each combination run and judged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from textwrap import fill
from typing import Any

import pandas as pd
import xarray as xr

from ep2sindy.figures.breathing import curves_figure, stability_figure
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Captioned, Result, Section, Table, Text, pictures, places
from ep2sindy.runtime.files import WriteError
from ep2sindy.studies.source import doubts, is_simulation, quiet
from ep2sindy.studies.study import Deferred

FAILED = "failed"
SCANNED = (
    "f_kHz", "multiplicity", "peak_spread", "I_d_mean", "I_d_std", "thrust_N", "isp_s",
    "anode_efficiency", "mass_balance", "energy_balance",
)  # fmt: skip
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


@dataclass(frozen=True)
class Simulated:
    """Result of one point.

    notes: warnings besides the status. message: why it could not be run.
    """

    status: str
    cycle: str = "none"
    numbers: Mapping[str, float] = field(default_factory=dict)
    initial: str = ""
    notes: Sequence[str] = ()
    message: str = ""


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
        return Simulated(FAILED, message=str(error) or type(error).__name__)
    attributes = run.attrs
    return Simulated(
        attributes["status"],
        attributes.get("cycle", "none"),
        {name: float(attributes.get(name, float("nan"))) for name in SCANNED},
        attributes.get("initial", ""),
        doubts(attributes),
    )


def value_text(value: Any) -> str:
    """A value as text in tables and on axes: `250`, `BN`, `ColdStart(n_i=1e+17)`."""
    if isinstance(value, Mapping):
        name = str(value.get("_target_", "")).rpartition(".")[2]
        inner = [f"{k}={value_text(v)}" for k, v in value.items() if k != "_target_"]
        return f"{name}({', '.join(inner)})" if inner or not name else name
    if isinstance(value, list):
        return f"[{', '.join(map(value_text, value))}]"
    return f"{value:g}" if isinstance(value, float) else "null" if value is None else str(value)


@dataclass(frozen=True, eq=False)
class ScanOutcome:
    """All points of a scan and their results. labels: names of some places."""

    points: Sequence[Point]
    results: Sequence[Simulated]
    labels: Mapping[str, str]

    @property
    def rows(self) -> pd.DataFrame:
        """One row per point: settings, verdict, numbers in SI, and the reason if it failed."""
        nothing = dict.fromkeys(SCANNED, float("nan"))
        rows = []
        for point, each in zip(self.points, self.results, strict=True):
            verdict = {"status": each.status, "cycle": each.cycle}
            told = {"initial": each.initial, "message": each.message or "; ".join(each.notes)}
            rows.append({**point.values, **verdict, **nothing, **each.numbers, **told})
        return pd.DataFrame(rows)

    @property
    def scanned(self) -> list[str]:
        """Places that take several values; the first place if none does."""
        several = [name for name in self._places if len(self._texts[name].unique()) > 1]
        return several or self._places[:1]

    @property
    def _places(self) -> list[str]:
        return list(self.points[0].values)

    @property
    def _texts(self) -> pd.DataFrame:
        """The rows, with the settings as text."""
        texts = {
            name: [value_text(each.values[name]) for each in self.points] for name in self._places
        }
        return self.rows.assign(**texts)

    def label(self, place: str) -> str:
        return self.labels.get(place, place.replace(".", ": ").replace("_", " "))

    def models(self) -> dict[str, SparseModel]:
        return {}

    def tables(self) -> dict[str, pd.DataFrame]:
        return {"points": self._texts}

    def figures(self) -> dict[str, Captioned]:
        along = self.scanned
        if len(along) == 1:
            values = [each.values[along[0]] for each in self.points]
            numbers = all(type(value) in (int, float) for value in values)
            points = self.rows if numbers else self._texts
            draw = partial(curves_figure, points, along[0], self.label(along[0]))
            return {"curves": Captioned(draw, CURVES)}
        labels = {name: self.label(name) for name in along}
        drawn = partial(stability_figure, self._texts, along, labels)
        return {"stability": Captioned(drawn, MAP)}

    def in_short(self) -> Result:
        """How many points oscillate, and between which frequencies."""
        counts = ", ".join(f"{n} {status}" for status, n in self._counts.items())
        f_kHz = self.rows["f_kHz"].dropna()
        ends = dict.fromkeys(f"{value:.3g}" for value in (f_kHz.min(), f_kHz.max()))
        text = f"frequencies {' to '.join(ends)} kHz" if len(f_kHz) else "nothing oscillates"
        (picture,) = self.figures()
        return Result(
            f"Simulated: {len(self.points)} points, {counts}",
            [Text(f"over {', '.join(map(self.label, self.scanned))}: {text}")],
            load='pandas.read_csv("{}/tables/points.csv")',
            picture=picture,
        )

    def sections(self) -> list[Section]:
        counts = ", ".join(f"{n} {status}" for status, n in self._counts.items())
        starts = dict.fromkeys(each.initial for each in self.results if each.initial)
        lines = [
            Text(f"{len(self.points)} points: {counts}; from {', '.join(starts)}."),
            *self._failures(),
        ]
        return [Section("Scan", [*lines, self._table(), *pictures(["curves", "stability"])])]

    def _failures(self) -> list[Text]:
        """Reasons why points could not be run, each once."""
        failed: dict[str, list[str]] = {}
        for point, each in zip(self.points, self.results, strict=True):
            if each.message:
                failed.setdefault(each.message, []).append(point.label)
        found = []
        for message, labels in failed.items():
            more = f" and {len(labels) - 2} more" if len(labels) > 2 else ""
            found.append(Text(f"{'; '.join(labels[:2])}{more}: {message}", warning=True))
        return found

    @property
    def _counts(self) -> dict[str, int]:
        return dict(Counter(each.status for each in self.results))

    def _table(self) -> Table:
        shown = []
        for row in self._texts.to_dict("records"):
            shown.append(
                {
                    **{self.label(name): row[name] for name in self._places},
                    "status": row["status"],
                    "cycle": row["cycle"].replace("none", "-"),
                    "current mean (A)": places(row["I_d_mean"], 2),
                    "std (A)": places(row["I_d_std"], 2),
                    "f (kHz)": places(row["f_kHz"], 1),
                    "thrust (mN)": places(1e3 * row["thrust_N"], 1),
                    "efficiency (%)": places(100.0 * row["anode_efficiency"], 1),
                    "spread of peaks (%)": places(100.0 * row["peak_spread"], 1),
                    "mass balance": places(row["mass_balance"], 4),
                    "energy balance": places(row["energy_balance"], 4),
                }
            )
        narrow = {name: fill(name, HEADING, break_long_words=False) for name in shown[0]}
        return Table(pd.DataFrame(shown).rename(columns=narrow), note="balance: (out + stored)/in")

    def summary(self) -> dict[str, Any]:
        return {"statuses": self._counts, "points": self.rows.to_dict("records")}

    def headline(self) -> dict[str, float]:
        names = ("oscillating", "transit", "steady", "decaying", "out", "diverged", FAILED)
        counts = {f"n_{name}": float(self._counts.get(name, 0)) for name in names}
        return {"n_points": float(len(self.points)), **counts}
