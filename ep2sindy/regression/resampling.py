"""Draws of rows with replacement, in blocks of neighbours where neighbours are alike."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int


def moving_block_counts(
    n_rows: int, *, n_drawn: int, block: int, rng: np.random.Generator
) -> Int[np.ndarray, " rows"]:
    """How often each row comes in one draw of `n_drawn` rows, taken as runs of `block` rows.

    A row may stand for a group of rows, which come together.
    Every run lies within the rows; the last one is cut to length. block: 1 draws single rows;
    for a time series, long enough that rows farther apart are unrelated.
    Raises ValueError for a block that is not between one row and all of them.
    Source: Kuensch 1989, doi:10.1214/aos/1176347265.
    """
    if not 1 <= block <= n_rows:
        raise ValueError(
            f"a block must hold between one and all {n_rows} groups of training rows: {block} "
            "came; shorten it, or use more data"
        )
    n_blocks = -(-n_drawn // block)
    first = rng.integers(n_rows - block + 1, size=n_blocks)
    drawn = (first[:, None] + np.arange(block)).ravel()[:n_drawn]
    return np.bincount(drawn, minlength=n_rows)
