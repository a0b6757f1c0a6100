"""Integration in time with a budget: compiled, by SciPy for functions, implicit where stiff.

A run ends at the border of the domain of its model's functions, which `Border` finds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from time import monotonic

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.library.functions import Function, Interval

# Evaluations of the right-hand side that a run may take: a hundred times what an oscillation
# takes that its samples resolve. A model that blows up in steps ever smaller stops there.
CALLS, CALLS_PER_SAMPLE = 20_000, 200
EXPLICIT, IMPLICIT = "DOP853", "Radau"
# Whether a run is stiff is asked after so many evaluations, and each time that they have doubled.
FIRST_LOOK, CALLS_PER_STEP = 5_000, 12
STABLE = 2.0  # the fastest rate times a step, which accuracy keeps well below and stability below 6
# Evaluations of compiled equations after which the clock is looked at: a tenth of a second.
CALLS_PER_LOOK = 100_000

Rates = Callable[[float, np.ndarray], np.ndarray]
Clock = Callable[[], float]  # seconds that have passed since whenever


@dataclass(frozen=True, eq=False)
class Products:
    """A right-hand side of products of scaled states and of inputs, which can be compiled.

    table: which columns each term multiplies, of the states, the inputs and a one. coef: in units
    of the scale. breaks, pieces: the inputs as cubics in the time since the last break.
    """

    table: Int[np.ndarray, "terms degree"]
    coef: Float[np.ndarray, "terms n_states"]
    scale: Float[np.ndarray, " n_states"]
    breaks: Float[np.ndarray, " _"]
    pieces: Float[np.ndarray, "order spans n_inputs"]

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        from ep2sindy.model import kernels

        slope, columns = np.empty(len(y)), np.ones(len(y) + self.pieces.shape[2] + 1)
        # Copied: of a column or of what is read only, kernels would be compiled anew.
        kernels.rates(self.parts, float(t), np.array(y), columns, slope)
        return slope

    @cached_property
    def parts(self) -> tuple[np.ndarray, ...]:
        """What compiled functions take: see `model.kernels`."""
        parts = self.table, self.coef, self.scale, self.breaks, self.pieces
        return tuple(np.array(part, order="C") for part in parts)


@cache
def scheme() -> tuple[np.ndarray, ...]:
    """Coefficients of the explicit method, from SciPy's table of them: see `model.kernels`."""
    from scipy.integrate import DOP853

    tables = (
        DOP853.A, DOP853.B, DOP853.C, DOP853.E3, DOP853.E5,
        DOP853.A_EXTRA, DOP853.C_EXTRA, DOP853.D,
    )  # fmt: skip
    return tuple(np.ascontiguousarray(table) for table in tables)


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
    clock: Clock
    deadline: float
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
            if self.stiff or self.calls > self.budget or self.clock() > self.deadline:
                self.given_up_s = t
        return self.given_up_s - t

    def _is_stiff(self, t: float, y: np.ndarray) -> bool:
        """Whether steps are short because the fastest part decays, and not to follow the run."""
        fastest = fastest_rate(self.rates, t, y)
        step_s = CALLS_PER_STEP * (t - self.began_s) / self.calls
        return bool(fastest.real < -abs(fastest.imag) and abs(fastest) * step_s > STABLE)


@dataclass(frozen=True, eq=False)
class Stage:
    """What one method made of a run: states at the times reached, and why it stopped there.

    status: of SciPy's `solve_ivp`, 0 at the end, 1 at an event and -1 where steps became too
    small. last_s, last: the time and state of the event, if there was one. crossed: whether that
    was a border of the equations' domain.
    """

    t: Float[np.ndarray, " samples"]
    y: Float[np.ndarray, "samples n_states"]
    status: int
    message: str = ""
    last_s: float = np.nan
    last: Float[np.ndarray, " n_states"] | None = None
    crossed: bool = False


