"""Data sets as NetCDF files, by way of memory: HDF5 must never meet a disk that is full."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from ep2sindy.runtime.files import write_bytes


def write_netcdf(
    dataset: xr.Dataset, path: Path, *, encoding: Mapping[str, Mapping[str, Any]] | None = None
) -> None:
    """Write NetCDF under `path`, whole or not at all.

    The file is made in memory, which must hold it: where HDF5 itself cannot write to the end, it
    ends the whole program when it closes. Raises OSError, naming the file, where the disk takes it
    not.
    """
    content = dataset.to_netcdf(None, engine="h5netcdf", encoding=encoding)
    write_bytes(path, content)
