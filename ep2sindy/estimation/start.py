"""Where an estimate begins: smoothed states, and every coefficient from their derivatives."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.data.domain import kept_inside
from ep2sindy.data.scales import zero_to_one
from ep2sindy.estimation.likelihood import Fit
from ep2sindy.estimation.noise import FLOOR
from ep2sindy.estimation.problem import Problem
from ep2sindy.signals.kalman import KalmanSmoother

UNSURE = 0.05  # of the RMS: noise taken for a start where the smoother's is not believed
CUTOFF = 1e-8  # singular values of unit columns: smaller ones follow noise


def smoothed_start(
    problem: Problem, log10_ratio: float | None
) -> tuple[Fit, tuple[np.ndarray, ...]]:
    """All coefficients free, on smoothed states; and the noise beside them, by record (samples, d).

    log10_ratio: of the smoother; None finds the most likely one of each record and state. Below
    some twenty samples a period the likely one may take signal for noise.
    """
    smoother = KalmanSmoother(log10_ratio)
    estimates = [smoother.estimate(r.times, r.samples) for r in problem.records]
    variance = np.mean([np.square(e.noise_std) for e in estimates], axis=0)
    samples = [np.concatenate([r.samples, r.inputs], axis=1) for r in problem.records]
    values = [
        kept_inside(problem.library, np.concatenate([e.smoothed, r.inputs], axis=1), raw)
        for e, r, raw in zip(estimates, problem.records, samples, strict=True)
    ]
    paths = tuple(each[:, : len(problem.states)] for each in values)
    theta = np.concatenate([problem.library.evaluate(each) for each in values])
    rates = np.concatenate([e.derivative for e in estimates])
    support = np.ones(problem.C.shape[1], dtype=np.bool_)
    fit = Fit(paths, _regressed(problem, theta, rates), support, np.full(len(variance), np.inf))
    std = np.maximum(np.sqrt(variance), FLOOR if log10_ratio is None else UNSURE)
    return fit, tuple(np.tile(std, (len(path), 1)) for path in paths)


def _regressed(
    problem: Problem,
    theta: Float[np.ndarray, "samples terms"],
    rates: Float[np.ndarray, "samples d"],
) -> Float[np.ndarray, " free"]:
    """Least squares of all equations at once, relations held."""
    n, d = rates.shape
    rows = np.zeros((n, d, len(problem.equation)))
    for k, (equation, column) in enumerate(zip(problem.equation, problem.column, strict=True)):
        rows[:, equation, k] = theta[:, column]
    target = (rates - rows @ problem.fixed).reshape(-1)
    if problem.related:
        return _solved(rows.reshape(n * d, -1) @ problem.C, target)
    free = np.zeros(problem.C.shape[1])
    for equation in range(d):  # far smaller, equation by equation
        own = problem.equation == equation
        free[own] = _solved(rows[:, equation, own], target.reshape(n, d)[:, equation])
    return free


def _solved(
    rows: Float[np.ndarray, "rows columns"], target: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " columns"]:
    size = zero_to_one(np.linalg.norm(rows, axis=0))
    return np.linalg.lstsq(rows / size, target, rcond=CUTOFF)[0] / size
