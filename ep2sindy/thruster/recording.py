"""Recording by the simulators: chunks of samples, progress reports, and variable names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.runtime.progress import Advance

CHUNK_ROWS = 50  # samples between two progress reports

# Records the samples of a slice of rows; returns their number, which is smaller if the run breaks.
March = Callable[[slice], int]


def record_samples(march: March, n_rows: int, advance: Advance) -> int:
    """March until n_rows samples are recorded or the run breaks; returns the number of samples."""
    filled = 0
    while filled < n_rows:
        part = slice(filled, min(filled + CHUNK_ROWS, n_rows))
        done = march(part)
        filled += done
        advance(done)
        if filled < part.stop:
            break
    return filled


def warm_up(march: March, n_rows: int, advance: Advance) -> int | None:
    """March by n_rows samples without keeping them; each chunk overwrites the previous one.

    Returns None, or if the run breaks, the number of samples in the last chunk.
    """
    while n_rows > 0:
        n = min(n_rows, CHUNK_ROWS)
        if (filled := record_samples(march, n, advance)) < n:
            return filled
        n_rows -= n
    return None


def notes(unit: str, long_name: str) -> dict[str, str]:
    """Unit and long name in the form of xarray's attributes."""
    return {"units": unit, "long_name": long_name}


def as_dataset(
    data: Mapping[str, tuple[tuple[str, ...], np.ndarray, Mapping[str, str]]],
    *,
    sample_s: float,
    n_samples: int,
    z: Float[np.ndarray, " z"],
    r: Float[np.ndarray, " r"] | None = None,
) -> xr.Dataset:
    """Recorded arrays, without copies, over time, z and, if there is one, r.

    data: dimensions, values and attributes of every variable.
    """
    coords: dict[str, Any] = {
        # "s" is a unit here, not a calendar: decode with decode_times=False
        "time": ("time", sample_s * np.arange(n_samples), notes("s", "time after the warm-up")),
        "z": ("z", z, notes("m", "axial distance from the anode")),
    }
    if r is not None:
        coords["r"] = ("r", r, notes("m", "radius"))
    return xr.Dataset(dict(data), coords=coords)
