"""NetCDF 3 and 4."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import xarray as xr

from ep2sindy.data.readers.source import UNDECODED, Reader, Source, dataset_source


def read_netcdf(path: Path) -> Source:
    """NetCDF 3 and 4, read when asked for."""
    with path.open("rb") as file:
        classic = file.read(4) in (b"CDF\x01", b"CDF\x02")
    # The netCDF library fills what a cut classic file lacks with zeros; SciPy raises.
    engine: Literal["scipy", "netcdf4"] = "scipy" if classic else "netcdf4"
    return dataset_source(path, xr.open_dataset(path, engine=engine, **UNDECODED))


NETCDF = Reader(
    "NetCDF", read_netcdf, first_bytes=(b"CDF",), form="hdf5", endings=(".nc", ".nc4", ".cdf")
)
