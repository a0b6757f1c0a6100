"""The cycle that a free model oscillates on: whether it attracts, and which starts reach it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import count

import numpy as np
from jaxtyping import Complex, Float

from ep2sindy.model.closed_orbit import (
    N_SAMPLES,
    RETURNS,
    closed_orbit,
    deviations,
    free_run,
)
from ep2sindy.model.many import rk4_step
from ep2sindy.model.model import SparseModel
from ep2sindy.model.scaled import ScaledModel
from ep2sindy.runtime.arrays import read_only

# A modulus this close to one is neutral: a departure takes a thousand periods or more to change
# e-fold, longer than any record. The multipliers themselves are exact to 1e-6 or better.
NEUTRAL_WITHIN = 1e-3

# Where no orbit is closed from the start, Newton's method begins again this many periods on.
N_SETTLING = 10

# A start has reached the cycle if, over its last periods, it stays this close to the curve.
REACHED_WITHIN, N_LATE = 0.1, 3.0

# Steps to a period, at least; and the longest step times the norm of the Jacobian, well inside
# what the scheme of fourth order is stable for (2.8).
MIN_STEPS, STEP_TIMES_RATE = 64, 1.0

# Given up as diverged: this many times as far from the cycle's mean as the farthest start; as
# stuck: after this many times the steps that the cycle itself takes.
BLOW_UP, PATIENCE = 30.0, 4.0


class Stability(StrEnum):
    """What becomes of a small departure from a cycle: it dies out, stays, or grows."""

    ATTRACTING = "attracting"
    NEUTRAL = "neutral"
    REPELLING = "repelling"


@dataclass(frozen=True, eq=False)
class LimitCycle:
    """A periodic orbit of an autonomous model, and what a small departure from it becomes.

    states: over one period, evenly spaced, the first not repeated, in SI. multipliers: Floquet's,
    that of the flow itself (1) first, the others by falling modulus: a departure is multiplied by
    them in every period.
    """

    period_s: float
    states: Float[np.ndarray, "samples n_states"]
    multipliers: Complex[np.ndarray, " n_states"]

    def __post_init__(self) -> None:
        multipliers = np.array(self.multipliers, dtype=np.complex128)
        multipliers.flags.writeable = False
        object.__setattr__(self, "states", read_only(self.states))
        object.__setattr__(self, "multipliers", multipliers)
        if not (np.isfinite(self.period_s) and self.period_s > 0.0):
            raise ValueError(f"period_s must be positive and finite: {self.period_s} came")
        if self.states.ndim != 2 or multipliers.shape != self.states.shape[1:]:
            raise ValueError(
                "a cycle has one multiplier per state: multipliers of shape "
                f"{multipliers.shape} came for states of shape {self.states.shape}"
            )

    @property
    def stability(self) -> Stability:
        """By the largest modulus of the multipliers but the flow's: neutral within 1e-3 of one."""
        largest = float(np.abs(self.multipliers[1:]).max(initial=0.0))
        if abs(largest - 1.0) <= NEUTRAL_WITHIN:
            return Stability.NEUTRAL
        return Stability.ATTRACTING if largest < 1.0 else Stability.REPELLING


def limit_cycle(
    model: SparseModel,
    start: Float[np.ndarray, " n_states"],
    *,
    period_s: float,
    n_samples: int = 128,
) -> LimitCycle | None:
    """The closed orbit next to a state, by Newton's method on the return after one period.

    start: near the cycle, in SI. period_s: a guess, within 30 %.
    Unknowns are the state, which moves across the flow, and the period. Steps are of least norm:
    where closed orbits come in families (predator and prey), the neighbouring one is found.
    Where none is found, it begins again ten periods on, nearer to a cycle that attracts, and at
    last backwards in time, where one that repels attracts.
    Returns None where the states diverge, Newton's method closes no orbit with a period of half
    to twice the guess, or it ends on a fixed point. Where the guess is several periods, the least
    one is returned.
    Raises ValueError for a model with inputs, or a wrong start, period or number of samples.
    Source: Seydel 2010, Practical Bifurcation and Stability Analysis, chapter 7.
    """
    start = np.asarray(start, dtype=np.float64)
    _check_search(model, start, period_s=period_s, n_samples=n_samples)
    run = free_run(model, start, period_s=period_s, n_periods=RETURNS[1])
    cycle = _cycle(model, run, period_s=period_s, n_samples=n_samples)
    if run is not None and cycle is None:
        run = free_run(model, start, period_s=period_s, n_periods=N_SETTLING + RETURNS[1])
        late = None if run is None else run[N_SETTLING * N_SAMPLES :]
        cycle = _cycle(model, late, period_s=period_s, n_samples=n_samples)
    if cycle is None:
        return _backwards(model, start, period_s=period_s, n_samples=n_samples)
    if cycle.stability is not Stability.REPELLING:
        return cycle
    # Forwards, such an orbit magnifies the solver's errors: backwards, it forgets them.
    start, period_s = cycle.states[0], cycle.period_s
    return _backwards(model, start, period_s=period_s, n_samples=n_samples) or cycle


