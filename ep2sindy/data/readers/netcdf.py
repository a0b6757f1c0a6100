"""NetCDF 3 and 4."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import xarray as xr

from ep2sindy.data.readers.classic import check_places
from ep2sindy.data.readers.hdf5 import holes_of
from ep2sindy.data.readers.source import Reader, Source, dataset_source

# What the netCDF library reads where nothing was written and no attribute says otherwise; bytes
# have none. Source: netcdf.h, NC_FILL_SHORT and its kin.
FILLS = {
    "i2": -32767, "u2": 65535, "i4": -2147483647, "u4": 4294967295,
    "i8": -9223372036854775806, "u8": 18446744073709551614,
    "f4": 9.969209968386869e36, "f8": 9.969209968386869e36,
}  # fmt: skip


def read_netcdf(path: Path) -> Source:
    """NetCDF 3 and 4, read when asked for; samples that were never written are NaN.

    Raises ValueError for a classic file whose header does not fit it.
    """
    with path.open("rb") as file:
        head = file.read(4)
    # The netCDF library fills what a cut classic file lacks with zeros; SciPy raises.
    engine: Literal["scipy", "netcdf4"] = "scipy" if head in (b"CDF\x01", b"CDF\x02") else "netcdf4"
    if head.startswith(b"CDF"):
        check_places(path)
    dataset = xr.open_dataset(path, engine=engine, decode_cf=False)
    for variable in dataset.variables.values():
        kind = variable.dtype.str[1:]
        if kind in FILLS and not {"_FillValue", "missing_value"} & set(variable.attrs):
            variable.attrs["_FillValue"] = variable.dtype.type(FILLS[kind])
    source = dataset_source(path, dataset)
    return source if head.startswith(b"CDF") else _without_holes(source, _with_holes(path))


def _with_holes(path: Path) -> frozenset[str]:
    """Variables of which some samples were never written and read as a number like any other.

    The netCDF library leaves its fill values there; what other programs write through HDF5 reads
    as zeros.
    """
    import h5py

    found = set()
    with h5py.File(path) as file:
        for name, item in file.items():
            if isinstance(item, h5py.Dataset) and item.dtype.kind in "iuf":
                marks = {FILLS.get(item.dtype.str[1:]), *np.ravel(item.attrs.get("_FillValue", []))}
                if item.fillvalue not in marks and holes_of(item) and "NAME" not in item.attrs:
                    found.add(name)
    return frozenset(found)


def _without_holes(source: Source, holes: Collection[str]) -> Source:
    def read(name: str) -> xr.DataArray:
        if name in holes:
            raise ValueError(
                f"some samples of {name!r} were never written, and read as if they were zero; "
                "write them, or give the variable a _FillValue"
            )
        return source.read(name)

    return replace(source, read=read)


NETCDF = Reader(
    "NetCDF", read_netcdf, first_bytes=(b"CDF",), form="hdf5", endings=(".nc", ".nc4", ".cdf")
)
