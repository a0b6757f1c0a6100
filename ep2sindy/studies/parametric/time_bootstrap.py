"""How far coefficients would move, had the record been another stretch of the same time series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.constraints.fit import WeightedEquation, weighted_equations
from ep2sindy.constraints.relations import Constraint
from ep2sindy.data.scales import column_norms
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.search.bootstraps import moving_block_counts

MIN_BLOCKS = 5  # in a record: fewer draws of blocks than these differ too little from another


@dataclass(frozen=True)
class TimeBootstrap:
    """Intervals of least squares: draws of blocks that last `periods` of the oscillation."""

    n_draws: int
    periods: float

    def __post_init__(self) -> None:
        if self.n_draws < 40 or self.periods <= 0.0:
            raise ValueError(
                "a 95 % interval needs 40 draws or more, and blocks some length: "
                f"n_draws={self.n_draws}, periods={self.periods} came"
            )


def resampled_coefficients(
    problems: Sequence[RegressionRows],
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
    Raises ValueError for blocks that leave fewer than five to draw from, or several trajectories.
    Source: Kuensch 1989, doi:10.1214/aos/1176347265; Lahiri 2003, Resampling Methods for
    Dependent Data, 2.5, for the centre.
    """
    if len(problems[0].trajectories) > 1:
        raise ValueError(
            "a bootstrap over time needs one trajectory, or blocks would cross from one to the "
            f"next: {len(problems[0].trajectories)} came"
        )
    equations = weighted_equations(problems, constraint)
    coef = coefficients_of(model, constraint)
    rows = [_free_rows(equation, constraint, coef) for equation in equations]
    groups = [e.problem.groups[~e.problem.test] for e in equations]
    numbers = np.unique(np.concatenate(groups))
    _check_blocks(len(numbers), block)
    scale = column_norms(np.concatenate(rows))
    sums = np.zeros((len(numbers), len(scale), len(scale)))
    for own, group in zip(rows, groups, strict=True):
        unit = own / scale
        np.add.at(sums, np.searchsorted(numbers, group), unit[:, :, None] * unit[:, None, :])
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
    return (z - z.mean(axis=0) + coef[constraint.free]) @ constraint.C.T + constraint.d


def _check_blocks(n_groups: int, block: int) -> None:
    if n_groups < MIN_BLOCKS * block:
        raise ValueError(
            f"a bootstrap over time needs {MIN_BLOCKS} blocks or more: blocks of {block} were "
            f"asked of {n_groups} groups of rows; use fewer periods per block "
            "(bootstrap.periods), or a longer record"
        )


def coefficients_of(model: SparseModel, constraint: Constraint) -> Float[np.ndarray, " coefs"]:
    """In the order of the constraint's."""
    index, states = model.library.index, model.states.index
    return np.array([model.coef[index(term), states(s)] for s, term in constraint.coefficients])


def _free_rows(
    equation: WeightedEquation, constraint: Constraint, coef: Float[np.ndarray, " coefs"]
) -> Float[np.ndarray, "rows columns"]:
    """One equation's rows by free coefficient, the target last; residuals of variance 1."""
    at = equation.at
    theta, target = equation.rows(coef[at])
    return np.column_stack([theta @ constraint.C[at], target - theta @ constraint.d[at]])
