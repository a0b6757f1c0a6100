"""Summary of one array in a file: shape, unit, range, missing values, spacing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ep2sindy.data.conversion import counted_in
from ep2sindy.data.mapping import read_array
from ep2sindy.data.readers.source import FileSource
from ep2sindy.data.readers.table_layout import unit_in_brackets

MIN_GAP = 3.0  # steps; a shorter one may be a sample that came late

TEXT = "text or objects"  # problem of arrays that are not numbers


@dataclass(frozen=True)
class ArrayInfo:
    """Summary of one array in a file: shape, unit, range, missing values, spacing.

    unit: "" if the file states none. low, high:
    range of the finite values. n_missing: number of NaN or infinite values. step: median step of
    an increasing vector, else None. even: True if the steps are equal. gap: where steps that are
    otherwise even leave out samples, in words. falls: where a vector first does not
    increase, in words. problem: reason why the array cannot be used, or "".
    """

    name: str
    shape: tuple[int, ...] = ()
    kind: str = ""
    unit: str = ""
    dims: tuple[str, ...] = ()
    low: float = np.nan
    high: float = np.nan
    n_missing: int = 0
    step: float | None = None
    even: bool = False
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
    except ValueError as error:
        return ArrayInfo(name, problem=_short(str(error)))
    values = np.asarray(array.values, dtype=np.float64)
    finite = values[np.isfinite(values)]
    attribute = str(array.attrs.get("units", "") or source.units.get(name, ""))
    stated = counted_in(attribute) or unit_in_brackets(name)
    dims = tuple(map(str, array.dims)) if source.dims_named else ()
    is_vector = values.size in values.shape
    steps = _steps(values.ravel()) if is_vector else np.empty(0)
    return ArrayInfo(
        name, values.shape, str(array.dtype), stated, dims,
        float(finite.min()) if finite.size else np.nan,
        float(finite.max()) if finite.size else np.nan,
        int(values.size - finite.size),
        float(np.median(steps)) if steps.size else None,
        bool(steps.size and np.ptp(steps) <= 1e-3 * steps.mean()),
        _gap(steps),
        _fall(values.ravel()) if is_vector else "",
    )  # fmt: skip


def _short(text: str) -> str:
    return TEXT if "real numbers" in text else text


def _fall(points: np.ndarray) -> str:
    """Where points first do not increase, in words; empty if they do."""
    falls = np.flatnonzero(np.diff(points) <= 0.0)
    if not falls.size:
        return ""
    k = int(falls[0])
    return f"{points[k + 1]:.9g} follows {points[k]:.9g} at row {k + 2}"


def _steps(points: np.ndarray) -> np.ndarray:
    """Steps of points that increase throughout; empty for others, and for fewer than three."""
    steps = np.diff(points)
    return steps if len(steps) > 1 and (steps > 0).all() else np.empty(0)


def _gap(steps: np.ndarray) -> str:
    """The longest gap in steps of which nine in ten are alike, in words; empty if there is none."""
    if not steps.size:
        return ""
    usual, k = float(np.median(steps)), int(steps.argmax())
    are_alike = np.mean(np.abs(steps - usual) <= 0.1 * usual) >= 0.9
    if not are_alike or steps[k] < MIN_GAP * usual:
        return ""
    return f"{steps[k]:.4g} pass after row {k + 1}, where steps are {usual:.4g}"