def solve_stages(
    rates: Rates,
    border: Border,
    t: Float[np.ndarray, " samples"],
    y: Float[np.ndarray, " n_states"],
    *,
    blow_up: float,
    bound: str,
    rtol: float,
    limit_s: float,
    clock: Clock = monotonic,
) -> Solved:
    """From y over t, until a state exceeds `blow_up`, a domain is left or the budget is spent.

    `Products` are integrated by compiled functions. A run whose steps stability keeps short goes
    on from there by an implicit method, with as many evaluations again. bound: what `blow_up` is
    a multiple of, in words. clock: what `limit_s` is measured by.
    """
    began = clock()
    budget = CALLS + CALLS_PER_SAMPLE * len(t)
    rhs = Counted(rates, border, budget, clock, began + limit_s, float(t[0]))
    with np.errstate(over="ignore", invalid="ignore"):  # on the way to a blow-up
        if not np.isfinite(rhs(t[0], y)).all():
            text = f"the first step overflows: a rate at t = {t[0]:.6g} s is not finite"
            return Solved(t[:1], y[None], True, text)
        explicit = _compiled_stage if isinstance(rates, Products) else _explicit_stage
        found = explicit(rhs, t, y, blow_up, rtol)
        if rhs.stiff:
            return _implicit(found, rhs, t, blow_up, bound, rtol)
    return _outcome(found, rhs, blow_up, bound, clock() - began)


def _implicit(
    before: Stage, rhs: Counted, t: np.ndarray, blow_up: float, bound: str, rtol: float
) -> Solved:
    """The rest of a run that was stiff, behind what had been reached."""
    began, at, state = rhs.clock(), before.last_s, before.last
    assert state is not None, "a run that is found to be stiff has been stopped there"
    # Never stiff itself: it does not say when it began.
    rest = Counted(rhs.rates, rhs.border, rhs.budget, rhs.clock, rhs.deadline)
    try:
        found = _scipy_stage(rest, IMPLICIT, np.append(at, t[t > at]), state, blow_up, rtol)
    except (ValueError, np.linalg.LinAlgError):  # slopes that are not finite
        text = f"the equations are stiff, and overflow, at t = {at:.6g} s"
        return Solved(before.t, before.y, True, text)
    ended = _outcome(found, rest, blow_up, bound, rhs.clock() - began)
    text = f"{ended.message}; stiff from t = {at:.6g} s on, and implicit there"
    states = np.concatenate([before.y, ended.y[1:]])
    times = np.append(before.t, ended.t[1:])
    return Solved(times, states, ended.ended_early, text, ended.edge)


def _explicit_stage(
    rhs: Counted, t: np.ndarray, y: np.ndarray, blow_up: float, rtol: float
) -> Stage:
    return _scipy_stage(rhs, EXPLICIT, t, y, blow_up, rtol)


def _scipy_stage(
    rhs: Counted, method: str, t: np.ndarray, y: np.ndarray, blow_up: float, rtol: float
) -> Stage:
    """Of one method; the first event is a blow-up or the end of the budget."""
    from scipy.integrate import solve_ivp

    def ends(t: float, y: np.ndarray) -> float:
        return min(blow_up - float(np.abs(y).max()), rhs.left_s(t, y))

    ends.terminal = True  # type: ignore[attr-defined]
    events = [ends, rhs.border] if rhs.border.edges else [ends]
    found = solve_ivp(
        rhs, (t[0], t[-1]), y, method=method, t_eval=t, events=events, rtol=rtol, atol=rtol
    )
    # A solver that failed in its first step gives an empty list.
    states = np.asarray(found.y, dtype=np.float64).reshape(len(y), -1).T
    times = np.asarray(found.t, dtype=np.float64)
    met = [k for k, at in enumerate(found.t_events) if at.size] if found.status == 1 else []
    if not met:
        return Stage(times, states, found.status, found.message)
    first = met[-1]  # a border comes before a budget that ends in the same step
    last_s, last = float(found.t_events[first][0]), found.y_events[first][0]
    return Stage(times, states, found.status, found.message, last_s, last, crossed=first == 1)


def _compiled_stage(
    rhs: Counted, t: np.ndarray, y: np.ndarray, blow_up: float, rtol: float
) -> Stage:
    """The explicit method, compiled: step by step what SciPy's does."""
    from ep2sindy.model import kernels

    assert isinstance(rhs.rates, Products)
    equations, times = rhs.rates.parts, np.array(t)
    now, state, out = float(t[0]), np.array(y), np.empty((len(t), len(y)))
    slope = rhs.rates(now, state)
    h = _first_step(rhs.rates, now, float(t[-1]) - now, state, slope, rtol)
    rhs.calls += 2
    place, status = 0, kernels.LOOK
    while status == kernels.LOOK and rhs.left_s(now, state) > 0.0:
        limit = min(rhs.look_at, rhs.budget, rhs.calls + CALLS_PER_LOOK)
        status, now, h, place, rhs.calls = kernels.advance(
            equations, scheme(), times, out, state, slope, now, h, place, rhs.calls, limit,
            blow_up, rtol,
        )  # fmt: skip
    if status == kernels.FINISHED:
        return Stage(times, out, 0)
    if status == kernels.FAILED:
        text = "Required step size is less than spacing between numbers."
        return Stage(times[:place], out[:place], -1, text)
    return Stage(times[:place], out[:place], 1, "", now, state)


