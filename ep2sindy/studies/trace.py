"""A living model from one measured signal: `+exp=trace`.

The model is tested on the end of the record, and by runs from starts off its cycle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.data.conversion import to_si
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import Zone
from ep2sindy.discovery.discover import Discovery, discover
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.figures.fronts import front_figure
from ep2sindy.figures.living import (
    cycle_figure,
    free_run_figure,
    has_waveform,
    waveform_figure,
)
from ep2sindy.library.equations import equation_text
from ep2sindy.library.library import polynomial
from ep2sindy.model.comparison import Verdict
from ep2sindy.model.free_run import FreeRun, free_run
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.model.stability import LimitCycle
from ep2sindy.report.document import Block, Captioned, Equation, Section, Table, Text, pictures
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, facts, percent
from ep2sindy.report.run import Run
from ep2sindy.selection.rule import SystemSelection
from ep2sindy.signals.attractor import find_cycle
from ep2sindy.signals.embedding import Chosen, Delays, Embedding, LogRate, Rate, embed
from ep2sindy.signals.trace import MIN_PERIODS, Trace, from_one_signal
from ep2sindy.studies.library_result import CandidateRow, candidate_rows
from ep2sindy.studies.living import WAVEFORM, FreeCycle, runs_from
from ep2sindy.studies.source import Source, data_summary, zone_of
from ep2sindy.studies.study import Count, Deferred, Positive, Share
from ep2sindy.studies.views import (
    coefficients,
    display_equation,
    interval_table,
    intervals,
    model_summary,
    rollout_tables,
)

PULSES = 1.0  # third moment about the median over the second's 3/2: pulses that stand out upwards

# Candidates per equation if no equation is known, so that there are few combinations.
DEPTH_OF_BOTH = 2

MIN_JUDGED = 4.0  # periods that a held-out part must have

STARTS = (0.3, 0.6, 1.4, 0.6, 1.4)  # distance from the cycle's middle, relative to its states

CAPTIONS = {
    "free_run": "The model run freely from one sample (colour) over the record that it never saw "
    "(grey): the first periods, and the last.",
    "plane": "The model's cycle in the plane of both states, over the data (grey), and runs from "
    "other starts.",
    "waveform": WAVEFORM,
    "front": "Error of the derivative against number of terms: every candidate that was refined "
    "and run freely; the star is selected, by its free runs.",
}


@dataclass(frozen=True)
class Study:
    """Embed one signal, search its unknown equation, and test the model by a free run.

    signal: the variable. unit: needed if the data group does not describe the signal, or to
    override its unit; None takes the described unit, or none. offset: added to the samples, in SI.
    embedding: auto, log_rate, rate or delays. harmonics: number of harmonics of the period that the
    smoother follows. decimate, detrend: see `from_one_signal`. degree: of the library. held_out:
    the share at the end of the record that is not fitted and serves as the test.
    """

    source: Source
    method: AnyMethod
    signal: str
    offset: float
    embedding: str
    harmonics: Positive
    decimate: int | str | None
    detrend: bool
    degree: Count
    held_out: Share
    unit: str | None = None

    def __post_init__(self) -> None:
        embeddings(self.harmonics)
        if self.embedding not in ("auto", *embeddings(self.harmonics)):
            raise ValueError(
                f"embedding must be auto, {' or '.join(embeddings(self.harmonics))}: "
                f"{self.embedding!r} came"
            )

    def compute(self, run: Run) -> Outcome:
        data = self._sampled(run)
        signal = from_one_signal(data, decimate=self.decimate, detrend=self.detrend)
        for text in signal.done:
            run.say(f"{signal.name}: {text}")
        for text in signal.advice:
            run.warn(text)
        with run.progress(None, "", "states of the signal"):
            chosen = self._embedded(signal)
        if type(chosen.embedding) is not LogRate and (hint := lost_mean(signal)):
            run.warn(hint)
        states = chosen.embedded.run
        n_fitted = count_fitted(signal, states, self.held_out)
        found = self._found(chosen, states.window(0, n_fitted), run)
        held = states if n_fitted == states.n_samples else states.window(n_fitted, states.n_samples)
        with run.progress(None, "", "free run and limit cycle"):
            return evaluate(signal, chosen, found, states, held, label=self.method.selection.label)

    def _sampled(self, run: Run) -> Trajectory:
        zone = zone_of(self.source) or Zone()
        space = [axis for axis, bounds in (("z", zone.z), ("r", zone.r)) if bounds is None]
        data = only(self.source.data, self.signal, self.unit, without=space)
        source = replace(self.source, data=data)
        if self.unit is not None and data.settings.get("variables") is None:
            step = partial(in_unit, signal=self.signal, unit=self.unit)
            source = replace(source, prepare=[step, *source.prepare])
        with run.progress(None, "", "data"):
            field = source.field()
        sampled = source.sampled(field, [], run)
        return replace(sampled, states=sampled.states + self.offset)

    def _embedded(self, signal: Trace) -> Chosen:
        known = embeddings(self.harmonics)
        if self.embedding != "auto":
            return embed(signal, known[self.embedding])
        chosen = embed(signal)
        (fitting,) = (e for e in known.values() if type(e) is type(chosen.embedding))
        return chosen if fitting == chosen.embedding else replace(
            embed(signal, fitting), reason=chosen.reason
        )  # fmt: skip

    def _found(self, chosen: Chosen, states: Trajectory, run: Run) -> Discovery:
        method, rule = self.method, self.method.selection
        if isinstance(rule, SystemSelection):  # the measured signal is judged, not derived states
            from ep2sindy.selection.free_run import (
                FreeRunScore,  # loads torch, only for this rule
            )

            if isinstance(rule, FreeRunScore):
                method = replace(method, selection=replace(rule, judged=(self.signal,)))
        if not chosen.embedded.terms:
            method = replace(method, depth=min(method.depth, DEPTH_OF_BOTH))
        return discover(
            states,
            polynomial(states.state_names, degree=self.degree),
            method,
            relations=chosen.embedded.relations,
            terms=chosen.embedded.terms,
            seed=run.seed,
            progress=run.watch,
        )


def embeddings(harmonics: float) -> dict[str, Embedding]:
    return {
        "log_rate": LogRate(harmonics),
        "rate": Rate(harmonics),
        "delays": Delays(harmonics=harmonics),
    }


def lost_mean(signal: Trace) -> str | None:
    """A message if the signal is one-sided pulses about a mean of zero; otherwise None."""
    away = signal.x - np.median(signal.x)
    one_way = float(np.mean(away**3) / np.mean(away**2) ** 1.5)
    if not one_way > PULSES:
        return None
    return (
        f"{signal.name} is pulses that take either sign, as a positive signal does that lost its "
        f"mean in a capacitor: offset=MEAN gives it back (over {-signal.x.min():.3g}), and the "
        "growth rate with it, which is simpler"
    )


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


def count_fitted(signal: Trace, states: Trajectory, held_out: float) -> int:
    """Number of samples to fit; all of them if the record is too short to hold out a part."""
    n_fitted = round((1.0 - held_out) * states.n_samples)
    periods = states.dt_s / signal.period_s * np.array([n_fitted, states.n_samples - n_fitted])
    enough = periods[0] >= MIN_PERIODS + 0.5 and periods[1] >= MIN_JUDGED
    return n_fitted if enough else states.n_samples


def as_measured(signal: Trace, held: Trajectory) -> Trajectory:
    """Held-out states, with the measured samples of the signal in place of the smoothed ones."""
    first = int(np.searchsorted(signal.t, held.t[0] - 1e-6 * held.dt_s))
    states = held.states.copy()
    states[:, 0] = signal.x[first : first + held.n_samples]
    return replace(held, states=states)


def evaluate(
    signal: Trace,
    chosen: Chosen,
    found: Discovery,
    states: Trajectory,
    held: Trajectory,
    *,
    label: str,
) -> Outcome:
    """Run the model freely over the held-out part, and compare it to the measured signal."""
    measured = as_measured(signal, held)
    run: FreeRun = free_run(found.model, measured, initial=held.states[0], judged=(signal.name,))
    return Outcome(signal, chosen, found, states, measured, FreeCycle.of(run), label)


@dataclass(frozen=True, eq=False)
class Outcome:
    """The model found from one signal, and its tests.

    states: all of the record, smoothed. measured: the test data, with the signal as measured. free:
    the run of the model over them, from their first smoothed sample, and its cycle. label: name of
    the scores.
    """

    signal: Trace
    chosen: Chosen
    found: Discovery
    states: Trajectory
    measured: Trajectory
    free: FreeCycle
    label: str

    @property
    def run(self) -> FreeRun:
        return self.free.run

    @property
    def cycle(self) -> LimitCycle | None:
        return self.free.cycle

    @property
    def model(self) -> SparseModel:
        return self.found.model

    @property
    def is_held_out(self) -> bool:
        return self.measured.n_samples < self.states.n_samples

    @property
    def searched(self) -> list[str]:
        return self.chosen.embedded.searched

    @property
    def data_frequency(self) -> str:
        cycle = find_cycle(self.measured.t, self.measured.states[:, :1])
        frequency_Hz = cycle.frequency_Hz if cycle else float("nan")
        return self.run.rollout.clock.frequency_text(frequency_Hz)

    def models(self) -> dict[str, SparseModel]:
        return {"trace": self.model}

    def tables(self) -> dict[str, pd.DataFrame]:
        fronts = {f"front_{state}": self._front(state).csv() for state in self.searched}
        samples = dict(zip(self.states.state_names, self.states.states.T, strict=True))
        return {
            **fronts,
            **rollout_tables(self.measured, {"trace": self.run}),
            "states": pd.DataFrame({"t_s": self.states.t, **samples}),
            "coefficients": coefficients(self.models(), heading="model"),
        }

    def _front(self, state: str) -> ResultTable[CandidateRow]:
        return ResultTable(candidate_rows(self.found.fronts[state]), CANDIDATES)

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
        drawn["front"] = partial(front_figure, fronts, label=self.label)
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
            front = self._front(state)
            table = front.csv()
            shown = _best_of_sizes(table)
            blocks.append(
                Table(
                    front.screen().iloc[shown].reset_index(drop=True),
                    title=f"candidates for {state}'",
                    bold=np.flatnonzero(table["selected"].to_numpy()[shown]).tolist(),
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
            blocks.append(display_equation(model, state, clock, lead=exact))
        blocks += interval_table(model, self.searched, clock)
        where = "held-out record" if self.is_held_out else "whole record, too short to hold out"
        rows = ResultTable({"model": self}, FREE_RUN).upright("")
        blocks.append(Table(rows, title=f"run freely from one sample over the {where}"))
        blocks += [Text(text, warning=warn) for text, warn in self._stability()]
        return Section("Living model", [*blocks, *pictures(["free_run", "plane", "waveform"])])

    def _stability(self) -> list[tuple[str, bool]]:
        if self.cycle is None:
            return [("the model has no cycle near its run", True)]
        return [(self.free.text, self.run.verdict is not Verdict.LIVES)]

    def n_terms(self, *, known: bool) -> int:
        states = [s for s in self.model.states if (s not in self.searched) == known]
        return sum(len(self.model.terms(state)) for state in states)

    def summary(self) -> dict[str, Any]:
        name = self.signal.name
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
            "living": facts(self, FREE_RUN),
        }

    def headline(self) -> Mapping[str, float]:
        return ResultTable([self], FREE_RUN).headline()


COMPARED = View.JSON | View.HEADLINE
FREE_RUN: Metrics[Outcome] = [
    Metric("verdict", lambda o: o.run.text, View.JSON | View.SCREEN),
    Metric("note", lambda o: o.found.note, View.JSON),
    Metric("held_out", lambda o: o.is_held_out, View.JSON),
    Metric("frequency of the data", lambda o: o.data_frequency, View.SCREEN),
    Metric("f_error", lambda o: o.run.f_error, View.ALL, "frequency error", percent(2)),
    Metric("amplitude_ratio", lambda o: o.run.amplitude_ratio[o.signal.name], COMPARED),
    Metric(
        "amplitude_error", lambda o: {o.signal.name: o.run.amplitude_ratio[o.signal.name] - 1.0},
        View.SCREEN, "amplitude error of {}", percent(2),
    ),
    Metric("waveform_error", lambda o: o.run.waveform_error[o.signal.name], COMPARED),
    Metric(
        "waveform", lambda o: {o.signal.name: o.run.waveform_error[o.signal.name]},
        View.SCREEN, "waveform error of {}", "{:.3f} std",
    ),
    Metric("n_terms", lambda o: o.n_terms(known=False), View.HEADLINE),
    Metric("n_terms_searched", lambda o: o.n_terms(known=False), View.JSON),
    Metric("n_terms_known", lambda o: o.n_terms(known=True), View.JSON),
    Metric(
        "terms", lambda o: f"{o.n_terms(known=False)} searched, {o.n_terms(known=True)} known",
        View.SCREEN,
    ),
    Metric("stability", lambda o: o.cycle.stability if o.cycle else None, View.JSON),
    Metric("multiplier", lambda o: o.free.multiplier, COMPARED),
    Metric("share_reaching", lambda o: o.free.share, COMPARED),
]  # fmt: skip
CANDIDATES: Metrics[CandidateRow] = [
    Metric("terms", lambda row: row.candidate.n_terms, View.SHOWN),
    Metric("r2", lambda row: row.candidate.r2_train, View.SHOWN, "R2", "{:.3f}"),
    Metric("score", lambda row: row.candidate.score, View.SHOWN, format="{:.3f}"),
    Metric("selected", lambda row: row.is_selected),
    Metric("text", lambda row: equation_text(row.candidate.equation, row.terms)),
    Metric("model", lambda row: _marked(row), View.SCREEN),
]


def _marked(row: CandidateRow) -> Equation:
    mark = "  <- selected" if row.is_selected else ""
    return Equation(row.candidate.equation, row.terms, mark=mark)


def _best_of_sizes(table: pd.DataFrame, most: int = 3) -> list[int]:
    """The best rows of every size, ordered by score and then by position."""
    order = table.sort_values(["terms", "score"], kind="stable")
    return sorted(order.groupby("terms").head(most).index.tolist())


def paths_off(model: SparseModel, cycle: LimitCycle) -> list[Rollout]:
    """Runs from states off the cycle, some nearer to its middle and some farther."""
    middle = cycle.states.mean(axis=0)
    places = np.arange(len(STARTS)) * len(cycle.states) // len(STARTS)
    starts = middle + np.array(STARTS)[:, None] * (cycle.states[places] - middle)
    starts[:, 0] = [_inside(start, cycle.states[:, 0]) for start in starts[:, 0]]
    return runs_from(starts, model, cycle)


def _inside(value: float, states: np.ndarray) -> float:
    """A start value with the sign that the signal has on the cycle, if that is fixed."""
    return max(value, 0.5 * float(states.min())) if (states > 0.0).all() else value
