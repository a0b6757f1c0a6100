"""A model run freely from one sample of a record: does it stay on the data's attractor?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from ep2sindy.data.scales import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.signals.attractor import (
    Cycle,
    distribution_distances,
    find_cycle,
    phase_along,
    spectrum_distance,
    waveform_errors,
)
from ep2sindy.signals.spectrum import dominant_frequency

LONG = 8.0  # periods of a record whose first half may be left out as a transient
DEAD = 0.1  # of the data's spread: a state that varies less in the second half has died out


class Verdict(StrEnum):
    """How a free run ends, the best first."""

    LIVES = "lives"
    SLIPS = "slips"
    WRONG_CYCLE = "wrong cycle"
    DIES_OUT = "dies out"
    LEAVES_DOMAIN = "leaves the domain"
    DIVERGES = "diverges"


@dataclass(frozen=True)
class Bounds:
    """How close a model that lives stays to the data.

    frequency, amplitude: relative error of the frequency and of each state's standard deviation.
    waveform: RMS difference of the waveforms, in standard deviations. For records without a
    period, distribution: Wasserstein distance of each state's distribution, in standard
    deviations, and spectrum: share of the power in other bands; or twice as far as the two halves
    of the data are apart, where that is more.
    """

    frequency: float = 0.01
    amplitude: float = 0.1
    waveform: float = 0.2
    distribution: float = 0.2
    spectrum: float = 0.3

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0.0:
                raise ValueError(f"the bound {name} must be positive: {value} came")


@dataclass(frozen=True, eq=False)
class FreeRun:
    """A model run from one sample over a record, driven by its inputs if it has any.

    Compared are the second halves, where transients are over; all of a record that has no period,
    or less than eight. f_error: relative, of the frequency. amplitude_ratio, waveform_error (in
    standard deviations), distribution (the same): by state. NaN where they are not known: all of a
    run that diverged, frequency and waveform where the record or the run has no period. periods:
    until the model's phase has slipped by a quarter, or those of the record. excursion: largest
    distance from the data's mean, in standard deviations. frequency_Hz: by state; nrmse: root mean
    square error over all samples in standard deviations. NaN where it diverged, or died out.
    """

    model: SparseModel
    rollout: Rollout
    verdict: Verdict
    f_error: float
    amplitude_ratio: Mapping[str, float]
    waveform_error: Mapping[str, float]
    distribution: Mapping[str, float]
    spectrum: float
    periods: float
    excursion: float
    frequency_Hz: Mapping[str, float]
    nrmse: float

    @property
    def text(self) -> str:
        """The verdict, and how long after its start it diverged."""
        of = f" of {self.rollout.outside}" if self.rollout.outside else ""
        lasted = self.rollout.lasted_text if self.rollout.diverged else ""
        return f"{self.verdict}{of} after {lasted}" if lasted else str(self.verdict)


def free_run(
    model: SparseModel,
    run: Trajectory,
    *,
    n_samples: int | None = None,
    initial: Float[np.ndarray, " n_states"] | None = None,
    bounds: Bounds | None = None,
    judged: Sequence[str] | None = None,
) -> FreeRun:
    """Run a model over a record, or its first samples, and compare the attractors.

    initial: the state to start from, in SI; None takes the data's. judged: states that the verdict
    and f_error are by, such as the one that was measured; None takes all.
    Raises ValueError for a judged state that the model does not have.
    """
    n_samples = run.n_samples if n_samples is None else min(n_samples, run.n_samples)
    rollout = model.rollout(run, n_samples=n_samples, initial=initial)
    record = record_of(run.window(0, n_samples), model.states)
    bounds = bounds or Bounds()
    likeness = ours = record.likeness(rollout.states, bounds)
    if judged is not None:
        columns = columns_of(model.states, judged)
        some = record_of(run.window(0, n_samples), judged)
        ours = some.likeness(rollout.states[:, columns], bounds)
    by_state = {
        name: MappingProxyType(dict(zip(model.states, values.tolist(), strict=True)))
        for name, values in likeness.by_state.items()
    }
    return FreeRun(
        model=model,
        rollout=rollout,
        verdict=Verdict.LEAVES_DOMAIN if rollout.outside else ours.verdict,
        f_error=ours.f_error,
        spectrum=likeness.spectrum,
        periods=_periods_kept(record, rollout.states),
        excursion=record.excursion(rollout.states),
        frequency_Hz=_frequencies(model, rollout, record),
        nrmse=_nrmse(rollout, record),
        **by_state,
    )


@dataclass(frozen=True, eq=False)
class Likeness:
    """How one run compares to a record; the fields are those of `FreeRun`."""

    verdict: Verdict
    f_error: float
    spectrum: float
    by_state: Mapping[str, Float[np.ndarray, " n_states"]]


def deviation(
    f_error: float,
    amplitude_ratio: Float[np.ndarray, " n_states"],
    waveform_error: Float[np.ndarray, " n_states"],
    bounds: Bounds,
) -> float:
    """The largest from the data's cycle, in units of its bound; NaN where there is none."""
    return float(
        max(
            abs(f_error) / bounds.frequency,
            np.abs(amplitude_ratio - 1.0).max() / bounds.amplitude,
            waveform_error.max() / bounds.waveform,
        )
    )


