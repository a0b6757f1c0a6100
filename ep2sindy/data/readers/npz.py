"""NumPy archives."""

from __future__ import annotations

from pathlib import Path
from zipfile import ZipFile

import numpy as np
import xarray as xr

from ep2sindy.data.readers.source import Reader, Source
from ep2sindy.trust.limits import check_declared


def read_npz(path: Path) -> Source:
    """NumPy arrays saved with `numpy.savez`; pickled objects are refused."""

    def read(name: str) -> xr.DataArray:
        with np.load(path, allow_pickle=False) as arrays:
            return xr.DataArray(arrays[name])

    with ZipFile(path) as archive:
        for member in archive.infolist():
            check_declared(repr(member.filename), member.file_size, path)
    with np.load(path, allow_pickle=False) as arrays:
        return Source(path, list(arrays), read)


NPZ = Reader("npz", read_npz, first_bytes=(b"PK",))
