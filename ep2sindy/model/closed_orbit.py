"""Closed orbits of a free model: Newton's method on the return after one period."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float
from scipy.integrate import DOP853, OdeSolution

from ep2sindy.model.model import SparseModel
from ep2sindy.model.scaled import ScaledModel

# Of the integrations: from the start, while Newton's method runs, and once the orbit is closed.
START_RTOL, RTOL, FINAL_RTOL = 1e-6, 1e-9, 1e-11

# A period takes 30 to 300 steps; a run that takes this many, stiff on its way to infinity, is lost.
MAX_STEPS = 1000

# A state this many standard deviations (of the first run: times its first size) away is lost, too.
BLOW_UP, START_BLOW_UP = 1e3, 1e4

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


def closed_orbit(
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
    closed = _closed(scaled, run[0] / scale, float(first + distance.argmin()) / N_SAMPLES)
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


def _closed(scaled: ScaledModel, y: np.ndarray, period: float) -> tuple[np.ndarray, float] | None:
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
    blow_up: float = BLOW_UP,
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
