"""Embeddings: states made of one signal and its growth rate, its derivative or its past."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.interpolate import make_interp_spline

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.units import unit_product
from ep2sindy.signals.kalman import LOG10_RATIO_MIN, KalmanSmoother
from ep2sindy.signals.log_smoother import LogSmoother, ratio_bound
from ep2sindy.signals.trace import Trace

# Number of harmonics that the smoothers follow; faster components count as noise. Two states
# cannot describe more. Ion-transit oscillations, ten times faster, would spoil the derivative.
HARMONICS = 7.0

# Noise level, in standard deviations of the signal, above which no derivative is taken.
DROWNED = 0.5


@dataclass(frozen=True, eq=False)
class Embedded:
    """A signal as a trajectory of states, with the equations that are known exactly.

    relations, terms: in the form that `discover` takes. noise_std: standard deviation of the noise
    in the signal, in its unit; it includes components faster than the smoother follows.
    """

    run: Trajectory
    relations: Sequence[str]
    terms: Mapping[str, Sequence[str]]
    noise_std: float

    @property
    def searched(self) -> list[str]:
        """States whose equations are not known."""
        return [name for name in self.run.state_names if name not in self.terms]


@runtime_checkable
class Embedding(Protocol):
    """Interface of the embeddings.

    says: description in words. names: names of the states made of a signal, the signal first.
    """

    @property
    def says(self) -> str: ...

    def names(self, signal: str) -> tuple[str, str]: ...

    def embed(self, signal: Trace) -> Embedded: ...


@dataclass(frozen=True)
class LogRate:
    """A positive signal x and its growth rate g = d ln x / dt, so that x' = x g is known.

    harmonics: number of harmonics of the period that the smoother follows.
    """

    harmonics: float = HARMONICS

    def __post_init__(self) -> None:
        _check_harmonics(self.harmonics)

    @property
    def says(self) -> str:
        return "the signal and its growth rate"

    def names(self, signal: str) -> tuple[str, str]:
        return signal, _other(signal, "g")

    def embed(self, signal: Trace) -> Embedded:
        """Raises ValueError for a signal that is not positive."""
        x, g = self.names(signal.name)
        if not signal.is_positive:
            share = 100.0 * float((signal.x <= 0.0).mean())
            raise ValueError(
                f"a growth rate needs a positive signal: {x} falls to {signal.x.min():.4g} "
                f"{signal.unit}, {share:.2g} % of its samples are zero or less, and noise does not "
                "explain it; take its derivative instead (embedding=rate, ep.signals.Rate()), "
                "or an offset out of it"
            )
        found = LogSmoother(_finest_s(signal, self.harmonics)).estimate(signal.t, signal.x)
        states = np.column_stack([found.smoothed, found.rate])
        run = _trajectory(signal, signal.t, states, {x: signal.unit, g: "s^-1"})
        return Embedded(run, (f"{x}: {x}*{g} == 1",), {x: (f"{x}*{g}",)}, found.noise_std)


@dataclass(frozen=True)
class Rate:
    """A signal x of either sign and its derivative v, so that x' = v is known."""

    harmonics: float = HARMONICS

    def __post_init__(self) -> None:
        _check_harmonics(self.harmonics)

    @property
    def says(self) -> str:
        return "the signal and its derivative"

    def names(self, signal: str) -> tuple[str, str]:
        return signal, _other(signal, "v")

    def embed(self, signal: Trace) -> Embedded:
        x, v = self.names(signal.name)
        smoothed, derivative, noise_std = _smooth(signal, self.harmonics)
        states = np.column_stack([smoothed, derivative])
        units = {x: signal.unit, v: unit_product([(signal.unit, 1), ("s", -1)])}
        run = _trajectory(signal, signal.t, states, units)
        return Embedded(run, (f"{x}: {v} == 1",), {x: (v,)}, noise_std)


@dataclass(frozen=True)
class Delays:
    """A signal and its own delayed value.

    This embedding needs no derivative, but no equation is known beforehand either.

    share: delay as a fraction of the period.
    """

    share: float = 0.25
    harmonics: float = HARMONICS

    def __post_init__(self) -> None:
        _check_harmonics(self.harmonics)
        if not 0.0 < self.share < 1.0:
            raise ValueError(f"share of the period must lie between 0 and 1: {self.share} came")

    @property
    def says(self) -> str:
        return f"the signal and itself {self.share:g} of a period before"

    def names(self, signal: str) -> tuple[str, str]:
        return signal, f"{signal}_before"

    def embed(self, signal: Trace) -> Embedded:
        x, before = self.names(signal.name)
        smoothed, _, noise_std = _smooth(signal, self.harmonics)
        lag_s = self.share * signal.period_s
        late = signal.t >= signal.t[0] + lag_s
        t = signal.t[late]
        past = make_interp_spline(signal.t, smoothed, k=3)(t - lag_s)
        states = np.column_stack([smoothed[late], past])
        run = _trajectory(signal, t, states, {x: signal.unit, before: signal.unit})
        return Embedded(run, (), {}, noise_std)


@dataclass(frozen=True, eq=False)
class Chosen:
    """An embedding, its result, and the reason for choosing it, in words."""

    embedding: Embedding
    reason: str
    embedded: Embedded = field(repr=False)


def embed(signal: Trace, embedding: Embedding | None = None) -> Chosen:
    """Embed a signal as states; None chooses the embedding by the signal's sign and noise.

    Raises ValueError if the given embedding does not suit the signal.
    """
    if embedding is not None:
        return Chosen(embedding, "set", embedding.embed(signal))
    if signal.is_positive:
        positive = LogRate()
        return Chosen(positive, f"{signal.name} is positive", positive.embed(signal))
    rate = Rate()
    found = rate.embed(signal)
    share = found.noise_std / float(signal.x.std())
    if share <= DROWNED:
        return Chosen(rate, f"{signal.name} takes either sign", found)
    delays = Delays()
    why = f"{signal.name} takes either sign, and noise is {share:.2f} of its standard deviation"
    return Chosen(delays, why, delays.embed(signal))


def _smooth(signal: Trace, harmonics: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Kalman-smoothed signal, its derivative, and the noise; follows at most `harmonics`."""
    column = signal.x[:, None]
    found = KalmanSmoother().estimate(signal.t, column)
    step_s = float(np.ptp(signal.t)) / (len(signal.t) - 1)
    finest = max(ratio_bound(_finest_s(signal, harmonics), step_s), LOG10_RATIO_MIN)
    if found.log10_ratio[0] > finest:
        found = KalmanSmoother(finest).estimate(signal.t, column)
    return found.smoothed[:, 0], found.derivative[:, 0], float(found.noise_std[0])


def _finest_s(signal: Trace, harmonics: float) -> float:
    """Time in which the highest harmonic advances by one radian, in s."""
    return signal.period_s / (2.0 * np.pi * harmonics)


def _trajectory(
    signal: Trace, t: np.ndarray, states: np.ndarray, units: Mapping[str, str]
) -> Trajectory:
    return Trajectory(
        t=t,
        states=states,
        state_names=tuple(units),
        units=units,
        label=signal.name,
        clock=signal.clock,
    )


def _other(signal: str, name: str) -> str:
    """Name of the second state, changed if the signal already has that name."""
    return name if name != signal else f"{name}_rate"


def _check_harmonics(harmonics: float) -> None:
    if not harmonics >= 1.0:
        raise ValueError(f"harmonics must be one or more: {harmonics} came")
