"""How well predictions explain data."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def r2(
    *, truth: Float[np.ndarray, " rows"], prediction: Float[np.ndarray, "models rows"]
) -> Float[np.ndarray, " models"]:
    """Coefficient of determination, 1 - SS_res/SS_tot, the total about the truth's mean."""
    total = np.square(truth - truth.mean()).sum()
    if total == 0.0:
        raise ValueError(
            "R2 needs a target that varies: it is constant on these rows; hold out more rows "
            "or check that the state varies"
        )
    return 1.0 - np.square(truth - prediction).sum(axis=1) / total
