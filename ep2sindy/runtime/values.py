"""Fields of immutable values: read-only copies of arrays, and checks of the settings that came."""

from __future__ import annotations

from typing import Protocol

import numpy as np


def read_only(values: np.ndarray) -> np.ndarray:
    """Copy to float64 and lock, so that the data of an object cannot change from outside."""
    copy = np.array(values, dtype=np.float64, order="C")
    copy.flags.writeable = False
    return copy


def check_list(name: str, value: object) -> None:
    """Raise ValueError for a text where a list belongs: it would be read letter by letter."""
    if isinstance(value, str):
        raise ValueError(f"{name} must be a list: {value!r} came; write [{value!r}]")


def check_kind(name: str, value: object, kind: type, example: str) -> None:
    """Raise ValueError for a value of the wrong type, or a class instead of an instance.

    kind: a class, or a protocol; then the error names the members that the value lacks.
    """
    start = f"{name} must be a {kind.__name__}, such as {example}"
    if isinstance(value, type):
        raise ValueError(f"{start}: the class {value.__name__} came; call it to make a value")
    if not isinstance(value, kind):
        members = [m for m in vars(kind) if not m.startswith("_")]
        lacking = [m for m in members if m not in dir(value)] if Protocol in kind.__mro__ else []
        end = f", which has no {' and no '.join(lacking)}" if lacking else ""
        raise ValueError(f"{start}: {value!r} came{end}")
