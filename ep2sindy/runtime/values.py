"""Fields of immutable values: read-only copies of arrays, and checks of the settings that came."""

from __future__ import annotations

import numpy as np


def read_only(values: np.ndarray) -> np.ndarray:
    """Copy to float64 and lock, so that the data of an object cannot change from outside."""
    copy = np.array(values, dtype=np.float64, order="C")
    copy.flags.writeable = False
    return copy


def check_kind(name: str, value: object, kind: type, example: str) -> None:
    """Raise ValueError for a value of the wrong type, or a class instead of an instance."""
    if isinstance(value, type) or not isinstance(value, kind):
        raise ValueError(f"{name} must be a {kind.__name__}, such as {example}: {value!r} came")
