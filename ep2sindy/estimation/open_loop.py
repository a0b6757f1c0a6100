"""Open-loop runs of a fitted model: whether it keeps the motion of the samples by itself.

A path that the samples steer from step to step, or that process noise holds up, may follow them
though the model itself decays, runs away or turns at another pace. So the model is run from the
first state alone, several times, under the process noise of its fit (a posterior predictive check;
Gelman, Meng & Stern 1996, Statistica Sinica 6:733). Compared are the spread of each state and the
number of its turns, which chaos and a wandering phase leave as they are. Assumed is that the path
shows them: the runs begin where it does, so they pass the same transients.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.estimation.likelihood import TrajectoryFit
from ep2sindy.estimation.observation import LackOfFit
from ep2sindy.estimation.problem import ByState, ScaledRecord
from ep2sindy.model.flow import Steps, ends

N_RUNS = 100  # the path of a right model is outside of all runs with a chance of 2 in 101
MOST_STEPS = 1000  # of a run: more would say the same
RUNS_AWAY = 10.0  # distance from the middle of the path, in halves of its range
# Least factor between the path and the median run. Errors of coefficients change spread and pace by
# some percent; a wrong cycle is off by more.
OFF = 1.5
COUNTED = 0.5  # standard deviations on either side of the mean that a counted turn passes
STRAYS = "run freely from its first state the model decays, runs away or turns at another pace"
Runs = Float[np.ndarray, "samples runs d"]


def try_open_loop(
    fit: TrajectoryFit, noise: ByState, process: ByState, *, start: ByState
) -> LackOfFit:
    """Test whether any measured state leaves its motion when the model of a fit runs by itself.

    noise, process: standard deviations, of the samples and of each step of the runs, scaled. start:
    those of the first state. The longest record is compared, and at most its first thousand steps.
    """
    problem = fit.problem
    record, path = max(zip(problem.records, fit.paths, strict=True), key=lambda pair: len(pair[1]))
    path = path[: MOST_STEPS + 1]
    first = path[0] + start * np.random.default_rng(0).standard_normal((N_RUNS, len(start)))
    runs = _run(fit, record, first, process, len(path))
    middle, half = (path.max(axis=0) + path.min(axis=0)) / 2.0, np.ptp(path, axis=0) / 2.0
    with np.errstate(invalid="ignore"):
        stay = (np.abs(runs - middle) <= RUNS_AWAY * zero_to_one(half + noise)).all(axis=0)
    whole = stay[:, problem.measured].all(axis=1)
    strays = 2 * int(whole.sum()) < N_RUNS or any(
        _leaves(path[:, k], runs[:, whole, k], float(noise[k]))
        for k in np.flatnonzero(problem.measured).tolist()
    )
    return LackOfFit(np.full(len(noise), strays), 0.0, STRAYS)


def _run(
    fit: TrajectoryFit, record: ScaledRecord, first: np.ndarray, process: ByState, n: int
) -> Runs:
    """Runs of n samples from first states, (runs, d), under the inputs of a record."""
    rng, field, runs = np.random.default_rng(1), fit.problem.field(fit.free), [first]
    steps = ScaledRecord.join([record]).divided(fit.n_substeps)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for k in range(n - 1):
            inputs = np.repeat(steps.inputs[:, k : k + 1], N_RUNS, axis=1)
            moved = ends(field, runs[-1], Steps(np.full(N_RUNS, steps.h[k]), inputs))
            runs.append(moved + process * rng.standard_normal(moved.shape))
    return np.array(runs)


def _leaves(
    path: Float[np.ndarray, " samples"], runs: Float[np.ndarray, "samples runs"], noise: float
) -> bool:
    """True if all runs have another spread than a path in its second half, or other turns.

    What is smaller than the noise is not compared.
    """
    late, level = slice(len(path) // 2, None), COUNTED * float(np.hypot(path.std(), noise))
    off = np.column_stack([path, runs]) - path.mean()
    for own, *theirs in (np.hypot(off[late].std(axis=0), noise), _turns(off, level)):
        less = max(theirs) < own and OFF * np.median(theirs) < own
        if less or (min(theirs) > own and np.median(theirs) > OFF * own):
            return True
    return False


def _turns(off: Float[np.ndarray, "samples runs"], level: float) -> Float[np.ndarray, " runs"]:
    """How often each run passes from a level below zero to the same level above it."""
    count, below = np.zeros(off.shape[1]), np.zeros(off.shape[1], dtype=np.bool_)
    for row in off:
        above = row > level
        count += below & above
        below = (below & ~above) | (row < -level)
    return count