def against_cycle(
    cycle: Cycle, t: Float[np.ndarray, " samples"], states: Float[np.ndarray, "samples n_states"]
) -> tuple[float, Float[np.ndarray, " n_states"], Float[np.ndarray, " n_states"]]:
    """Relative error of the frequency, amplitude ratios, waveform errors; NaN without a cycle."""
    found = find_cycle(t, states, n_harmonics=len(cycle.harmonics))
    if found is None:
        nothing = np.full(states.shape[1], np.nan)
        return np.nan, nothing, nothing
    f_error = found.frequency_Hz / cycle.frequency_Hz - 1.0
    return f_error, found.std / zero_to_one(cycle.std), waveform_errors(cycle, found)


@dataclass(frozen=True, eq=False)
class Record:
    """What runs are compared to: samples, and what they repeat.

    cycle: of the samples, or of a longer record that they are a part of; None without a period.
    """

    t: Float[np.ndarray, " samples"]
    states: Float[np.ndarray, "samples n_states"]
    cycle: Cycle | None
    std: Float[np.ndarray, " n_states"] = field(init=False)

    def __post_init__(self) -> None:
        std = self.states.std(axis=0) if self.cycle is None else self.cycle.std
        object.__setattr__(self, "std", zero_to_one(std))

    def excursion(self, states: Float[np.ndarray, "_ n_states"]) -> float:
        return float((np.abs(states - self.states.mean(axis=0)) / self.std).max())

    def likeness(self, states: Float[np.ndarray, "_ n_states"], bounds: Bounds) -> Likeness:
        """Of a run at the times t; one with fewer samples has diverged."""
        nothing = np.full(states.shape[1], np.nan)
        by_state = dict.fromkeys(("amplitude_ratio", "waveform_error", "distribution"), nothing)
        if len(states) < len(self.t) or not np.isfinite(states).all():
            return Likeness(Verdict.DIVERGES, np.nan, np.nan, by_state)
        half = len(states) // 2 if self._is_long else 0
        late = states[half:]
        by_state["distribution"] = distribution_distances(self.states[half:], late)
        by_state["amplitude_ratio"] = late.std(axis=0) / self.std
        spectrum = spectrum_distance(self.t[half:], self.states[half:], late)
        middle = len(states) // 2
        if (states[middle:].std(axis=0) < DEAD * self.states[middle:].std(axis=0)).all():
            return Likeness(Verdict.DIES_OUT, np.nan, spectrum, by_state)
        if self.cycle is None:
            verdict = self._without_period(by_state["distribution"], spectrum, bounds)
            return Likeness(verdict, np.nan, spectrum, by_state)
        f_error, amplitude, waveform = against_cycle(self.cycle, self.t[half:], late)
        if np.isnan(f_error):
            return Likeness(Verdict.WRONG_CYCLE, f_error, spectrum, by_state)
        by_state |= {"amplitude_ratio": amplitude, "waveform_error": waveform}
        verdict = Verdict.WRONG_CYCLE
        if deviation(0.0, amplitude, waveform, bounds) <= 1.0:
            verdict = Verdict.LIVES if abs(f_error) <= bounds.frequency else Verdict.SLIPS
        return Likeness(verdict, f_error, spectrum, by_state)

    @property
    def _is_long(self) -> bool:
        """Whether half of it holds enough periods to compare."""
        return self.cycle is not None and self.cycle.n_periods >= LONG

    def _without_period(self, distribution: np.ndarray, spectrum: float, bounds: Bounds) -> Verdict:
        half = len(self.t) // 2
        first, second = self.states[:half], self.states[half : 2 * half]
        apart = 2.0 * distribution_distances(first, second)
        apart_spectrum = 2.0 * spectrum_distance(self.t[:half], first, second)
        near = (distribution <= np.maximum(bounds.distribution, apart)).all()
        alike = spectrum <= max(bounds.spectrum, apart_spectrum)
        return Verdict.LIVES if near and alike else Verdict.WRONG_CYCLE


