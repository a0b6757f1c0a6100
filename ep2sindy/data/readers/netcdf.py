"""Readers of NetCDF 3 and 4, and of Zarr stores; values are read when they are used."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import xarray as xr

from ep2sindy.data.readers.source import FileSource, Reader, dataset_source
from ep2sindy.runtime.files import check_regular

# Default fill values, which the netCDF library returns for numbers that were never written unless
# an attribute sets another. Bytes have none. Source: netcdf.h, NC_FILL_SHORT and its kin.
FILLS = {
    "i2": -32767, "u2": 65535, "i4": -2147483647, "u4": 4294967295,
    "i8": -9223372036854775806, "u8": 18446744073709551614,
    "f4": 9.969209968386869e36, "f8": 9.969209968386869e36,
}  # fmt: skip


def read_netcdf(path: Path) -> FileSource:
    """Open NetCDF 3 or 4; samples never written are NaN.

    Raises ValueError for a classic file that is shorter than its values.
    """
    with path.open("rb") as file:
        head = file.read(4)
    if head == b"CDF\x05" and find_spec("netCDF4") is None:
        raise ValueError("it is CDF-5, which an extra reads: pip install 'ep2sindy[files]'")
    engine: Literal["scipy", "h5netcdf", "netcdf4"] = "h5netcdf"
    if head.startswith(b"CDF"):  # in a truncated file the netCDF library reads on; SciPy raises
        engine = "netcdf4" if head == b"CDF\x05" else "scipy"
    dataset = xr.open_dataset(path, engine=engine, decode_cf=False)
    size = path.stat().st_size
    if head.startswith(b"CDF") and dataset.nbytes > size:
        raise ValueError(
            f"it is cut short: its values take {dataset.nbytes} bytes, and it has {size}"
        )
    for variable in dataset.variables.values():
        kind = variable.dtype.str[1:]
        if kind in FILLS and not {"_FillValue", "missing_value"} & set(variable.attrs):
            variable.attrs["_FillValue"] = variable.dtype.type(FILLS[kind])
    return dataset_source(path, dataset)


def read_zarr(path: Path) -> FileSource:
    """Open a Zarr store in a folder, with named dimensions as xarray writes it.

    Pickled objects are refused by numcodecs, from the release on that the extra asks for.
    """
    check_regular(path)
    dataset = xr.open_dataset(path, engine="zarr", consolidated=False, decode_cf=False)
    return dataset_source(path, dataset)


NETCDF = Reader(
    "NetCDF", read_netcdf, first_bytes=(b"CDF",), form="hdf5", endings=(".nc", ".nc4", ".cdf")
)
ZARR = Reader("Zarr", read_zarr, form="folder", endings=(".zarr",), package="zarr")
