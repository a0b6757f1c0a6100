"""Explicit Runge-Kutta schemes as tables of numbers, and one step of them in arrays.

Source: Hairer, Norsett & Wanner 1993, Solving Ordinary Differential Equations I: II.1 for the
schemes of order four, II.5, II.6 and II.10 for the one of order eight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np


class Tableau(NamedTuple):
    """An explicit scheme of four stages, in fractions of a step.

    leads: (4, 4), weight of each earlier slope in the state of a stage; weights: (4,), of the
    slopes in the end of the step. places: (4,), of the stages among the positions at which inputs
    are given; every step begins `stride` positions after the one before.
    """

    leads: np.ndarray
    weights: np.ndarray
    places: np.ndarray
    stride: int


CLASSICAL = Tableau(
    leads=np.diag([0.5, 0.5, 1.0], k=-1),
    weights=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
    places=np.array([0, 1, 1, 2]),
    stride=2,
)

THREE_EIGHTHS = Tableau(
    leads=np.array([[0, 0, 0, 0], [1 / 3, 0, 0, 0], [-1 / 3, 1, 0, 0], [1.0, -1, 1, 0]]),
    weights=np.array([0.125, 0.375, 0.375, 0.125]),
    places=np.arange(4),
    stride=3,
)


@cache
def dormand_prince() -> tuple[np.ndarray, ...]:
    """Coefficients of the scheme of order eight, from SciPy's tables; see `model.kernels`."""
    from scipy.integrate import DOP853

    tables = (
        DOP853.A, DOP853.B, DOP853.C, DOP853.E3, DOP853.E5,
        DOP853.A_EXTRA, DOP853.C_EXTRA, DOP853.D,
    )  # fmt: skip
    return tuple(np.ascontiguousarray(table) for table in tables)


def step(
    slope: Callable[[np.ndarray, Any], np.ndarray],
    x: np.ndarray,
    inputs: Sequence[Any],
    h: float | np.ndarray,
) -> np.ndarray:
    """One classical step of x' = slope(x, inputs), of any number of states at once.

    inputs: at the start, middle and end of the step, or the times of these. h: length of the step,
    one number or an array that broadcasts.
    """
    end, k = x, np.zeros_like(x)
    for lead, weight, place in zip(
        CLASSICAL.leads.sum(axis=1), CLASSICAL.weights, CLASSICAL.places, strict=True
    ):
        k = slope(x + lead * h * k, inputs[place])  # a stage leads on from the one before alone
        end = end + weight * h * k
    return end
