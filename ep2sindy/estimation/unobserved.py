"""Signs that a state is unobserved, in the geometry of the path.

A state that moves by a law of its own cannot pass a value upwards and later downwards, and the path
of two states in their plane cannot cross itself.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.estimation.problem import BySample, EstimationProblem
from ep2sindy.estimation.solver import smooth_states

CLEAR = 4.0  # steps between the points of a path, in standard deviations of the noise
MOST_POINTS = 3000  # of a path that is looked at, the first ones
STRAIGHT = 0.95  # least cosine of the turn from one step to the next
LEAST_SINE = 0.5  # of the angle of a crossing: noise turns a path by less
LEAST_CROSSINGS = 3  # one may come from a gap or an outlier


def unobserved_state(problem: EstimationProblem) -> str:
    """The sign that a state is missing; empty if there is none, inputs drive, or d is above two."""
    d = len(problem.states)
    if problem.driven or d > 2 or not problem.measured.all():
        return ""
    smooth, _, noise = smooth_states(problem, None)
    paths = [_clear_steps(path) for path in problem.split(smooth / noise)]
    name = problem.states[0]
    if d == 1 and sum(_turns(path[:, 0]) for path in paths) >= LEAST_CROSSINGS:
        return f"{name} passes the same values up and down, which no law of {name} alone does"
    if d == 2 and sum(_crossings(path) for path in paths) >= LEAST_CROSSINGS:
        both = " and ".join(problem.states)
        return f"the path of {both} crosses itself, which no law of {both} alone does"
    return ""


def _clear_steps(path: BySample) -> Float[np.ndarray, "points d"]:
    """Points of a path that lie clearly apart; in units of the noise."""
    kept = [0]
    for k in range(1, len(path)):
        if np.square(path[k] - path[kept[-1]]).sum() > CLEAR**2:
            kept.append(k)
            if len(kept) == MOST_POINTS:
                break
    return path[kept]


def _turns(x: Float[np.ndarray, " points"]) -> int:
    """Number of turns from up to down."""
    up = np.diff(x) > 0.0
    return int((up[:-1] & ~up[1:]).sum())


def _crossings(path: Float[np.ndarray, "points 2"]) -> int:
    """Number of pairs of steps that cross each other at a clear angle."""
    if len(path) < 4:
        return 0
    points = path / np.maximum(path.std(axis=0), 1e-150)
    step = np.diff(points, axis=0)
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-150)
    along = (step[1:] * step[:-1]).sum(axis=1) > STRAIGHT * length[1:] * length[:-1]
    # The chord of an arc cuts its corner: only where the path goes straight does it lie on it.
    straight = np.flatnonzero(along[1:] & along[:-1]) + 1
    points, step, length = points[straight], step[straight], length[straight]
    count = 0
    for k in range(len(step) - 1):
        # Step k is p + s u, and a later one q + t v, with s and t from 0 to 1.
        between, later = points[k + 1 :] - points[k], step[k + 1 :]
        area = step[k, 0] * later[:, 1] - step[k, 1] * later[:, 0]
        clear = np.abs(area) > LEAST_SINE * length[k] * length[k + 1 :]
        safe = np.where(clear, area, 1.0)
        s = (between[:, 0] * later[:, 1] - between[:, 1] * later[:, 0]) / safe
        t = (between[:, 0] * step[k, 1] - between[:, 1] * step[k, 0]) / safe
        count += int((clear & (s >= 0.0) & (s < 1.0) & (t >= 0.0) & (t < 1.0)).sum())
    return count
