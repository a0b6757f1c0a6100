"""Comparison of a model run with a record: by the cycle, or by means and amplitudes without one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.signals.attractor import Cycle, find_cycle, waveform_errors, white_variance
from ep2sindy.signals.spectrum import DECAYED, dominant_frequency, has_decayed, power_spectrum

LONG = 8.0  # fewest periods in a record whose first half may be left out as a transient

# Depth below zero, in standard deviations of the data, from which a density counts as negative.
BELOW_ZERO = 1e-3


# Change of the amplitude from the first third of a record to the last from which the record grows
# or decays.
SPIRALS = 1.5

# Error over the first period, in standard deviations, above which a run does not sustain its
# oscillation that began on the data; noise in the samples, in the same unit, above which it is not
# asked for, since the start is as uncertain.
FIRST_PERIOD, TOO_NOISY = 0.3, 0.1


class Status(StrEnum):
    """What is said of a model next to a record, the best first; see `Evaluation.status`.

    - follows the samples: to within their noise. Nothing below overrules this.
    - sustained: a run from the record's start stays on the record's cycle, and this attracts.
    - not told: the run stays on it, but the cycle attracts too slowly for the record to show it.
    - neutral, repelling: the run stays on it, but perturbations of the cycle stay, or grow.
    - departs from the samples: by more than their noise. There is no cycle of the model's own to
      compare, since inputs set what oscillates, or the record does not repeat one.
    - wrong frequency: amplitudes and waveform are the record's, and the frequency is not, or the
      run misses the record in the first period already.
    - wrong cycle: the run oscillates with other amplitudes or another waveform.
    - no cycle to compare, of a `Comparison` alone: the record grows, decays or does not repeat
      itself. `Comparison.is_similar` states whether the run has its envelope, or its means and
      amplitudes.
    - decays, turns negative, leaves the domain (of a function of the model), diverges.
    """

    FOLLOWS = "follows the samples"
    SUSTAINED = "sustained"
    NOT_TOLD = "not told: relaxation is longer than the record"
    NEUTRAL = "on a neutral cycle"
    REPELLING = "on a repelling cycle"
    DEPARTS = "departs from the samples"
    WRONG_FREQUENCY = "wrong frequency"
    WRONG_CYCLE = "wrong cycle"
    NO_CYCLE = "no cycle to compare"
    DECAYS = "decays"
    NEGATIVE = "turns negative"
    LEAVES_DOMAIN = "leaves the domain"
    DIVERGES = "diverges"


@dataclass(frozen=True)
class FreeRunBounds:
    """Largest deviations from the data at which a run still counts as sustained.

    If a third of a record that does not repeat itself is farther from the whole, that distance is
    the bound instead.

    Parameters
    ----------
    frequency : float, default 0.01
        Relative error of the frequency.
    amplitude : float, default 0.1
        Relative error of the standard deviation of each state.
    waveform : float, default 0.2
        RMS difference of the waveforms, in standard deviations. For records that do not repeat
        themselves, the difference of the means.

    Raises
    ------
    ValueError
        If a bound is not positive.
    """

    frequency: float = 0.01
    amplitude: float = 0.1
    waveform: float = 0.2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0.0:
                raise ValueError(f"the bound {name} must be positive, got {value}")


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparison of one run with the cycle of a record, or with its statistics without one.

    status: SUSTAINED says that the run stays within the bounds of the cycle; whether it would stay
    for longer, `Evaluation.status` finds out. is_similar: whether the run is like the record: it
    stays on the cycle or, without one, has the record's envelope, or its means and amplitudes.
    f_error, by_state: as the fields of `Evaluation`.
    """

    status: Status
    is_similar: bool
    f_error: float
    by_state: Mapping[str, Float[np.ndarray, " n_states"]]

    @property
    def rank(self) -> tuple[bool, int]:
        """Sorts the best first: by whether the run is like the record, then by the status."""
        return not self.is_similar, list(Status).index(self.status)

    @property
    def stays(self) -> bool:
        """Whether the run stays within the bounds of the record's cycle."""
        return self.status is Status.SUSTAINED