def record_of(run: Trajectory, states: Sequence[str]) -> Record:
    """A trajectory as what runs are compared to."""
    values = run.columns(states)
    return Record(run.t, values, find_cycle(run.t, values))


def columns_of(states: Sequence[str], judged: Sequence[str] | None) -> list[int]:
    """Places of the states that are judged, None meaning all; ValueError for one not there."""
    names = list(states if judged is None else judged)
    if not names or not set(names) <= set(states):
        raise ValueError(f"judged must name some of the states {list(states)}: {names} came")
    return [list(states).index(name) for name in names]


def samples_in(run: Trajectory, duration_s: float) -> int:
    """Number of samples in the first `duration_s`, or in all where the data end before.

    Raises ValueError for a duration that holds fewer than two samples.
    """
    n = int(np.searchsorted(run.t, run.t[0] + duration_s * (1 + 1e-9), side="right"))
    if n < 2:
        raise ValueError(
            f"a window must hold two samples: {duration_s:g} s was asked of steps of {run.dt_s:g} s"
        )
    return n


def _periods_kept(record: Record, states: np.ndarray) -> float:
    """Periods of the data until the run's phase is a quarter off; NaN for data without any."""
    if record.cycle is None:
        return float("nan")
    frequency_Hz, n = record.cycle.frequency_Hz, len(states)
    if n < 4 or not (states.std(axis=0) > 0.0).all():
        return 0.0
    shares = np.abs(record.cycle.harmonics[0]) / record.std
    leader = int(np.argmax(shares))
    ours, theirs = (
        phase_along(record.t[:n], values[:n, leader], frequency_Hz)
        for values in (record.states, states)
    )
    slip = theirs - ours
    slip -= 2.0 * np.pi * np.round(slip[0] / (2.0 * np.pi))
    off = np.flatnonzero(np.abs(slip) > 0.5 * np.pi)
    last = off[0] if off.size else n - 1
    return float((record.t[last] - record.t[0]) * frequency_Hz)


def _frequencies(model: SparseModel, rollout: Rollout, record: Record) -> Mapping[str, float]:
    found = {}
    for k, (name, column) in enumerate(zip(model.states, rollout.states.T, strict=True)):
        alive = column[len(column) // 2 :].std() > DEAD * record.std[k]
        steady = alive and not rollout.diverged
        found[name] = dominant_frequency(rollout.t, column) if steady else float("nan")
    return MappingProxyType(found)


def _nrmse(rollout: Rollout, record: Record) -> float:
    if rollout.diverged:
        return float("nan")
    off = (rollout.states - record.states) / zero_to_one(record.states.std(axis=0))
    return float(np.sqrt(np.mean(np.square(off))))
