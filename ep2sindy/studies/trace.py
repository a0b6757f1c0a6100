"""A living model from one measured signal: `+exp=trace`.

States that nobody measured are found along with their equations. If no such equations explain the
signal to its noise, states are made of it by smoothing, and the equations searched by rows. The
model is tested on the end of the record, and by runs from starts off its cycle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import Zone
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.discovery.one_signal import SignalDiscovery, SignalSearch
from ep2sindy.discovery.result import Discovery
from ep2sindy.discovery.signal_unknowns import HiddenStates, fit_offset
from ep2sindy.figures.fronts import front_figure
from ep2sindy.figures.living import cycle_figure, find_waveforms, free_run_figure, waveform_figure
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.library.equations import equation_text
from ep2sindy.model.comparison import Status
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import LimitCycle
from ep2sindy.report.document import (
    Block,
    Captioned,
    Equation,
    Result,
    Section,
    Table,
    Text,
    pictures,
)
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, facts, percent
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Once
from ep2sindy.signals.attractor import find_cycle
from ep2sindy.signals.embedding import Delays, Embedded, LogRate, Rate
from ep2sindy.signals.trace import Trace, prepare_signal
from ep2sindy.studies.forecasts import forecast_errors, forecast_picture, forecast_section
from ep2sindy.studies.library_result import (
    CandidateRow,
    candidate_rows,
    column_note,
    estimate_section,
)
from ep2sindy.studies.living import WAVEFORM
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.source import Source, data_summary, in_unit, only, zone_of
from ep2sindy.studies.study import Count, Positive, Share
from ep2sindy.studies.views import (
    MODEL,
    coefficients,
    display_equation,
    found_model,
    interval_table,
    intervals,
    rollout_tables,
)

NOT_EXPLAINED = (
    "no equations of the signal and states that nobody measured explain it to its noise and live: "
    "states are made by smoothing"
)

PULSES = 1.0  # third moment about the median over the second's 3/2: pulses that stand out upwards


@dataclass(frozen=True)
class Study:
    """Find states and equations of one signal, and test the model on time it has not seen.

    signal: the variable. unit: needed if the data group does not describe the signal, or to
    override its unit; None takes the described unit, or none. offset: added to the samples, in
    SI; fit finds it, for a positive signal that lost its mean.
    embedding: how states are made. hidden: they are found along with their equations; log_rate,
    rate and delays: by smoothing the signal; auto: hidden if an exact trajectory of such equations
    explains the signal to its noise, and lives, else by smoothing. n_states: or auto: two, and
    three as well for a signal that does not repeat itself; of these the ones that forecast best
    where they were fitted. harmonics: of the period, which the smoother follows.
    decimate, detrend: see `prepare_signal`. degree, functions, function_degree: of the library; a
    `?` in a function stands for a number to be fitted, as in `sign(?*v)` and `1/(?+x)`.
    held_out: the share at the end of the record that is not fitted and serves as the test. keep:
    whether a run goes on with the finished searches of one that was broken off.
    """

    source: Source
    method: AnyMethod
    signal: str
    offset: float | str
    embedding: str
    n_states: int | str
    harmonics: Positive
    decimate: int | str | None
    detrend: bool | str
    degree: Count
    functions: Sequence[str]
    function_degree: Count
    held_out: Share
    unit: str | None = None
    keep: bool = True

    def __post_init__(self) -> None:
        if isinstance(self.offset, str) and self.offset != "fit":
            raise ValueError(f"offset must be a number or fit: {self.offset!r} came")
        _ = self._search  # checks the other settings

    @property
    def _search(self) -> SignalSearch:
        return SignalSearch(
            self.method, self.embedding, self.n_states, self.harmonics, self.degree,
            self.functions, self.function_degree, self.held_out,
        )  # fmt: skip

    def compute(self, run: Run) -> Outcome:
        data = self._sampled(run)
        with resumed(self.keep, run) as keeping:
            return self._found_in(data, keeping.once, run)

    def _found_in(self, data: Trajectory, once: Once, run: Run) -> Outcome:
        signal = self._with_offset(self._signal(data), data, once, run)
        for text in signal.done:
            run.say(f"{signal.name}: {text}")
        for text in signal.advice:
            run.warn(text)
        tested = self._search.find(signal, seed=run.seed, progress=run.watch, once=once)
        embedding = tested.best.states.embedding
        if self.embedding == "auto" and not isinstance(embedding, HiddenStates):
            run.say(NOT_EXPLAINED)
        if isinstance(embedding, Rate | Delays) and (hint := lost_mean(signal)):
            run.warn(hint)
        return Outcome(tested)

    def _signal(self, data: Trajectory) -> Trace:
        return prepare_signal(data, decimate=self.decimate, detrend=self.detrend)

    def _with_offset(self, signal: Trace, data: Trajectory, once: Once, run: Run) -> Trace:
        """The signal with its fitted offset, if one is asked for."""
        if self.offset != "fit":
            return signal
        names = LogRate().names(signal.name)
        library = self._search.library(names, (), max(2, self.degree))
        past, method = self._search.fitted_part(signal), self._search.by_trajectories
        value, low, high = fit_offset(past, library, method, run.watch, once)
        moved = self._signal(replace(data, states=data.states + value))
        words = (
            f"offset of {value:.4g} {signal.unit} fitted and added (95 %: {low:.4g} to {high:.4g})"
        )
        return replace(moved, done=(*moved.done, words))

    def _sampled(self, run: Run) -> Trajectory:
        zone = zone_of(self.source) or Zone()
        space = [axis for axis, bounds in (("z", zone.z), ("r", zone.r)) if bounds is None]
        data = only(self.source.data, self.signal, self.unit, without=space)
        source = replace(self.source, data=data)
        if self.unit is not None and data.settings.get("variables") is None:
            step = partial(in_unit, signal=self.signal, unit=self.unit)
            source = replace(source, prepare=[step, *source.prepare])
        _, sampled = source.opened([], run)
        known = 0.0 if isinstance(self.offset, str) else self.offset
        return replace(sampled, states=sampled.states + known)


def lost_mean(signal: Trace) -> str | None:
    """A message if the signal is one-sided pulses about a mean of zero; otherwise None."""
    away = signal.x - np.median(signal.x)
    one_way = float(np.mean(away**3) / np.mean(away**2) ** 1.5)
    if not one_way > PULSES:
        return None
    return (
        f"{signal.name} is pulses that take either sign, as a positive signal does that lost its "
        f"mean in a capacitor: offset=MEAN gives it back (over {-signal.x.min():.3g}; offset=fit "
        "looks for it), and the growth rate with it, which is simpler"
    )


SCORED = (
    "Score against number of terms: the supports that were weighed against each other; the star is "
    "selected."
)


RUN_SCORE = "largest deviation of a free run, in units of its bound; one lives."
CAPTIONS = {
    "free_run": "The model run freely from one sample (colour) over the record that it never saw "
    "(grey): the first periods, and the last.",
    "plane": "The model's cycle in the plane of both states, over the data (grey), and runs from "
    "other starts.",
    "waveform": WAVEFORM,
    "front": "Error of the derivative against number of terms: every candidate that was refined "
    "and run freely; the star is selected, by its free runs.",
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """The model found from one signal, and its tests."""

    tested: SignalDiscovery

    @property
    def chosen(self) -> Embedded:
        return self.tested.best.states

    @property
    def found(self) -> Discovery:
        return self.tested.discovery

    @property
    def label(self) -> str:
        """The name of the scores."""
        return self.found.method.selection.label

    @property
    def by_runs(self) -> bool:
        """Whether whole models were run freely, rather than weighed by their likelihood."""
        return self.found.method.selection.basis == "runs"

    @property
    def run(self) -> Evaluation:
        return self.tested.evaluation

    @property
    def cycle(self) -> LimitCycle | None:
        return self.run.cycle

    @property
    def model(self) -> SparseModel:
        return self.found.model

    @property
    def searched(self) -> list[str]:
        return self.chosen.searched

    def models(self) -> dict[str, SparseModel]:
        return {"trace": self.model}

    def tables(self) -> dict[str, pd.DataFrame]:
        fronts = {f"front_{state}": self._front(state).csv() for state in self.searched}
        run, skill = self.tested.states, self.run.forecast
        samples = dict(zip(run.state_names, run.states.T, strict=True))
        return {
            **fronts,
            **rollout_tables(self.run.record, {"trace": self.run}),
            "states": pd.DataFrame({"t_s": run.t, **samples}),
            "coefficients": coefficients(self.models(), heading="model"),
        } | ({} if skill is None else {"forecasts": forecast_errors(skill)})

    def _front(self, state: str) -> ResultTable[CandidateRow]:
        front = self.found.fronts[state]
        metrics = [m for m in CANDIDATES if m.key != "r2" or front.has_errors]
        return ResultTable(candidate_rows(front), metrics)

    def figures(self) -> dict[str, Captioned]:
        held, rollout = self.run.record, self.run.rollout
        period_s = self.tested.signal.period_s
        drawn: dict[str, Any] = {
            "free_run": partial(free_run_figure, held, rollout, period_s=period_s)
        }
        if self.cycle is not None:
            drawn["plane"] = partial(cycle_figure, self.tested.states, self.cycle)
        if find_waveforms(held, rollout) and self.tested.signal.cycle is not None:
            drawn["waveform"] = partial(waveform_figure, held, rollout)
        fronts = {state: self.found.fronts[state] for state in self.searched}
        drawn["front"] = partial(front_figure, fronts, label=self.label)
        captions = CAPTIONS if self.by_runs else CAPTIONS | {"front": SCORED}
        pictures_of = {name: Captioned(draw, captions[name]) for name, draw in drawn.items()}
        if self.run.forecast is not None:
            pictures_of["forecast"] = forecast_picture(self.tested.states, self.run.forecast)
        return pictures_of

    def in_short(self) -> Result:
        caution = self.run.caution
        return found_model(
            f"Found from {self.tested.signal.name}",
            self.run,
            file="trace",
            picture="free_run",
            more=[Text(caution, warning=True)] if caution else [],
            where=self.tested.where,
            seen=not self.tested.is_held_out,
            misfit=self.found.misfit,
        )

    def sections(self) -> list[Section]:
        forecasts = [] if self.run.forecast is None else [forecast_section(self.run.forecast)]
        search, name = [self._search_section()], self.tested.signal.name
        if (estimate := self.found.estimate) is not None:
            of_model = self.found.noise_test.tested
            search.append(estimate_section(name, estimate, self.tested.states, of_model=of_model))
        return [self._signal_section(), *search, self._living_section(), *forecasts]

    def _signal_section(self) -> Section:
        signal, embedded = self.tested.signal, self.chosen
        names = self.tested.states.state_names
        made = f"{self.chosen.embedding.says}, {', '.join(names[:-1])} and {names[-1]}"
        per_period = signal.period_s / self.tested.states.dt_s
        is_hidden = isinstance(self.chosen.embedding, HiddenStates)
        too_fast = "" if is_hidden else ", and what is too fast to be followed"
        turns = "periods" if signal.cycle is not None else "turns, which do not repeat themselves,"
        blocks: list[Block] = [
            Text(
                f"{signal.clock.frequency_text(1.0 / signal.period_s)}, "
                f"{signal.n_periods:.0f} {turns} of {per_period:.0f} samples"
            ),
            Text(f"states: {made} ({self.chosen.reason})"),
            Text(
                f"noise{too_fast}: {embedded.noise_std:.3g} {signal.unit}, "
                f"{100.0 * embedded.noise_std / signal.x.std():.2g} % of the standard deviation"
            ),
            *(Text(each) for each in signal.done),
            *(Text(each.text) for each in self.tested.attempts),
        ]
        return Section(f"The signal {signal.name}", blocks)

    def _search_section(self) -> Section:
        blocks: list[Block] = []
        score = RUN_SCORE if self.by_runs else column_note(self.label)
        for state in self.searched:
            front = self._front(state)
            table = front.csv()
            order = table.sort_values(["terms", "score"], kind="stable")
            shown = sorted(order.groupby("terms").head(3).index.tolist())  # the best of every size
            blocks.append(
                Table(
                    front.screen().iloc[shown].reset_index(drop=True),
                    title=f"candidates for {state}'",
                    bold=np.flatnonzero(table["selected"].to_numpy()[shown]).tolist(),
                    note=f"Of every size the best three. Score: {score}",
                )
            )
        return Section("Search", [*blocks, *pictures(["front"])])

    def _living_section(self) -> Section:
        model, clock = self.model, self.tested.states.clock
        blocks: list[Block] = [Text(self.found.note)] if self.found.note else []
        for state in model.states:
            exact = "known" if state not in self.searched else ""
            blocks.append(display_equation(model, state, clock, lead=exact))
        blocks += interval_table(model, self.searched, clock)
        rows = ResultTable({"model": self}, FREE_RUN).upright("")
        blocks.append(Table(rows, title=f"run freely from one sample over {self.tested.where}"))
        blocks += [Text(text, warning=warn) for text, warn in self._stability()]
        return Section("Living model", [*blocks, *pictures(["free_run", "plane", "waveform"])])

    def _stability(self) -> list[tuple[str, bool]]:
        if self.cycle is None:
            is_asked = self.tested.signal.cycle is not None
            return [("the model has no cycle near its run", True)] if is_asked else []
        return [(self.run.cycle_text, self.run.status is not Status.SUSTAINED)]

    def n_terms(self, *, known: bool) -> int:
        states = [s for s in self.model.states if (s not in self.searched) == known]
        return sum(len(self.model.terms(state)) for state in states)

    def summary(self) -> dict[str, Any]:
        name = self.tested.signal.name
        return {
            "data": data_summary(self.tested.states),
            "signal": {
                "name": name,
                "unit": self.tested.signal.unit,
                "done": list(self.tested.signal.done),
                "embedding": type(self.chosen.embedding).__name__,
                "n_states": self.tested.best.n_states,
                "reason": self.chosen.reason,
                "noise_std": self.chosen.noise_std,
                "period_s": self.tested.signal.period_s,
            },
            "model": facts(self.model, MODEL) | {"intervals": intervals(self.model)},
            "states": {
                str(each.n_states): {"error": each.error, "unexplained": each.share}
                for each in self.tested.attempts
            },
            "misfit": self.found.misfit,
            "living": facts(self, FREE_RUN),
            "forecast": self.run.forecast and self.run.forecast.summary(),
        }

    def headline(self) -> Mapping[str, float]:
        return ResultTable([self], FREE_RUN).headline()


def _data_frequency(tested: SignalDiscovery) -> str:
    cycle = find_cycle(tested.evaluation.record.t, tested.evaluation.record.states[:, :1])
    return tested.signal.clock.frequency_text(cycle.frequency_Hz if cycle else float("nan"))


COMPARED = View.JSON | View.HEADLINE
FREE_RUN: Metrics[Outcome] = [
    Metric("status", lambda o: o.run.text, View.JSON),
    Metric("status", lambda o: o.tested.words, View.SCREEN),
    Metric("note", lambda o: o.found.note, View.JSON),
    Metric("held_out", lambda o: o.tested.is_held_out, View.JSON),
    Metric("frequency of the data", lambda o: _data_frequency(o.tested), View.SCREEN),
    Metric("f_error", lambda o: o.run.f_error, View.ALL, "frequency error", percent(2)),
    Metric("amplitude_ratio", lambda o: o.run.amplitude_ratio[o.tested.signal.name], COMPARED),
    Metric(
        "amplitude_error",
        lambda o: {o.tested.signal.name: o.run.amplitude_ratio[o.tested.signal.name] - 1.0},
        View.SCREEN, "amplitude error of {}", percent(2),
    ),
    Metric("waveform_error", lambda o: o.run.waveform_error[o.tested.signal.name], COMPARED),
    Metric(
        "waveform", lambda o: {o.tested.signal.name: o.run.waveform_error[o.tested.signal.name]},
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
    Metric("multiplier", lambda o: o.run.multiplier, COMPARED),
    Metric("share_reaching", lambda o: o.run.share_reaching, COMPARED),
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
