"""Free run of a model from one sample of a record, compared with the data's attractor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.comparison import ComparedRecord, FreeRunBounds, Verdict, record_of
from ep2sindy.model.fixed_point import RestPoint, rest_point
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.model.stability import (
    LEAST_WAIT,
    CycleStability,
    LimitCycle,
    limit_cycle,
    periods_to_reach,
    share_reaching,
)
from ep2sindy.runtime.values import check_kind
from ep2sindy.signals.attractor import follow_phase
from ep2sindy.signals.spectrum import DIED_OUT, dominant_frequency


@dataclass(frozen=True, eq=False)
class FreeRun:
    """A model run from one sample over a record, driven by its inputs if it has any.

    Only the second halves are compared, after transients. If the record does not repeat one
    waveform, or has fewer than eight periods, all of it is compared.

    record: the samples that it was run over. f_error: relative error of the frequency.
    amplitude_ratio, waveform_error, distribution: by state, the last two in standard deviations.
    They are NaN for a run that diverged; frequency and waveform errors are also NaN if the record
    or the run has no period.
    periods: number of periods until the model's phase has slipped by a quarter of a period, or
    those of the record if it does not.
    excursion: largest distance from the data's mean, in standard deviations.
    frequency_Hz: by state, NaN if the run diverged or the state died out.
    nrmse: root mean square error over all samples, in standard deviations; NaN if it diverged.
    """

    model: SparseModel
    record: Trajectory = field(repr=False)
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
        """Verdict, with the time from start to divergence if the run diverged."""
        of = f" of {self.rollout.outside}" if self.rollout.outside else ""
        lasted = self.rollout.lasted_text if self.rollout.diverged else ""
        return f"{self.verdict}{of} after {lasted}" if lasted else str(self.verdict)

    def words(self, *, seen: bool, misfit: str = "") -> str:
        """The verdict in words. Over samples that a model was fitted to (`seen`) none lives.

        misfit: why the model does not explain the data, which then are not like it; may be empty.
        """
        if self.verdict is Verdict.ALIKE and misfit:
            return "does not explain the data"
        does = {Verdict.LIVES: "follows", Verdict.FOLLOWS: "follows"}
        does |= {Verdict.ALIKE: "keeps the statistics of"}
        is_kept = seen and self.verdict in does
        return f"{does[self.verdict]} the record it was fitted to" if is_kept else self.text


@dataclass(frozen=True, eq=False)
class FreeCycle:
    """A free run and the limit cycle of its model.

    cycle: None if the run ends on none. share: the share of starts around the cycle that reach it;
    NaN without a cycle. rest: where the model rests inside the cycle, if it does.
    """

    run: FreeRun
    cycle: LimitCycle | None
    share: float
    rest: RestPoint | None = None

    @staticmethod
    def of(run: FreeRun) -> FreeCycle:
        """The cycle on which a free run ends, and how many starts reach it."""
        cycle = cycle_of(run)
        if cycle is None:
            return FreeCycle(run, None, np.nan)
        model, states = run.model, cycle.states
        rest = rest_point(model, states.mean(axis=0), states.std(axis=0), states.min(axis=0) > 0.0)
        return FreeCycle(run, cycle, share_reaching(model, cycle), rest)

    @property
    def multiplier(self) -> float:
        """Largest modulus of the nontrivial Floquet multipliers; NaN without a cycle."""
        if self.cycle is None:
            return float("nan")
        return self.cycle.largest_multiplier

    @property
    def caution(self) -> str:
        """A sentence if the cycle is neutral; else empty."""
        if self.cycle is None or self.cycle.stability is not CycleStability.NEUTRAL:
            return ""
        return (
            "the cycle is neutral: it neither attracts nor repels, and every start has a cycle of "
            "its own, so the model says nothing of what sets the amplitude"
        )

    @property
    def text(self) -> str:
        """The stability of the cycle, in a sentence; empty without a cycle."""
        if self.cycle is None:
            return ""
        wait = periods_to_reach(self.cycle)
        slowly = f", slowly, over {wait:.0f} periods" if wait > LEAST_WAIT else ""
        text = (
            f"The cycle is {self.cycle.stability}: of a departure {self.multiplier:.3g} is left "
            f"after a period (Floquet multiplier); {100.0 * self.share:.0f} % of starts from 0.3 "
            f"to 3 times the cycle's mean reach it{slowly}."
        )
        return text if self.rest is None else f"{text} {self._rest_text(self.rest)}"

    def _rest_text(self, rest: RestPoint) -> str:
        """Where the model rests, and what becomes of a small departure, in a sentence."""
        units, clock = self.run.model.units, self.run.rollout.clock
        place = ", ".join(
            f"{state} = {value:.3g}{'' if units[state] == '1' else f' {units[state]}'}"
            for state, value in zip(self.run.model.states, rest.state.tolist(), strict=True)
        )
        change = "grows" if rest.growth_per_s > 0.0 else "decays"
        rate = f"{clock.seconds * abs(rest.growth_per_s):.3g} {clock.rate_unit('1')}"
        turns = (
            f" and turns at {clock.frequency_text(rest.frequency_Hz)}" if rest.frequency_Hz else ""
        )
        return f"It rests at {place}, where a departure {change} by {rate}{turns}."


def free_run(
    model: SparseModel,
    run: Run,
    *,
    n_samples: int | None = None,
    initial: Float[np.ndarray, " n_states"] | None = None,
    bounds: FreeRunBounds | None = None,
    judged: Sequence[str] | None = None,
) -> FreeRun:
    """Run a model over a record, or its first samples, and compare the attractors.

    run: a Trajectory, or what `discover` takes as one run. initial: the state to start from, in SI;
    None takes the data's. judged: states that determine the verdict and f_error, such as the
    measured one; None takes all.
    Raises ValueError for a judged state that the model does not have.
    """
    check_kind("model", model, SparseModel, "found.model")
    run = trajectory_of(run)
    n_samples = run.n_samples if n_samples is None else min(n_samples, run.n_samples)
    rollout = model.rollout(run, n_samples=n_samples, initial=initial)
    part = run.window(0, n_samples)
    record = record_of(part, model.states)
    bounds = bounds or FreeRunBounds()
    likeness = ours = record.likeness(rollout.states, bounds)
    if judged is not None:
        columns = columns_of(model.states, judged)
        some = record_of(part, judged)
        ours = some.likeness(rollout.states[:, columns], bounds)
    by_state = {
        name: MappingProxyType(dict(zip(model.states, values.tolist(), strict=True)))
        for name, values in likeness.by_state.items()
    }
    return FreeRun(
        model=model,
        record=part,
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


def cycle_of(run: FreeRun) -> LimitCycle | None:
    """The closed orbit on which a free run ends."""
    if run.model.inputs or run.rollout.diverged or run.verdict is Verdict.DIES_OUT:
        return None
    frequency_Hz = np.nanmax(list(run.frequency_Hz.values()), initial=0.0)
    if not frequency_Hz > 0.0:
        return None
    return limit_cycle(run.model, run.rollout.states[-1], period_s=1.0 / frequency_Hz)


def columns_of(states: Sequence[str], judged: Sequence[str] | None) -> list[int]:
    """Column indices of the judged states, None meaning all; ValueError for an unknown state."""
    names = list(states if judged is None else judged)
    if not names or not set(names) <= set(states):
        raise ValueError(f"judged must name some of the states {list(states)}: {names} came")
    return [list(states).index(name) for name in names]


def samples_in(run: Trajectory, duration_s: float) -> int:
    """Number of samples in the first `duration_s`, or of all samples if the data end earlier.

    Raises ValueError for a duration that holds fewer than two samples.
    """
    n = int(np.searchsorted(run.t, run.t[0] + duration_s * (1 + 1e-9), side="right"))
    if n < 2:
        raise ValueError(
            f"a window must hold two samples: {duration_s:g} s was asked of steps of {run.dt_s:g} s"
        )
    return n


def _periods_kept(record: ComparedRecord, states: np.ndarray) -> float:
    """Periods of the data until the run's phase is a quarter off; NaN for data without a period."""
    if record.cycle is None:
        return float("nan")
    frequency_Hz, n = record.cycle.frequency_Hz, len(states)
    straight = 2.0 * np.pi * frequency_Hz * (record.t[:n] - record.t[0])
    if n < 4 or not (states.std(axis=0) > 0.0).all():
        return 0.0
    shares = np.abs(record.cycle.harmonics[0]) / record.std
    leader = int(np.argmax(shares))
    ours, theirs = (
        follow_phase(record.t[:n], values[:n, leader], straight)
        for values in (record.states, states)
    )
    slip = theirs - ours
    slip -= 2.0 * np.pi * np.round(slip[0] / (2.0 * np.pi))
    off = np.flatnonzero(np.abs(slip) > 0.5 * np.pi)
    last = off[0] if off.size else n - 1
    return float((record.t[last] - record.t[0]) * frequency_Hz)


def _frequencies(
    model: SparseModel, rollout: Rollout, record: ComparedRecord
) -> Mapping[str, float]:
    found = {}
    for k, (name, column) in enumerate(zip(model.states, rollout.states.T, strict=True)):
        alive = column[len(column) // 2 :].std() > DIED_OUT * record.std[k]
        steady = alive and not rollout.diverged
        found[name] = dominant_frequency(rollout.t, column) if steady else float("nan")
    return MappingProxyType(found)


def _nrmse(rollout: Rollout, record: ComparedRecord) -> float:
    if rollout.diverged:
        return float("nan")
    off = (rollout.states - record.states) / zero_to_one(record.states.std(axis=0))
    return float(np.sqrt(np.mean(np.square(off))))
