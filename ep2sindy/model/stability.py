"""The limit cycle of a free model: closed orbit, Floquet multipliers, starts that reach it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import count

import numpy as np
from jaxtyping import Complex, Float
from scipy.integrate import DOP853, OdeSolution

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


class CycleStability(StrEnum):
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
    def stability(self) -> CycleStability:
        """By the largest modulus of the multipliers but the flow's: neutral within 1e-3 of one."""
        largest = float(np.abs(self.multipliers[1:]).max(initial=0.0))
        if abs(largest - 1.0) <= NEUTRAL_WITHIN:
            return CycleStability.NEUTRAL
        return CycleStability.ATTRACTING if largest < 1.0 else CycleStability.REPELLING


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
    if cycle.stability is not CycleStability.REPELLING:
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
    orbit = find_closed_orbit(model, run, period_s=period_s, n_samples=n_samples)
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

    nearest = KDTree(_interpolate(curve))
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


def _interpolate(curve: np.ndarray) -> np.ndarray:
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


# Closed orbits of a free model: Newton's method on the return after one period.


# Of the integrations: from the start, while Newton's method runs, and once the orbit is closed.
START_RTOL, RTOL, FINAL_RTOL = 1e-6, 1e-9, 1e-11

# A period takes 30 to 300 steps; a run that takes this many, stiff on its way to infinity, is lost.
MAX_STEPS = 1000

# A state this many standard deviations (of the first run: times its first size) away is lost, too.
ORBIT_BLOW_UP, START_BLOW_UP = 1e3, 1e4

# A return this close, times what the orbit amplifies, is closed to within what RTOL resolves.
CLOSED_WITHIN = 1e-7

# Steps of Newton's method, shortened ones included; the longest, in standard deviations, and a
# fifth of it for the period, in guessed ones.
N_NEWTON, LONGEST = 25, 1.0

# Singular values below this share of the largest are zero: along a family of closed orbits.
RCOND = 1e-7

# Where the first return is looked for, and where the period must lie, in guessed ones.
RETURNS, PERIODS = (0.7, 1.3), (0.5, 2.0)

# What oscillates less than this share of the first run's standard deviation is a fixed point.
STILL = 1e-3

# Samples of a run to a guessed period.
N_SAMPLES = 200


@dataclass(frozen=True, eq=False)
class ClosedOrbit:
    """An orbit of least period, in units of `scale` and of the guessed period.

    states: evenly spaced, the first not repeated. monodromy: derivatives of the state after a
    period by the first one. flow: the slope there.
    """

    period: float
    states: Float[np.ndarray, "samples n_states"]
    monodromy: Float[np.ndarray, "n_states n_states"]
    flow: Float[np.ndarray, " n_states"]
    scale: Float[np.ndarray, " n_states"]

    @property
    def multipliers(self) -> Complex[np.ndarray, " n_states"]:
        """One for the flow, then those of departures across it, by falling modulus.

        The flow is an eigenvector of 1; in a basis that begins with it the rest is a block of
        its own, so that a second multiplier of 1 is not split by rounding.
        """
        basis = np.linalg.qr(self.flow[:, None], mode="complete")[0]
        others = np.linalg.eigvals((basis.T @ self.monodromy @ basis)[1:, 1:])
        return np.append(1.0 + 0.0j, others[np.argsort(-np.abs(others), kind="stable")])


@dataclass(frozen=True, eq=False)
class _Path:
    """A state and, behind it, departures from it, integrated; `at` works where it was kept."""

    end: np.ndarray
    times: list[float]
    pieces: list[object]

    def at(self, t: float | np.ndarray) -> np.ndarray:
        return OdeSolution(self.times, self.pieces)(t)


def free_run(
    model: SparseModel, start: Float[np.ndarray, " n_states"], *, period_s: float, n_periods: float
) -> Float[np.ndarray, "samples n_states"] | None:
    """States from a start on, N_SAMPLES to a period; None where they diverge."""
    # What starts near zero is as large as its first rate makes it; what stays there, one.
    size = np.maximum(np.abs(start), np.abs(model.derivative(start, np.empty(0))) * period_s)
    size = np.where(size > 0.0, size, 1.0)
    scaled = ScaledModel.of(model, size, period_s)
    y = np.append(start / size, np.zeros(start.size**2))
    path = _path(scaled, y, n_periods, rtol=START_RTOL, blow_up=START_BLOW_UP, keep=True)
    if path is None:
        return None
    times = np.linspace(0.0, n_periods, round(N_SAMPLES * n_periods) + 1)
    return path.at(times)[: start.size].T * size