def _first_step(
    rates: Rates, t: float, span: float, y: np.ndarray, slope: np.ndarray, rtol: float
) -> float:
    """By the size of the first two derivatives: Hairer, Norsett & Wanner 1993, II.4."""
    allowed = rtol + np.abs(y) * rtol
    size, fast = (float(np.sqrt(np.mean(np.square(v / allowed)))) for v in (y, slope))
    h = min(1e-6 if size < 1e-5 or fast < 1e-5 else 0.01 * size / fast, span)
    h = max(h, float(np.finfo(np.float64).tiny))  # the slope may be too large to be squared
    bend = rates(t + h, y + h * slope) - slope
    bent = float(np.sqrt(np.mean(np.square(bend / allowed)))) / h
    if fast <= 1e-15 and bent <= 1e-15:
        return min(100.0 * h, max(1e-6, h * 1e-3), span)
    return min(100.0 * h, (0.01 / max(fast, bent)) ** (1.0 / 8.0), span)


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


def _outcome(found: Stage, rhs: Counted, blow_up: float, bound: str, took_s: float) -> Solved:
    edge = _left(found, rhs)
    message = _text(found, rhs, blow_up, bound, took_s)
    if edge:
        at = found.t[-1] if len(found.t) else np.nan
        message = f"the run left {edge.text}, at t = {at:.6g} s"
    return Solved(found.t, found.y, found.status != 0, message, edge)


def _left(found: Stage, rhs: Counted) -> Edge | None:
    """The edge that a run ended at, if it did: crossed, or too steep for a solver to cross."""
    if found.crossed and found.last is not None:
        return rhs.border.nearest(found.last_s, found.last)
    return rhs.beyond if found.status == -1 else None


def _text(found: Stage, rhs: Counted, blow_up: float, bound: str, took_s: float) -> str:
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


# Where a run leaves the domain of its model's functions, such as log(x) at x = 0.


@dataclass(frozen=True)
class Edge:
    """A function, the place of its variable among values, and the interval its argument is in.

    interval: None where the start is in none.
    """

    function: Function
    place: int
    interval: Interval | None

    def margin(self, values: Float[np.ndarray, " known"]) -> float:
        """How far the argument is inside; zero or less where it has left."""
        argument = self.function.scale * values[self.place] + self.function.shift
        low, high = self.interval or (np.inf, -np.inf)
        return float(min(argument - low, high - argument))

    @property
    def text(self) -> str:
        return f"the domain of {self.function.name}, which needs {self.function.need}"


def edges_of(
    functions: Sequence[Function], known: Sequence[str], start: Float[np.ndarray, " known"]
) -> tuple[Edge, ...]:
    """Where functions end, on either side of where a run starts; sin(x) has no end."""
    edges = []
    for function in functions:
        place = list(known).index(function.variable)
        interval = function.interval(float(start[place]))
        if interval is None or np.isfinite(interval).any():
            edges.append(Edge(function, place, interval))
    return tuple(edges)


@dataclass(frozen=True)
class Border:
    """All edges of a model along one run: an event for a solver, which ends there.

    values: time in s and scaled states -> states and inputs in SI.
    """

    edges: tuple[Edge, ...]
    values: Callable[[float, np.ndarray], np.ndarray]
    terminal: bool = True

    def __call__(self, t: float, y: np.ndarray) -> float:
        at = self.values(t, y)
        return min(edge.margin(at) for edge in self.edges)

    def nearest(self, t: float, y: np.ndarray) -> Edge:
        at = self.values(t, y)
        return min(self.edges, key=lambda edge: edge.margin(at))

    def beyond(self, t: float, y: np.ndarray) -> Edge | None:
        """An edge that a state lies beyond, if any."""
        if not self.edges:
            return None
        at = self.values(t, y)
        return next((edge for edge in self.edges if edge.margin(at) <= 0.0), None)
