"""Processes over operating points: their rates by a law, at points left out, and in the records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtri

from ep2sindy.data.trajectory import point_label
from ep2sindy.figures.operating import processes_figure
from ep2sindy.library.relations import Constraint
from ep2sindy.library.roles import ROLELESS
from ep2sindy.operating.law import OperatingLaw, read_law
from ep2sindy.operating.left_out import LawChoice
from ep2sindy.operating.quantities import lines_of
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.report.document import Table
from ep2sindy.report.models import with_error
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, ResultTable, View, percent
from ep2sindy.studies.processes import (
    NO_ZONES,
    ComparedProcess,
    Zones,
    compared_processes,
    ends_of,
)

N_COLUMNS = 8  # most points side by side

CAPTION = (
    "Mean rate of each process over the record of each point: by the law's terms at the record's "
    "states (filled, with 95 % intervals by the jackknife), and in the record (open). Thin lines "
    "only join the points: between them there is no record to take the mean over."
)
NOTE = (
    "Means over each record, of the law's terms at the record's states. ±: half the 95 % interval "
    "by the jackknife: how far the law moves if a point is left out; what is known has none."
)
BESIDE = " In brackets: the rate over that in the record."


@dataclass(frozen=True, eq=False)
class PointProcess:
    """A process of a law at one operating point, in SI per second.

    left_out: its mean rate by the law of the other points; NaN if these do not suffice for one.
    """

    record: OperatingRecord
    process: ComparedProcess
    left_out: float

    @property
    def modelled(self) -> float:
        return float(self.process.modelled.mean())

    @property
    def recorded(self) -> float:
        """The mean rate in the record; NaN if it does not give it."""
        recorded = self.process.recorded
        return float("nan") if recorded is None else float(recorded.mean())

    @property
    def reach(self) -> float:
        """Half the 95 % interval of the mean rate; NaN if it is not known."""
        return float(ndtri(0.975)) * self.process.std

    @property
    def left_out_error(self) -> float:
        """Relative to the record, or to the law of all points where the record does not give it."""
        return self.left_out / (self.modelled if np.isnan(self.recorded) else self.recorded) - 1.0

    @property
    def unit(self) -> str:
        """Unit of the rate on the record's clock."""
        giver, taker = self.process.ends
        return self.record.run.clock.rate_unit(self.record.run.units[giver or taker])

    def cell(self, scale: float) -> str:
        """The rate over a scale, with its error, and in brackets its ratio to the record's."""
        text = with_error(self.modelled / scale, self.reach / scale or np.nan)
        return text if np.isnan(self.recorded) else f"{text} ({self.process.ratio:.2f})"


def point_processes(choice: LawChoice, zones: Mapping[str, Zones]) -> list[PointProcess]:
    """The processes of a law at every record; none unless it was found under `Roles`.

    zones: what the record of each point tells, by its label; a point that is absent tells nothing.
    """
    trial, fits, found = choice.choice, choice.choice.fits, []
    if not fits.relations.common.processes:
        return []
    pairs = zip(choice.records, fits.relations.at(fits.points), strict=True)
    for k, (record, held) in enumerate(pairs):
        at_point = partial(_at_point, record, held, zones.get(record.label, NO_ZONES))
        left_out = {}
        if choice.law.covariance is not None:  # the points suffice for laws without one of them
            others = at_point(fits.law_without(k, trial.functions))
            left_out = {process.ends: float(process.modelled.mean()) for process in others}
        for process in at_point(choice.law):
            found.append(PointProcess(record, process, left_out.get(process.ends, float("nan"))))
    return found


def _at_point(
    record: OperatingRecord, held: Constraint, zones: Zones, law: OperatingLaw
) -> list[ComparedProcess]:
    """The processes of a law at a record, without terms of states that have no roles."""
    moving = [each for each in (*held.processes, *held.known) if not each.role.endswith(ROLELESS)]
    model, ends = read_law(law, record.parameters), [ends_of(process) for process in moving]
    compared = compared_processes(model, held, record.run, zones)
    return [process for process in compared if process.ends in ends]


def add_processes(
    report: Report, choice: LawChoice, zones: Mapping[str, Zones], labels: Mapping[str, str]
) -> None:
    """Add the table of processes by operating point, and their figure; nothing without processes.

    zones: see `point_processes`. labels: of the parameters, on axes.
    """
    found = point_processes(choice, zones)
    if not found:
        return
    points = [record.parameters for record in choice.records]
    report.section("Processes over the operating points")
    table = ResultTable(found, _metrics(list(points[0])))
    note = NOTE + BESIDE * any(np.isfinite(each.recorded) for each in found)
    shown = Table(*_side_by_side(found, _on_a_line(choice.records)), note=note + _left_out(found))
    report.table("processes", table, shown=shown)
    report.add(Table(table.screen(), title="at every point, in SI", page_only=True))
    trends = lines_of(points)
    for k, unit in enumerate(dict.fromkeys(each.unit for each in found if trends)):
        rates = _rates([each for each in found if each.unit == unit])
        draw = partial(processes_figure, rates, trends=trends, labels=labels, unit=unit)
        report.figure(f"processes_{k + 1}" if k else "processes", draw, CAPTION)


