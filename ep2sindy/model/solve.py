"""Time integration with a budget of evaluations.

Equations of products are integrated by compiled code, equations with functions by SciPy, and stiff
equations by an implicit method. A run ends at the edge of the domain of its model's functions:
beyond it the rates are not finite, and no step gets across.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from time import monotonic

import numpy as np
from jaxtyping import Float

from ep2sindy.library.functions import Function, Interval
from ep2sindy.model.inputs import Curve
from ep2sindy.model.runge_kutta import dormand_prince
from ep2sindy.model.vector_field import VectorField

# Largest number of evaluations of the right-hand side in a run: a hundred times what an oscillation
# needs that its samples resolve. A model that blows up in ever smaller steps stops there.
CALLS, CALLS_PER_SAMPLE = 20_000, 200
EXPLICIT, IMPLICIT = "DOP853", "Radau"
# Stiffness is tested after FIRST_LOOK evaluations, and each time that their number has doubled.
FIRST_LOOK, CALLS_PER_STEP = 5_000, 12
# Fastest decay rate times step above which a run counts as stiff. Accuracy keeps this product well
# below the bound, stability below 6.
STABLE = 2.0
# Evaluations of compiled equations between readings of the clock: about a tenth of a second.
CALLS_PER_LOOK = 100_000

Rates = Callable[[float, np.ndarray], np.ndarray]
Border = Callable[[float, np.ndarray], "Edge | None"]
Clock = Callable[[], float]  # seconds since an arbitrary origin


@dataclass(frozen=True, eq=False)
class Driven:
    """Right-hand side of a vector field, in its own units, with its inputs along time."""

    field: VectorField
    drive: Curve | None = None

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        values, rates = self._at_point
        values[: len(y)] = y
        if self.drive is not None and len(values) > len(y):
            values[len(y) :] = self.drive(t)
        return rates()

    @property
    def is_compiled(self) -> bool:
        """Whether compiled code can integrate it, which calls no functions."""
        return not (self.field.library.functions or (self.drive and self.drive.functions))

    @cached_property
    def parts(self) -> tuple[np.ndarray, ...]:
        """Arguments of the compiled functions; see `model.kernels`."""
        t, pieces = np.arange(2.0), np.empty((1, 1, 0))
        if self.drive is not None:
            t, pieces = self.drive.t, self.drive.pieces
        # Copied: kernels would be compiled again for a strided or read-only array.
        return tuple(np.array(part, order="C") for part in (*self.field.entries, t, pieces))

    @cached_property
    def _at_point(self) -> tuple[np.ndarray, Callable[[], np.ndarray]]:
        return self.field.at_point()


@dataclass(frozen=True, eq=False)
class Integration:
    """States at the times that were reached, and how the run ended.

    status: as in SciPy's `solve_ivp`, 0 at the end, 1 at an event and -1 if steps became too
    small. edge: the edge of the domain that the run left; None if it left none. last_s, last: time
    and state of the event, if there was one.
    """

    t: Float[np.ndarray, " samples"]
    y: Float[np.ndarray, "samples n_states"]
    status: int
    message: str = ""
    edge: Edge | None = None
    last_s: float = np.nan
    last: Float[np.ndarray, " n_states"] | None = None

    @property
    def ended_early(self) -> bool:
        return self.status != 0


@dataclass
class Counted:
    """Right-hand side with bounds, and with a budget of evaluations and time.

    border: the edge of the domain that a state lies beyond, where the rates are NaN; None for rates
    that are defined everywhere. bound: the quantity that `blow_up` is a multiple of, in words.
    """

    rates: Rates
    border: Border | None
    stops: Float[np.ndarray, " _"]
    n_bounded: int
    blow_up: float
    bound: str
    rtol: float
    budget: int
    clock: Clock
    started: float
    limit_s: float
    began_s: float
    calls: int = 0
    look_at: int = FIRST_LOOK
    stiff: bool = False
    given_up_s: float = np.inf
    beyond: Edge | None = None
    beyond_s: float = np.inf

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        self.calls += 1
        if self.is_beyond(t, y):
            return np.full(len(y), np.nan)
        if t > self.beyond_s and np.isfinite(y).all():  # a shorter step stayed in the domain
            self.beyond = None
        return self.rates(t, y)

    def is_beyond(self, t: float, y: np.ndarray) -> bool:
        """True, and noted, for a state beyond an edge of the domain."""
        edge = self.border(t, y) if self.border else None
        if edge:
            self.beyond, self.beyond_s = edge, t
        return edge is not None

    def left_s(self, t: float, y: np.ndarray) -> float:
        """Integration time until the run is given up: when first called with no budget left."""
        if self.given_up_s == np.inf:
            if self.calls > self.look_at:
                self.look_at *= 2
                self.stiff = self._is_stiff(t, y)
            late = self.clock() > self.started + self.limit_s
            if self.stiff or self.calls > self.budget or late:
                self.given_up_s = t
        return self.given_up_s - t

    def _is_stiff(self, t: float, y: np.ndarray) -> bool:
        """True if a fast decaying mode limits the steps by stability, rather than accuracy."""
        fastest = fastest_rate(self.rates, t, y)
        step_s = CALLS_PER_STEP * (t - self.began_s) / self.calls
        return bool(fastest.real < -abs(fastest.imag) and abs(fastest) * step_s > STABLE)


def solve_stages(
    rates: Rates,
    t: Float[np.ndarray, " samples"],
    y: Float[np.ndarray, " n_states"],
    *,
    border: Border | None = None,
    stops: Sequence[float] | Float[np.ndarray, " _"] = (),
    blow_up: float = np.inf,
    bound: str = "",
    rtol: float,
    limit_s: float,
    n_bounded: int | None = None,
    clock: Clock = monotonic,
) -> Integration:
    """Integrate from y over t, first explicitly, then implicitly if the equations are stiff.

    The run ends early if a state exceeds `blow_up`, leaves the domain or exhausts the budget.
    A `Driven` field of products is integrated by compiled functions. If stability limits the steps,
    an implicit method continues the run, with the same number of evaluations again.
    border: see `Counted`. stops: times among t at which the inputs jump or bend; every method
    starts anew there. bound: the quantity that `blow_up` is a multiple of, in words. n_bounded:
    number of the first states, which `blow_up` bounds; None for all. clock: measures `limit_s`.
    """
    budget, n_bounded = CALLS + CALLS_PER_SAMPLE * len(t), n_bounded or len(y)
    rhs = Counted(
        rates, border, np.asarray(stops), n_bounded, blow_up, bound, rtol, budget, clock, clock(),
        limit_s, float(t[0]),
    )  # fmt: skip
    with np.errstate(over="ignore", invalid="ignore"):  # on the way to a blow-up
        if not np.isfinite(rhs(t[0], y)).all():
            text = f"the first step overflows: a rate at t = {t[0]:.6g} s is not finite"
            return Integration(t[:1], y[None], -1, text)
        compiled = isinstance(rates, Driven) and rates.is_compiled
        found = _compiled_stage(rhs, t, y) if compiled else _scipy_stage(rhs, t, y)
        return _continue_implicitly(found, rhs, t) if rhs.stiff else _explain_end(found, rhs)


def _continue_implicitly(before: Integration, rhs: Counted, t: np.ndarray) -> Integration:
    """Continue a stiff run by the implicit method, and join both parts."""
    at, state = before.last_s, before.last
    assert state is not None, "a run that is found to be stiff has been stopped there"
    # began_s at infinity: this part is never taken for stiff.
    rest = replace(
        rhs, began_s=np.inf, started=rhs.clock(), calls=0, stiff=False, given_up_s=np.inf
    )
    rest.limit_s -= rest.started - rhs.started
    try:
        found = _scipy_stage(rest, np.append(at, t[t > at]), state, IMPLICIT)
    except (ValueError, np.linalg.LinAlgError):  # raised for slopes that are not finite
        text = f"the equations are stiff, and overflow, at t = {at:.6g} s"
        return replace(before, status=-1, message=text)
    ended = _explain_end(found, rest)
    return replace(
        ended,
        t=np.append(before.t, ended.t[1:]),
        y=np.concatenate([before.y, ended.y[1:]]),
        message=f"{ended.message}; stiff from t = {at:.6g} s on, and implicit there",
    )


def _scipy_stage(rhs: Counted, t: np.ndarray, y: np.ndarray, method: str = EXPLICIT) -> Integration:
    """Integrate by one method of SciPy, from each stop of the inputs to the next."""
    places = [0, *(np.flatnonzero(np.isin(t[1:-1], rhs.stops)) + 1).tolist(), len(t) - 1]
    times, states = [t[:1]], [y[None]]
    for first, last in pairwise(places):
        if rhs.is_beyond(t[first], states[-1][-1]):  # inputs have jumped out of the domain
            part = Integration(t[:0], y[None][:0], -1)
            break
        part = _smooth_stage(rhs, method, t[first : last + 1], states[-1][-1])
        times.append(part.t[1:])
        states.append(part.y[1:])
        if part.status:
            break
    return replace(part, t=np.concatenate(times), y=np.concatenate(states))


def _smooth_stage(rhs: Counted, method: str, t: np.ndarray, y: np.ndarray) -> Integration:
    """Integrate between two stops; the event is a blow-up or the end of the budget."""
    from scipy.integrate import solve_ivp

    before_end = np.nextafter(t[-1], -np.inf)  # at a stop itself the inputs have jumped already

    def rates(now: float, y: np.ndarray) -> np.ndarray:
        return rhs(min(now, before_end), y)

    def ends(t: float, y: np.ndarray) -> float:
        return min(rhs.blow_up - float(np.abs(y[: rhs.n_bounded]).max()), rhs.left_s(t, y))

    ends.terminal = True  # type: ignore[attr-defined]
    found = solve_ivp(
        rates, (t[0], t[-1]), y, method=method, t_eval=t, events=ends, rtol=rhs.rtol, atol=rhs.rtol
    )
    # A solver that failed in its first step gives an empty list.
    states = np.asarray(found.y, dtype=np.float64).reshape(len(y), -1).T
    times = np.asarray(found.t, dtype=np.float64)
    event = (float(found.t_events[0][0]), found.y_events[0][0]) if found.status == 1 else ()
    return Integration(times, states, found.status, found.message, None, *event)


def _compiled_stage(rhs: Counted, t: np.ndarray, y: np.ndarray) -> Integration:
    """Integrate by the compiled explicit method, which takes the same steps as SciPy's."""
    from ep2sindy.model import kernels

    assert isinstance(rhs.rates, Driven)
    equations, times, stops = rhs.rates.parts, np.array(t), np.append(rhs.stops, t[-1])
    now, state, out = float(t[0]), np.array(y), np.empty((len(t), len(y)))
    slope = rhs.rates(now, state)
    h = _first_step(rhs.rates, now, float(t[-1]) - now, state, slope, rhs.rtol)
    rhs.calls += 2
    place, status = 0, kernels.LOOK
    while status == kernels.LOOK and rhs.left_s(now, state) > 0.0:
        limit = min(rhs.look_at, rhs.budget, rhs.calls + CALLS_PER_LOOK)
        status, now, h, place, rhs.calls = kernels.advance(
            equations, dormand_prince(), times, stops, out, state, slope, now, h, place, rhs.calls,
            limit, rhs.n_bounded, rhs.blow_up, rhs.rtol,
        )  # fmt: skip
    if status == kernels.FINISHED:
        return Integration(times, out, 0)
    if status == kernels.FAILED:
        text = "Required step size is less than spacing between numbers."
        return Integration(times[:place], out[:place], -1, text)
    return Integration(times[:place], out[:place], 1, last_s=now, last=state)


