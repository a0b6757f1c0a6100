"""Integration in time with a budget, by an implicit method where equations are stiff."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp

from ep2sindy.model.edges import Border, Edge

# Evaluations of the right-hand side that a run may take: a hundred times what an oscillation
# takes that its samples resolve. A model that blows up in steps ever smaller stops there.
CALLS, CALLS_PER_SAMPLE = 20_000, 200
EXPLICIT, IMPLICIT = "DOP853", "Radau"
# Whether a run is stiff is asked after so many evaluations, and each time that they have doubled.
FIRST_LOOK, CALLS_PER_STEP = 5_000, 12
STABLE = 2.0  # the fastest rate times a step, which accuracy keeps well below and stability below 6

Rates = Callable[[float, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Solved:
    """States at the times that were reached, and how the run ended.

    edge: of the domain that it left, if it did.
    """

    t: Float[np.ndarray, " samples"]
    y: Float[np.ndarray, "samples n_states"]
    ended_early: bool
    message: str
    edge: Edge | None = None


@dataclass
class Counted:
    """A right-hand side that may be evaluated so many times, and that knows its border."""

    rates: Rates
    border: Border
    budget: int
    deadline: float = np.inf
    began_s: float = np.inf
    calls: int = 0
    look_at: int = FIRST_LOOK
    stiff: bool = False
    given_up_s: float = np.inf
    beyond: Edge | None = None
    beyond_s: float = np.inf

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        self.calls += 1
        if edge := self.border.beyond(t, y):
            self.beyond, self.beyond_s = edge, t
        elif t > self.beyond_s and np.isfinite(y).all():  # a step too long has been mended
            self.beyond = None
        return self.rates(t, y)

    def left_s(self, t: float, y: np.ndarray) -> float:
        """Time until the run is given up, which is when it is first asked with nothing left."""
        if self.given_up_s == np.inf:
            if self.calls > self.look_at:
                self.look_at *= 2
                self.stiff = self._is_stiff(t, y)
            if self.stiff or self.calls > self.budget or monotonic() > self.deadline:
                self.given_up_s = t
        return self.given_up_s - t

    def _is_stiff(self, t: float, y: np.ndarray) -> bool:
        """Whether steps are short because the fastest part decays, and not to follow the run."""
        fastest = fastest_rate(self.rates, t, y)
        step_s = CALLS_PER_STEP * (t - self.began_s) / self.calls
        return bool(fastest.real < -abs(fastest.imag) and abs(fastest) * step_s > STABLE)


def solved(
    rates: Rates,
    border: Border,
    t: Float[np.ndarray, " samples"],
    y: Float[np.ndarray, " n_states"],
    *,
    blow_up: float,
    bound: str,
    rtol: float,
    limit_s: float,
) -> Solved:
    """From y over t, until a state exceeds `blow_up`, a domain is left or the budget is spent.

    A run whose steps stability keeps short goes on from there by an implicit method, with as many
    evaluations again. bound: what `blow_up` is a multiple of, in words.
    """
    began = monotonic()
    rhs = Counted(rates, border, CALLS + CALLS_PER_SAMPLE * len(t), began + limit_s, float(t[0]))
    with np.errstate(over="ignore", invalid="ignore"):  # on the way to a blow-up
        if not np.isfinite(rhs(t[0], y)).all():
            text = f"the first step overflows: a rate at t = {t[0]:.6g} s is not finite"
            return Solved(t[:1], y[None], True, text)
        found = _stage(rhs, EXPLICIT, t, y, blow_up, rtol)
        if rhs.stiff:
            at, state = float(found.t_events[0][0]), found.y_events[0][0]
            return _implicit(found, rhs, t, at, state, blow_up, bound, rtol)
    return _outcome(found, rhs, len(y), blow_up, bound, monotonic() - began)


def _implicit(
    before: Any,
    rhs: Counted,
    t: np.ndarray,
    at: float,
    state: np.ndarray,
    blow_up: float,
    bound: str,
    rtol: float,
) -> Solved:
    """The rest of a run that was stiff, behind what had been reached."""
    began = monotonic()
    rest = Counted(rhs.rates, rhs.border, rhs.budget, rhs.deadline)  # never stiff: no began_s
    ahead = t[t > at]
    try:
        found = _stage(rest, IMPLICIT, np.append(at, ahead), state, blow_up, rtol)
    except (ValueError, np.linalg.LinAlgError):  # slopes that are not finite
        text = f"the equations are stiff, and overflow, at t = {at:.6g} s"
        return Solved(before.t, _states(before, len(state)), True, text)
    ended = _outcome(found, rest, len(state), blow_up, bound, monotonic() - began)
    text = f"{ended.message}; stiff from t = {at:.6g} s on, and implicit there"
    states = np.concatenate([_states(before, len(state)), ended.y[1:]])
    times = np.append(before.t, ended.t[1:])
    return Solved(times, states, ended.ended_early, text, ended.edge)


def _stage(
    rhs: Counted, method: str, t: np.ndarray, y: np.ndarray, blow_up: float, rtol: float
) -> Any:
    """Of one method; the first event is a blow-up or the end of the budget."""

    def ends(t: float, y: np.ndarray) -> float:
        return min(blow_up - float(np.abs(y).max()), rhs.left_s(t, y))

    ends.terminal = True  # type: ignore[attr-defined]
    events = [ends, rhs.border] if rhs.border.edges else [ends]
    return solve_ivp(
        rhs, (t[0], t[-1]), y, method=method, t_eval=t, events=events, rtol=rtol, atol=rtol
    )


def fastest_rate(rates: Rates, t: float, y: np.ndarray) -> complex:
    """Eigenvalue of the largest size of the linearization, in 1/s; zero where there is none."""
    steps = 1e-7 * np.maximum(np.abs(y), 1e-3)
    with np.errstate(all="ignore"):
        ahead, behind = ([rates(t, y + s * step) for step in np.diag(steps)] for s in (1.0, -1.0))
    jacobian = (np.array(ahead) - np.array(behind)).T / (2.0 * steps)
    if not np.isfinite(jacobian).all():
        return 0.0j
    values = np.linalg.eigvals(jacobian)
    return complex(values[np.argmax(np.abs(values))])


def _outcome(
    found: Any, rhs: Counted, n_states: int, blow_up: float, bound: str, took_s: float
) -> Solved:
    edge, t = _left(found, rhs), np.asarray(found.t, dtype=np.float64)
    message = _text(found, rhs, blow_up, bound, took_s)
    if edge:
        message = f"the run left {edge.text}, at t = {t[-1] if len(t) else np.nan:.6g} s"
    return Solved(t, _states(found, n_states), found.status != 0, message, edge)


def _states(found: Any, n_states: int) -> np.ndarray:
    """(samples, n_states); a solver that failed in its first step gives an empty list."""
    return np.asarray(found.y, dtype=np.float64).reshape(n_states, -1).T


def _left(found: Any, rhs: Counted) -> Edge | None:
    """The edge that a run ended at, if it did: crossed, or too steep for a solver to cross."""
    if rhs.border.edges and found.status == 1 and found.t_events[1].size:
        return rhs.border.nearest(found.t_events[1][0], found.y_events[1][0])
    return rhs.beyond if found.status == -1 else None


def _text(found: Any, rhs: Counted, blow_up: float, bound: str, took_s: float) -> str:
    last = found.t[-1] if len(found.t) else float("nan")
    if found.status == 0:
        return f"integrated to t = {last:.6g} s"
    if found.status == 1 and np.isfinite(rhs.given_up_s):
        if rhs.calls > rhs.budget:
            return (
                f"the solver gave up at t = {rhs.given_up_s:.6g} s, after {rhs.calls} evaluations "
                "of the equations: its steps became too small for the samples"
            )
        return f"the solver gave up at t = {rhs.given_up_s:.6g} s, after {took_s:.3g} s of work"
    if found.status == 1:
        return f"a state grew past {blow_up:g} times {bound} at t = {last:.6g} s"
    return f"the solver stopped at t = {last:.6g} s: {found.message}"
