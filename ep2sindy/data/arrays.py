"""Summary of one array in a file: shape, unit, range, missing values, spacing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ep2sindy.data.conversion import counted_in
from ep2sindy.data.mapping import N_MARKS, read_array
from ep2sindy.data.numbers import digits_of_rounded, even_grid
from ep2sindy.data.readers.source import FileSource
from ep2sindy.data.readers.table_layout import unit_in_brackets

MIN_GAP = 3.0  # steps; a shorter one may be a sample that came late

TEXT = "text or objects"  # problem of arrays that are not numbers


@dataclass(frozen=True)
class ArrayInfo:
    """Summary of one array in a file: shape, unit, range, missing values, spacing.

    unit: "" if the file states none. low, high: range of the finite values. n_missing: number of
    NaN or infinite values. n_marks: of these, marks of overload or absence. step: median step of an
    increasing vector, else None. even: True if the steps are equal. digits: to how many the times
    of equal steps were rounded, so that some repeat, else None. gap: where steps that are otherwise
    even leave out samples, in words. falls: where and how often a vector does not increase, in
    words. problem: reason why the array cannot be used, or "".
    """

    name: str
    shape: tuple[int, ...] = ()
    unit: str = ""
    dims: tuple[str, ...] = ()
    low: float = np.nan
    high: float = np.nan
    n_missing: int = 0
    n_marks: int = 0
    step: float | None = None
    even: bool = False
    digits: int | None = None
    gap: str = ""
    falls: str = ""
    problem: str = ""

    @property
    def lengths(self) -> tuple[int, ...]:
        """Lengths of the axes that have more than one point."""
        return tuple(n for n in self.shape if n > 1)

    @property
    def is_counter(self) -> bool:
        """True for a vector without a unit that may number the samples, from 0, 1 or 22."""
        return self.even and self.step == 1.0 and self.low % 1.0 == 0.0 and self.unit in ("", "1")


def describe_array(source: FileSource, name: str) -> ArrayInfo:
    """Read one array and summarise it."""
    try:
        array = read_array(source, name, name)
    except ValueError as error:  # its reason, without the file's name
        reason = str(error).removeprefix(f"{source.path} cannot be read: ")
        return ArrayInfo(name, problem=TEXT if "real numbers" in reason else reason)
    values = np.asarray(array.values, dtype=np.float64)
    finite = values[np.isfinite(values)]
    attribute = str(array.attrs.get("units", "") or source.units.get(name, ""))
    stated = counted_in(attribute) if attribute else unit_in_brackets(name)
    dims = tuple(map(str, array.dims)) if source.dims_named else ()
    points = values.ravel() if values.size in values.shape else np.empty(0)
    digits = digits_of_rounded(points)
    steps = np.diff(points if digits is None else even_grid(points))
    falls = _fall(points, steps)
    steps = steps if steps.size > 1 and not falls else np.empty(0)
    return ArrayInfo(
        name, values.shape, stated, dims,
        *((float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)),
        int(values.size - finite.size),
        int(array.attrs.get(N_MARKS, 0)),
        float(np.median(steps)) if steps.size else None,
        bool(steps.size and np.ptp(steps) <= 1e-3 * steps.mean()),
        digits,
        _gap(steps),
        falls,
    )  # fmt: skip


def _fall(points: np.ndarray, steps: np.ndarray) -> str:
    """Where points first do not increase, and how often, in words; empty if they do."""
    falls = np.flatnonzero(~(steps > 0.0))
    if not falls.size:
        return ""
    k, n_repeats = int(falls[0]), int((steps == 0.0).sum())
    first = f"{points[k + 1]:.9g} follows {points[k]:.9g} at row {k + 2}"
    return f"{first}; {n_repeats} repeat the one before, {falls.size - n_repeats} run back"


def _gap(steps: np.ndarray) -> str:
    """The longest gap in steps of which nine in ten are alike, in words; empty if there is none."""
    if not steps.size:
        return ""
    usual, k = float(np.median(steps)), int(steps.argmax())
    are_alike = np.mean(np.abs(steps - usual) <= 0.1 * usual) >= 0.9
    if not are_alike or steps[k] < MIN_GAP * usual:
        return ""
    return f"{steps[k]:.4g} pass after row {k + 1}, where steps are {usual:.4g}"