def find_closed_orbit(
    model: SparseModel,
    run: Float[np.ndarray, "samples n_states"],
    *,
    period_s: float,
    n_samples: int,
) -> ClosedOrbit | None:
    """The orbit next to where a `free_run` begins; its closest return begins the search.

    None where Newton's method does not close it, or ends on a fixed point.
    """
    scale = deviations(run)
    scaled = ScaledModel.of(model, scale, period_s)
    first, last = (round(N_SAMPLES * r) for r in RETURNS)
    distance = np.linalg.norm((run[first : last + 1] - run[0]) / scale, axis=1)
    closed = _close_orbit(scaled, run[0] / scale, float(first + distance.argmin()) / N_SAMPLES)
    if closed is None:
        return None
    y, period = closed
    n = len(y)
    path = _path(scaled, np.append(y, np.eye(n)), period, rtol=FINAL_RTOL, keep=True)
    if path is None:
        return None
    # A guess of several periods is met by several turns.
    turns = (k for k in range(6, 1, -1) if np.abs(path.at(period / k)[:n] - y).max() < 1e-4)
    period /= next(turns, 1)
    states = path.at(np.arange(n_samples) * (period / n_samples))[:n].T
    if not (states.std(axis=0) > STILL).any():
        return None
    monodromy = path.at(period)[n:].reshape(n, n).T
    return ClosedOrbit(
        period, _without_rounding(states), monodromy, scaled.slope(y[:, None])[:, 0], scale
    )


def deviations(states: Float[np.ndarray, "samples n_states"]) -> Float[np.ndarray, " n_states"]:
    """Standard deviations; of a state that stands still its size, at zero one."""
    std, size = states.std(axis=0), np.abs(states).max(axis=0)
    return np.where(std > 1e-9 * size, std, np.where(size > 0.0, size, 1.0))


def _close_orbit(
    scaled: ScaledModel, y: np.ndarray, period: float
) -> tuple[np.ndarray, float] | None:
    """State and period of a closed orbit, by Newton steps of least norm, halved where they fail."""
    n = len(y)
    base, step, best = np.append(y, period), np.zeros(n + 1), np.inf
    for _ in range(N_NEWTON):
        trial = base + step
        path = None
        if PERIODS[0] <= trial[n] <= PERIODS[1]:
            path = _path(scaled, np.append(trial[:n], np.eye(n)), float(trial[n]), rtol=RTOL)
        missed = np.inf if path is None else float(np.linalg.norm(path.end[:n] - trial[:n]))
        if path is None or missed > best:
            step = 0.5 * step
            if np.abs(step).max() < CLOSED_WITHIN:
                return None
            continue
        base, best = trial, missed
        monodromy = path.end[n:].reshape(n, n).T
        step = _newton_step(scaled, base[:n], path.end[:n], monodromy)
        if missed <= CLOSED_WITHIN * max(1.0, float(np.linalg.norm(monodromy, 2))):
            base += step  # it costs nothing more, and squares what is missed
            return base[:n], float(base[n])
    return None


def _newton_step(
    scaled: ScaledModel, y: np.ndarray, reached: np.ndarray, monodromy: np.ndarray
) -> np.ndarray:
    """Of the state, across the flow, and of the period."""
    n = len(y)
    here, there = scaled.slope(np.stack([y, reached], axis=1)).T
    equations = np.zeros((n + 1, n + 1))
    equations[:n, :n] = monodromy - np.eye(n)
    equations[:n, n] = there
    equations[n, :n] = here / max(float(np.linalg.norm(here)), np.finfo(float).tiny)
    step = np.linalg.lstsq(equations, np.append(y - reached, 0.0), rcond=RCOND)[0]
    length = max(float(np.linalg.norm(step[:n])), 5.0 * abs(float(step[n])))
    return step * (LONGEST / max(length, LONGEST))


def _path(
    scaled: ScaledModel,
    y: np.ndarray,
    span: float,
    *,
    rtol: float,
    blow_up: float = ORBIT_BLOW_UP,
    keep: bool = False,
) -> _Path | None:
    """From a state and departures, over scaled time; None where it is lost."""
    n = scaled.n_states
    times, pieces = [0.0], []
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is lost
        solver = DOP853(scaled.with_departures(), 0.0, y, span, rtol=rtol, atol=rtol)
        for _ in range(MAX_STEPS):
            solver.step()
            if solver.status == "failed" or not np.abs(solver.y[:n] - y[:n]).max() < blow_up:
                return None
            if keep:
                times.append(solver.t)
                pieces.append(solver.dense_output())
            if solver.status == "finished":
                return _Path(solver.y, times, pieces) if np.isfinite(solver.y).all() else None
    return None


def _without_rounding(states: np.ndarray) -> np.ndarray:
    """Scaled states that stand still, or at zero, to within the solver's error do so exactly."""
    mean = states.mean(axis=0)
    still = np.ptp(states, axis=0) < 1e-6
    return np.where(still, np.where(np.abs(mean) < 1e-6, 0.0, mean), states)
