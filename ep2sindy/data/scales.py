"""Sizes to divide by, so that columns of different units compare."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def zero_to_one(sizes: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """The same with one in place of zero: what is all zeros stays so when divided."""
    return np.where(sizes == 0.0, 1.0, sizes)


def column_norms(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, " columns"]:
    """L2 norms to divide by, of values of moderate size: squares beyond 1e308 overflow."""
    return zero_to_one(np.linalg.norm(values, axis=0))
