"""How the outcome of `trace` reads: the signal, the front, the model that lives, its figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import Discovery
from ep2sindy.figures.fronts import front_figure
from ep2sindy.figures.living import (
    cycle_figure,
    free_run_figure,
    has_waveform,
    waveform_figure,
)
from ep2sindy.library.equations import equation_text
from ep2sindy.model.free_run import FreeRun
from ep2sindy.model.likeness import Verdict
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import LimitCycle
from ep2sindy.report.document import (
    Block,
    Captioned,
    Equation,
    Section,
    Table,
    Text,
    pictures,
    places,
)
from ep2sindy.selection.rule import selected
from ep2sindy.signals.attractor import find_cycle
from ep2sindy.signals.embedding import Chosen
from ep2sindy.signals.trace import Trace
from ep2sindy.studies.source import data_summary
from ep2sindy.studies.trace_judged import paths_off
from ep2sindy.studies.views import (
    coefficients,
    interval_table,
    intervals,
    model_summary,
    rollout_tables,
    shown_equation,
)

CAPTIONS = {
    "free_run": "The model run freely from one sample (colour) over the record that it never saw "
    "(grey): the first periods, and the last.",
    "plane": "The model's cycle in the plane of both states, over the data (grey), and runs from "
    "other starts.",
    "waveform": "One period by phase, shown twice: samples, their waveform, and the model's.",
    "front": "Error of the derivative against number of terms: every candidate that was refined "
    "and run freely; the star is selected, by its free runs.",
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one signal taught.

    states: all of the record, smoothed. measured: what judges, the signal as it was measured; run:
    the model over it, from its first sample smoothed. cycle: of the model, if it has one; share:
    of starts that reach it. label: what the scores are called.
    """

    signal: Trace
    chosen: Chosen
    found: Discovery
    states: Trajectory
    measured: Trajectory
    run: FreeRun
    cycle: LimitCycle | None
    share: float
    label: str

    @property
    def model(self) -> SparseModel:
        return self.found.model

    @property
    def is_held_out(self) -> bool:
        return self.measured.n_samples < self.states.n_samples

    @property
    def searched(self) -> list[str]:
        return self.chosen.embedded.searched

    def models(self) -> dict[str, SparseModel]:
        return {"trace": self.model}

    def tables(self) -> dict[str, pd.DataFrame]:
        fronts = {f"front_{state}": self._front(state) for state in self.searched}
        samples = dict(zip(self.states.state_names, self.states.states.T, strict=True))
        return {
            **fronts,
            **rollout_tables(self.measured, {"trace": self.run}),
            "states": pd.DataFrame({"t_s": self.states.t, **samples}),
            "coefficients": coefficients(self.models(), heading="model"),
        }

    def _front(self, state: str) -> pd.DataFrame:
        front, scores = self.found.fronts[state], self.found.scores[state]
        chosen = selected(front, scores)
        return pd.DataFrame(
            {
                "terms": [c.n_terms for c in front.candidates],
                "r2": [c.r2_train for c in front.candidates],
                "score": scores,
                "selected": [c is chosen for c in front.candidates],
                "text": [equation_text(state, c.coef_by_term) for c in front.candidates],
            }
        )

    def figures(self) -> dict[str, Captioned]:
        held, rollout = self.measured, self.run.rollout
        period_s = self.signal.period_s
        drawn: dict[str, Any] = {
            "free_run": partial(free_run_figure, held, rollout, period_s=period_s)
        }
        if self.cycle is not None:
            plane, paths = held.state_names, paths_off(self.model, self.cycle)
            drawn["plane"] = partial(
                cycle_figure, self.states, self.cycle.states, paths, plane=plane
            )
        if has_waveform(held, rollout):
            drawn["waveform"] = partial(waveform_figure, held, rollout)
        fronts = {state: self.found.fronts[state] for state in self.searched}
        scores = {state: self.found.scores[state] for state in self.searched}
        drawn["front"] = partial(front_figure, fronts, scores, label=self.label)
        return {name: Captioned(draw, CAPTIONS[name]) for name, draw in drawn.items()}

    def sections(self) -> list[Section]:
        return [self._signal_section(), self._search_section(), self._living_section()]

    def _signal_section(self) -> Section:
        signal, embedded = self.signal, self.chosen.embedded
        names = self.states.state_names
        made = f"{self.chosen.embedding.says}, {names[0]} and {names[1]}"
        per_period = signal.period_s / self.states.dt_s
        blocks: list[Block] = [
            Text(
                f"{signal.clock.frequency_text(1.0 / signal.period_s)}, "
                f"{signal.cycle.n_periods:.0f} periods of {per_period:.0f} samples"
            ),
            Text(f"states: {made} ({self.chosen.reason})"),
            Text(
                f"noise, and what is too fast to be followed: {embedded.noise_std:.3g} "
                f"{signal.unit}, {100.0 * embedded.noise_std / signal.x.std():.2g} % of the "
                "standard deviation"
            ),
            *(Text(each) for each in signal.done),
        ]
        return Section(f"The signal {signal.name}", blocks)

    def _search_section(self) -> Section:
        blocks: list[Block] = []
        for state in self.searched:
            table = self._front(state)
            pairs = zip(self.found.fronts[state].candidates, table["selected"], strict=True)
            equations: list[Any] = [
                Equation(state, each.coef_by_term, mark="  <- selected" if chosen else "")
                for each, chosen in pairs
            ]
            rows = table.assign(
                r2=[places(r, 3) for r in table["r2"]],
                score=[places(s, 3) for s in table["score"]],
                text=equations,
            )
            shown = _best_of_sizes(table)
            rows = rows.iloc[shown].drop(columns="selected")
            rows = rows.rename(columns={"r2": "R2", "text": "model"})
            bold = np.flatnonzero(table["selected"].to_numpy()[shown]).tolist()
            blocks.append(
                Table(
                    rows.reset_index(drop=True),
                    title=f"candidates for {state}'",
                    bold=bold,
                    note="Of every size the best three by score, then by R2 of the derivative; "
                    "score: largest deviation of a free run, in units of its bound; one lives.",
                )
            )
        return Section("Search", [*blocks, *pictures(["front"])])

    def _living_section(self) -> Section:
        model, clock = self.model, self.states.clock
        blocks: list[Block] = [Text(self.found.note)] if self.found.note else []
        for state in model.states:
            exact = "known" if state not in self.searched else ""
            blocks.append(shown_equation(model, state, clock, lead=exact))
        blocks += interval_table(model, self.searched, clock)
        where = "held-out record" if self.is_held_out else "whole record, too short to hold out"
        blocks.append(Table(self._table(), title=f"run freely from one sample over the {where}"))
        blocks += [Text(text, warning=warn) for text, warn in self._stability()]
        return Section("Living model", [*blocks, *pictures(["free_run", "plane", "waveform"])])

    def _table(self) -> pd.DataFrame:
        run, name = self.run, self.signal.name
        measured = find_cycle(self.measured.t, self.measured.states[:, :1])
        rows = {
            "verdict": run.text,
            "frequency of the data": run.rollout.clock.frequency_text(
                measured.frequency_Hz if measured else np.nan
            ),
            "frequency error": _percent(run.f_error),
            f"amplitude error of {name}": _percent(run.amplitude_ratio[name] - 1.0),
            f"waveform error of {name}": f"{places(run.waveform_error[name], 3)} std",
            "terms": f"{self._n_terms(known=False)} searched, {self._n_terms(known=True)} known",
        }
        return pd.DataFrame({"": list(rows), "model": list(rows.values())})

    def _stability(self) -> list[tuple[str, bool]]:
        if self.cycle is None:
            return [("the model has no cycle near its run", True)]
        text = (
            f"cycle {self.cycle.stability}: of a departure {self._multiplier:.3g} is left after a "
            f"period (Floquet multiplier); {100.0 * self.share:.0f} % of starts from 0.3 to 3 "
            "times the cycle's states reach it"
        )
        return [(text, self.run.verdict is not Verdict.LIVES)]

    @property
    def _multiplier(self) -> float:
        """The largest modulus beside the flow's own."""
        if self.cycle is None:
            return float("nan")
        return float(np.abs(self.cycle.multipliers[1:]).max())

    def _n_terms(self, *, known: bool) -> int:
        states = [s for s in self.model.states if (s not in self.searched) == known]
        return sum(len(self.model.terms(state)) for state in states)

    def summary(self) -> dict[str, Any]:
        run, name = self.run, self.signal.name
        return {
            "data": data_summary(self.states),
            "signal": {
                "name": name,
                "unit": self.signal.unit,
                "done": list(self.signal.done),
                "embedding": type(self.chosen.embedding).__name__,
                "reason": self.chosen.reason,
                "noise_std": self.chosen.embedded.noise_std,
                "period_s": self.signal.period_s,
            },
            "model": model_summary(self.model) | {"intervals": intervals(self.model)},
            "living": {
                "verdict": run.text,
                "note": self.found.note,
                "held_out": self.is_held_out,
                "f_error": run.f_error,
                "amplitude_ratio": run.amplitude_ratio[name],
                "waveform_error": run.waveform_error[name],
                "n_terms_searched": self._n_terms(known=False),
                "n_terms_known": self._n_terms(known=True),
                "stability": self.cycle.stability if self.cycle else None,
                "multiplier": self._multiplier,
                "share_reaching": self.share,
            },
        }

    def headline(self) -> Mapping[str, float]:
        name = self.signal.name
        return {
            "f_error": self.run.f_error,
            "amplitude_ratio": self.run.amplitude_ratio[name],
            "waveform_error": self.run.waveform_error[name],
            "n_terms": float(self._n_terms(known=False)),
            "multiplier": self._multiplier,
            "share_reaching": self.share,
        }


def _percent(value: float) -> str:
    return "-" if value != value else f"{100.0 * value:.2f} %"


def _best_of_sizes(table: pd.DataFrame, most: int = 3) -> list[int]:
    """Rows of the best of every size: by score, then as they stand."""
    order = table.sort_values(["terms", "score"], kind="stable")
    return sorted(order.groupby("terms").head(most).index.tolist())