def _metrics(parameters: Sequence[str]) -> list[Metric[PointProcess]]:
    return [
        Metric("process", lambda each: each.process.name, View.SHOWN),
        *map(of_parameter, parameters),
        Metric("modelled", lambda each: each.modelled, View.SHOWN, "by the law"),
        Metric("reach", lambda each: each.reach, View.SHOWN, "±"),
        Metric("recorded", lambda each: each.recorded, View.SHOWN, "in the record"),
        Metric("ratio", lambda each: each.process.ratio, View.SHOWN, format="{:.2f}"),
        Metric("r2", lambda each: each.process.r2, View.SHOWN, "R2", "{:.3f}"),
        Metric("left_out", lambda each: each.left_out, View.SHOWN, "by the law of the others"),
        Metric("terms", lambda each: ", ".join(each.process.coef), View.SHOWN),
    ]


def of_parameter(name: str) -> Metric[Any]:
    """The value of a parameter at the point of a record."""
    return Metric(name, lambda each: each.record.parameters[name], View.SHOWN, name, "{:g}")


def _on_a_line(records: Sequence[OperatingRecord]) -> list[OperatingRecord]:
    """All records, or of many some of the longest line along one parameter, evenly chosen."""
    if len(records) <= N_COLUMNS:
        return list(records)
    lines = [
        sorted(
            (r for r in records if held.items() <= r.parameters.items()),
            key=lambda record: record.parameters[along],
        )
        for along, held in lines_of([record.parameters for record in records])
    ]
    longest = max(lines, key=len, default=list(records))
    n_shown = min(len(longest), N_COLUMNS)
    return [longest[k] for k in np.linspace(0, len(longest) - 1, n_shown).round().astype(int)]


def _side_by_side(
    found: Sequence[PointProcess], records: Sequence[OperatingRecord]
) -> tuple[pd.DataFrame, str]:
    """A row per process, a column per record, and a title of what all rates have in common."""
    first = records[0].parameters
    held = {k: v for k, v in first.items() if all(r.parameters[k] == v for r in records)}
    varying = [name for name in first if name not in held] or list(first)
    rows: dict[str, dict[str, object]] = {}
    for unit in dict.fromkeys(each.unit for each in found):
        own = [each for each in found if each.unit == unit]
        per = 1.0 / own[0].record.run.clock.seconds
        # One power of ten for all rates, so that they can be compared at sight.
        power = int(np.floor(np.log10(max(abs(each.modelled) for each in own) / per or 1.0)))
        power = 0 if -3 <= power <= 3 else power
        words = f"10^{power} {unit}" if power else unit
        for each in [each for each in own if each.record in records]:
            row = rows.setdefault(each.process.name, {"process": each.process.name, "unit": words})
            header = point_label({name: each.record.parameters[name] for name in varying})
            row[header] = each.cell(per * 10.0**power)
    table, title = pd.DataFrame([*rows.values()]), [f"at {point_label(held)}"] if held else []
    if table["unit"].nunique() == 1:
        title.insert(0, f"in {table.pop('unit')[0]}")
    return table, ", ".join(title)


def _left_out(found: Sequence[PointProcess]) -> str:
    """How far rates are off at points left out, in a sentence; of those that are not known."""
    errors = np.abs([each.left_out_error for each in found if each.process.std > 0.0])
    if not errors.size:
        return ""
    beside = "those recorded" if np.isfinite([e.recorded for e in found]).any() else "these"
    text = percent(1)
    return (
        f" By the law of the others, the rates at a point left out differ from {beside} by "
        f"{text(float(np.median(errors)))} in the median, {text(float(errors.max()))} at most."
    )


def _rates(found: Sequence[PointProcess]) -> pd.DataFrame:
    """A row per process, point and kind, with the ends of its interval, as a figure takes them."""
    rows = []
    for each in found:
        per, point = each.record.run.clock.seconds, each.record.parameters
        kinds = {
            "by the law": (each.modelled, each.reach),
            "in the record": (each.recorded, float("nan")),
        }
        for kind, (rate, reach) in kinds.items():
            ends = {"value": per * rate, "low": per * (rate - reach), "high": per * (rate + reach)}
            rows.append({**point, "quantity": each.process.name, "kind": kind, **ends})
    table = pd.DataFrame(rows)
    return table[table["value"].notna()]
