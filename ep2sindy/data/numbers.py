"""Conversion of samples and times to float64, checks of their size, and norms to scale by.

Values without a single clear meaning as real numbers are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import comb
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Shaped

from ep2sindy.library.units import calendar_unit
from ep2sindy.runtime.values import Samples

if TYPE_CHECKING:
    import pandas as pd

# Below the first size a product of three variables, squared in a Gram matrix, underflows to zero;
# above the second a square overflows. Terms that overflow raise their own error.
LEAST, MOST = 1e-50, 1e150

Points = Float[np.ndarray, " points"]

# Times the noise, and fraction of the RMS, by which a state that is nonnegative may lie below zero.
BELOW_NOISE, BELOW_ZERO = 6.0, 0.05


def real_numbers(values: object, what: str) -> np.ndarray:
    """Copy values to float64; a masked value becomes NaN, which always means missing.

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
        hint = ways.get(array.dtype.kind, "convert them first")
        raise ValueError(f"{what} must hold real numbers, got {array.dtype}; {hint}")
    copy = np.array(array, dtype=np.float64, order="C")
    if masked is not None:
        copy[np.ma.getmaskarray(masked)] = np.nan
    return copy


def seconds(t: object) -> np.ndarray:
    """Convert times to s: numbers are taken as s, dates are counted from the first one.

    Rounded times are moved onto their even grid, see `even_grid`.
    Raises ValueError for anything but numbers and dates.
    """
    array = t if isinstance(t, np.ma.MaskedArray) else np.asarray(t)
    if array.dtype.kind == "M" and array.size:
        array = array - array.flat[0]
    if array.dtype.kind == "m":
        return np.where(np.isnat(array), np.nan, array / np.timedelta64(1, "s"))
    return even_grid(array) if array.ndim == 1 else real_numbers(array, "t")


def count_dates(dates: pd.Series) -> tuple[Float[np.ndarray, " rows"], str]:
    """Dates, from the first one and without their time zone, or durations in s; and their unit.

    The unit, in which they are shown, is the longest of days, hours, minutes and seconds that is no
    longer than a usual step.
    """
    is_date = dates.dtype.kind == "M"
    t = seconds(dates.to_numpy(dtype="datetime64[ns]") if is_date else dates.to_numpy())
    steps = np.abs(np.diff(t))
    return t, calendar_unit(float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0)


def even_grid(t: Shaped[np.ndarray, " samples"]) -> Samples:
    """Convert times to float64; those that are even within rounding become exactly even.

    These are times of a shorter type, and times that repeat because they were written with few
    digits. Other times keep their values.
    """
    times = real_numbers(t, "t")
    if len(times) < 3:
        return times
    if digits_of_rounded(times) is not None:
        return np.linspace(times[0], times[-1], len(times))
    if t.dtype not in (np.float16, np.float32):
        return times
    largest = np.abs(t).max()
    grid = np.linspace(times[0], times[-1], len(times))
    step = grid[1] - grid[0]
    if not (np.isfinite(largest) and step > 0):
        return times
    rounding = 2.0 * float(np.spacing(largest))  # rounding of a sample plus that of the grid's ends
    is_rounded = rounding <= 0.5 * step and np.abs(times - grid).max() <= rounding
    return grid if is_rounded else times


def digits_of_rounded(t: Samples) -> int | None:
    """Number of digits to which times of equal steps were rounded so that some repeat; or None.

    Each time must lie on the even grid within one unit of its last digit, and the steps must be
    shorter than that: a row that was written twice makes no rounded times. Nor do fewer than five
    different times.
    """
    if len(t) < 8 or not np.isfinite(t).all():
        return None
    steps = np.diff(t)
    if (steps < 0).any() or (steps > 0).all() or np.count_nonzero(steps) < 4:
        return None
    grid = np.linspace(t[0], t[-1], len(t))
    for digits in range(1, 7):
        if np.array_equal(t, [float(f"{value:.{digits - 1}e}") for value in t.tolist()]):
            unit = 10.0 ** (np.floor(np.log10(np.abs(t).max())) - digits + 1)
            fits = np.abs(t - grid).max() <= unit and 0.02 * unit < grid[1] - grid[0] < 0.9 * unit
            return digits if fits else None
    return None


# What instruments and programs write for an overload, or for no sample.
MARKS = (9.9e37, -9.9e37, 9.91e37, 1e30, -1e30, -999.0, -9999.0, 32767.0, -32768.0)