def _first_step(
    rates: Rates, t: float, span: float, y: np.ndarray, slope: np.ndarray, rtol: float
) -> float:
    """First step size from the first two derivatives: Hairer, Norsett & Wanner 1993, II.4."""
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
    """Eigenvalue of largest modulus of the Jacobian, in 1/s; zero if it is not finite."""
    steps = 1e-7 * np.maximum(np.abs(y), 1e-3)
    with np.errstate(all="ignore"):
        ahead, behind = ([rates(t, y + s * step) for step in np.diag(steps)] for s in (1.0, -1.0))
    jacobian = (np.array(ahead) - np.array(behind)).T / (2.0 * steps)
    if not np.isfinite(jacobian).all():
        return 0.0j
    values = np.linalg.eigvals(jacobian)
    return complex(values[np.argmax(np.abs(values))])


def _explain_end(found: Integration, rhs: Counted) -> Integration:
    """The solution with the edge at which it ended, if any, and with its end in words."""
    edge = rhs.beyond if found.status == -1 else None
    last = found.t[-1] if len(found.t) else float("nan")
    message = f"the run left {edge.text}, at t = {last:.6g} s" if edge else _text(found, rhs, last)
    return replace(found, message=message, edge=edge)


def _text(found: Integration, rhs: Counted, last: float) -> str:
    if found.status == 0:
        return f"integrated to t = {last:.6g} s"
    if found.status == -1:
        return f"the solver stopped at t = {last:.6g} s: {found.message}"
    if not np.isfinite(rhs.given_up_s):
        return f"a state grew past {rhs.blow_up:g} times {rhs.bound} at t = {last:.6g} s"
    gave_up = f"the solver gave up at t = {rhs.given_up_s:.6g} s, after"
    if rhs.calls > rhs.budget:
        return (
            f"{gave_up} {rhs.calls} evaluations of the equations: its steps became too small for "
            "the samples"
        )
    return f"{gave_up} {rhs.clock() - rhs.started:.3g} s of work"


# Edges at which a run leaves the domain of its model's functions, such as x = 0 for log(x).


@dataclass(frozen=True)
class Edge:
    """A function and the interval of its domain in which a run starts.

    place: index of the function's variable among the values. interval: None if the start is
    outside the domain.
    """

    function: Function
    place: int
    interval: Interval | None

    def margin(self, values: Float[np.ndarray, " known"]) -> float:
        """Distance of the argument to the nearer end of its interval; zero or less outside."""
        argument = self.function.scale * values[self.place] + self.function.shift
        low, high = self.interval or (np.inf, -np.inf)
        return float(min(argument - low, high - argument))

    @property
    def text(self) -> str:
        return f"the domain of {self.function.name}, which needs {self.function.need}"


def edges_of(
    functions: Sequence[Function], known: Sequence[str], start: Float[np.ndarray, " known"]
) -> tuple[Edge, ...]:
    """Edges of the domains of functions around the start of a run; sin(x) has none."""
    edges = []
    for function in functions:
        place = list(known).index(function.variable)
        interval = function.interval(float(start[place]))
        if interval is None or np.isfinite(interval).any():
            edges.append(Edge(function, place, interval))
    return tuple(edges)
