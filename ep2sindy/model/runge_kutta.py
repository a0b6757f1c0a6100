"""The classical Runge-Kutta scheme, for many states at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def rk4_step(
    slope: Callable[[np.ndarray, np.ndarray], np.ndarray],
    x: np.ndarray,
    inputs: tuple[np.ndarray, np.ndarray, np.ndarray],
    step_s: float | np.ndarray,
) -> np.ndarray:
    """One step of fourth order of x' = slope(x, inputs).

    inputs: at the start, middle and end of the step. step_s: one, or of a shape that broadcasts.
    Source: Hairer, Norsett & Wanner 1993, Solving Ordinary Differential Equations I, II.1.
    """
    start, middle, end = inputs
    k1 = slope(x, start)
    k2 = slope(x + 0.5 * step_s * k1, middle)
    k3 = slope(x + 0.5 * step_s * k2, middle)
    k4 = slope(x + step_s * k3, end)
    return x + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
