"""A self-sustained model from one measured signal: `+exp=trace`.

States are made of the signal in the ways that the config lists, the first of which look for states
that nobody measured along with their equations. The model is tested on the end of the record, and
by runs from starts off its cycle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import Zone
from ep2sindy.discovery.foresight import is_linear
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.discovery.one_signal import (
    Attempt,
    Preparation,
    StatedFacts,
    best_of,
    fit_offset,
    fitted_part,
    run_on_rest,
    try_in_turn,
)
from ep2sindy.figures.series import free_run_figure
from ep2sindy.forecasting.baselines import AUTOREGRESSION
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.forecasting.skill import MODEL, ForecastSkill
from ep2sindy.library.library import polynomial
from ep2sindy.report.document import Text
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, percent
from ep2sindy.runtime.kept_pieces import Once
from ep2sindy.signals.driving import add_drive, ask_whether_driven, report_unknown_drive
from ep2sindy.signals.signal import Signal, prepare_signal
from ep2sindy.studies.discoveries import add_candidates, add_estimate
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.source import (
    Source,
    columns_beside,
    data_summary,
    in_unit,
    only,
    zone_of,
)
from ep2sindy.studies.study import A_LIST, Fraction, PositiveOrAll, Terms
from ep2sindy.studies.sustained import CAPTIONS, add_cycle
from ep2sindy.studies.views import (
    CYCLE,
    EVALUATED,
    EVALUATION,
    add_forecasts,
    add_samples,
    found_model,
)

NAME = "trace"  # of the model, in files
NOT_EXPLAINED = (
    "equations with hidden states were tried first: none both explains the signal to within its "
    "noise and sustains its oscillation, so states are made by smoothing instead"
)

LINEAR = (
    "nothing beyond a linear autoregression is foreseen, not even for a quarter of a turn: no "
    "equations of a few states explain that, and only linear ones are tried"
)

AR_2 = (
    "what noise drives about a line at one frequency forecasts as well as any autoregression: the "
    "frequency, the damping and the size of the noise are all there is, and an AR(2) says all"
)
AS_WELL = 1.15  # largest ratio of two errors of forecasts that count as equal

ERRORS = (
    "Forecasts: up to a period, where the model was fitted, in standard deviations. Unexplained: "
    "fraction of the next derivative that neighbours in these states leave."
)
PULSES = 1.0  # third moment about the median over the second's 3/2: pulses that stand out upwards


@dataclass(frozen=True)
class Study:
    """Find states and equations of one signal, and test the model on time it has not seen.

    signal: the variable. unit: needed if the data group does not describe the signal, or to
    override its unit; None takes the described unit, or none. offset: added to the samples, in
    SI; fit finds it, for a positive signal that lost its mean.
    inputs: columns next to the signal that drive it. period_s: of a drive that is known by its
    period, which becomes the inputs `cos_drive` and `sin_drive`.
    tried: preparations into states with their libraries, in turn (`Preparation`). Hidden states,
    found along with their equations, end the list if an exact trajectory of these explains the
    signal to its noise and sustains its oscillation. Of the others, those that forecast best where
    they were fitted are taken; of more than two states, only for a signal that does not repeat
    itself. decimate, detrend: see `prepare_signal`. held_out: the fraction at the end of the record
    that is not fitted and serves as the test. keep: whether a run continues with the finished
    searches of one that was interrupted. exclude, relations, rests_at_zero: known of the equations,
    see `StatedFacts`.
    """

    source: Source
    method: AnyMethod
    signal: str
    offset: float | str
    tried: Annotated[Sequence[Preparation], A_LIST]
    decimate: int | str | None
    detrend: bool | str
    held_out: Fraction
    unit: str | None = None
    keep: bool = True
    exclude: Terms | None = None
    relations: Sequence[str] = ()
    rests_at_zero: bool = False
    inputs: Sequence[str] = ()
    period_s: PositiveOrAll = None

    def __post_init__(self) -> None:
        if isinstance(self.offset, str) and self.offset != "fit":
            raise ValueError(f"offset must be a number or fit, got {self.offset!r}")

    @property
    def facts(self) -> StatedFacts:
        """What is known of the equations."""
        barred = {
            state: [str(name) for name in names] for state, names in (self.exclude or {}).items()
        }
        return StatedFacts(barred, self.relations, self.rests_at_zero)

    def run(self, report: Report) -> None:
        field, data = self._sampled(report)
        with resumed(self.keep, report) as keeping:
            signal = self._prepared(data, keeping.once, report)
            self.facts.check(self.tried, signal)
            past = fitted_part(signal, self.held_out)
            linear = is_linear(past)
            if linear:
                report.say(LINEAR)
            beside = columns_beside(self.source.data, field, [self.signal])
            if question := ask_whether_driven(signal, beside):
                report.warn(question)
            attempts = try_in_turn(
                past, self.tried, self.method, facts=self.facts, linear=linear,
                seed=report.seed, progress=report.watch, once=keeping.once,
            )  # fmt: skip
        best = best_of(attempts)
        states, free = run_on_rest(signal, best, progress=report.watch)
        skill = free.forecast
        self._report_choice(signal, best, skill, report, linear=linear)
        seen = len(best.states.signal.t) == len(signal.t)
        where = "all of it, too short to hold out" if seen else "its end, which was not fitted"
        unknown = report_unknown_drive(signal) if free.holds and not question else None
        report.found(
            found_model(
                signal.name,
                free,
                file=NAME,
                picture=f"free_run_{NAME}",
                more=[Text(unknown)] if unknown else [],
                where=where,
                seen=seen,
                lack_of_fit=best.found.lack_of_fit,
            )
        )
        _add_model(report, signal, best, free, where)
        if skill is not None:
            add_forecasts(report, NAME, signal.run, skill)
        _add_signal(report, signal, states, attempts, best)
        fronts = {state: best.found.fronts[state] for state in best.searched}
        add_candidates(report, NAME, replace(best.found, fronts=fronts))
        if best.found.estimate is not None:
            add_estimate(report, signal.name, best.found)

    def _report_choice(
        self, signal: Signal, best: Attempt, skill: ForecastSkill | None, report: Report, *,
        linear: bool,
    ) -> None:  # fmt: skip
        """Tell what the chosen states and model mean. linear: whether the signal is."""
        how = best.states.embedding.how
        if how != "hidden" and not linear and any(each.how == "hidden" for each in self.tried):
            report.say(NOT_EXPLAINED)
        if how in ("derivative", "delays") and (hint := lost_mean(signal)):
            report.warn(hint)
        if best.is_damped_line and skill is not None and _equals_linear(skill):
            report.say(AR_2)

    def _prepared(self, data: Trajectory, once: Once, report: Report) -> Signal:
        """The signal, with its fitted offset if one is asked for."""
        prepare = partial(prepare_signal, decimate=self.decimate, detrend=self.detrend)
        signal = prepare(data)
        if self.offset == "fit":
            past = fitted_part(signal, self.held_out)
            degree = max(2, *(each.degree for each in self.tried))
            value, low, high = fit_offset(
                past, degree, self.method, progress=report.watch, once=once
            )
            signal = prepare(replace(data, states=data.states + value))
            ends = f"95 %: {low:.4g} to {high:.4g}"
            words = f"offset of {value:.4g} {signal.unit} fitted and added ({ends})"
            signal = replace(signal, done=(*signal.done, words))
        for text in signal.done:
            report.say(f"{signal.name}: {text}")
        for text in signal.advice:
            report.warn(text)
        return signal

    def _sampled(self, report: Report) -> tuple[xr.Dataset, Trajectory]:
        zone = zone_of(self.source) or Zone()
        space = [axis for axis, bounds in (("z", zone.z), ("r", zone.r)) if bounds is None]
        data = only(self.source.data, self.signal, self.unit, inputs=self.inputs, without=space)
        source = replace(self.source, data=data)
        if self.unit is not None and data.settings.get("variables") is None:
            step = partial(in_unit, signal=self.signal, unit=self.unit)
            source = replace(source, prepare=[step, *source.prepare])
        drives = [polynomial([self.signal, *self.inputs], degree=1)]
        field, sampled = source.opened(drives, report)
        sampled = sampled if self.period_s is None else add_drive(sampled, self.period_s)
        known = 0.0 if isinstance(self.offset, str) else self.offset
        return field, replace(sampled, states=sampled.states + known)


def _equals_linear(skill: ForecastSkill) -> bool:
    """Whether a model forecasts half a turn as well as an autoregression, but no better."""
    early = skill.horizons_s <= 0.5 * skill.period_s
    if AUTOREGRESSION not in skill.nrmse or not early.any():
        return False
    ratio = skill.nrmse[MODEL][early].mean() / skill.nrmse[AUTOREGRESSION][early].mean()
    return bool(1.0 / AS_WELL < ratio < AS_WELL)


def lost_mean(signal: Signal) -> str | None:
    """A question if the signal is one-sided pulses whose mean is zero; otherwise None.

    A part of a period that is left over moves the mean by up to its part of the record.
    """
    away = signal.x - np.median(signal.x)
    one_way = float(np.mean(away**3) / np.mean(away**2) ** 1.5)
    error = signal.x.std() / signal.n_periods
    if signal.is_positive or not one_way > PULSES or abs(signal.x.mean()) > error:
        return None
    zero = f"{error:.2g} {signal.unit}".removesuffix(" 1")
    return (
        f"did {signal.name} lose its mean, as behind a capacitor? It is pulses to one side whose "
        f"mean is zero to within {zero}. If so, offset=MEAN gives it back (more than "
        f"{-signal.x.min():.3g}; offset=fit looks for it), and simpler equations are tried"
    )


def _add_model(report: Report, signal: Signal, best: Attempt, free: Evaluation, where: str) -> None:
    """Add the model, and how it runs over the samples that were not fitted."""
    model = best.found.model
    note = best.found.note
    report.section("The model", *([note] if note != best.found.lack_of_fit else []))
    report.model(NAME, model, clock=signal.clock)
    draw = partial(free_run_figure, free.record, free.rollout, period_s=signal.period_s)
    report.figure(f"free_run_{NAME}", draw, CAPTIONS["free_run"])
    title = f"run freely from one sample over {where}"
    rows = ResultTable({NAME: free}, [*EVALUATION, *CYCLE])
    report.table("evaluations", rows, by_state=True, title=title, note=EVALUATED)
    if free.cycle_text:
        report.add(Text(free.cycle_text, warning=not free.holds))
    elif signal.cycle is not None:
        report.add(Text("the model has no cycle near its run", warning=True))
    add_cycle(report, NAME, free)
    add_samples(report, free.record, {NAME: free})
    report.headline["n_terms"] = sum(len(model.terms(state)) for state in best.searched)


def _add_signal(
    report: Report, signal: Signal, states: Trajectory, attempts: Sequence[Attempt], best: Attempt
) -> None:
    """Add the signal, the states that were made of it, and other states that were tried."""
    embedding, known = best.states.embedding, best.states.known
    per_period = signal.period_s / states.dt_s
    turns = "periods" if signal.cycle is not None else "turns, which do not repeat themselves,"
    too_fast = "" if embedding.how == "hidden" else ", and what is too fast to be followed"
    percentage = 100.0 * best.noise_std / signal.x.std()
    noise = f"{best.noise_std:.3g} {signal.unit}".removesuffix(" 1")
    moves = ", ".join(f"{state} by {size:.2g}" for state, size in best.process_noise_std.items())
    exact = ", ".join(f"{state}' = {term.replace('*', ' ')}" for state, term in known.items())
    report.section(
        f"The signal {signal.name}",
        f"{signal.clock.frequency_text(signal.frequency_Hz)}, {signal.n_periods:.0f} {turns} of "
        f"{per_period:.0f} samples",
        f"states: {embedding.says}, {', '.join(states.state_names)} ({best.states.reason})"
        f"{'; known: ' if exact else ''}{exact}",
        f"noise{too_fast}: {noise}, {percentage:.2g} % of the standard deviation",
        f"process noise, which moves the states at random in every step: {moves}",
        *signal.done,
    )
    chosen = [attempts.index(best)]
    title, rows = "states tried", ResultTable(attempts, TRIED)
    report.table("tried", rows, title=title, note=ERRORS, bold=chosen)
    samples = dict(zip(states.state_names, states.states.T, strict=True))
    report.samples("states", pd.DataFrame({"t_s": states.t, **samples}))
    report.summary["data"] = data_summary(states)
    report.summary["signal"] = {
        "name": signal.name,
        "unit": signal.unit,
        "done": list(signal.done),
        "period_s": signal.period_s,
        "n_fitted": len(best.states.signal.t),
        "how": embedding.how,
        "n_states": embedding.n_states,
        "reason": best.states.reason,
        "known": dict(known),
        "noise_std": best.noise_std,
        "process_noise_std": best.process_noise_std,
        "lack_of_fit": best.found.lack_of_fit,
        "note": best.found.note,
    }


TRIED: Metrics[Attempt] = [
    Metric("how", lambda tried: tried.states.embedding.how),
    Metric("states", lambda tried: tried.states.embedding.says, View.SCREEN),
    Metric("n_states", lambda tried: tried.preparation.n_states),
    Metric("degree", lambda tried: tried.preparation.degree, View.SHOWN),
    Metric("error", lambda tried: tried.error, View.SHOWN, "error of forecasts", "{:.3f}"),
    Metric("unexplained", lambda tried: tried.fraction, View.SHOWN, format=percent(2)),
]