def _cycle(
    model: SparseModel, run: np.ndarray | None, *, period_s: float, n_samples: int
) -> LimitCycle | None:
    """By Newton's method from where a run begins; None, too, where that diverged."""
    if run is None:
        return None
    orbit = closed_orbit(model, run, period_s=period_s, n_samples=n_samples)
    if orbit is None:
        return None
    return LimitCycle(orbit.period * period_s, orbit.states * orbit.scale, orbit.multipliers)


def _backwards(
    model: SparseModel, start: np.ndarray, *, period_s: float, n_samples: int
) -> LimitCycle | None:
    """The cycle of the model in reversed time, told in forward time."""
    reverse = replace(model, coef=-model.coef, covariance=None)
    run = free_run(reverse, start, period_s=period_s, n_periods=RETURNS[1])
    cycle = _cycle(reverse, run, period_s=period_s, n_samples=n_samples)
    if cycle is None or not cycle.multipliers.all():
        return None
    inverse = 1.0 / cycle.multipliers
    states = np.roll(cycle.states[::-1], 1, axis=0)  # the same state first
    return LimitCycle(cycle.period_s, states, np.append(inverse[0], inverse[:0:-1]))


def share_reaching(
    model: SparseModel,
    cycle: LimitCycle,
    *,
    n_starts: int = 64,
    n_periods: float = 40.0,
    spread: tuple[float, float] = (0.3, 3.0),
) -> float:
    """Share of starts that end on a cycle, staying within 0.1 of it over three last periods.

    Distances are to the cycle's curve, states in units of their standard deviation on it; the
    last periods must pass all its quarters, too.
    Starts fill a box (Halton's points: nothing random). A state that keeps one sign on the cycle
    takes values from spread[0] to spread[1] times its mean, evenly in the logarithm; one that
    does not, its mean plus or minus spread[1] times half its range, evenly.
    Every start takes its own steps: a 64th of the period, or where that is less, one over the
    norm of the Jacobian. It is given up 30 times as far from the cycle's mean as the farthest
    start, or once it has taken four times the steps that the cycle takes.
    Raises ValueError for a model with inputs, a cycle of another model or a wrong setting.
    """
    _check_reach(model, cycle, n_starts=n_starts, n_periods=n_periods, spread=spread)
    scale = deviations(cycle.states)
    scaled = ScaledModel.of(model, scale, cycle.period_s)
    curve = cycle.states / scale
    y = (_starts(cycle.states, n_starts, spread) / scale).T
    per_period = float(np.mean(1.0 / _steps(scaled, curve.T)))
    on_cycle = _on_cycle(scaled, y, curve, n_periods, round(PATIENCE * n_periods * per_period))
    return float(on_cycle) / n_starts


