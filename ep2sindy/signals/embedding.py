"""States made of one signal: its growth rate, its derivative or its past."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import make_interp_spline

from ep2sindy.data.gaps import between_gaps
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.runs import Run
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.units import unit_product
from ep2sindy.runtime.values import check_count
from ep2sindy.signals.driving import drop_repeats
from ep2sindy.signals.log_smoother import LogSmoother
from ep2sindy.signals.signal import Signal, prepare_signal
from ep2sindy.signals.smoothers import KalmanSmoother
from ep2sindy.signals.spectrum import signal_memory_s

# Number of harmonics that the smoothers follow; faster components count as noise. Two states
# cannot describe more. Ion-transit oscillations, ten times faster, would spoil the derivative.
HARMONICS = 7.0

MAX_STATES = 5

# Neighbours whose mean predicts the next state, samples at either end and most samples used.
N_NEIGHBOURS, EDGE, MAX_POINTS = 4, 10, 5000

DELAY = 0.25  # of a delayed value, as a fraction of the period

CUBIC = 3  # degree of a spline, which needs more samples than that

# Noise level, in standard deviations of the signal, above which no derivative is taken.
DROWNED = 0.5

# What the states are, by how they are made.
SAYS = {
    "hidden": "the signal and {n} that nobody measured",
    "rate": "the signal and its growth rate{more}",
    "derivative": "the signal and its derivative{more}",
    "delays": f"the signal and itself {DELAY:g} of a period before{{times}}",
}


@dataclass(frozen=True)
class Embedding:
    """How states are made of a signal x.

    how: "rate": x and its growth rate g = d ln x / dt, so that x' = x g is known; x is positive.
    "derivative": x and its derivative v, so that x' = v is known. "delays": x and x a quarter of a
    period before, for which no derivative is needed; no equation is known. "hidden": x alone is
    given, and `discover` finds the other states with their equations.
    n_states: in all; of more than two, the others are derivatives, g' = h and v' = w, or values two
    delays before, and so on. One state, the signal alone, is "hidden" without hidden ones; it
    oscillates only if inputs drive it. harmonics: of the period, which the smoother follows.
    Raises ValueError for another `how`, fewer than two states (one, if they are "hidden"), more
    than five, or harmonics below one.
    """

    how: str
    n_states: int = 2
    harmonics: float = HARMONICS

    def __post_init__(self) -> None:
        if self.how not in SAYS:
            raise ValueError(f"how must be auto, {', '.join(SAYS)}, got {self.how!r}")
        if not self.harmonics >= 1.0:
            raise ValueError(f"harmonics must be one or more, got {self.harmonics}")
        least = 1 if self.how == "hidden" else 2
        if not least <= check_count("n_states", self.n_states) <= MAX_STATES:
            raise ValueError(
                f"n_states must be {least} to {MAX_STATES}, got {self.n_states}; an oscillation "
                "that nothing drives needs two, and higher derivatives are noise"
            )

    @property
    def says(self) -> str:
        n = self.n_states - 1
        if not n:
            return "the signal alone"
        more = f", with {n - 1} more derivative{'s'[: n - 2]}" if n > 1 else ""
        return SAYS[self.how].format(n=n, more=more, times=f", {n} times" if n > 1 else "")

    def names(self, signal: Signal) -> tuple[str, ...]:
        """The states. Of hidden ones too, the first is a growth rate if the signal is positive."""
        x, n = signal.name, self.n_states
        if self.how == "delays":
            return x, *(f"{x}_before{k}" for k in ("", *range(2, n)))
        is_rate = self.how == "rate" or (self.how == "hidden" and signal.is_positive)
        letters = ("ghkl" if is_rate else "vwuz")[: n - 1]
        return x, *(name if name != x else f"{name}_rate" for name in letters)

    def embed(self, signal: Signal, reason: str = "set") -> Embedded:
        """The states of a signal. Raises ValueError for a growth rate of one that is not positive.

        reason: why they are made so, in words.
        """
        names, unit = self.names(signal), signal.unit
        t, states, noise_std = self._states(signal)
        units = [unit] * len(names)
        known = {}
        if self.how in ("rate", "derivative"):
            of_first = unit if self.how == "derivative" else "1"
            time = signal.clock.of_values
            units[1:] = [unit_product([(of_first, 1), (time, -k)]) for k in range(1, self.n_states)]
            known = dict(pairwise(names))
        if self.how == "rate":
            known[names[0]] = f"{names[0]}*{names[1]}"
        own = names[: len(states)]
        run = replace(
            signal.run,
            t=t,
            states=np.column_stack(states),
            state_names=own,
            units={**signal.run.units, **dict(zip(own, units, strict=False))},
            inputs=signal.run.inputs[np.searchsorted(signal.t, t)],
        )
        return Embedded(self, signal, run, names, known, noise_std, reason)

    def _states(self, signal: Signal) -> tuple[np.ndarray, list[np.ndarray], float]:
        """Times, every state at these, and the standard deviation of the noise in the signal."""
        t, n = signal.t, self.n_states
        if self.how == "hidden":
            return t, [signal.x], float("nan")
        finest_s = signal.period_s / (2.0 * np.pi * self.harmonics)  # a radian of the highest one
        coarsest_s = max(signal_memory_s(t, signal.x), finest_s)
        if self.how == "rate":
            if not signal.is_positive:
                percentage = 100.0 * float((signal.x <= 0.0).mean())
                raise ValueError(
                    f"a growth rate needs a positive signal: {signal.name} falls to "
                    f"{signal.x.min():.4g} {signal.unit}, {percentage:.2g} % of its samples are "
                    "zero or less, and noise does not explain it; take its derivative instead "
                    "(derivative), or an offset out of it"
                )
            growth = LogSmoother(finest_s, coarsest_s).estimate(t, signal.x)
            states = [growth.smoothed, *_differentiate(t, growth.log, n)[1:]]
            return t, states, growth.noise_std
        smoother = KalmanSmoother(finest_s=finest_s, coarsest_s=coarsest_s)
        found = smoother.estimate(t, signal.x[:, None])
        x, noise_std = found.smoothed[:, 0], float(found.noise_std[0])
        if self.how == "derivative":
            return t, [x, found.derivative[:, 0], *_differentiate(t, x, n)[2:]], noise_std
        lags_s = DELAY * signal.period_s * np.arange(1, n)
        pieces = [(a, b) for a, b in between_gaps(t) if b - a > CUBIC]
        parts = [_append_past(t[a:b], x[a:b], lags_s) for a, b in pieces]
        late, states_late = (np.concatenate(each) for each in zip(*parts, strict=True))
        return late, list(states_late.T), noise_std


@dataclass(frozen=True, eq=False)
class Embedded:
    """States of a signal, with what is known of their equations.

    embedding: how they were made. signal: as prepared. run: the states along it, the signal first;
    hidden ones are not in it. names: of all states. known: state -> the only term of its equation,
    whose coefficient is one. noise_std: standard deviation of the noise in the signal, in its unit;
    it includes components faster than the smoother follows. NaN before hidden states are found.
    reason: why the states are made so, in words.
    """

    embedding: Embedding
    signal: Signal
    run: Trajectory
    names: Sequence[str]
    known: Mapping[str, str]
    noise_std: float
    reason: str

    @property
    def hidden(self) -> Sequence[str]:
        """States that nobody measured, as `discover` takes them."""
        return self.names[len(self.run.state_names) :]

    @property
    def unsmoothed(self) -> bool:
        """Whether the search takes the samples as they are, and finds all other states itself."""
        return self.embedding.how == "hidden"

    @property
    def relations(self) -> list[str]:
        return [f"{state}: {term} == 1" for state, term in self.known.items()]

    @property
    def terms(self) -> dict[str, list[str]]:
        return {state: [term] for state, term in self.known.items()}

    def library(
        self, degree: int = 3, functions: Sequence[str] = (), function_degree: int = 1
    ) -> Library:
        """Products of states and inputs up to a degree, and functions, with what is known.

        degree, functions, function_degree: see `polynomial`.
        """
        names = [*self.names, *self.run.input_names]
        library = polynomial(
            names, degree=degree, functions=functions, function_degree=function_degree
        )
        return drop_repeats(library).relate(*self.relations).only(self.terms)

    def along(self, run: Trajectory) -> Trajectory:
        """The states along other samples of the signal, which are the first column of a run."""
        own = replace(self.signal.run, t=run.t, states=run.states[:, :1], inputs=run.inputs)
        return self.embedding.embed(replace(self.signal, run=own)).run


def embed(
    run: Run | Signal,
    how: str = "auto",
    signal: str | None = None,
    *,
    n_states: int = 2,
    harmonics: float = HARMONICS,
    decimate: int | str | None = "auto",
    detrend: bool | str = "auto",
) -> Embedded:
    """Make states of one measured signal, so that equations can be found for it.

    A single first-order equation cannot oscillate, so an oscillating signal needs a second state.

    Parameters
    ----------
    run : run or Signal
        A run as `discover` takes it, or a signal from `ep.signals.prepare_signal`.
    how : str, default 'auto'
        "rate": the signal x and its growth rate g, so that x' = x g is known. "derivative": x and
        its derivative v, so that x' = v is known. "delays": x and x a quarter of a period before.
        "hidden": x by itself; `discover` finds the other states. "auto" takes the rate for a
        positive signal and the derivative for any other, or delays if noise hides the derivative.
    signal : str, optional
        Name of the variable. None takes the only state.
    n_states : int, default 2
        Number of states in all. More than two adds further derivatives or delays.
    harmonics : float, default HARMONICS
        Number of harmonics of the period that the smoother follows.
    decimate : int, "auto" or None, default "auto"
        Number of samples that are replaced by their mean, see `ep.signals.prepare_signal`.
    detrend : bool or "auto", default "auto"
        Whether a straight line is subtracted, see `ep.signals.prepare_signal`.

    Returns
    -------
    Embedded
        The states along the run, what is known of their equations, and `library`, which makes a
        library for them.

    Raises
    ------
    ValueError
        If the signal does not oscillate, holds under six periods or under six samples a period, or
        a setting does not suit it.

    Examples
    --------
    >>> t = np.linspace(0.0, 60.0, 1201)
    >>> states = ep.embed((t, np.sin(t)))
    >>> states.run.state_names, states.known
    (('x', 'v'), {'x': 'v'})
    >>> found = ep.discover(states.run, states.library(degree=1), ep.Regression())
    >>> round(found.model.terms("v")["x"], 2)
    -1.0
    """
    if not isinstance(run, Signal):
        run = prepare_signal(run, signal, decimate=decimate, detrend=detrend)
    return embed_alike([run], how, n_states=n_states, harmonics=harmonics)[0]


def embed_alike(
    signals: Sequence[Signal], how: str = "auto", *, n_states: int = 2, harmonics: float = HARMONICS
) -> list[Embedded]:
    """Make states of the same signal of several runs, by one embedding.

    Equations of one form can then hold for all.

    Parameters
    ----------
    signals : sequence of Signal
        Signals from `prepare_signal`.
    how : str, default 'auto'
        As for `ep.embed`. "auto" takes the growth rate if the signal is positive in every run, and
        delays if noise hides the derivative in one.
    n_states : int, default 2
        Number of states in all.
    harmonics : float, default HARMONICS
        Number of harmonics of the period that the smoother follows.

    Returns
    -------
    list of Embedded
        The states along each run.

    Raises
    ------
    ValueError
        If there is no signal.
    """
    if not signals:
        raise ValueError("an embedding needs a signal or more, got an empty list")

    def make(how: str, reason: str) -> list[Embedded]:
        embedding = Embedding(how, n_states, harmonics)
        return [embedding.embed(each, reason) for each in signals]

    if how != "auto":
        return make(how, "set")
    name = signals[0].name
    if all(each.is_positive for each in signals):
        return make("rate", f"{name} is positive")
    either = f"{name} takes either sign"
    found = make("derivative", either)
    fraction = max(each.noise_std / float(each.signal.x.std()) for each in found)
    if fraction <= DROWNED:
        return found
    return make("delays", f"{either}, and noise is {fraction:.2f} of its standard deviation")


def _append_past(t: np.ndarray, x: np.ndarray, lags_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times of a segment without a gap, and its states there: x, and x some lags before."""
    late = t >= t[0] + lags_s[-1]
    past = make_interp_spline(t, x, k=CUBIC)
    return t[late], np.column_stack([x[late], *(past(t[late] - lag_s) for lag_s in lags_s)])


