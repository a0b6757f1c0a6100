"""A living model from one measured signal: `+exp=trace`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ep2sindy.data.extent import Zone
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import Discovery, discover
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.library.library import polynomial
from ep2sindy.model.free_run import FreeRun, free_run
from ep2sindy.model.stability import share_reaching
from ep2sindy.report.run import Run
from ep2sindy.selection.rule import SystemSelection
from ep2sindy.signals.embedding import Chosen, Delays, Embedding, LogRate, Rate, embed
from ep2sindy.signals.trace import Trace, trace
from ep2sindy.studies.kinds import Count, Deferred, Positive, Share
from ep2sindy.studies.living import cycle_of
from ep2sindy.studies.source import Source, zone_of
from ep2sindy.studies.trace_judged import as_measured, fitted_samples
from ep2sindy.studies.trace_view import Outcome

PULSES = 1.0  # third moment about the median over the second's 3/2: pulses that stand out upwards

# Of each equation where none is known, so that their combinations stay few.
DEPTH_OF_BOTH = 2


@dataclass(frozen=True)
class Study:
    """Make states of one signal, search the equation that is not known, judge it by free run.

    signal: the variable. unit: of one that the data group does not describe, or instead of what it
    says; None: as it says, else none. offset: added to the samples, in SI. embedding: auto,
    log_rate, rate or delays; harmonics: of the period that the smoother follows. decimate,
    detrend: see `trace`. degree: of the library. held_out: the end of the record that the model
    never sees, and is judged on.
    """

    source: Source
    recipe: AnyMethod
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
        signal = trace(data, decimate=self.decimate, detrend=self.detrend)
        for text in signal.done:
            run.say(f"{signal.name}: {text}")
        for text in signal.advice:
            run.warn(text)
        with run.progress(None, "", "states of the signal"):
            chosen = self._embedded(signal)
        if type(chosen.embedding) is not LogRate and (hint := lost_mean(signal)):
            run.warn(hint)
        states = chosen.embedded.run
        n_fitted = fitted_samples(signal, states, self.held_out)
        found = self._found(chosen, states.window(0, n_fitted), run)
        held = states if n_fitted == states.n_samples else states.window(n_fitted, states.n_samples)
        with run.progress(None, "", "free run and limit cycle"):
            return living(signal, chosen, found, states, held, label=self.recipe.selection.label)

    def _sampled(self, run: Run) -> Trajectory:
        zone = zone_of(self.source) or Zone()
        space = [axis for axis, bounds in (("z", zone.z), ("r", zone.r)) if bounds is None]
        data = only(self.source.data, self.signal, self.unit, without=space)
        source = replace(self.source, data=data)
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
        recipe, rule = self.recipe, self.recipe.selection
        if isinstance(rule, SystemSelection):  # what was measured counts, not what is made of it
            from ep2sindy.selection.free_run import (
                FreeRunScore,  # torch, for those alone who refine
            )

            if isinstance(rule, FreeRunScore):
                recipe = replace(recipe, selection=replace(rule, judged=(self.signal,)))
        if not chosen.embedded.terms:
            recipe = replace(recipe, depth=min(recipe.depth, DEPTH_OF_BOTH))
        return discover(
            states,
            polynomial(states.state_names, degree=self.degree),
            recipe,
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
    """What to say of pulses of one sign about a mean of zero; None of other signals."""
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
    """Data read from a file with this variable alone, whatever else a config expects there.

    without: axes that are not asked for. Data that are not read from a file stay as they are.
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


def living(
    signal: Trace,
    chosen: Chosen,
    found: Discovery,
    states: Trajectory,
    held: Trajectory,
    *,
    label: str,
) -> Outcome:
    """The model run freely over the held-out part, against the signal as it was measured."""
    measured = as_measured(signal, held)
    run: FreeRun = free_run(found.model, measured, initial=held.states[0], judged=(signal.name,))
    cycle = cycle_of(run)
    share = float("nan") if cycle is None else share_reaching(found.model, cycle)
    return Outcome(signal, chosen, found, states, measured, run, cycle, share, label)
