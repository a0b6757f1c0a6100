"""Limit cycle of a model without inputs: closed orbit, Floquet multipliers, basin of attraction."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Complex, Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.model.draws import starts_around
from ep2sindy.model.kernels import approach
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import check_start, simulate, start_scale
from ep2sindy.model.runge_kutta import CLASSICAL, step
from ep2sindy.model.solve import Driven, solve_stages
from ep2sindy.model.vector_field import VectorField, entries_of
from ep2sindy.runtime.values import check_positive, locked, read_only

# A multiplier whose modulus is this close to one counts as neutral: a perturbation then takes at
# least a thousand periods to change e-fold, longer than any record. The multipliers themselves are
# exact to 1e-6 or better.
NEUTRAL_WITHIN = 1e-3

# Largest modulus, after that of the flow, at which a cycle is trusted to attract: a perturbation
# halves within 14 periods. Data of a few periods cannot tell weaker attraction from none. And the
# smallest at which a cycle repels; a neutral cycle's is one but for errors of its coefficients.
ATTRACTING_BELOW, REPELLING_ABOVE = 0.95, 1.003

# If no orbit is found near the start, Newton's method begins again this many periods later.
N_SETTLING = 10

# A start has reached the cycle if it stays within REACHED_WITHIN of the curve over the last N_LATE
# periods.
REACHED_WITHIN, N_LATE = 0.1, 3.0

# Least number of steps per period, and the largest step times the norm of the Jacobian, well inside
# the stability limit of the fourth-order scheme (2.8).
MIN_STEPS, STEP_TIMES_RATE = 64, 1.0

# A perturbation from an attracting cycle is waited for until it has shrunk to e^-3, a twentieth,
# over a number of periods between these.
SHRUNK, LEAST_WAIT, MOST_WAIT = 3.0, 40.0, 400.0

# Error of a multiplier by Newton's method; eigenvalues of a covariance below this fraction of the
# largest are rounding. Periods and samples at the end of a long run, and its tolerance.
EXACT, NO_DIRECTION = 1e-6, 1e-10
N_END, N_SAMPLES_AT_END, LONG_RTOL = 20, 64, 1e-8

# A run is given up as diverged when it is BLOW_UP times as far from the cycle's mean as the
# farthest start, and as stuck after PATIENCE times the steps that the cycle itself takes, or after
# MOST_STEPS, which on a stiff cycle take a second.
BLOW_UP, PATIENCE, MOST_STEPS = 30.0, 4.0, 1e6


@dataclass(frozen=True, eq=False)
class LimitCycle:
    """A periodic orbit of an autonomous model, with its Floquet multipliers.

    states: over one period, evenly spaced, the first not repeated, in SI. multipliers: Floquet
    multipliers, by which a small perturbation grows in every period; that of the flow itself (1)
    first, the others by decreasing modulus. model: whose orbit it is.
    """

    period_s: float
    states: Float[np.ndarray, "samples n_states"]
    multipliers: Complex[np.ndarray, " n_states"]
    model: SparseModel = field(repr=False)

    def __post_init__(self) -> None:
        multipliers = locked(np.array(self.multipliers, dtype=np.complex128))
        object.__setattr__(self, "states", read_only(self.states))
        object.__setattr__(self, "multipliers", multipliers)
        check_positive("period_s", self.period_s)
        if self.states.ndim != 2 or multipliers.shape != self.states.shape[1:]:
            raise ValueError(
                "a cycle has one multiplier per state, got multipliers of shape "
                f"{multipliers.shape} for states of shape {self.states.shape}"
            )

    @property
    def largest_multiplier(self) -> float:
        """Largest modulus of the multipliers other than that of the flow."""
        return float(np.abs(self.multipliers[1:]).max(initial=0.0))

    @property
    def relaxation_s(self) -> float:
        """Time in s in which a perturbation shrinks e-fold; infinite if it does not."""
        largest = self.largest_multiplier
        if largest == 0.0:
            return 0.0
        return float(-self.period_s / np.log(largest)) if largest < 1.0 else float("inf")

    @property
    def stability(self) -> str:
        """Attracting, neutral or repelling: a small perturbation decays, persists or grows.

        By the largest of the other multipliers; neutral if it is within 1e-3 of one.
        """
        largest = self.largest_multiplier
        if abs(largest - 1.0) <= NEUTRAL_WITHIN:
            return "neutral"
        return "attracting" if largest < 1.0 else "repelling"


def limit_cycle(
    model: SparseModel,
    start: Float[np.ndarray, " n_states"],
    *,
    period_s: float,
    n_samples: int = 128,
) -> LimitCycle | None:
    """Closed orbit near a state, by Newton's method on the return after one period.

    If no orbit is found, the search begins again ten periods later, nearer to an attracting cycle,
    and finally backwards in time, where a repelling cycle attracts.

    Parameters
    ----------
    model : SparseModel
        A model without inputs.
    start : (n_states,) array
        State near the cycle, in SI.
    period_s : float
        A guess of the period in s, within 30 %.
    n_samples : int, default 128
        Number of samples of the orbit.

    Returns
    -------
    LimitCycle or None
        The orbit with its Floquet multipliers. None if the states diverge, Newton's method finds no
        closed orbit with a period of half to twice the guess, or it ends on a fixed point. If the
        guess is several periods, the orbit with the least period is returned.

    Raises
    ------
    ValueError
        If the model has inputs, or the start, the period or the number of samples is wrong.

    Notes
    -----
    Solves, for the state x and the period T,

        flow(x, T) - x = 0

    where x moves across the flow. Steps are of least norm: if closed orbits form a family (predator
    and prey), a neighbouring one is found.

    Source: Seydel 2010, Practical Bifurcation and Stability Analysis, chapter 7.
    """
    _check_free(model)
    start = check_start(model.states, start, name="start")
    if not (np.isfinite(period_s) and period_s > 0.0):
        raise ValueError(f"period_s must be a positive time in s, got {period_s}")
    if n_samples < 8:
        raise ValueError(f"n_samples must be 8 or more, to draw a cycle, got {n_samples}")
    find = partial(_find_orbit, period_s=period_s, n_samples=n_samples)
    cycle = find(model, start) or find(model, start, n_settling=N_SETTLING)
    if cycle is None:
        return _backwards(model, start, period_s=period_s, n_samples=n_samples)
    if cycle.stability != "repelling":
        return cycle
    # Near a repelling orbit the solver's errors grow forwards in time and decay backwards.
    start, period_s = cycle.states[0], cycle.period_s
    return _backwards(model, start, period_s=period_s, n_samples=n_samples) or cycle


def _backwards(
    model: SparseModel, start: np.ndarray, *, period_s: float, n_samples: int
) -> LimitCycle | None:
    """Cycle found in reversed time, converted to forward time."""
    reverse = replace(model, coef=-model.coef, covariance=None)
    cycle = _find_orbit(reverse, start, period_s=period_s, n_samples=n_samples)
    if cycle is None or not cycle.multipliers.all():
        return None
    inverse = 1.0 / cycle.multipliers
    states = np.roll(cycle.states[::-1], 1, axis=0)  # reversed, with the same first state
    return LimitCycle(cycle.period_s, states, np.append(inverse[0], inverse[:0:-1]), model)


def basin_stability(
    model: SparseModel,
    cycle: LimitCycle,
    *,
    n_starts: int = 64,
    n_periods: float | None = None,
    spread: tuple[float, float] = (0.3, 3.0),
) -> float:
    """Fraction of starts that end on a cycle: within 0.1 of it over their last three periods.

    Distances are to the cycle's curve, with states in units of their standard deviation on it. In
    the last periods a run must also pass through all quarters of the cycle.

    Parameters
    ----------
    model : SparseModel
        A model without inputs.
    cycle : LimitCycle
        Its cycle, from `limit_cycle`.
    n_starts : int, default 64
        Number of starts.
    n_periods : float, optional
        Number of periods after which a run is assessed. None takes `periods_to_reach`.
    spread : (float, float), default (0.3, 3.0)
        Starts fill a box (Halton points, so nothing is random). A state that keeps one sign on the
        cycle takes values from spread[0] to spread[1] times its mean, evenly in the logarithm. Any
        other state takes values within spread[1] times half its range of its mean, evenly.

    Returns
    -------
    float
        The fraction, 0 to 1.

    Raises
    ------
    ValueError
        If the model has inputs, the cycle is of another model, or a setting is wrong.

    Notes
    -----
    Every start has its own time step: a 64th of the period, or one over the norm of the Jacobian if
    that is less. A run is given up when it is 30 times as far from the cycle's mean as the farthest
    start, or after four times the steps that the cycle takes, a million at most.

    Source: Menck, Heitzig, Marwan & Kurths 2013, doi:10.1038/nphys2516, for the measure.
    """
    n_periods = periods_to_reach(cycle) if n_periods is None else n_periods
    _check_free(model)
    if cycle.states.shape[1] != len(model.states):
        raise ValueError(
            f"the cycle must be one of this model: it has {cycle.states.shape[1]} states, the "
            f"model {list(model.states)}; take it from limit_cycle(model, ...)"
        )
    if n_starts < 1 or not (np.isfinite(n_periods) and n_periods > N_LATE):
        raise ValueError(
            f"one start or more and over {N_LATE:g} periods are needed, of which the last "
            f"{N_LATE:g} are assessed, got n_starts={n_starts}, n_periods={n_periods}"
        )
    if not 0.0 < spread[0] < spread[1] < np.inf:
        raise ValueError(f"spread must be two positive factors, the lower first, got {spread}")
    scale = deviations(cycle.states)
    field = model.field.scaled(scale, cycle.period_s)
    curve = cycle.states / scale
    y = starts_around(cycle.states, n_starts, spread) / scale
    per_period = float(np.mean(1.0 / _steps(field, curve)))
    n_steps = round(min(PATIENCE * n_periods * per_period, MOST_STEPS))
    on_cycle = _on_cycle(field, y, curve, n_periods, n_steps)
    return float(on_cycle) / n_starts


def periods_to_reach(cycle: LimitCycle) -> float:
    """Periods in which a perturbation from an attracting cycle shrinks to a twentieth, 40 to 400.

    Forty where nothing decays: what is on another cycle of a neutral family stays there.
    """
    largest = cycle.largest_multiplier
    if not 0.0 < largest < 1.0:
        return LEAST_WAIT
    return float(np.clip(-SHRUNK / np.log(largest), LEAST_WAIT, MOST_WAIT))


def multiplier_error(cycle: LimitCycle) -> float:
    """Standard error of the largest multiplier by the covariance of the coefficients.

    It is that of Newton's method, 1e-6, for a model without covariance. Each direction in which the
    coefficients are uncertain moves them by its standard deviation, and the multiplier with them;
    one that leaves no closed orbit counts as moving it by one.
    """
    model = cycle.model
    if model.covariance is None:
        return EXACT
    used = model.coef.T != 0.0
    scale = np.sqrt(zero_to_one(np.maximum(np.diag(model.covariance), 0.0)))
    values, vectors = np.linalg.eigh(model.covariance / np.outer(scale, scale))
    squares = EXACT**2
    for value, vector in zip(values, vectors.T, strict=True):
        if value <= NO_DIRECTION * values[-1]:
            continue
        coef = model.coef.T.copy()
        coef[used] += np.sqrt(value) * vector * scale
        moved = replace(model, coef=coef.T, covariance=None)
        near = limit_cycle(moved, cycle.states[0], period_s=cycle.period_s)
        change = 1.0 if near is None else near.largest_multiplier - cycle.largest_multiplier
        squares += change**2
    return float(np.sqrt(squares))


def end_of_long_run(
    model: SparseModel,
    start: Float[np.ndarray, " n_states"],
    duration_s: float,
    period_s: float,
    scale: Float[np.ndarray, " n_states"],
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples n_states"]] | None:
    """Times and states at the end of a long run by LSODA; None if it diverges or gives up.

    It goes on for twenty periods after the duration, with 64 samples in each. scale: of the states.
    LSODA is another solver than that of `SparseModel.rollout`, whose errors might keep a run on a
    cycle.
    """
    from scipy.integrate import solve_ivp

    n = N_END * N_SAMPLES_AT_END
    t = duration_s + period_s * np.arange(n) / N_SAMPLES_AT_END
    scaled = Driven(model.field.scaled(scale))
    bound = BLOW_UP * (np.linalg.norm(start / scale) + np.sqrt(len(start)))

    def blown_up(_: float, y: np.ndarray) -> float:
        return float(np.linalg.norm(y)) - bound

    blown_up.terminal = True  # type: ignore[attr-defined]
    with np.errstate(over="ignore", invalid="ignore"):
        found = solve_ivp(
            scaled, (0.0, t[-1]), start / scale, method="LSODA", t_eval=t, events=blown_up,
            rtol=LONG_RTOL, atol=LONG_RTOL,
        )  # fmt: skip
    if not found.success or len(found.t) < n or not np.isfinite(found.y).all():
        return None
    return t, found.y.T * scale


def _on_cycle(
    field: VectorField, y: np.ndarray, curve: np.ndarray, n_periods: float, n_steps: int
) -> int:
    """Number of starts (starts, n_states) that follow the curve over the last periods."""
    from scipy.interpolate import CubicSpline  # imports take 0.25 s, and are seldom needed
    from scipy.spatial import KDTree

    closed = np.append(curve, curve[:1], axis=0)
    spline = CubicSpline(np.arange(len(closed)), closed, bc_type="periodic")
    nearest = KDTree(spline(np.arange(16 * len(curve)) / 16.0))
    centre = curve.mean(axis=0)
    bound = float(BLOW_UP * np.abs(y - centre).max())
    y, t, left = _approach(field, y, centre, bound, n_periods - N_LATE, n_steps)
    quarters = np.zeros((len(t), 4), dtype=np.bool_)
    while (running := (t < n_periods) & (left > 0)).any():
        with np.errstate(over="ignore", invalid="ignore"):  # runs that overflow are dropped
            h = np.where(running, _steps(field, y), 0.0)
            y = step(lambda x, _: field.rates(x), y, (t, t, t), h[:, None])
            t, left = t + h, left - running
            kept = (np.abs(y - centre) <= bound).all(axis=1)
        late = np.flatnonzero(kept & (t >= n_periods - N_LATE))
        if len(late):
            distance, place = nearest.query(y[late])
            kept[late] = distance <= REACHED_WITHIN
            quarters[late, 4 * place // nearest.n] = True
        if not kept.all():
            y, t, left, quarters = y[kept], t[kept], left[kept], quarters[kept]
    return int(np.count_nonzero(quarters.all(axis=1) & (t >= n_periods)))


def _steps(field: VectorField, y: np.ndarray) -> np.ndarray:
    """Time step at every state (points, n_states), in periods.

    The Frobenius norm of the Jacobian is no smaller than its largest eigenvalue.
    """
    rate = np.linalg.norm(field.jacobian(y), axis=(1, 2))
    return STEP_TIMES_RATE / np.maximum(rate, STEP_TIMES_RATE * MIN_STEPS)


def _approach(
    field: VectorField, y: np.ndarray, centre: np.ndarray, bound: float, until: float, n_steps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starts that stay within the bound about the centre, run until a time by compiled code.

    Each takes Runge-Kutta steps of its own, at most n_steps. Returns the states, their times and
    the steps left. With functions in the library, which no kernel evaluates, nothing has been run.
    """
    t, left = np.zeros(len(y)), np.full(len(y), n_steps)
    if field.library.functions:
        return y, t, left
    derivatives = field.weights[:, 1:].reshape(-1, field.weights.shape[2]).T
    points = np.array(y, order="C")
    kept = approach(
        field.entries, entries_of(field.products.table, derivatives),
        CLASSICAL.leads, CLASSICAL.weights,
        centre, bound, until, STEP_TIMES_RATE, STEP_TIMES_RATE * MIN_STEPS, points, t, left,
    )  # fmt: skip
    return points[kept], t[kept], left[kept]


