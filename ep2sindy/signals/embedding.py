"""Embeddings: states made of one signal and its growth rate, its derivative or its past."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Protocol, overload, runtime_checkable

import numpy as np
from scipy.interpolate import make_interp_spline

from ep2sindy.data.gaps import between_gaps
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.units import unit_product
from ep2sindy.runtime.values import check_count
from ep2sindy.signals.log_smoother import LogSmoother
from ep2sindy.signals.smoothers import KalmanSmoother
from ep2sindy.signals.spectrum import signal_memory_s
from ep2sindy.signals.trace import Trace

# Number of harmonics that the smoothers follow; faster components count as noise. Two states
# cannot describe more. Ion-transit oscillations, ten times faster, would spoil the derivative.
HARMONICS = 7.0

# Least share of what stands out of the noise floor in the spectrum that a smoother must follow.
KEPT = 0.99

MAX_STATES = 5

# Neighbours whose mean predicts the next state, samples at either end and most samples used.
N_NEIGHBOURS, EDGE, MAX_POINTS = 4, 10, 5000

DELAY = 0.25  # of a delayed value, as a share of the period

CUBIC = 3  # degree of a spline, which needs more samples than that

# Noise level, in standard deviations of the signal, above which no derivative is taken.
DROWNED = 0.5


@runtime_checkable
class Embedding(Protocol):
    """Interface of the embeddings.

    n_states: number of states made of a signal, the signal first. says: description in words.
    """

    @property
    def n_states(self) -> int: ...

    @property
    def says(self) -> str: ...

    def embed(self, signal: Trace) -> Embedded: ...


@dataclass(frozen=True, eq=False)
class Embedded:
    """A signal as a trajectory of states, with the equations that are known exactly.

    embedding: that made the states. relations, terms: known of their equations, see `known_in`.
    noise_std: standard deviation of the noise in the signal, in its unit; it includes components
    faster than the smoother follows. reason: why this embedding was taken, in words.
    """

    embedding: Embedding
    run: Trajectory
    relations: Sequence[str]
    terms: Mapping[str, Sequence[str]]
    noise_std: float
    reason: str = "set"

    @property
    def searched(self) -> list[str]:
        """States whose equations are not known."""
        return [name for name in self.run.state_names if name not in self.terms]

    def known_in(self, library: Library) -> Library:
        """A library of the states, with the equations that are known."""
        return library.relate(*self.relations).only(self.terms)


@dataclass(frozen=True)
class LogRate:
    """A positive signal x and its growth rate g = d ln x / dt, so that x' = x g is known.

    harmonics: number of harmonics of the period that the smoother follows. n_states: 3 adds the
    derivative of the growth rate, g' = h, and so on.
    """

    harmonics: float = HARMONICS
    n_states: int = 2

    def __post_init__(self) -> None:
        _check_settings(self)

    @property
    def says(self) -> str:
        return f"the signal and its growth rate{_and_derivatives(self.n_states)}"

    def names(self, signal: str) -> tuple[str, ...]:
        return _name_chain(signal, "ghkl"[: self.n_states - 1])

    def embed(self, signal: Trace) -> Embedded:
        """Raises ValueError for a signal that is not positive."""
        x, g, *higher = self.names(signal.name)
        if not signal.is_positive:
            share = 100.0 * float((signal.x <= 0.0).mean())
            raise ValueError(
                f"a growth rate needs a positive signal: {x} falls to {signal.x.min():.4g} "
                f"{signal.unit}, {share:.2g} % of its samples are zero or less, and noise does not "
                "explain it; take its derivative instead (embedding=rate, ep.signals.Rate()), "
                "or an offset out of it"
            )
        smoother = LogSmoother(**_memory_bounds(signal, self.harmonics))
        found = smoother.estimate(signal.t, signal.x)
        states = [found.smoothed, *_differentiate(signal.t, found.log, self.n_states)[1:]]
        chain = {x: f"{x}*{g}"} | dict(pairwise([g, *higher]))
        return _assemble(self, signal, "s^-1", states, chain, found.noise_std)


@dataclass(frozen=True)
class Rate:
    """A signal x of either sign and its derivative v, so that x' = v is known.

    harmonics: number of harmonics of the period that the smoother follows. n_states: 3 adds the
    derivative of v, v' = w, and so on.
    """

    harmonics: float = HARMONICS
    n_states: int = 2

    def __post_init__(self) -> None:
        _check_settings(self)

    @property
    def says(self) -> str:
        return f"the signal and its derivative{_and_derivatives(self.n_states)}"

    def names(self, signal: str) -> tuple[str, ...]:
        return _name_chain(signal, "vwuz"[: self.n_states - 1])

    def embed(self, signal: Trace) -> Embedded:
        names = self.names(signal.name)
        smoothed, derivative, noise_std = _smooth(signal, self.harmonics)
        states = [smoothed, derivative, *_differentiate(signal.t, smoothed, self.n_states)[2:]]
        unit = unit_product([(signal.unit, 1), ("s", -1)])
        return _assemble(self, signal, unit, states, dict(pairwise(names)), noise_std)


@dataclass(frozen=True)
class Delays:
    """A signal and its own delayed values.

    This embedding needs no derivative, but no equation is known beforehand either. The delay is a
    quarter of the period. n_states: 3 adds the value two delays before, and so on.
    """

    harmonics: float = HARMONICS
    n_states: int = 2

    def __post_init__(self) -> None:
        _check_settings(self)

    @property
    def says(self) -> str:
        more = "" if self.n_states == 2 else f", {self.n_states - 1} times"
        return f"the signal and itself {DELAY:g} of a period before{more}"

    def names(self, signal: str) -> tuple[str, ...]:
        return signal, *(f"{signal}_before{k}" for k in ("", *range(2, self.n_states)))

    def embed(self, signal: Trace) -> Embedded:
        smoothed, _, noise_std = _smooth(signal, self.harmonics)
        lags_s = DELAY * signal.period_s * np.arange(1, self.n_states)
        parts = [
            _append_past(signal.t[a:b], smoothed[a:b], lags_s)
            for a, b in between_gaps(signal.t)
            if b - a > CUBIC
        ]
        t, states = (np.concatenate(each) for each in zip(*parts, strict=True))
        late = signal.with_samples(t, states[:, 0])
        return _assemble(self, late, "", list(states.T), {}, noise_std)


AnyEmbedding = LogRate | Rate | Delays


# The embeddings by the names that settings give them.
EMBEDDINGS: Mapping[str, Callable[..., AnyEmbedding]] = MappingProxyType(
    {"log_rate": LogRate, "rate": Rate, "delays": Delays}
)


@overload
def embed(signal: Trace, *, n_states: int = 2, harmonics: float = HARMONICS) -> Embedded: ...
@overload
def embed(
    signal: Sequence[Trace], *, n_states: int = 2, harmonics: float = HARMONICS
) -> list[Embedded]: ...
def embed(
    signal: Trace | Sequence[Trace], *, n_states: int = 2, harmonics: float = HARMONICS
) -> Embedded | list[Embedded]:
    """Embed a signal as states by the embedding that its sign and its noise ask for.

    signal: one, or the same signal of several runs. These all get one embedding, so that equations
    of one form can hold for all: the growth rate if the signal is positive in every run, and delays
    if noise drowns the derivative in one. n_states, harmonics: of the embedding, see `LogRate`.
    Raises ValueError for no signal.
    """
    if isinstance(signal, Trace):
        return embed([signal], n_states=n_states, harmonics=harmonics)[0]
    if not signal:
        raise ValueError("an embedding needs a signal or more: an empty list came")
    name = signal[0].name
    if all(each.is_positive for each in signal):
        log_rate = LogRate(harmonics, n_states)
        return [replace(log_rate.embed(each), reason=f"{name} is positive") for each in signal]
    either, rate = f"{name} takes either sign", Rate(harmonics, n_states)
    found = [replace(rate.embed(each), reason=either) for each in signal]
    share = max(
        own.noise_std / float(each.x.std()) for own, each in zip(found, signal, strict=True)
    )
    if share <= DROWNED:
        return found
    delays = Delays(harmonics, n_states)
    reason = f"{either}, and noise is {share:.2f} of its standard deviation"
    return [replace(delays.embed(each), reason=reason) for each in signal]


def _smooth(signal: Trace, harmonics: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Kalman-smoothed signal, its derivative, and the noise; follows at most `harmonics`."""
    smoother = KalmanSmoother(**_memory_bounds(signal, harmonics))
    found = smoother.estimate(signal.t, signal.x[:, None])
    return found.smoothed[:, 0], found.derivative[:, 0], float(found.noise_std[0])


