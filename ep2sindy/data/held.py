"""One array of a file as it is looked at: shape, unit, range, what is missing, and its steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ep2sindy.data.conversion import counted_in
from ep2sindy.data.mapping import read_array
from ep2sindy.data.quantities import typical
from ep2sindy.data.readers.source import Source

TEXT = "text or objects"  # what is not even tried


@dataclass(frozen=True)
class Held:
    """One array of a file. unit: "" where the file says none. n_missing: NaN or infinite.

    step: mean step of a vector that increases, else None. even: whether its steps are equal.
    problem: why it cannot be used.
    """

    name: str
    shape: tuple[int, ...] = ()
    kind: str = ""
    unit: str = ""
    dims: tuple[str, ...] = ()
    low: float = np.nan
    high: float = np.nan
    size: float = 0.0
    n_missing: int = 0
    step: float | None = None
    even: bool = False
    problem: str = ""

    @property
    def lengths(self) -> tuple[int, ...]:
        """Of its axes, without those of one point."""
        return tuple(n for n in self.shape if n > 1)


def held_array(source: Source, name: str) -> Held:
    """What one array holds; reads it."""
    try:
        array = read_array(source, name, name)
    except ValueError as error:
        return Held(name, problem=_short(str(error)))
    values = np.asarray(array.values, dtype=np.float64)
    finite = values[np.isfinite(values)]
    stated = counted_in(str(array.attrs.get("units", "") or source.units.get(name, "")))
    dims = tuple(map(str, array.dims)) if source.dims_named else ()
    step, even = _step(values.ravel()) if values.size in values.shape else (None, False)
    return Held(
        name, values.shape, str(array.dtype), stated, dims,
        float(finite.min()) if finite.size else np.nan,
        float(finite.max()) if finite.size else np.nan,
        typical(values), int(values.size - finite.size), step, even,
    )  # fmt: skip


def _short(text: str) -> str:
    return TEXT if "real numbers" in text else text


def _step(points: np.ndarray) -> tuple[float | None, bool]:
    steps = np.diff(points)
    if len(steps) < 2 or not (steps > 0).all():
        return None, False
    return float(steps.mean()), bool(np.ptp(steps) <= 1e-3 * steps.mean())
