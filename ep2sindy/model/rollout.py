"""Models integrated over time: along the data, or freely from one state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from ep2sindy.data.trajectory import Trajectory, check_time
from ep2sindy.library.library import Library
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.edges import Border, Edge, edges_of
from ep2sindy.model.inputs import Drive, driven, spline
from ep2sindy.model.rates import used_terms

# Evaluations of the right-hand side that a run may take: a hundred times what an oscillation
# takes that its samples resolve. A model that blows up in steps ever smaller stops there.
CALLS, CALLS_PER_SAMPLE = 20_000, 200


@runtime_checkable
class Equations(Protocol):
    """What is integrated, a SparseModel: x' = library(states, inputs) coef."""

    @property
    def library(self) -> Library: ...

    @property
    def states(self) -> Sequence[str]: ...

    @property
    def inputs(self) -> Sequence[str]: ...

    @property
    def coef(self) -> np.ndarray: ...

    @property
    def units(self) -> Mapping[str, str]: ...


@dataclass(frozen=True, eq=False)
class Rollout:
    """A model integrated along data or freely, and how that ended.

    t: (samples,) in s, states: (samples, n_states), inputs: (samples, n_inputs), all cut where
    a diverged run stopped. units: by name, of states and inputs. clock: how people read t.
    outside: the function of the model whose domain the run has left; it counts as diverged.
    """

    t: Float[np.ndarray, " samples"]
    states: Float[np.ndarray, "samples n_states"]
    diverged: bool
    message: str
    state_names: tuple[str, ...]
    inputs: Float[np.ndarray, "samples n_inputs"]
    input_names: tuple[str, ...]
    units: Mapping[str, str]
    outside: str = ""
    clock: Clock = SECONDS

    @property
    def lasted_s(self) -> float:
        return float(self.t[-1] - self.t[0]) if len(self.t) else 0.0

    @property
    def lasted_text(self) -> str:
        """`182 µs`; empty where nothing was integrated."""
        return self.clock.duration_text(self.lasted_s) if self.lasted_s else ""

    def trajectory(self, *, label: str = "") -> Trajectory:
        """The samples as data, as far as they go.

        Raises ValueError where there are fewer than two, or where a state never changed.
        """
        return Trajectory(
            t=self.t,
            states=self.states,
            state_names=self.state_names,
            inputs=self.inputs,
            input_names=self.input_names,
            units=self.units,
            label=label,
            clock=self.clock,
        )


def rollout(
    model: Equations,
    trajectory: Trajectory,
    *,
    start: int,
    n_samples: int | None,
    initial: Float[np.ndarray, " n_states"] | None,
    blow_up: float,
    rtol: float,
) -> Rollout:
    """Integrate along a trajectory: see `SparseModel.rollout`."""
    stop = trajectory.n_samples if n_samples is None else start + n_samples
    window = trajectory.window(start, stop)
    data = window.columns(model.states)
    inputs = window.columns(model.inputs)
    found = _integrated(
        model,
        window.t,
        data[0] if initial is None else initial,
        drive=spline(window.t, inputs) if model.inputs else None,
        samples=inputs,
        scale=np.abs(data).max(axis=0),
        blow_up=blow_up,
        bound="the data's largest value",
        rtol=rtol,
    )
    return replace(found, clock=trajectory.clock)


def simulate(
    model: Equations,
    t: ArrayLike,
    x0: ArrayLike,
    inputs: ArrayLike | Mapping[str, Any] | None,
    *,
    blow_up: float,
    rtol: float,
) -> Rollout:
    """Integrate freely from one state: see `SparseModel.simulate`."""
    times, start = np.asarray(t, dtype=np.float64), np.asarray(x0, dtype=np.float64)
    if start.shape != (len(model.states),) or not np.isfinite(start).all():
        came = f"shape {start.shape}" if start.size > 8 else f"{start.tolist()}"
        raise ValueError(
            f"x0 must give a finite number for each of {list(model.states)}: {came} came; the "
            "order is simulate(t, x0)"
        )
    check_time(times)
    drive, samples = driven(model.inputs, inputs, times)
    library, coef = used_terms(model.library, model.coef)
    values, terms = library.at_points([*model.states, *model.inputs])
    values[:] = np.append(start, samples[0])
    # What starts at zero is as large as its first rate makes it; what stays there, one.
    reach = np.abs(start) + (start == 0.0) * np.abs(terms() @ coef) * (times[-1] - times[0])
    return _integrated(
        model,
        times,
        start,
        drive=drive,
        samples=samples,
        scale=np.where(reach > 0.0, reach, 1.0),
        blow_up=blow_up,
        bound="its start",
        rtol=rtol,
    )


