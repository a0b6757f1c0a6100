"""What the predicted operating points leave, and how it reads on the terminal and on the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.scales import zero_to_one
from ep2sindy.discovery.operating_points import OperatingRecord, values_of
from ep2sindy.figures.operating import laws_figure, left_out_figure, map_figure
from ep2sindy.model.free_run import Verdict
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Block, Captioned, Equation, Picture, Section, Table, Text
from ep2sindy.studies.parametric.oscillation import OSCILLATING, point_label
from ep2sindy.studies.predict import tables
from ep2sindy.studies.predict.branch import Branch

INTERVALS = (
    "±: half the 95 % interval, from a sandwich with the windows of all points as clusters: how "
    "far other windows of the same records would move a number, not how far a law of this form is "
    "from the truth; for that see the points left out."
)
LEFT_OUT = (
    "Each point in turn read off the law of the others, tied in one refinement, and run freely "
    "from one sample of its record, where the states move least. f, amplitude and waveform: errors "
    "against the record's cycle; enclosed: whether the others enclose it; also: other cycles whose "
    "law oscillates there, inside its points."
)
TRIED = (
    "error: mean over the points left out of the largest deviation from the cycle, in units of its "
    "bound (1 % of frequency, 10 % of amplitude, 0.2 of waveform), 10 at most; laws through "
    "separate refinements. Chosen: the fewest numbers within a standard error of the least."
)
CAPTIONS = {
    "laws": "Coefficients over the operating parameters: refined at each point alone (open, with "
    "95 % intervals) and by the law that all points share (lines). Where the open points leave "
    "the lines by more than their bars, other coefficients make up for it: points are sloppy in "
    "some directions, and the law is fitted to the records, not to them.",
    "left_out": "Points left out, each read off the law of the others. Left: frequency of the free "
    "run over the record's, the band 1 %. Right: errors of amplitude and waveform of each "
    "state, those beyond the panel filled on its edge; band and line are the bounds of a "
    "model that lives.",
    "map": "Frequency and relative amplitude (standard deviation over mean) of the law's cycle "
    "over the operating parameters, and of the simulated points in the same colours (circles); "
    "crosses: simulated points that do not oscillate. Black line: where the model's cycle ends; "
    "dashed: where its fixed point turns stable; grey: the points that the law was fitted to "
    "enclose this. White: no cycle.",
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """Operating points, the law of each cycle, and what it says of points that it has not seen.

    statuses: of every point, by its label. members: parameters of the records, by cycle.
    branches: by cycle, those that have a law. labels: what figures call parameters.
    """

    points: Sequence[Mapping[str, float]]
    statuses: Mapping[str, str]
    records: Sequence[OperatingRecord]
    members: Mapping[str, Sequence[Mapping[str, float]]]
    branches: Mapping[str, Branch]
    labels: Mapping[str, str]

    @property
    def parameters(self) -> list[str]:
        return list(self.points[0])

    def models(self) -> dict[str, SparseModel]:
        """By cycle and number of the record: what the law says there."""
        return {
            f"{name}_{number}": model
            for name, branch in self.branches.items()
            for number, model in enumerate(branch.tied.models)
        }

    def tables(self) -> dict[str, pd.DataFrame]:
        return dict(self._tables)

    @cached_property
    def _tables(self) -> dict[str, pd.DataFrame]:
        return {
            "points": tables.points_table(self.points, self.statuses, self.records, self.members),
            "laws": tables.laws_table(self.branches),
            "coefficients": tables.coefficients_table(self.branches),
            "structures": tables.structures_table(self.branches),
            "left_out": tables.left_out_table(self.branches),
            "at_points": tables.map_table(self.branches, "at_points"),
            "map": tables.map_table(self.branches, "map"),
        }

    def figures(self) -> dict[str, Captioned]:
        found = {
            "left_out": Captioned(
                partial(left_out_figure, self._tables["left_out"]), CAPTIONS["left_out"]
            )
        }
        for name, branch in self.branches.items():
            at_points = self._of("coefficients", name)
            draw = partial(
                laws_figure, at_points, branch.law, parameters=self.parameters, labels=self.labels
            )
            found[f"laws_{name}"] = Captioned(draw, CAPTIONS["laws"])
            if branch.map and len(self.parameters) == 2:
                points = self._tables["points"]
                own = (points["branch"] == name) | (points["branch"] == "")
                draw = partial(
                    map_figure, self._of("map", name), points[own], branch.law.points,
                    parameters=self.parameters, labels=self.labels,
                )  # fmt: skip
                found[f"map_{name}"] = Captioned(draw, CAPTIONS["map"])
        return found

    def _of(self, table: str, branch: str) -> pd.DataFrame:
        rows = self._tables[table]
        return rows[rows["branch"] == branch]

    def sections(self) -> list[Section]:
        return [
            Section("Operating points", self._point_lines()),
            *(self._structures(name) for name, b in self.branches.items() if len(b.trials) > 1),
            *(self._law(name, branch) for name, branch in self.branches.items()),
            Section("Points left out", self._left_out()),
            Section("Where it oscillates", self._map()),
        ]

    def _point_lines(self) -> list[Block]:
        counts: dict[str, list[str]] = {}
        for label, status in self.statuses.items():
            counts.setdefault(status, []).append(label)
        lines: list[Block] = []
        for status, labels in counts.items():
            where = "" if status == OSCILLATING else f": {'; '.join(labels)}"
            lines.append(Text(f"{len(labels)} {status}{where}"))
        if len(self.members) > 1:
            for name, group in self.members.items():
                where = "; ".join(point_label(point) for point in group)
                lines.append(Text(f"{name} cycle, {len(group)} points: {where}"))
        return lines

    def _structures(self, name: str) -> Section:
        rows = self._of("structures", name).drop(columns="branch")
        shown = rows.drop(columns="chosen").sort_values("error", kind="stable")
        places = np.flatnonzero(rows.loc[shown.index, "chosen"]).tolist()
        shown["f_error"] = [_percent(value) for value in shown["f_error"]]
        return Section(f"Structure and order: {name}", [Table(shown, bold=places, note=TRIED)])

    def _law(self, name: str, branch: Branch) -> Section:
        law, found = branch.law, branch.tied
        middle = _middle(branch.fit.records)
        model = law.model_at(middle.parameters)
        equations: list[Block] = [
            Equation(state, model.terms(state), on_screen=True) for state in model.states
        ]
        rows = self._of("laws", name)
        shown = [
            {
                "coefficient": f"{state}: {term}",
                **{r["function"]: _with_error(r) for r in group.to_dict("records")},
            }
            for (state, term), group in rows.groupby(["state", "term"], sort=False)
        ]
        text = (
            f"{len(law.coefficients)} coefficients of {len(law.functions)} functions each, "
            f"{law.coef.size} numbers, from {len(law.points)} records; {found.status}, loss "
            f"{found.loss.mean():.3g} of a constant's. At {point_label(middle.parameters)}:"
        )
        blocks = [Text(text), *equations, Table(pd.DataFrame(shown), note=INTERVALS)]
        return Section(f"Law: {name}", [*blocks, Picture(f"laws_{name}")])

    def _left_out(self) -> list[Block]:
        rows = self._tables["left_out"]
        shown = rows.copy()
        if len(self.branches) == 1:
            shown = shown.drop(columns=["branch", "also"])
        shown = shown.drop(columns="f_model_kHz").rename(columns={"f_error": "f"})
        shown["f"] = [_percent(value, sign=True) for value in rows["f_error"]]
        for column in [c for c in map(str, rows) if c.startswith(("amplitude_", "waveform_"))]:
            change = column.startswith("amplitude_")
            shown[column] = [
                _percent(value - 1.0, sign=True) if change else f"{value:.3f}".replace("nan", "-")
                for value in rows[column]
            ]
        for name in self.parameters:
            shown[name] = [f"{value:g}" for value in rows[name]]
        shown["f_kHz"] = [f"{value:.2f}" for value in rows["f_kHz"]]
        shown["enclosed"] = ["yes" if value else "no" for value in rows["enclosed"]]
        headings = {c: str(c).replace("_", " ") for c in shown if c not in self.parameters}
        shown = shown.rename(columns=headings)
        lines: list[Block] = [Text(self._spread(name)) for name in self.branches]
        return [*lines, Table(shown, note=LEFT_OUT), Picture("left_out")]

    def _spread(self, name: str) -> str:
        found = self._numbers(name)
        smooth_f, smooth_amplitude = self.branches[name].smooth
        return (
            f"{name}: frequency {_percent(found['f_median'])} in the median, nine in ten "
            f"{_percent(found['f_90'])}; {found['diverging']:.0f} of {found['n']:.0f} diverge; "
            f"amplitude {_percent(found['amplitude_median'])}, waveform "
            f"{found['waveform_median']:.3f}. The records' own frequencies and amplitudes, "
            f"interpolated by the same functions, miss by {_percent(float(np.median(smooth_f)))} "
            f"and {_percent(float(np.median(smooth_amplitude)))} in the median."
        )

    def _numbers(self, name: str) -> dict[str, float]:
        found = self.branches[name].left_out
        f = np.array([abs(each.run.f_error) for each in found])
        f[np.isnan(f)] = np.inf
        ratios = [np.array(list(each.run.amplitude_ratio.values())) for each in found]
        amplitude = np.array([np.abs(each - 1.0).max() for each in ratios])
        waveform = np.array([max(each.run.waveform_error.values()) for each in found])
        return {
            "n": float(len(found)),
            "n_lives": float(sum(each.run.verdict is Verdict.LIVES for each in found)),
            "diverging": float(sum(each.run.rollout.diverged for each in found)),
            "f_median": float(np.median(f)),
            "f_90": float(np.quantile(f, 0.9, method="higher")),
            "amplitude_median": _median(amplitude),
            "waveform_median": _median(waveform),
        }

    def _map(self) -> list[Block]:
        right, n, quiet_right, quiet = tables.agreement(self.branches, self.statuses)
        text = f"Oscillating or not, the laws are right at {right} of {n} points"
        if quiet:
            text += (
                f"; at {quiet_right} of the {quiet} that do not oscillate, which no fit has seen"
            )
        pictures = [Picture(f"map_{name}") for name in self.branches]
        drawn = [p for p in pictures if p.name in self.figures()]
        return [Text(f"{text}."), *drawn]

    def summary(self) -> dict[str, Any]:
        right, n, quiet_right, quiet = tables.agreement(self.branches, self.statuses)
        return {
            "points": self._tables["points"].to_dict("records"),
            "branches": {
                name: {
                    "structure": {s: list(t) for s, t in branch.fit.structure.items()},
                    "degree": branch.choice.degree,
                    "status": branch.tied.status,
                    "loss": float(branch.tied.loss.mean()),
                    "left_out": self._numbers(name),
                }
                for name, branch in self.branches.items()
            },
            "oscillating_or_not": {"right": right, "points": n, "quiet": quiet_right, "of": quiet},
        }

    def headline(self) -> dict[str, float]:
        right, n, _, _ = tables.agreement(self.branches, self.statuses)
        first = self._numbers(next(iter(self.branches)))
        return {"n_points": float(len(self.points)), **first, "map_right": right / n}


def _middle(records: Sequence[OperatingRecord]) -> OperatingRecord:
    """The one nearest to the mean of all."""
    values = values_of(records)
    off = (values - values.mean(axis=0)) / zero_to_one(np.ptp(values, axis=0))
    return records[int(np.argmin(np.linalg.norm(off, axis=1)))]


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else float("nan")


def _percent(value: float, *, sign: bool = False) -> str:
    if np.isnan(value):
        return "-"
    return f"{100.0 * value:{'+' if sign else ''}.2f} %"


def _with_error(row: Mapping[Any, Any]) -> str:
    reach = 0.5 * (row["high"] - row["low"])
    return f"{row['value']:.3g}" + ("" if np.isnan(reach) else f" ±{reach:.1g}")
