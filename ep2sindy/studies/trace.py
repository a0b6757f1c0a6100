"""A living model from one measured signal: `+exp=trace`.

States that nobody measured are found along with their equations. If no such equations explain the
signal to its noise, states are made of it by smoothing, and the equations searched by rows. The
model is tested on the end of the record, and by runs from starts off its cycle.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from ep2sindy.data.coerce import Task
from ep2sindy.data.conversion import to_si
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import Zone
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.fitted_functions import FITTED, fit_functions
from ep2sindy.discovery.method import AnyMethod, Regression, TrajectorySearch
from ep2sindy.discovery.result import Discovery
from ep2sindy.estimation.explanation import FIRST_MAX_TERMS
from ep2sindy.forecasting.calibration import calibrate
from ep2sindy.forecasting.skill import forecast_skill
from ep2sindy.forecasting.tracking import track
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import relations_of
from ep2sindy.model.comparison import REPEATS
from ep2sindy.model.free_run import free_run
from ep2sindy.regression.searches import BestSubset
from ep2sindy.regression.weak import WeightedWeak
from ep2sindy.report.run import Run
from ep2sindy.selection.rule import SystemSelection
from ep2sindy.signals.embedding import (
    AnyEmbedding,
    Chosen,
    Delays,
    Embedded,
    LogRate,
    Rate,
    embed,
    unexplained,
)
from ep2sindy.signals.trace import Trace, from_one_signal
from ep2sindy.studies.living import FreeCycle
from ep2sindy.studies.source import Source, zone_of
from ep2sindy.studies.study import Count, Deferred, Positive, Share
from ep2sindy.studies.trace_hidden import fit_offset, names_of, search_hidden
from ep2sindy.studies.trace_result import (
    Attempt,
    Outcome,
    choose_attempt,
    error_where_fitted,
    states_before,
    with_all_states,
)

PULSES = 1.0  # third moment about the median over the second's 3/2: pulses that stand out upwards

# Candidates per equation if no equation is known, so that there are few combinations.
DEPTH_OF_BOTH = 2

NOT_EXPLAINED = (
    "no equations of the signal and states that nobody measured explain it to its noise and live: "
    "states are made by smoothing"
)

MIN_FITTED = 4.0  # periods that a fitted part must have
MIN_JUDGED = 1.5  # periods that a held-out part must have


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
    decimate, detrend: see `from_one_signal`. degree, functions, function_degree: of the library; a
    `?` in a function stands for a number to be fitted, as in `sign(?*v)` and `1/(?+x)`.
    held_out: the share at the end of the record that is not fitted and serves as the test.
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

    def __post_init__(self) -> None:
        known = ("hidden", *embeddings(self.harmonics, 2))
        if self.embedding not in ("auto", *known):
            raise ValueError(
                f"embedding must be auto, {' or '.join(known)}: {self.embedding!r} came"
            )
        if isinstance(self.offset, str) and self.offset != "fit":
            raise ValueError(f"offset must be a number or fit: {self.offset!r} came")
        if self.n_states != "auto":
            if isinstance(self.n_states, str):
                raise ValueError(f"n_states must be auto or a number: {self.n_states!r} came")
            embeddings(self.harmonics, self.n_states)

    def compute(self, run: Run) -> Outcome:
        data = self._sampled(run)
        signal = self._with_offset(self._signal(data), data, run)
        for text in signal.done:
            run.say(f"{signal.name}: {text}")
        for text in signal.advice:
            run.warn(text)
        n_fitted = count_fitted(signal, self.held_out)
        attempts = self._attempts(signal.window(0, n_fitted), self._numbers(signal), run)
        best = choose_attempt(attempts)
        if isinstance(best.chosen.embedding, Rate | Delays) and (hint := lost_mean(signal)):
            run.warn(hint)
        with run.progress(None, "", "forecasts, free run and limit cycle"):
            return evaluate(signal, n_fitted, best, attempts)

    def _signal(self, data: Trajectory) -> Trace:
        return from_one_signal(data, decimate=self.decimate, detrend=self.detrend)

    def _with_offset(self, signal: Trace, data: Trajectory, run: Run) -> Trace:
        """The signal with its fitted offset, if one is asked for."""
        if self.offset != "fit":
            return signal
        names = LogRate().names(signal.name)
        library = self._library(names, (), max(2, self.degree))
        past = signal.window(0, count_fitted(signal, self.held_out))
        found = fit_offset(past, library, self._by_trajectories, run.watch)
        moved = self._signal(replace(data, states=data.states + found.value))
        words = (
            f"offset of {found.value:.4g} {signal.unit} fitted and added (95 %: {found.low:.4g} to "
            f"{found.high:.4g})"
        )
        return replace(moved, done=(*moved.done, words))

    @property
    def _degrees(self) -> range:
        """Of the libraries of hidden states, the smallest first."""
        return range(min(2, self.degree), self.degree + 1)

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
        known = 0.0 if isinstance(self.offset, str) else self.offset
        return replace(sampled, states=sampled.states + known)

    def _numbers(self, signal: Trace) -> list[int]:
        """Numbers of states to try; a signal of two states either repeats itself or spirals."""
        if self.n_states != "auto":
            return [int(self.n_states)]
        return [2] if repeats(signal) else [2, 3]

    def _attempts(self, past: Trace, numbers: Sequence[int], run: Run) -> list[Attempt]:
        """One with hidden states if it explains the signal, or else one for every number."""
        if self.embedding in ("auto", "hidden"):
            libraries = self._libraries(past, numbers)
            search = search_hidden(past, libraries, self._by_trajectories, run.watch)
            if search.explains or self.embedding == "hidden":
                return [self._attempt(past, search.chosen(past), search.found, run)]
            run.say(NOT_EXPLAINED)
        return [self._smoothed(past, n, run) for n in numbers]

    def _libraries(self, past: Trace, numbers: Sequence[int]) -> Iterator[Library]:
        """Of the signal and hidden states, the smallest first."""
        for n_states in numbers:
            names, functions = names_of(past, n_states), self.functions
            if any(FITTED in text for text in functions):
                functions = self._fitted_functions(self._embedded(past, n_states).embedded)
            for degree in self._degrees:
                yield self._library(names, functions, degree)

    @property
    def _by_trajectories(self) -> TrajectorySearch:
        own = self.method
        if isinstance(own, TrajectorySearch):
            return TrajectorySearch(max_terms=own.max_terms)
        return TrajectorySearch()

    def _smoothed(self, past: Trace, n_states: int, run: Run) -> Attempt:
        with run.progress(None, "", f"{n_states} states of the signal"):
            chosen = self._embedded(past, n_states)
        return self._attempt(past, chosen, self._found(chosen, run), run)

    def _attempt(self, past: Trace, chosen: Chosen, found: Discovery, run: Run) -> Attempt:
        with run.progress(None, "", "forecasts where it was fitted"):
            record = with_all_states(past, chosen)
            tracker = track(found.model, record, measured=[past.name])
            error = error_where_fitted(past, chosen, tracker)
            own = chosen.embedding
            share = unexplained(past, own) if isinstance(own, AnyEmbedding) else None
        return Attempt(chosen, found, tracker, error, share)

    def _embedded(self, signal: Trace, n_states: int) -> Chosen:
        known = embeddings(self.harmonics, n_states)
        if self.embedding in known:
            return embed(signal, known[self.embedding])
        chosen = embed(signal, n_states=n_states)
        (fitting,) = (e for e in known.values() if type(e) is type(chosen.embedding))
        return chosen if fitting == chosen.embedding else replace(
            embed(signal, fitting), reason=chosen.reason
        )  # fmt: skip

    def _library(
        self, names: Sequence[str], functions: Sequence[str], degree: int | None = None
    ) -> Library:
        return polynomial(
            names,
            degree=self.degree if degree is None else degree,
            functions=functions,
            function_degree=self.function_degree,
        )

    def _fitted_functions(self, known: Embedded) -> list[str]:
        """The functions, with numbers where they have a `?`."""
        library_of = partial(self._library, known.run.state_names)
        return fit_functions(
            self.functions, known.run, library_of, partial(_misfit, self.method, known)
        )

    def _found(self, chosen: Chosen, run: Run) -> Discovery:
        method, rule, known = self.method, self.method.selection, chosen.embedded
        if isinstance(rule, SystemSelection):  # the measured signal is judged, not derived states
            from ep2sindy.selection.free_run import (
                FreeRunScore,  # loads torch, only for this rule
            )

            if isinstance(rule, FreeRunScore):
                method = replace(method, selection=replace(rule, judged=(self.signal,)))
        if not known.terms:
            method = replace(method, depth=min(method.depth, DEPTH_OF_BOTH))
        found = discover(
            known.run,
            self._library(known.run.state_names, self._fitted_functions(known)),
            method,
            relations=known.relations,
            terms=known.terms,
            seed=run.seed,
            progress=run.watch,
        )
        # Smoothing has made the states, so intervals would not cover the truth under a misfit.
        return (
            replace(found, model=replace(found.model, covariance=None)) if found.misfit else found
        )


def _misfit(method: AnyMethod, known: Embedded, library: Library) -> float:
    """Share of the derivatives that the largest candidates leave, the product over equations.

    Infinite for a library that cannot be used on the states.
    """
    if isinstance(method, TrajectorySearch):
        method = Regression(
            WeightedWeak(), BestSubset(max_terms=method.max_terms or FIRST_MAX_TERMS)
        )
    try:
        task = Task([known.run], library, relations_of(known.relations), known.terms)
        equations = method.search_equations(task, rng=0)
    except ValueError:
        return float("inf")
    fronts = [each.front for each in equations if each.front.equation in known.searched]
    return float(np.prod([min(1.0 - c.r2_train for c in f.candidates) for f in fronts]))


def embeddings(harmonics: float, n_states: int) -> dict[str, AnyEmbedding]:
    return {
        "log_rate": LogRate(harmonics, n_states),
        "rate": Rate(harmonics, n_states),
        "delays": Delays(harmonics=harmonics, n_states=n_states),
    }


def repeats(signal: Trace) -> bool:
    """True if most of the signal is one cycle, again and again."""
    return signal.cycle is not None and signal.cycle.share >= REPEATS


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


def count_fitted(signal: Trace, held_out: float) -> int:
    """Number of samples to fit; all of them if the record is too short to hold out a part."""
    n = len(signal.t)
    n_fitted = round((1.0 - held_out) * n)
    periods = np.array([n_fitted, n - n_fitted]) / signal.per_period
    enough = periods[0] >= MIN_FITTED and periods[1] >= MIN_JUDGED
    return n_fitted if enough else n


def evaluate(signal: Trace, n_fitted: int, best: Attempt, attempts: Sequence[Attempt]) -> Outcome:
    """Run the model freely over the held-out part, and forecast it again and again.

    The start is fitted to the samples before the held-out part. Without such a part, the whole
    record is compared, from the first of its states.
    """
    chosen, model = best.chosen, best.found.model
    whole = with_all_states(signal, replace(
        chosen, embedded=chosen.embedding.embed(signal)
    ))  # fmt: skip
    own = [signal.name]
    if n_fitted == len(signal.t):
        begin = int(np.searchsorted(signal.t, chosen.embedded.run.t[0]))
        measured = whole.window(begin, whole.n_samples)
        run = free_run(model, measured, initial=chosen.embedded.run.states[0], judged=own)
        return Outcome(signal, best, attempts, whole, measured, FreeCycle.of(run), None)
    past = with_all_states(signal.window(0, n_fitted), chosen)
    before = partial(states_before, signal, chosen.embedding)
    tracker = calibrate(best.tracker, past, states_of=before)
    start = tracker.end_of(before(past)).mean
    measured = whole.window(n_fitted - 1, whole.n_samples)
    run = free_run(model, measured, initial=start, judged=own)
    skill = forecast_skill(
        model,
        whole,
        n_fitted=n_fitted,
        measured=own,
        states_of=before,
        tracker=tracker,
    )
    return Outcome(signal, best, attempts, whole, measured, FreeCycle.of(run), skill)