def deviation(
    f_error: float,
    amplitude_ratio: Float[np.ndarray, " n_states"],
    waveform_error: Float[np.ndarray, " n_states"],
    bounds: FreeRunBounds,
) -> float:
    """Largest deviation from the data's cycle, in units of its bound; NaN without a cycle."""
    return float(
        max(
            abs(f_error) / bounds.frequency,
            np.abs(amplitude_ratio - 1.0).max() / bounds.amplitude,
            waveform_error.max() / bounds.waveform,
        )
    )


def compare_cycles(
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
class ComparedRecord:
    """A record that runs are compared with: samples, and their cycle.

    cycle: cycle of the samples, or of a longer record that contains them; None without a period.
    densities: indices of the states that cannot be negative.
    """

    t: Float[np.ndarray, " samples"]
    states: Float[np.ndarray, "samples n_states"]
    cycle: Cycle | None
    densities: Sequence[int] = ()
    std: Float[np.ndarray, " n_states"] = field(init=False)

    def __post_init__(self) -> None:
        std = self.states.std(axis=0) if self.cycle is None else self.cycle.std
        object.__setattr__(self, "std", zero_to_one(std))

    def similarity(
        self, states: Float[np.ndarray, "_ n_states"], bounds: FreeRunBounds
    ) -> Comparison:
        """Compare a run at the times t with this record; a run with fewer samples has diverged."""
        nothing = np.full(states.shape[1], np.nan)
        by_state = dict.fromkeys(("amplitude_ratio", "waveform_error"), nothing)
        if len(states) < len(self.t) or not np.isfinite(states).all():
            return Comparison(Status.DIVERGES, False, np.nan, by_state)
        # Half of a record may be left out as a transient if the rest holds periods enough.
        is_long = self.cycle is not None and self.repeats and self.cycle.n_periods >= LONG
        half = len(states) // 2 if is_long else 0
        late = states[half:]
        by_state["amplitude_ratio"] = late.std(axis=0) / zero_to_one(self.states[half:].std(axis=0))
        if turns_negative(late, self.densities, self.std):
            return Comparison(Status.NEGATIVE, False, np.nan, by_state)
        middle = len(states) // 2
        if has_decayed(states[middle:], self.states[middle:], DECAYED).all():
            return Comparison(Status.DECAYS, False, np.nan, by_state)
        if spirals(self.states):
            is_similar = self._is_followed(states, bounds)
            return Comparison(Status.NO_CYCLE, is_similar, np.nan, by_state)
        is_similar = not self.repeats and self._is_alike(states, bounds)
        if is_similar or self.cycle is None:
            return Comparison(Status.NO_CYCLE, is_similar, np.nan, by_state)
        f_error, amplitude, waveform = compare_cycles(self.cycle, self.t[half:], late)
        if np.isnan(f_error):
            return Comparison(Status.WRONG_CYCLE, False, f_error, by_state)
        by_state |= {"amplitude_ratio": amplitude, "waveform_error": waveform}
        if deviation(0.0, amplitude, waveform, bounds) > 1.0:
            status = Status.WRONG_CYCLE
        elif abs(f_error) > bounds.frequency or self._begins_apart(states):
            status = Status.WRONG_FREQUENCY
        else:
            status = Status.SUSTAINED
        return Comparison(status, status is Status.SUSTAINED, f_error, by_state)

    def _begins_apart(self, states: np.ndarray) -> bool:
        """True if a run begins on the record, and misses it by much in its first period already."""
        assert self.cycle is not None
        if (np.abs(states[0] - self.states[0]) > FIRST_PERIOD * self.std).any():
            return False  # a transient from elsewhere
        first = self.t <= self.t[0] + 1.0 / self.cycle.frequency_Hz
        off = np.square((states - self.states)[first] / self.std).mean(axis=0)
        noise = np.array(
            [white_variance(*power_spectrum(self.t, x)) for x in self.states.T]
        ) / np.square(self.std)
        is_quiet = np.sqrt(noise) <= TOO_NOISY
        return bool((np.maximum(off - noise, 0.0) > FIRST_PERIOD**2)[is_quiet].any())

    def _is_followed(self, states: np.ndarray, bounds: FreeRunBounds) -> bool:
        """True if a run has the envelope of the record in each third, and its frequency."""
        off = np.abs(_sizes(states) / _sizes(self.states) - 1.0)
        ours, theirs = (dominant_frequency(self.t, x[:, 0]) for x in (states, self.states))
        bin_Hz = 1.0 / float(self.t[-1] - self.t[0])
        near = abs(ours - theirs) <= max(bounds.frequency * theirs, 0.5 * bin_Hz)
        return bool((off <= bounds.amplitude).all() and near)

    @property
    def repeats(self) -> bool:
        """True if the record repeats one cycle; otherwise runs are compared by statistics first."""
        return self.cycle is not None and self.cycle.repeats

    def _is_alike(self, states: np.ndarray, bounds: FreeRunBounds) -> bool:
        """True if means and amplitudes are as near to the record's as those of its thirds are."""
        mean, thirds = self.states.mean(axis=0), np.array_split(self.states, 3)
        drift = np.abs([part.mean(axis=0) - mean for part in thirds]).max(axis=0)
        off = np.abs(states.mean(axis=0) - mean)
        near = off <= np.maximum(bounds.waveform * self.std, drift)
        std = zero_to_one(self.states.std(axis=0))
        wander = np.abs(_sizes(self.states) / std - 1.0).max(axis=0)
        alike = np.abs(states.std(axis=0) / std - 1.0) <= np.maximum(bounds.amplitude, wander)
        return bool((near & alike).all())


def spirals(states: Float[np.ndarray, "samples n_states"]) -> bool:
    """Whether every state of a record grows or decays throughout."""
    sizes = _sizes(states)
    steps = np.diff(np.log(sizes), axis=0)
    ratio = np.abs(np.log(sizes[-1] / sizes[0]))
    return bool((ratio > np.log(SPIRALS)).all() and (steps[0] * steps[1] > 0.0).all())


def _sizes(states: np.ndarray) -> np.ndarray:
    """Standard deviation of every state in each third of a record, (3, n_states)."""
    return np.array([zero_to_one(part.std(axis=0)) for part in np.array_split(states, 3)])


def record_of(run: Trajectory, states: Sequence[str]) -> ComparedRecord:
    """Record of a trajectory, with its cycle, that runs are compared with."""
    values = run.columns(states)
    return ComparedRecord(run.t, values, find_cycle(run.t, values), densities_of(run, states))


def densities_of(run: Trajectory, states: Sequence[str]) -> list[int]:
    """Indices of the states that cannot be negative: in m^-3, nine of ten samples positive.

    Noise makes some samples of a density negative; what is half negative is no density.
    """
    positive = (run.columns(states) > 0.0).mean(axis=0)
    return [k for k, name in enumerate(states) if run.units[name] == "m^-3" and positive[k] > 0.9]


def turns_negative(
    path: Float[np.ndarray, "samples n_states"],
    densities: Sequence[int],
    std: Float[np.ndarray, " n_states"],
) -> bool:
    """True if a density on a path is negative by more than rounding and noise of its start."""
    columns = list(densities)
    return bool((path[:, columns] < -BELOW_ZERO * std[columns]).any())


def columns_of(states: Sequence[str], assessed: Sequence[str] | None) -> list[int]:
    """Column indices of the assessed states, None meaning all; ValueError for an unknown state."""
    names = list(states if assessed is None else assessed)
    if not names or not set(names) <= set(states):
        raise ValueError(f"assessed must name some of the states {list(states)}, got {names}")
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
