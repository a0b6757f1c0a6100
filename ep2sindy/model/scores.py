"""Scores of predictions against data."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def r2(
    *, truth: Float[np.ndarray, " rows"], prediction: Float[np.ndarray, "models rows"]
) -> Float[np.ndarray, " models"]:
    """Coefficient of determination, 1 - SS_res/SS_tot, with SS_tot about the mean of the truth."""
    spread = np.square(truth - truth.mean()).sum()
    return r2_of(np.square(truth - prediction).sum(axis=1), spread=float(spread))


def r2_of(squares: Float[np.ndarray, " models"], *, spread: float) -> Float[np.ndarray, " models"]:
    """As `r2`, from the sums of squares of the residuals; spread: of the truth about its mean.

    Raises ValueError for a truth that is constant.
    """
    if spread == 0.0:
        raise ValueError(
            "R2 needs a target that varies: it is constant on these rows; hold out more rows "
            "or check that the state varies"
        )
    return 1.0 - squares / spread
