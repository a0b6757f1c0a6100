"""Checks shared by the dataclasses of `thruster`: numbers in range, tables without gaps."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np


def set_profile(owner: object, places: str, name: str, positive_in: str | None) -> None:
    """Keep two fields of a frozen value as tuples of numbers: increasing places, a value at each.

    positive_in: unit of values that must be positive, "" for pure numbers; None takes values of
    both signs. Raises ValueError for gaps, places out of order, or a value that is not positive
    where it must be.
    """
    for field in (places, name):
        object.__setattr__(owner, field, tuple(float(value) for value in getattr(owner, field)))
    check_increasing(owner, places)
    values, n_places, who = getattr(owner, name), len(getattr(owner, places)), type(owner).__name__
    if len(values) != n_places:
        raise ValueError(
            f"{who}.{name} must have one number for each of {places}: {len(values)} for {n_places}"
        )
    if not np.all(np.isfinite(values)):
        row = int(np.argmin(np.isfinite(values)))
        raise ValueError(
            f"{who}.{name} must be finite, got {values[row]!r} at position {row}; fill the gap or "
            "leave the row out"
        )
    if positive_in is not None and (least := min(values)) <= 0.0:
        got = f"{least:g} {positive_in}".strip()
        raise ValueError(f"{who}.{name} must be positive everywhere, got {got}")


def check_positive(owner: object, *names: str) -> None:
    """Raise ValueError for the first named field that is not a finite positive number."""
    check_range(owner, "finite and positive", lambda value: value > 0.0, *names)


def check_not_negative(owner: object, *names: str) -> None:
    """Raise ValueError for the first named field that is negative or not finite."""
    check_range(owner, "finite and zero or more", lambda value: value >= 0.0, *names)


def check_range(owner: object, what: str, holds: Callable[[float], bool], *names: str) -> None:
    """Raise ValueError for the first named field that is not finite, or for which this fails.

    what: that the field must be, in words.
    """
    for name in names:
        value = getattr(owner, name)
        if not (math.isfinite(value) and holds(value)):
            raise ValueError(f"{type(owner).__name__}.{name} must be {what}, got {value!r}")


def check_increasing(owner: object, name: str) -> None:
    """Raise ValueError if a named field is not two or more finite, increasing numbers."""
    values = np.asarray(getattr(owner, name), dtype=float)
    if values.ndim != 1 or values.size < 2:
        raise ValueError(f"{type(owner).__name__}.{name} must hold two numbers or more")
    steps = np.diff(values)
    if not np.all(steps > 0.0):  # NaN fails, too
        row = int(np.argmin(steps > 0.0)) + 1
        raise ValueError(
            f"{type(owner).__name__}.{name} must increase: {values[row]:g} follows "
            f"{values[row - 1]:g} at position {row}; sort the rows first, and fill the gaps"
        )