def without_marks(values: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Samples with NaN in place of marks of overload or absence; the same array if there are none.

    A number is a mark if it comes twice or more, and lies farther from all other samples than
    these range.
    """
    for mark in MARKS:
        # Not exactly: older releases of pandas may read the last digit of a number wrongly.
        hits = np.abs(values - mark) <= 1e-14 * abs(mark)
        if np.count_nonzero(hits) < 2:
            continue
        others = values[~hits & np.isfinite(values)]
        if others.size < 2 or np.abs(others - mark).min() > np.ptp(others) > 0.0:
            values = np.where(hits, np.nan, values)
    return values


def rounding_s(t: Samples) -> float:
    """Largest error of a time due to float64 rounding, in s; epoch seconds resolve 2e-7 s."""
    return 2.0 * float(np.spacing(np.abs(t).max()))


def check_magnitude(values: Float[np.ndarray, "samples variables"], names: tuple[str, ...]) -> None:
    """Raise ValueError for a variable whose products underflow or overflow in float64."""
    levels = np.abs(values).max(axis=0, initial=0.0)
    for name, level in zip(names, levels, strict=True):
        if level and not LEAST <= level <= MOST:
            raise ValueError(
                f"a variable must be of a size whose products are numbers, {LEAST:g} to {MOST:g}: "
                f"{name!r} reaches {level:.3g}; count it in another unit"
            )


# Norms to divide by, so that columns in different units become comparable.


def zero_to_one(sizes: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Replace zero sizes by one, so that a column of zeros stays zero when divided."""
    return np.where(sizes == 0.0, 1.0, sizes)


def column_norms(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, " columns"]:
    """L2 norms of the columns, with one in place of zero.

    High powers of densities do not overflow, since every column is divided by its largest value
    before it is squared.
    """
    columns = np.abs(values.T, order="C")  # each column contiguous in memory
    largest = zero_to_one(columns.max(axis=1, initial=0.0))
    columns /= largest[:, None]
    return zero_to_one(largest * np.sqrt(np.einsum("cr,cr->c", columns, columns)))


def least_squares(
    columns: Float[np.ndarray, "rows columns"],
    target: Float[np.ndarray, " rows"],
    *,
    cutoff: float | None = None,
) -> Float[np.ndarray, " columns"]:
    """Least squares of columns in any units, each of which is scaled to unit norm.

    cutoff: singular values below this fraction of the largest count as zero; None for rounding.
    """
    size = column_norms(columns)
    return np.linalg.lstsq(columns / size, target, rcond=cutoff)[0] / size


def least_beside_grid(
    function: Callable[[float], float], grid: Points, on_grid: Points, *, tolerance: float
) -> float:
    """Where a function that may be flat or have several minima is least.

    The least of its values on a grid, which are given, finds the deepest minimum, and a bounded
    search between the neighbours of that point refines it.
    """
    from scipy.optimize import minimize_scalar  # import takes 0.5 s; most calls do not need it

    best = int(on_grid.argmin())
    search = minimize_scalar(
        function,
        bounds=sorted(grid[[max(best - 1, 0), min(best + 1, len(grid) - 1)]]),
        method="bounded",
        options={"xatol": tolerance},
    )
    # The bounded search never tries the bounds themselves, so the grid point may be better.
    return float(search.x if search.fun < on_grid[best] else grid[best])


def quantiles(draws: Float[np.ndarray, "draws ..."], levels: Sequence[float]) -> np.ndarray:
    """Quantiles over the draws that are finite; NaN where none is.

    Between two draws of n lies the fraction 1 / (n + 1) of all others, so bands hold what they say.
    """
    # Sorted along the last axis, which is many times as fast as np.nanquantile.
    ordered = np.sort(np.moveaxis(np.where(np.isfinite(draws), draws, np.nan), 0, -1), axis=-1)
    n = np.isfinite(ordered).sum(axis=-1)
    last = np.maximum(n - 1, 0)
    place = np.clip(np.multiply.outer(levels, n + 1) - 1, 0, last)
    below = place.astype(np.int64)
    low, high = (
        np.take_along_axis(ordered[None], at[..., None], axis=-1)[..., 0]
        for at in (below, np.minimum(below + 1, last))
    )
    return low + (place - below) * (high - low)


def band_of(draws: Float[np.ndarray, "draws ..."], level: float) -> np.ndarray:
    """Bounds that hold this fraction of the draws. ValueError if it is no fraction."""
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must lie between 0 and 1, got {level}")
    return quantiles(draws, [0.5 - 0.5 * level, 0.5 + 0.5 * level])


def noise_of(x: Samples, order: int) -> float:
    """Standard deviation of white noise, by the median of differences of this order.

    These remove what is smooth; a few outliers do not change their median. It is zero for samples
    that have none.
    """
    if len(x) <= order:
        return 0.0
    # Differences of white noise have so many times its variance; 0.6745 is the normal quartile.
    return float(np.median(np.abs(np.diff(x, order)))) / (0.6745 * np.sqrt(comb(2 * order, order)))


def check_nonnegative(name: str, runs: Sequence[Samples]) -> None:
    """Raise ValueError for a state that is below zero by more than its noise; NaN is missing."""
    for values in runs:
        x = values[np.isfinite(values)]
        allowed = max(BELOW_NOISE * noise_of(x, 2), BELOW_ZERO * np.sqrt(np.square(x).mean()))
        if x.mean() < 0.0 or x.min() < -allowed:
            raise ValueError(
                f"nonnegative roles need states that are concentrations or numbers: {name} is "
                f"{x.mean():.3g} in the mean and falls to {x.min():.3g}; shift or turn its values, "
                "or leave nonnegative out"
            )
