"""Models integrated over time: along the data, or freely from one state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library


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


@dataclass(frozen=True, eq=False)
class Rollout:
    """A model integrated over a window of a trajectory.

    t: (samples,) in s, states: (samples, n_states), both cut where a diverged run stopped.
    """

    t: Float[np.ndarray, " samples"]
    states: Float[np.ndarray, "samples n_states"]
    diverged: bool
    message: str


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
    return _integrated(
        model,
        window.t,
        data[0] if initial is None else initial,
        drive=spline(window.t, inputs) if model.inputs else None,
        scale=np.abs(data).max(axis=0),
        blow_up=blow_up,
        bound="the data's largest value",
        rtol=rtol,
    )


def spline(
    t: Float[np.ndarray, " samples"], inputs: Float[np.ndarray, "samples n_inputs"]
) -> Callable[[float], np.ndarray]:
    """Inputs between their samples, by cubics."""
    return make_interp_spline(t, inputs, k=min(3, len(inputs) - 1))


def _integrated(
    model: Equations,
    t: np.ndarray,
    x0: np.ndarray,
    *,
    drive: Callable[[float], np.ndarray] | None,
    scale: np.ndarray,
    blow_up: float,
    bound: str,
    rtol: float,
) -> Rollout:
    """From x0 over t, in units of `scale`, until a state exceeds `blow_up` of them."""

    def too_large(t: float, y: np.ndarray) -> float:
        return blow_up - float(np.abs(y).max())

    too_large.terminal = True  # type: ignore[attr-defined]
    # An overflow on the way to a blow-up is caught by the event, or ends the solver.
    with np.errstate(over="ignore", invalid="ignore"):
        solution = solve_ivp(
            _scaled_rhs(model, drive, scale),
            (t[0], t[-1]),
            x0 / scale,
            method="DOP853",
            t_eval=t,
            events=too_large,
            rtol=rtol,
            atol=rtol,
        )
    return Rollout(
        t=solution.t,
        states=solution.y.T * scale,
        diverged=solution.status != 0,
        message=_ending_text(solution, blow_up, bound),
    )


def _scaled_rhs(
    model: Equations, drive: Callable[[float], np.ndarray] | None, scale: np.ndarray
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


def _ending_text(solution: object, blow_up: float, bound: str) -> str:
    status, t = solution.status, solution.t  # type: ignore[attr-defined]
    last = t[-1] if len(t) else float("nan")
    if status == 0:
        return f"integrated to t = {last:.6g} s"
    if status == 1:
        return f"a state grew past {blow_up:g} times {bound} at t = {last:.6g} s"
    return f"the solver stopped at t = {last:.6g} s: {solution.message}"  # type: ignore[attr-defined]