def _check_free(model: SparseModel) -> None:
    if model.inputs:
        raise ValueError(
            f"a cycle needs a model without inputs: this one has {list(model.inputs)}; discover "
            "it with a library of the states alone"
        )


# Closed orbits of a model without inputs, by Newton's method on the return after one period.


# Relative tolerances of the integrations: from the start, during Newton's method, and for the
# closed orbit.
START_RTOL, RTOL, FINAL_RTOL = 1e-6, 1e-9, 1e-11

# Longest work on a run; a period takes milliseconds, unless it is stiff.
LIMIT_S = 60.0

# A run is also given up when a state has become this large: in standard deviations, or for the
# first run in units of its initial size.
ORBIT_BLOW_UP, START_BLOW_UP = 1e3, 1e4

# An orbit counts as closed if its gap is below this value times the amplification over one period,
# which is the accuracy that RTOL allows.
CLOSED_WITHIN = 1e-7

# Largest number of Newton steps, shortened ones included; and the longest step of the state, in
# standard deviations. The longest step of the period is a fifth of LONGEST, in guessed periods.
N_NEWTON, LONGEST = 25, 1.0

# Singular values below this fraction of the largest count as zero: the direction of an orbit
# family.
RCOND = 1e-7

# Search range of the first return, and allowed range of the period, in guessed periods.
RETURNS, PERIODS = (0.7, 1.3), (0.5, 2.0)

