"""The trajectories behind the rows of fronts, with their states smoothed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.search.front import ParetoFront
from ep2sindy.signals.kalman import KalmanSmoother


@dataclass(frozen=True, eq=False)
class Records:
    """The trajectories that equations are judged by, and their states smoothed."""

    runs: Sequence[Trajectory]
    smoothed: Sequence[Float[np.ndarray, "_ n_states"]]


def records_of(fronts: Sequence[ParetoFront]) -> Records:
    """What stands behind the rows, states in the order of the fronts.

    Raises ValueError for rows without trajectories or a state without a front.
    """
    runs = fronts[0].problem.trajectories
    if not runs:
        raise ValueError(
            "to integrate, the rows must know their trajectories: none came with the regression; "
            "pass them as RegressionRows(trajectories=...)"
        )
    equations = [front.equation for front in fronts]
    if sorted(equations) != sorted(runs[0].state_names):
        raise ValueError(
            f"to integrate, every state needs one front: {equations} came for the states "
            f"{list(runs[0].state_names)}"
        )
    return Records(runs, [KalmanSmoother().smooth(run.t, run.columns(equations)) for run in runs])
