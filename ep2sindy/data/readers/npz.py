"""NumPy archives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from ep2sindy.data.readers.source import Reader, Source


def read_npz(path: Path) -> Source:
    """NumPy arrays saved with `numpy.savez`; pickled objects are refused."""

    def read(name: str) -> xr.DataArray:
        with np.load(path, allow_pickle=False) as arrays:
            return xr.DataArray(arrays[name])

    with np.load(path, allow_pickle=False) as arrays:
        return Source(path, list(arrays), read)


NPZ = Reader("npz", read_npz, first_bytes=(b"PK",))