# An orbit that varies less than this fraction of the first run's standard deviation is a fixed
# point.
STILL = 1e-3

# Samples of a run per guessed period.
N_SAMPLES = 200


def _find_orbit(
    model: SparseModel,
    start: Float[np.ndarray, " n_states"],
    *,
    period_s: float,
    n_samples: int,
    n_settling: int = 0,
) -> LimitCycle | None:
    """Closed orbit over its least period, near where a free run is after periods of settling.

    The closest return of the run starts Newton's method. None if the run diverges, or if Newton's
    method does not close the orbit, or ends on a fixed point.
    """
    # A state that starts near zero has at least the size that its rate gives it in a period.
    moved = np.abs(model.derivative(start, np.empty(0))) * period_s
    size = np.maximum(start_scale(model, start, np.empty(0), period_s), moved)
    n_periods = n_settling + RETURNS[1]
    t = period_s * np.linspace(0.0, n_periods, round(N_SAMPLES * n_periods) + 1)
    free = simulate(model, t, start, None, blow_up=START_BLOW_UP, rtol=START_RTOL, reach=size)
    if free.diverged:
        return None
    run = free.states[n_settling * N_SAMPLES :]
    scale = deviations(run)
    field = model.field.scaled(scale, period_s)
    departing = Driven(field.with_perturbations())
    first, last = (round(N_SAMPLES * r) for r in RETURNS)
    distance = np.linalg.norm((run[first : last + 1] - run[0]) / scale, axis=1)
    period = float(first + distance.argmin()) / N_SAMPLES
    closed = _close_orbit(field, departing, run[0] / scale, period)
    if closed is None:
        return None
    y, period = closed
    # If the guess was several periods, the orbit found is traversed several times.
    turns = np.arange(6, 0, -1)
    path = _path(departing, y, np.append(0.0, period / turns), rtol=FINAL_RTOL)
    if path is None:
        return None
    n, returned = len(y), np.abs(path[1:-1, : len(y)] - y).max(axis=1) < 1e-4
    period /= turns[np.argmax(np.append(returned, True))]
    path = _path(departing, y, np.linspace(0.0, period, n_samples + 1), rtol=FINAL_RTOL)
    if path is None or not (path[:-1, :n].std(axis=0) > STILL).any():
        return None
    multipliers = _multipliers(path[-1, n:].reshape(n, n).T, field.rates(y))
    return LimitCycle(
        period * period_s, _without_rounding(path[:-1, :n]) * scale, multipliers, model
    )


