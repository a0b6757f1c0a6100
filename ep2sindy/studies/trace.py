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
import xarray as xr

from ep2sindy.data.quantities import to_si
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import Zone
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.discovery.one_signal import SignalSearch, choose_attempt, count_fitted, evaluate
from ep2sindy.discovery.signal_unknowns import fit_offset
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Once
from ep2sindy.signals.embedding import Delays, LogRate, Rate
from ep2sindy.signals.trace import Trace, prepare_signal
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.source import Source, zone_of
from ep2sindy.studies.study import Count, Deferred, Positive, Share
from ep2sindy.studies.trace_result import Outcome

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
            self.functions, self.function_degree,
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
        n_fitted = count_fitted(signal, self.held_out)
        past = signal.window(0, n_fitted)
        attempts = self._search.attempts(
            past, signal, seed=run.seed, progress=run.watch, say=run.say, once=once
        )
        best = choose_attempt(attempts)
        if isinstance(best.chosen.embedding, Rate | Delays) and (hint := lost_mean(signal)):
            run.warn(hint)
        return Outcome(evaluate(signal, n_fitted, attempts, progress=run.watch))

    def _signal(self, data: Trajectory) -> Trace:
        return prepare_signal(data, decimate=self.decimate, detrend=self.detrend)

    def _with_offset(self, signal: Trace, data: Trajectory, once: Once, run: Run) -> Trace:
        """The signal with its fitted offset, if one is asked for."""
        if self.offset != "fit":
            return signal
        names = LogRate().names(signal.name)
        library = self._search.library(names, (), max(2, self.degree))
        past = signal.window(0, count_fitted(signal, self.held_out))
        found = fit_offset(past, library, self._search.by_trajectories, run.watch, once)
        moved = self._signal(replace(data, states=data.states + found.value))
        words = (
            f"offset of {found.value:.4g} {signal.unit} fitted and added (95 %: {found.low:.4g} to "
            f"{found.high:.4g})"
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
        with run.progress(None, "", "data"):
            field = source.field()
        sampled = source.sampled(field, [], run)
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