def _memory_bounds(signal: Trace, harmonics: float) -> dict[str, float]:
    """Bounds on the memory of a smoother, in s, by the period and by the spectrum of the signal.

    The finest is the time in which the highest harmonic advances by one radian.
    """
    finest_s = signal.period_s / (2.0 * np.pi * harmonics)
    coarsest_s = signal_memory_s(signal.t, signal.x, kept=KEPT)
    return {"finest_s": finest_s, "coarsest_s": max(coarsest_s, finest_s)}


def _assemble(
    embedding: AnyEmbedding, signal: Trace, rate_unit: str, states: Sequence[np.ndarray],
    chain: Mapping[str, str], noise_std: float,
) -> Embedded:  # fmt: skip
    """States of a signal, with the equations that are known.

    rate_unit: unit of the second state, of which those after it are derivatives; empty if all have
    the signal's. chain: state -> the only term of its equation, whose coefficient is one.
    """
    names = embedding.names(signal.name)
    rates = [unit_product([(rate_unit or signal.unit, 1), ("s", -k)]) for k in range(len(names))]
    units = [signal.unit, *rates] if rate_unit else [signal.unit] * len(names)
    run = Trajectory(
        t=signal.t,
        states=np.column_stack(states),
        state_names=names,
        units=dict(zip(names, units, strict=False)),
        label=signal.name,
        clock=signal.clock,
        parameters=signal.parameters,
    )
    relations = tuple(f"{state}: {term} == 1" for state, term in chain.items())
    terms = {state: (term,) for state, term in chain.items()}
    return Embedded(embedding, run, relations, terms, noise_std)