def _multipliers(
    monodromy: Float[np.ndarray, "n_states n_states"], flow: Float[np.ndarray, " n_states"]
) -> Complex[np.ndarray, " n_states"]:
    """Floquet multipliers: 1 for the flow, then those across it by decreasing modulus.

    monodromy: derivatives of the state after one period by the initial state. flow: right-hand
    side there, an eigenvector for the multiplier 1. In a basis that begins with it the other
    multipliers belong to a separate block, so rounding does not split a second multiplier of 1.
    """
    basis = np.linalg.qr(flow[:, None], mode="complete")[0]
    others = np.linalg.eigvals((basis.T @ monodromy @ basis)[1:, 1:])
    return np.append(1.0 + 0.0j, others[np.argsort(-np.abs(others), kind="stable")])


def deviations(states: Float[np.ndarray, "samples n_states"]) -> Float[np.ndarray, " n_states"]:
    """Standard deviations of the states; the size of a constant state, or one if it is zero."""
    # Less than the first run resolves is rounding: by it, a point of rest would look like a cycle.
    std, size = states.std(axis=0), np.abs(states).max(axis=0)
    return np.where(std > START_RTOL * size, std, zero_to_one(size))


def _close_orbit(
    field: VectorField, departing: Driven, y: np.ndarray, period: float
) -> tuple[np.ndarray, float] | None:
    """State and period of a closed orbit, by Newton steps of least norm, halved if they fail."""
    n = len(y)
    base, change, best = np.append(y, period), np.zeros(n + 1), np.inf
    for _ in range(N_NEWTON):
        trial = base + change
        path = None
        if PERIODS[0] <= trial[n] <= PERIODS[1]:
            path = _path(departing, trial[:n], np.array([0.0, trial[n]]), rtol=RTOL)
        missed = np.inf if path is None else float(np.linalg.norm(path[-1, :n] - trial[:n]))
        if path is None or missed > best:
            change = 0.5 * change
            if np.abs(change).max() < CLOSED_WITHIN:
                return None
            continue
        base, best = trial, missed
        monodromy = path[-1, n:].reshape(n, n).T
        change = _newton_step(field, base[:n], path[-1, :n], monodromy)
        if missed <= CLOSED_WITHIN * max(1.0, float(np.linalg.norm(monodromy, 2))):
            base += change  # costs no further integration, and squares the remaining error
            return base[:n], float(base[n])
    return None


