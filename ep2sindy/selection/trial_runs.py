"""Trial runs: the cycles of records, and where systems run over what was held out of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from ep2sindy.model.many import DrivenWindows, Ensemble
from ep2sindy.selection.folds import Stretch
from ep2sindy.selection.integral import Records
from ep2sindy.signals.attractor import Cycle, find_cycle
from ep2sindy.signals.spectrum import steps_in

# Of a record, so that its folds leave windows of two: six, less what noise makes of them.
LEAST_PERIODS = 5.5

# Change of every state's amplitude from each third of a record to the next, in one direction, above
# which it spirals: no one cycle has the amplitude of all folds within 10 %.
MOST_DRIFT = 1.1

# Periods of a trial run: enough for a transient to die out. A model without inputs runs on where
# a stretch ends before.
LEAST_RUN, MOST_RUN = 16.0, 30.0


def cycles_of(records: Records, states: Sequence[str]) -> list[Cycle] | str:
    """The cycle of every record, or what stands against there being one."""
    found = []
    for run in records.runs:
        # Samples as they are: a waveform of all periods averages noise, smoothing clips peaks.
        cycle = find_cycle(run.t, run.columns(states))
        name = f"record {run.label!r}" if run.label else "the record"
        if cycle is None:
            return f"{name} has no period"
        if cycle.n_periods < LEAST_PERIODS:
            return f"{name} holds {cycle.n_periods:.1f} periods, not six"
        if _spirals(cycle, run.columns(states)):
            return f"{name} spirals"
        found.append(cycle)
    return found


def _spirals(cycle: Cycle, states: Float[np.ndarray, "samples n_states"]) -> bool:
    """Whether the fundamental of every state grows, or of every state decays, all along."""
    amplitude = []
    for phase, part in zip(np.array_split(cycle.phase, 3), np.array_split(states, 3), strict=True):
        basis = np.column_stack([np.ones_like(phase), np.cos(phase), np.sin(phase)])
        amplitude.append(np.hypot(*np.linalg.lstsq(basis, part, rcond=None)[0][1:]))
    before, after = np.array(amplitude[:2]), np.array(amplitude[1:])
    grows, decays = after > MOST_DRIFT * before, before > MOST_DRIFT * after
    return bool(grows.all() or decays.all())


def paths_over(
    ensemble: Ensemble,
    held: Sequence[Stretch],
    records: Records,
    cycles: Sequence[Cycle],
    n_starts: int,
) -> Iterator[tuple[np.ndarray, np.ndarray, Cycle]]:
    """Times and paths of every system over every stretch that was held out, start by start."""
    joined = np.concatenate(records.smoothed)
    centre, spread = joined.mean(axis=0), joined.std(axis=0)
    for part in held:
        run, x, cycle = records.runs[part.run], records.smoothed[part.run], cycles[part.run]
        per_period = steps_in(1.0, frequency_Hz=cycle.frequency_Hz, dt_s=run.dt_s)
        first, n_samples = part.start, part.stop - part.start
        if not ensemble.inputs:
            n_samples = round(np.clip(n_samples, LEAST_RUN * per_period, MOST_RUN * per_period))
            # Over as many periods, no two at one phase.
            later = np.arange(n_starts) * (1.0 + 1.0 / n_starts) * per_period
            starts = np.minimum(first + later.round().astype(np.int64), part.stop - 1)
            begin = cycle.waveform(cycle.phase[starts]).T
            windows = DrivenWindows.free(begin, step_s=run.dt_s, n_samples=n_samples)
            t = run.dt_s * np.arange(n_samples)
        else:
            if n_samples < LEAST_RUN * per_period:  # inputs end with the record
                first, n_samples = 0, run.n_samples
            windows = DrivenWindows.of(
                run, x, ensemble.states, ensemble.inputs, np.array([first]), n_samples - 1
            )
            t = run.t[first : first + n_samples]
        paths = ensemble.paths(windows, centre=centre, spread=spread)
        for k in range(paths.shape[1]):
            yield t, paths[:, k], cycle