def _name_chain(signal: str, letters: str) -> tuple[str, ...]:
    """Names of the states, changed where the signal already has one."""
    return signal, *(name if name != signal else f"{name}_rate" for name in letters)


def _and_derivatives(n_states: int) -> str:
    return "" if n_states == 2 else f", with {n_states - 2} more derivative{'s'[: n_states - 3]}"


def _append_past(t: np.ndarray, x: np.ndarray, lags_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times of a stretch without a gap, and its states there: x, and x some lags before."""
    late = t >= t[0] + lags_s[-1]
    past = make_interp_spline(t, x, k=CUBIC)
    return t[late], np.column_stack([x[late], *(past(t[late] - lag_s) for lag_s in lags_s)])


def _differentiate(t: np.ndarray, x: np.ndarray, n: int) -> list[np.ndarray]:
    """x and its derivatives, n in all, by the quintic spline through the samples."""
    spline = make_interp_spline(t, x, k=5)
    return [x, *(spline.derivative(order)(t) for order in range(1, n))]


def _check_settings(embedding: LogRate | Rate | Delays) -> None:
    if not embedding.harmonics >= 1.0:
        raise ValueError(f"harmonics must be one or more: {embedding.harmonics} came")
    if not 2 <= check_count("n_states", embedding.n_states) <= MAX_STATES:
        raise ValueError(
            f"n_states must be 2 to {MAX_STATES}: {embedding.n_states} came; an oscillation needs "
            "two, and higher derivatives are noise"
        )


def unexplained(signal: Trace, embedding: AnyEmbedding) -> float:
    """Share of the next state's variance that neighbours in the given states do not explain.

    The next state, such as a further derivative, is a function of the given ones if these are
    enough; then neighbours agree in it. Otherwise some neighbours are false ones, which are close
    only because a state is missing. Neighbours within half a period in time do not count.
    Source: after Kennel, Brown & Abarbanel 1992, doi:10.1103/PhysRevA.45.3403.
    """
    from scipy.spatial import cKDTree  # imported only to count states

    wider = replace(embedding, n_states=embedding.n_states + 1)
    run = wider.embed(signal).run
    inner = slice(EDGE, run.n_samples - EDGE)  # derivatives are poor at the ends
    states = run.states[inner] - run.states[inner].mean(axis=0)
    states = states / states.std(axis=0)
    states = states[np.linspace(0, len(states) - 1, min(len(states), MAX_POINTS)).astype(int)]
    apart = 0.5 * signal.period_s / (run.dt_s * run.n_samples) * len(states)
    known, following = states[:, :-1], states[:, -1]
    n_asked = min(len(states), N_NEIGHBOURS + 2 * int(apart) + 1)
    _, places = cKDTree(known).query(known, k=n_asked)
    far = np.abs(places - np.arange(len(states))[:, None]) > apart
    order = np.cumsum(far, axis=1)
    used = far & (order <= N_NEIGHBOURS)
    means = (following[places] * used).sum(axis=1) / np.maximum(used.sum(axis=1), 1)
    off = np.square(following - means).mean()
    return float(off / (1.0 + 1.0 / N_NEIGHBOURS))  # the means themselves scatter
