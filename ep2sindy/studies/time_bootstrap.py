"""How far coefficients would move, had the record been another stretch of the same time series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.constrained import LEAST_RESIDUAL
from ep2sindy.constraints import Constraint
from ep2sindy.errors_in_variables import whitened_rows
from ep2sindy.model import SparseModel
from ep2sindy.regression import Regression
from ep2sindy.resampling import moving_block_counts

MIN_BLOCKS = 5  # in a record: fewer draws of blocks than these differ too little from another


def resampled_coefficients(
    problems: Sequence[Regression],
    constraint: Constraint,
    model: SparseModel,
    *,
    block: int,
    n_draws: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "draws coefs"]:
    """Coefficients of `constrained_fit` on training rows redrawn in blocks of time, in SI.

    A draw counts groups of rows, for all equations alike; each equation keeps the weight that it
    has on all rows, and rows whose noise is followed stay whitened as under `model`.
    model: of `constrained_fit` on these problems. block: groups that are drawn side by side.
    Returns one column per coefficient of the constraint. Draws are moved so that their mean is
    the fit: blocks seldom reach the ends of the record, which would shift them.
    Raises ValueError for blocks that leave fewer than five to draw from.
    Source: Kuensch 1989, doi:10.1214/aos/1176347265; Lahiri 2003, Resampling Methods for
    Dependent Data, 2.5, for the centre.
    """
    equations = [_unit_rows(problems, constraint, model, state) for state in constraint.states]
    numbers = np.unique(np.concatenate([equation.groups for equation in equations]))
    if len(numbers) < MIN_BLOCKS * block:
        raise ValueError(
            f"a bootstrap over time needs {MIN_BLOCKS} blocks or more: blocks of {block} were "
            f"asked of {len(numbers)} groups of rows; use fewer periods per block, or more data"
        )
    scale = _column_norms(equations)
    sums = np.zeros((len(numbers), len(scale), len(scale)))
    for equation in equations:
        rows = equation.rows / scale
        np.add.at(
            sums,
            np.searchsorted(numbers, equation.groups),
            rows[:, :, None] * rows[:, None, :],
        )
    counts = np.array(
        [
            moving_block_counts(len(numbers), n_drawn=len(numbers), block=block, rng=rng)
            for _ in range(n_draws)
        ],
        dtype=np.float64,
    )
    grams = np.tensordot(counts, sums, axes=1)
    z = np.linalg.solve(grams[:, :-1, :-1], grams[:, :-1, -1:])[:, :, 0]
    z *= scale[-1] / scale[:-1]
    fit = [_coefficient(model, *constraint.coefficients[k]) for k in constraint.free]
    return (z - z.mean(axis=0) + fit) @ constraint.C.T + constraint.d


def _coefficient(model: SparseModel, state: str, term: str) -> float:
    return float(model.coef[model.library.index(term), model.states.index(state)])


@dataclass(frozen=True, eq=False)
class _UnitRows:
    """One equation's training rows by free coefficient, the target last; residuals of variance 1.

    groups: (rows,), the number of each row's group.
    """

    rows: Float[np.ndarray, "rows columns"]
    groups: Int[np.ndarray, " rows"]


def _unit_rows(
    problems: Sequence[Regression], constraint: Constraint, model: SparseModel, state: str
) -> _UnitRows:
    """Weighted as `constrained_fit` weighs them."""
    problem = next(p for p in problems if state in p.equations)
    number = problem.equations.index(state)
    at = np.flatnonzero([s == state for s, _ in constraint.coefficients])
    terms = np.array([problem.library.index(constraint.coefficients[k][1]) for k in at], dtype=int)
    scale = problem.target_scale[number] / problem.theta_scale[terms]
    theta = problem.train_rows[:, terms]
    target = problem.train_rows[:, len(problem.library) + number]
    alone = np.linalg.lstsq(theta, target, rcond=None)[0]
    if problem.noisy is not None:
        mask, first, coef = np.zeros((3, len(problem.library)))
        mask[terms], first[terms] = 1.0, alone
        coef[terms] = model.coef[terms, model.states.index(state)] / scale
        used = mask == 1.0
        corrected = whitened_rows(problem, used, first, n_steps=8).corrected
        about = replace(problem, noisy=replace(problem.noisy, smoothed=corrected))
        white = whitened_rows(about, used, coef, n_steps=0)
        theta, target = white.theta[:, terms], white.target
    else:
        variance = np.square(target - theta @ alone).sum() / max(len(target) - len(terms), 1)
        std = np.sqrt(max(variance, LEAST_RESIDUAL**2 * np.square(target).mean())) or 1.0
        theta, target = theta / std, target / std
    theta = theta / scale
    free = np.column_stack([theta @ constraint.C[at], target - theta @ constraint.d[at]])
    return _UnitRows(free, problem.groups[~problem.test])


def _column_norms(equations: Sequence[_UnitRows]) -> Float[np.ndarray, " columns"]:
    norms = np.linalg.norm(np.concatenate([equation.rows for equation in equations]), axis=0)
    norms[norms == 0.0] = 1.0
    return norms
