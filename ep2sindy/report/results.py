"""Results as facts: each is described once, and becomes column, cell, JSON and headline.

`Metric` is one value of a record, `ResultTable` a table of records by their metrics. `LABELS` has
the words for headline values, for pages that compare runs and know only the names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Flag, auto
from math import isfinite
from typing import Any, Generic, TypeVar

import numpy as np
import pandas as pd

from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.report.document import cell_text

LABELS = {
    "f_kHz": "frequency",
    "f_per_step": "frequency",
    "f_error": "error of the frequency (relative)",
    "nrmse": "error of the trajectory (standard deviations)",
    "waveform_error": "error of the waveform (standard deviations)",
    "amplitude_ratio": "amplitude (times the data's)",
    "periods": "periods in phase",
    "r2": "R2",
    "r2_test": "R2 on held-out rows",
    "d_pareto": "distance to the corner of the front",
}


# Names of times in files, other than those of metrics.
TIMES = ("t_s", "dt_s", "period_s", "horizon_s", "unit_s")


class View(Flag):
    """Places where a metric appears.

    FILES: tables/*.csv and summary.json. SCREEN: screen and page. HEADLINE: the numbers by which
    runs are compared.
    """

    FILES = auto()
    SCREEN = auto()
    HEADLINE = auto()
    SHOWN = FILES | SCREEN
    ALL = SHOWN | HEADLINE


Record = TypeVar("Record")
Outer = TypeVar("Outer")
Metrics = Sequence["Metric[Record]"]
Values = Sequence[tuple["Metric[Any]", Any]]


@dataclass(frozen=True)
class Metric(Generic[Record]):
    """One value of a record, in SI unless its key says otherwise.

    key: its name in files and headlines. value: function that takes it from a record; a mapping
    gives one value for each state (or other part), in CSV files in columns `<key>_<state>`.
    heading: of its column on the screen, by default the key; `{}` in it stands for the state, and
    for nothing in a table with a row for each state. format: of its cell, such as `{:.3f}` (a dash
    for a missing number), or a function of the value; three digits by default.
    """

    key: str
    value: Callable[[Record], Any]
    view: View = View.FILES
    heading: str = ""
    format: str | Callable[[Any], object] = ""

    def cell(self, value: Any) -> object:
        """A value formatted for reading."""
        if callable(self.format):
            return self.format(value)
        if isinstance(value, bool | np.bool_):
            return "yes" if value else "no"
        if not self.format:
            return value
        return "-" if value is None or value != value else self.format.format(value)

    def columns(self, value: Any) -> dict[str, Any]:
        """The value by CSV column: one column, or one for each state."""
        if not isinstance(value, Mapping):
            return {self.key: value}
        return {f"{self.key}_{part}": each for part, each in value.items()}

    def cells(self, value: Any) -> dict[str, object]:
        """The formatted value by heading: one cell, or one for each state."""
        heading = self.heading or self.key.replace("_", " ")
        if not isinstance(value, Mapping):
            return {heading.replace("{}", "").strip(): self.cell(value)}
        return {heading.format(part): self.cell(each) for part, each in value.items()}

    def on(self, clock: Clock) -> Metric[Record]:
        """The same metric by the name, and in the unit, of the clock's values: see `Clock.key`."""
        key, factor = clock.key(self.key)
        made: Any = replace(self, key=key)
        if factor == 1.0:
            return made
        return replace(made, value=lambda record: factor * self.value(record))

    def of(
        self, part: Callable[[Outer], Record], key: str = "{}", view: View = View.ALL
    ) -> Metric[Outer]:
        """The same metric for a record that contains this record as a part.

        part: takes this record from the outer one. key: the new name, with `{}` for the old one.
        view: places to appear in, limited to the present ones.
        """
        made: Any = replace(self, key=key.format(self.key), view=self.view & view)
        return replace(made, value=lambda outer: self.value(part(outer)))  # of another record


@dataclass(frozen=True, eq=False)
class ResultTable(Generic[Record]):
    """Records, by name or in a sequence without names, and their metrics."""

    records: Mapping[str, Record] | Sequence[Record]
    metrics: Metrics[Record]

    def csv(self, heading: str = "", *, by_state: bool = False) -> pd.DataFrame:
        """A row per record, or the columns alone. heading: of that of names, left out if empty.

        by_state: a row per record and state instead, in which a metric without states is repeated.
        """
        rows = [
            first | part
            for first, values in self._rows(heading, View.FILES)
            for part in _parts(values, Metric.columns, by_state=by_state)
        ]
        known = None if rows else [*filter(None, [heading]), *(m.key for m in self._in(View.FILES))]
        return pd.DataFrame(rows, columns=known)

    def screen(self, heading: str = "", *, by_state: bool = False) -> pd.DataFrame:
        """A row of formatted cells per record.

        by_state: a row per record and state instead. The name, and metrics without states, are then
        shown only in a record's first row. Columns in which no cell has a value are left out.
        """
        rows: list[dict[str, object]] = []
        for first, values in self._rows(heading, View.SCREEN):
            again = {h for m, v in values if not isinstance(v, Mapping) for h in m.cells(v)}
            for k, part in enumerate(_parts(values, Metric.cells, by_state=by_state)):
                blank = dict.fromkeys([*first, *again] if k else [], "")
                rows.append(first | part | blank)
        table = pd.DataFrame(rows)
        empty = [n for n in table if all(cell_text(cell) in ("", "-") for cell in table[n])]
        return table.drop(columns=empty)

    def json(self) -> dict[str, dict[str, Any]] | list[dict[str, Any]]:
        """Metrics by key, of every record by its name or in turn; values by state stay mappings."""
        rows = [
            {m.key: dict(value) if isinstance(value, Mapping) else value for m, value in values}
            for _, values in self._rows("", View.FILES)
        ]
        if isinstance(self.records, Mapping):
            return dict(zip(self.records, rows, strict=True))
        return rows

    def headline(self) -> dict[str, float]:
        """Headline values by `name/key`, or `name/state/key` if they are by state."""
        found = {}
        for name, record in self._named():
            for metric in self._in(View.HEADLINE):
                value = metric.value(record)
                by_part = value if isinstance(value, Mapping) else {"": value}
                for part, each in by_part.items():
                    found["/".join(filter(None, (name, part, metric.key)))] = float(each)
        return found

    def _rows(self, heading: str, view: View) -> Iterator[tuple[dict[str, Any], Values]]:
        """The cell of the name, if there is a heading, and the values of every record."""
        for name, record in self._named():
            values = [(metric, metric.value(record)) for metric in self._in(view)]
            yield {heading: name} if heading else {}, values

    def _named(self) -> Iterator[tuple[str, Record]]:
        if isinstance(self.records, Mapping):
            yield from self.records.items()
        else:
            yield from (("", record) for record in self.records)

    def _in(self, view: View) -> list[Metric[Record]]:
        return [metric for metric in self.metrics if view in metric.view]


def on_clock(entries: Any, clock: Clock) -> Any:
    """Entries of a summary, with those of `TIMES` under the names of the clock's values."""
    if not isinstance(entries, Mapping):
        return entries
    return {
        clock.key(name)[0] if name in TIMES else name: on_clock(each, clock)
        for name, each in entries.items()
    }


def json_rows(table: pd.DataFrame) -> list[dict[Any, Any]]:
    """Rows of a table for `summary.json`; a missing value becomes None."""
    return table.astype(object).where(table.notna(), None).to_dict("records")


def percent(digits: int, *, sign: bool = False) -> Callable[[float], str]:
    """A format of fractions such as `12.3 %`, with a dash for a missing number."""

    def text(value: float) -> str:
        return f"{100.0 * value:{'+' if sign else ''}.{digits}f} %" if isfinite(value) else "-"

    return text


def in_words(name: str) -> str:
    """Words for a headline name: `simple/n_i/r2_test` -> `simple, n_i: R2 on held-out rows`.

    Parts without a label stay as they are; in the last part, underscores become blanks.
    """
    *where, what = name.split("/")
    text = LABELS.get(what, what.replace("_", " "))
    return f"{', '.join(LABELS.get(part, part) for part in where)}: {text}" if where else text


def value_text(name: str, value: float, clock: Clock = SECONDS) -> str:
    """A headline value as a cell; a frequency gets its unit, on the given clock."""
    factor = {"f_kHz": 1e3, "f_per_step": 1.0}.get(name.split("/")[-1])
    if factor is not None:
        return clock.frequency_text(factor * value)
    return cell_text(value)


def _parts(
    values: Values, cells: Callable[[Metric[Any], Any], dict[str, Any]], *, by_state: bool
) -> Iterator[dict[str, Any]]:
    """Cells of one record: in one row, or in a row per state of the first metric that has some."""
    if not by_state:
        yield {
            name: cell for metric, value in values for name, cell in cells(metric, value).items()
        }
        return
    for state in next(value for _, value in values if isinstance(value, Mapping)):
        row = {"state": state}
        for metric, value in values:
            row |= cells(metric, value[state] if isinstance(value, Mapping) else value)
        yield row
