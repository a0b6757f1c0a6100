"""A model integrated over a window of a trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Rollout:
    """A model integrated over a window of a trajectory.

    t: (samples,) in s, states: (samples, n_states), both cut where a diverged run stopped.
    """

    t: Float[np.ndarray, " samples"]
    states: Float[np.ndarray, "samples n_states"]
    diverged: bool
    message: str


def ending_text(solution: object, blow_up: float) -> str:
    status, t = solution.status, solution.t  # type: ignore[attr-defined]
    last = t[-1] if len(t) else float("nan")
    if status == 0:
        return f"integrated to t = {last:.6g} s"
    if status == 1:
        return f"a state grew past {blow_up:g} times the data's largest value at t = {last:.6g} s"
    return f"the solver stopped at t = {last:.6g} s: {solution.message}"  # type: ignore[attr-defined]