def _integrated(
    model: Equations,
    t: np.ndarray,
    x0: np.ndarray,
    *,
    drive: Drive | None,
    samples: np.ndarray,
    scale: np.ndarray,
    blow_up: float,
    bound: str,
    rtol: float,
) -> Rollout:
    """From x0 over t, in units of `scale`, until a state exceeds `blow_up` of them."""
    border = _border(model, np.append(x0, samples[0]), drive, scale)
    if edge := border.beyond(t[0], x0 / scale):
        message = f"the start, at t = {t[0]:.6g} s, is outside {edge.text}"
        return _ended(model, t[:1], x0[None], samples, message, edge.function.name)
    rhs = _Counted(_scaled_rhs(model, drive, scale), CALLS + CALLS_PER_SAMPLE * len(t), border)

    def ends(t: float, y: np.ndarray) -> float:
        return min(blow_up - float(np.abs(y).max()), rhs.left_s(t))

    ends.terminal = True  # type: ignore[attr-defined]
    # An overflow on the way to a blow-up is caught by the event, or ends the solver.
    with np.errstate(over="ignore", invalid="ignore"):
        solution = solve_ivp(
            rhs,
            (t[0], t[-1]),
            x0 / scale,
            method="DOP853",
            t_eval=t,
            events=[ends, border] if border.edges else [ends],
            rtol=rtol,
            atol=rtol,
        )
    message = _ending_text(solution, blow_up, bound, exhausted=rhs.given_up_s < np.inf)
    if edge := _left(solution, rhs, border):
        message = f"the run left {edge.text}, at t = {solution.t[-1]:.6g} s"
    return _ended(
        model,
        solution.t,
        solution.y.T * scale,
        samples,
        message,
        edge.function.name if edge else "",
        diverged=solution.status != 0,
    )


def _ended(
    model: Equations,
    t: np.ndarray,
    states: np.ndarray,
    samples: np.ndarray,
    message: str,
    outside: str = "",
    *,
    diverged: bool = True,
) -> Rollout:
    return Rollout(
        t=t,
        states=states,
        diverged=diverged,
        message=message,
        state_names=tuple(model.states),
        inputs=samples[: len(t)],
        input_names=tuple(model.inputs),
        units=model.units,
        outside=outside,
    )


def _border(model: Equations, start: np.ndarray, drive: Drive | None, scale: np.ndarray) -> Border:
    """Of the functions that the model uses."""

    def values(t: float, y: np.ndarray) -> np.ndarray:
        return y * scale if drive is None else np.append(y * scale, drive(t))

    library, _ = used_terms(model.library, model.coef)
    return Border(edges_of(library.functions, [*model.states, *model.inputs], start), values)


class _Counted:
    """A right-hand side that may be evaluated so many times, and that knows its border."""

    def __init__(
        self, rhs: Callable[[float, np.ndarray], np.ndarray], budget: int, border: Border
    ) -> None:
        self.rhs, self.budget, self.border = rhs, budget, border
        self.calls, self.given_up_s = 0, float("inf")
        self.beyond: Edge | None = None
        self.beyond_s = float("inf")

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        self.calls += 1
        if edge := self.border.beyond(t, y):
            self.beyond, self.beyond_s = edge, t
        elif t > self.beyond_s and np.isfinite(y).all():  # a step too long has been mended
            self.beyond = None
        return self.rhs(t, y)

    def left_s(self, t: float) -> float:
        """Time until the run is given up, which is when it is first asked with nothing left."""
        if self.calls > self.budget:
            self.given_up_s = min(self.given_up_s, t)
        return self.given_up_s - t


def _scaled_rhs(
    model: Equations, drive: Drive | None, scale: np.ndarray
) -> Callable[[float, np.ndarray], np.ndarray]:
    """The right-hand side for scaled states, with the absent terms left out."""
    present = np.flatnonzero(model.coef.any(axis=1))
    coef = model.coef[present] / scale
    values, terms = model.library.at_points([*model.states, *model.inputs], present)
    n = len(model.states)

    def rhs(t: float, y: np.ndarray) -> np.ndarray:
        values[:n] = y * scale
        if drive is not None:
            values[n:] = drive(t)
        return terms() @ coef

    return rhs


def _left(solution: Any, rhs: _Counted, border: Border) -> Edge | None:
    """The edge that a run ended at, if it did: crossed, or too steep for a solver to cross."""
    if border.edges and solution.status == 1 and solution.t_events[1].size:
        return border.nearest(solution.t_events[1][0], solution.y_events[1][0])
    return rhs.beyond if solution.status == -1 else None


def _ending_text(solution: object, blow_up: float, bound: str, *, exhausted: bool) -> str:
    status, t = solution.status, solution.t  # type: ignore[attr-defined]
    last = t[-1] if len(t) else float("nan")
    if status == 0:
        return f"integrated to t = {last:.6g} s"
    if status == 1 and exhausted:
        return f"the solver gave up at t = {last:.6g} s: its steps became too small for the samples"
    if status == 1:
        return f"a state grew past {blow_up:g} times {bound} at t = {last:.6g} s"
    return f"the solver stopped at t = {last:.6g} s: {solution.message}"  # type: ignore[attr-defined]