def _newton_step(
    field: VectorField, y: np.ndarray, reached: np.ndarray, monodromy: np.ndarray
) -> np.ndarray:
    """Newton step of the state, across the flow, and of the period."""
    n = len(y)
    here, there = field.rates(np.stack([y, reached]))
    equations = np.zeros((n + 1, n + 1))
    equations[:n, :n] = monodromy - np.eye(n)
    equations[:n, n] = there
    equations[n, :n] = here / max(float(np.linalg.norm(here)), np.finfo(float).tiny)
    change = np.linalg.lstsq(equations, np.append(y - reached, 0.0), rcond=RCOND)[0]
    length = max(float(np.linalg.norm(change[:n])), 5.0 * abs(float(change[n])))
    return change * (LONGEST / max(length, LONGEST))


def _path(
    departing: Driven, y: np.ndarray, times: np.ndarray, *, rtol: float
) -> Float[np.ndarray, "times n_states_and_departures"] | None:
    """States from y, then what n unit perturbations become; None if the run is given up."""
    n = len(y)
    found = solve_stages(
        departing,
        times,
        np.append(y, np.eye(n)),
        blow_up=ORBIT_BLOW_UP + float(np.abs(y).max()),
        bound="a standard deviation",
        rtol=rtol,
        limit_s=LIMIT_S,
        n_bounded=n,
    )
    return None if found.ended_early or not np.isfinite(found.y).all() else found.y


def _without_rounding(states: np.ndarray) -> np.ndarray:
    """Make scaled states that are constant, or zero, within the solver's error exactly so."""
    mean = states.mean(axis=0)
    still = np.ptp(states, axis=0) < 1e-6
    return np.where(still, np.where(np.abs(mean) < 1e-6, 0.0, mean), states)
