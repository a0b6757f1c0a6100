"""Fields of immutable values: read-only copies of arrays, and checks of settings."""

from __future__ import annotations

from collections.abc import Mapping
from operator import index
from typing import Protocol, SupportsIndex, cast

import numpy as np
from jaxtyping import Bool, Float

# Signals over the samples of a record: one, several side by side, and a choice of samples.
Samples = Float[np.ndarray, " samples"]
Columns = Float[np.ndarray, "samples columns"]
Mask = Bool[np.ndarray, " samples"]


def read_only(values: np.ndarray) -> np.ndarray:
    """Copy to float64 and lock, so that the data of an object cannot change from outside.

    An array that is locked already, and no view of another, is taken as it is; see `locked`.
    """
    if isinstance(values, np.ndarray) and values.dtype == np.float64:
        flags = values.flags
        if not flags.writeable and flags.owndata and flags.c_contiguous:
            return values
    copy = np.array(values, dtype=np.float64, order="C")
    copy.flags.writeable = False
    return copy


def locked(values: np.ndarray) -> np.ndarray:
    """Lock an array that its maker hands over, so that no copy of it is made."""
    values.flags.writeable = False
    return values


COUNTS = ("zero", "one", "two")


def check_count(name: str, value: object, least: int = 1) -> int:
    """Return a whole number, also one of NumPy, as an int; raise ValueError for anything else."""
    try:
        count = least - 1 if isinstance(value, bool) else index(cast(SupportsIndex, value))
    except TypeError:
        count = least - 1
    if count < least:
        raise ValueError(f"{name} must be a whole number, {COUNTS[least]} or more, got {value!r}")
    return count


def check_positive(name: str, value: float) -> None:
    """Raise ValueError unless a number is positive and finite."""
    if not 0.0 < value < np.inf:
        raise ValueError(f"{name} must be positive and finite, got {value}")


def set_counts(settings: object, least: Mapping[str, int]) -> None:
    """Check fields of a frozen value that hold whole numbers, and keep each as an int.

    least: name of a field -> its least value. A field that is None by default may be None.
    """
    for name, fewest in least.items():
        value = getattr(settings, name)
        if value is not None or getattr(type(settings), name) is not None:
            object.__setattr__(settings, name, check_count(name, value, fewest))


def check_list(name: str, value: object) -> None:
    """Raise ValueError for a text where a list belongs: it would be read letter by letter."""
    if isinstance(value, str):
        raise ValueError(f"{name} must be a list, got {value!r}; write [{value!r}]")


def check_kind(name: str, value: object, kind: type, example: str) -> None:
    """Raise ValueError for a value of the wrong type, or a class instead of an instance.

    kind: a class, or a protocol; then the error names the members that the value lacks.
    """
    start = f"{name} must be a {kind.__name__}, such as {example}"
    if isinstance(value, type):
        raise ValueError(f"{start}, got the class {value.__name__}; call it to make a value")
    if not isinstance(value, kind):
        members = [m for m in vars(kind) if not m.startswith("_")]
        lacking = [m for m in members if m not in dir(value)] if Protocol in kind.__mro__ else []
        end = f", which has no {' and no '.join(lacking)}" if lacking else ""
        got = repr(value)
        got = got if "\n" not in got else f"a {type(value).__name__}"
        raise ValueError(f"{start}, got {got}{end}")
