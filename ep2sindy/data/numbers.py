"""Samples and times as float64, where they have one meaning; and sizes to scale columns by."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

# Below it products of three, squared in a Gram matrix, vanish. Terms that overflow name themselves.
LEAST = 1e-50


def real_numbers(values: object, what: str) -> np.ndarray:
    """A copy in float64; a masked value is NaN, which means missing everywhere here.

    Raises ValueError for complex numbers, truth values, text, dates and other objects.
    """
    masked: Any = values if isinstance(values, np.ma.MaskedArray) else None
    array = np.asarray(values) if masked is None else masked.data
    if array.dtype.kind not in "iuf":
        ways = {
            "c": "give real and imaginary parts as variables of their own",
            "b": "give 0.0 and 1.0 if they are meant as numbers",
            "O": "convert them first, .astype(float)",
        }
        way_out = ways.get(array.dtype.kind, "convert them first")
        raise ValueError(f"{what} must hold real numbers: {array.dtype} came; {way_out}")
    copy = np.array(array, dtype=np.float64, order="C")
    if masked is not None:
        copy[np.ma.getmaskarray(masked)] = np.nan
    return copy


def seconds(t: object) -> np.ndarray:
    """Times in s: numbers are taken so; dates are counted from the first of them.

    Times in single precision that lie on an even grid but for their rounding are put on it.
    Raises ValueError for what is neither.
    """
    array = t if isinstance(t, np.ma.MaskedArray) else np.asarray(t)
    if array.dtype.kind == "M" and array.size:
        array = array - array.flat[0]
    if array.dtype.kind == "m":
        return np.where(np.isnat(array), np.nan, array / np.timedelta64(1, "s"))
    is_short = array.ndim == 1 and array.dtype in (np.float16, np.float32)
    return even_grid(array) if is_short else real_numbers(array, "t")


def even_grid(t: Shaped[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Times in float64: those of a shorter type, even but for its rounding, are on an even grid."""
    times = real_numbers(t, "t")
    if len(times) < 3 or t.dtype not in (np.float16, np.float32):
        return times
    largest = np.abs(t).max()
    grid = np.linspace(times[0], times[-1], len(times))
    step = grid[1] - grid[0]
    if not (np.isfinite(largest) and step > 0):
        return times
    rounding = 2.0 * float(np.spacing(largest))  # of a sample, and of the ends of the grid
    is_rounded = rounding <= 0.5 * step and np.abs(times - grid).max() <= rounding
    return grid if is_rounded else times


def rounding_s(t: Float[np.ndarray, " samples"]) -> float:
    """How far a time may be off for float64 alone: epoch seconds are told apart by 2e-7 s."""
    return 2.0 * float(np.spacing(np.abs(t).max()))


def check_magnitude(values: Float[np.ndarray, "samples variables"], names: tuple[str, ...]) -> None:
    """Raise ValueError for a variable so small that products of it vanish in float64."""
    levels = np.abs(values).max(axis=0, initial=0.0)
    for name, level in zip(names, levels, strict=True):
        if level and level < LEAST:
            raise ValueError(
                f"a variable must be of a size whose products are numbers, {LEAST:g} or more: "
                f"{name!r} reaches {level:.3g}; count it in another unit"
            )


# Sizes to divide by, so that columns of different units compare.


def zero_to_one(sizes: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """The same with one in place of zero: what is all zeros stays so when divided."""
    return np.where(sizes == 0.0, 1.0, sizes)


def column_norms(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, " columns"]:
    """L2 norms to divide by, of values of moderate size: squares beyond 1e308 overflow."""
    return zero_to_one(np.linalg.norm(values, axis=0))