def _differentiate(t: np.ndarray, x: np.ndarray, n: int) -> list[np.ndarray]:
    """x and its derivatives, n in all, by the quintic spline through the samples."""
    spline = make_interp_spline(t, x, k=5)
    return [x, *(spline.derivative(order)(t) for order in range(1, n))]


def unexplained(states: Embedded) -> float:
    """Fraction of the next state's variance that neighbours in the given states do not explain.

    The next state, such as a further derivative, is a function of the given ones and of the inputs
    if these are enough; then neighbours agree in it. Otherwise some neighbours are false ones,
    which are close only because a state is missing. Neighbours within half a period in time do not
    count.
    Source: after Kennel, Brown & Abarbanel 1992, doi:10.1103/PhysRevA.45.3403.
    """
    from scipy.spatial import cKDTree  # imported only to count states

    signal, own = states.signal, states.embedding
    run = replace(own, n_states=own.n_states + 1).embed(signal).run
    inner = slice(EDGE, run.n_samples - EDGE)  # derivatives are poor at the ends
    values = np.column_stack([run.inputs, run.states])[inner]
    values = (values - values.mean(axis=0)) / zero_to_one(values.std(axis=0))
    values = values[np.linspace(0, len(values) - 1, min(len(values), MAX_POINTS)).astype(int)]
    apart = 0.5 * signal.period_s / (run.dt_s * run.n_samples) * len(values)
    known, following = values[:, :-1], values[:, -1]
    n_asked = min(len(values), N_NEIGHBOURS + 2 * int(apart) + 1)
    _, places = cKDTree(known).query(known, k=n_asked)
    far = np.abs(places - np.arange(len(values))[:, None]) > apart
    order = np.cumsum(far, axis=1)
    used = far & (order <= N_NEIGHBOURS)
    means = (following[places] * used).sum(axis=1) / np.maximum(used.sum(axis=1), 1)
    off = np.square(following - means).mean()
    return float(off / (1.0 + 1.0 / N_NEIGHBOURS))  # the means themselves scatter
