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
from ep2sindy.figures.operating import (
    cycle_line_figure,
    cycle_map_figure,
    frequency_scale,
    laws_figure,
    left_out_figure,
)
from ep2sindy.model.likeness import Verdict
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import (
    Block,
    Captioned,
    Equation,
    Picture,
    Section,
    Table,
    Text,
    places,
)
from ep2sindy.studies.parametric.oscillation import OSCILLATING, point_label
from ep2sindy.studies.predict import tables
from ep2sindy.studies.predict.branch import Branch
from ep2sindy.studies.predict.words import ALSO, CAPTIONS, INTERVALS, LEFT_OUT, TRIED


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
            if branch.map:
                drawn, caption = (cycle_map_figure, "map") if len(self.parameters) == 2 else (
                    cycle_line_figure, "line",
                )  # fmt: skip
                draw = partial(
                    drawn, self._of("map", name), self._tables["points"], branch.law.points,
                    branch=name, parameters=self.parameters, labels=self.labels,
                )  # fmt: skip
                found[f"map_{name}"] = Captioned(draw, CAPTIONS[caption])
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
        groups: dict[str, list[Mapping[str, float]]] = {}
        for point in self.points:
            groups.setdefault(self.statuses[point_label(point)], []).append(point)
        lines = [
            f"{len(points)} {status}{'' if status == OSCILLATING else self._at(points)}"
            for status, points in groups.items()
        ]
        if len(self.members) > 1:
            counts = [f"{n_points(len(group))} on the {n}" for n, group in self.members.items()]
            few = min(self.members.values(), key=len)
            lines.append(f"two cycles: {' one, '.join(counts)} one{self._at(few)}")
        return [Text(line) for line in lines]

    def _at(self, points: Sequence[Mapping[str, float]]) -> str:
        """` at V_D_V, mdot_mg_s = (150, 3), (175, 2)`."""
        texts = [", ".join(f"{value:g}" for value in point.values()) for point in points]
        if len(self.parameters) > 1:
            texts = [f"({text})" for text in texts]
        return f" at {', '.join(self.parameters)} = {', '.join(texts)}"

    def _cycle(self, name: str) -> str:
        """Of a heading: nothing where there is but one cycle."""
        return "" if len(self.members) == 1 else f" of the {name} cycle"

    def _structures(self, name: str) -> Section:
        rows = self._of("structures", name).sort_values("error", kind="stable")
        bold = np.flatnonzero(rows["chosen"]).tolist()
        shown = rows.drop(columns=["branch", "chosen"]).rename(columns={"f_error": "f error"})
        shown["f error"] = [_percent(value) for value in rows["f_error"]]
        marks = np.where(rows["chosen"], "  <- chosen", "")
        shown["terms"] = [text + mark for text, mark in zip(rows["terms"], marks, strict=True)]
        title = f"Structure and order{self._cycle(name)}"
        return Section(title, [Table(shown, bold=bold, note=TRIED)])

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
        return Section(f"Law{self._cycle(name)}", [*blocks, Picture(f"laws_{name}")])

    def _left_out(self) -> list[Block]:
        rows = self._tables["left_out"]
        rows = rows.sort_values(["branch", *self.parameters], kind="stable")
        several = len(self.branches) > 1
        columns: dict[str, list[str]] = {"cycle": rows["branch"].tolist()} if several else {}
        columns |= {name: [f"{value:g}" for value in rows[name]] for name in self.parameters}
        columns["enclosed"] = ["yes" if value else "no" for value in rows["enclosed"]]
        factor, unit = frequency_scale(rows["f_kHz"])
        columns[f"f ({unit})"] = [places(factor * value, 2) for value in rows["f_kHz"]]
        columns["f error"] = [_percent(value, sign=True) for value in rows["f_error"]]
        for state in tables.states_of(rows):
            ratios = rows[f"amplitude_{state}"]
            columns[f"amplitude {state}"] = [_percent(r - 1.0, sign=True) for r in ratios]
        for state in tables.states_of(rows):
            columns[f"waveform {state}"] = [places(v, 3) for v in rows[f"waveform_{state}"]]
        columns["verdict"] = rows["verdict"].tolist()
        if several:
            columns["also"] = rows["also"].tolist()
        lines: list[Block] = [Text(self._spread(name)) for name in self.branches]
        table = Table(pd.DataFrame(columns), note=LEFT_OUT + (ALSO if several else ""))
        return [*lines, table, Picture("left_out")]

    def _spread(self, name: str) -> str:
        found = self._numbers(name)
        smooth_f, smooth_amplitude = self.branches[name].smooth
        lead = f"{name} cycle: " if len(self.members) > 1 else ""
        most = f"nine in ten within {_percent(found['f_90'])}"
        if not np.isfinite(found["f_90"]):
            most = "more than one in ten do not oscillate"
        return (
            f"{lead}{found['n_lives']} of {found['n']} live, diverging: {found['diverging']}. "
            f"Errors in the median: frequency {_percent(found['f_median'])} ({most}), the worst "
            "state's amplitude "
            f"{_percent(found['amplitude_median'])} and waveform "
            f"{places(found['waveform_median'], 3)}. The records' own frequencies and amplitudes, "
            f"interpolated by the same functions, miss by {_percent(float(np.median(smooth_f)))} "
            f"and {_percent(float(np.median(smooth_amplitude)))} in the median."
        )

    def _numbers(self, name: str) -> dict[str, float | int]:
        found = self.branches[name].left_out
        f = np.array([abs(each.run.f_error) for each in found])
        f[np.isnan(f)] = np.inf
        ratios = [np.array(list(each.run.amplitude_ratio.values())) for each in found]
        amplitude = np.array([np.abs(each - 1.0).max() for each in ratios])
        waveform = np.array([max(each.run.waveform_error.values()) for each in found])
        return {
            "n": len(found),
            "n_lives": sum(each.run.verdict is Verdict.LIVES for each in found),
            "diverging": sum(each.run.rollout.diverged for each in found),
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
        numbers = self._numbers(next(iter(self.branches)))
        first = {key: float(value) for key, value in numbers.items()}
        return {"n_points": float(len(self.points)), **first, "map_right": right / n}


def n_points(n: int) -> str:
    """`1 point`, `3 points`."""
    return f"{n} point" if n == 1 else f"{n} points"


def _middle(records: Sequence[OperatingRecord]) -> OperatingRecord:
    """The one nearest to the mean of all."""
    values = values_of(records)
    off = (values - values.mean(axis=0)) / zero_to_one(np.ptp(values, axis=0))
    return records[int(np.argmin(np.linalg.norm(off, axis=1)))]


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else float("nan")


def _percent(value: float, *, sign: bool = False) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{100.0 * value:{'+' if sign else ''}.2f} %"


def _with_error(row: Mapping[Any, Any]) -> str:
    reach = 0.5 * (row["high"] - row["low"])
    return f"{row['value']:.3g}" + ("" if np.isnan(reach) else f" ±{reach:.1g}")