def _on_cycle(
    scaled: ScaledModel, y: np.ndarray, curve: np.ndarray, n_periods: float, n_steps: int
) -> int:
    """How many of the starts (n_states, starts) follow the curve for the last periods."""
    from scipy.spatial import KDTree

    nearest = KDTree(_interpolated(curve))
    centre = curve.mean(axis=0)[:, None]
    bound = BLOW_UP * np.abs(y - centre).max()
    t, quarters = np.zeros(y.shape[1]), np.zeros((y.shape[1], 4), dtype=np.bool_)
    for _ in range(n_steps):
        running = t < n_periods
        if not running.any():
            break
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is dropped
            step = np.where(running, _steps(scaled, y), 0.0)
            y = rk4_step(lambda x, _: scaled.slope(x), y, (t, t, t), step)
            t = t + step
            kept = (np.abs(y - centre) <= bound).all(axis=0)
        late = np.flatnonzero(kept & (t >= n_periods - N_LATE))
        if len(late):
            distance, place = nearest.query(y[:, late].T)
            kept[late] = distance <= REACHED_WITHIN
            quarters[late, 4 * place // nearest.n] = True
        if not kept.all():
            y, t, quarters = y[:, kept], t[kept], quarters[kept]
    return int(np.count_nonzero(quarters.all(axis=1) & (t >= n_periods)))


def _steps(scaled: ScaledModel, y: np.ndarray) -> np.ndarray:
    """The step at every state (n_states, points), in periods."""
    return STEP_TIMES_RATE / np.maximum(scaled.rate(y), STEP_TIMES_RATE * MIN_STEPS)


def _interpolated(curve: np.ndarray) -> np.ndarray:
    """The closed curve through the samples, at sixteen points to each."""
    from scipy.interpolate import CubicSpline  # a quarter of a second that most do not need

    n = len(curve)
    spline = CubicSpline(np.arange(n + 1), np.append(curve, curve[:1], axis=0), bc_type="periodic")
    return spline(np.arange(16 * n) / 16.0)


def _starts(states: np.ndarray, n_starts: int, spread: tuple[float, float]) -> np.ndarray:
    """(starts, n_states), see `share_reaching`."""
    share = _halton(n_starts, states.shape[1])
    mean = states.mean(axis=0)
    reach = spread[1] * 0.5 * np.ptp(states, axis=0)
    low, high = np.log(spread)
    one_sign = (states > 0.0).all(axis=0) | (states < 0.0).all(axis=0)
    around = mean * np.exp(low + (high - low) * share)
    return np.where(one_sign, around, mean + reach * (2.0 * share - 1.0))


def _halton(n: int, n_dimensions: int) -> np.ndarray:
    """(n, n_dimensions): the first points of Halton's sequence but the one at zero.

    To the last digit those of `scipy.stats.qmc`, which takes half a second to import.
    Source: Halton 1960, doi:10.1007/BF01386213.
    """
    points = np.zeros((n, n_dimensions))
    bases = (k for k in count(2) if all(k % j for j in range(2, k)))
    for column, base in zip(points.T, bases, strict=False):
        digits, place = np.arange(1, n + 1), 1.0
        while digits.any():
            place /= base
            digits, digit = np.divmod(digits, base)
            column += place * digit
    return points


def _check_search(
    model: SparseModel, start: np.ndarray, *, period_s: float, n_samples: int
) -> None:
    _check_free(model)
    if start.shape != (len(model.states),) or not np.isfinite(start).all():
        raise ValueError(
            f"start must give a finite number for each of {list(model.states)}: "
            f"{start.tolist()} came"
        )
    if not (np.isfinite(period_s) and period_s > 0.0):
        raise ValueError(f"period_s must be a positive time in s: {period_s} came")
    if n_samples < 8:
        raise ValueError(f"n_samples must be 8 or more, to draw a cycle: {n_samples} came")


def _check_free(model: SparseModel) -> None:
    if model.inputs:
        raise ValueError(
            f"a cycle needs a model without inputs: this one has {list(model.inputs)}; discover "
            "it with a library of the states alone"
        )


def _check_reach(
    model: SparseModel,
    cycle: LimitCycle,
    *,
    n_starts: int,
    n_periods: float,
    spread: tuple[float, float],
) -> None:
    _check_free(model)
    if cycle.states.shape[1] != len(model.states):
        raise ValueError(
            f"the cycle must be one of this model: it has {cycle.states.shape[1]} states, the "
            f"model {list(model.states)}; take it from limit_cycle(model, ...)"
        )
    if n_starts < 1 or not (np.isfinite(n_periods) and n_periods > N_LATE):
        raise ValueError(
            f"one start or more and over {N_LATE:g} periods are needed, of which the last "
            f"{N_LATE:g} are judged: n_starts={n_starts}, n_periods={n_periods} came"
        )
    if not 0.0 < spread[0] < spread[1] < np.inf:
        raise ValueError(f"spread must be two positive factors, the lower first: {spread} came")
