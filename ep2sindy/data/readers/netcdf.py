"""Reader of NetCDF 3 and 4, and a check of the classic format's header against its file."""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import replace
from itertools import pairwise
from math import prod
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
import xarray as xr

from ep2sindy.data.readers.hdf5 import holes_of
from ep2sindy.data.readers.source import FileSource, Reader, dataset_source

# Default fill values, which the netCDF library returns for numbers that were never written unless
# an attribute sets another. Bytes have none. Source: netcdf.h, NC_FILL_SHORT and its kin.
FILLS = {
    "i2": -32767, "u2": 65535, "i4": -2147483647, "u4": 4294967295,
    "i8": -9223372036854775806, "u8": 18446744073709551614,
    "f4": 9.969209968386869e36, "f8": 9.969209968386869e36,
}  # fmt: skip


def read_netcdf(path: Path) -> FileSource:
    """Open NetCDF 3 or 4; values are read when used, and samples never written are NaN.

    Raises ValueError for a classic file whose header does not fit its content. Reading a variable
    raises ValueError if samples that were never written cannot be told from zeros.
    """
    with path.open("rb") as file:
        head = file.read(4)
    # For a truncated classic file the netCDF library fills in zeros, whereas SciPy raises.
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
    """Variables with samples that were never written but read as ordinary numbers.

    The netCDF library puts fill values there; files that other programs write through HDF5 give
    zeros.
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


def _without_holes(source: FileSource, holes: Collection[str]) -> FileSource:
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


# Positions of the variables in a classic NetCDF file (CDF-1, CDF-2, CDF-5), from its header.
#
# Source: https://docs.unidata.ucar.edu/netcdf-c/current/file_format_specifications.html


# Bytes per number for each type code: byte, char, short, int, float, double, ubyte to uint64.
SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 4, 6: 8, 7: 1, 8: 2, 9: 4, 10: 8, 11: 8}

WIDTHS = {1: (4, 4), 2: (4, 8), 5: (8, 8)}  # by version: bytes of a count and of a file offset

BIG_ENDIAN = {4: ">I", 8: ">Q"}


def check_places(path: Path) -> None:
    """Raise ValueError unless all variables lie inside the file, after its header, without overlap.

    The classic format has no checksums, so a damaged offset would silently read other values.
    """
    with path.open("rb") as file:
        try:
            header = _Header(file)
            blocks = _blocks(header)
        except (struct.error, KeyError, IndexError, OverflowError) as error:
            raise ValueError("its header is cut or damaged") from error
        blocks = [(0, file.tell()), *sorted(blocks)]
    end, size = max(stop for _, stop in blocks), path.stat().st_size
    if size < end:
        raise ValueError(f"its header describes {end} bytes, and it has {size}")
    for (_, stop), (start, _) in pairwise(blocks):
        if start < stop:
            raise ValueError(f"its header is damaged: two of its parts claim byte {start}")


class _Header:
    """Sequential reader of the numbers, names and lists in a header."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        file.seek(3)
        self.count_bytes, self.place_bytes = WIDTHS[file.read(1)[0]]

    def _number(self, n_bytes: int) -> int:
        return int(struct.unpack(BIG_ENDIAN[n_bytes], self._file.read(n_bytes))[0])

    def small(self) -> int:
        return self._number(4)

    def number(self) -> int:
        return self._number(self.count_bytes)

    def place(self) -> int:
        return self._number(self.place_bytes)

    def count(self) -> int:
        """Number of items in a list; its tag comes first and is skipped."""
        self.small()
        return self.number()

    def skip(self, n_bytes: int) -> None:
        """Skip some bytes and the padding to a multiple of four."""
        self._file.seek(_pad(n_bytes), 1)

    def attributes(self) -> None:
        for _ in range(self.count()):
            self.skip(self.number())
            kind = self.small()
            self.skip(SIZES[kind] * self.number())


def _blocks(header: _Header) -> list[tuple[int, int]]:
    """First byte and end of each block of the file.

    Each variable without records is one block. Variables with records give one block each for the
    first record, and a common one for all later records.
    """
    n_records = header.number()
    if n_records == 256**header.count_bytes - 1:  # unknown to the writer; assume at least one
        n_records = 1
    lengths = []
    for _ in range(header.count()):
        header.skip(header.number())
        lengths.append(header.number())
    header.attributes()
    fixed: list[tuple[int, int]] = []
    by_record: list[tuple[int, int]] = []
    for _ in range(header.count()):
        header.skip(header.number())
        shape = [lengths[header.number()] for _ in range(header.number())]
        header.attributes()
        size = SIZES[header.small()]
        header.number()  # size in bytes, unused: a large size does not fit this field
        begin = header.place()
        in_records = bool(shape) and shape[0] == 0
        (by_record if in_records else fixed).append((begin, size * prod(shape[in_records:])))
    blocks = [(begin, begin + n_bytes) for begin, n_bytes in fixed]
    if not by_record or not n_records:
        return blocks
    alone = len(by_record) == 1
    step = sum(n if alone else _pad(n) for _, n in by_record)
    blocks += [(begin, begin + n) for begin, n in by_record]
    first, (last, n_last) = min(by_record)[0], max(by_record)
    return [*blocks, (first + step, max(first + step, last + (n_records - 1) * step + n_last))]


def _pad(n_bytes: int) -> int:
    return -(-n_bytes // 4) * 4
