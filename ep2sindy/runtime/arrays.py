"""Read-only copies of arrays, for immutable objects."""

from __future__ import annotations

import numpy as np


def read_only(values: np.ndarray) -> np.ndarray:
    """Copy to float64 and lock, so that the data of an object cannot change from outside."""
    copy = np.array(values, dtype=np.float64, order="C")
    copy.flags.writeable = False
    return copy
