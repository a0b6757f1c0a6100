"""Test process that reads files first, since a damaged one may crash the C library that reads it.

Run as `python -m ep2sindy.trust.probe`. Each line of input is JSON with a path and the name of its
reader. Each line of output is JSON: "" for a sound file, or what is wrong with it. The process ends
with its input.
"""

from __future__ import annotations

import json
import os
import sys
from math import prod
from pathlib import Path
from typing import Any

from ep2sindy.trust.limits import DEPTH, N_NAMES, check_declared

SLAB = 2**24  # number of values read at once
READ_THROUGH = 2**30  # bytes up to which an array is read completely; of a longer one, its ends

MEMORY = 2**31  # limit of address space in bytes, in addition to twenty times the file's size


def look_through(path: Path, reader: str) -> None:
    """Read the content of a file as its reader would; raises an error if something is wrong."""
    with path.open("rb") as file:
        head = file.read(10)
    if head.startswith(b"MATLAB 5.0"):
        _matlab(path)
    elif head.startswith(b"PAR1"):
        _parquet(path)
    elif not head.startswith(b"CDF"):
        _hdf5(path)
    if reader == "NetCDF":
        _netcdf(path)


def _matlab(path: Path) -> None:
    from scipy.io import loadmat, whosmat

    for name, shape, kind in whosmat(path):
        is_nested = kind in ("struct", "cell", "object")  # their elements become Python objects
        check_declared(repr(name), prod(shape) * (256 if is_nested else 8), path)
    loadmat(path, simplify_cells=True)


def _parquet(path: Path) -> None:
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        for k in range(file.metadata.num_row_groups):
            group = file.metadata.row_group(k)
            check_declared(f"row group {k}", 8 * group.num_rows * group.num_columns, path)
            file.read_row_group(k, use_threads=False)


def _netcdf(path: Path) -> None:
    import netCDF4

    with netCDF4.Dataset(path) as file:
        for name, found in file.variables.items():
            for attribute in found.ncattrs():
                found.getncattr(attribute)
            if not file.data_model.startswith("NETCDF4"):  # otherwise _hdf5 has read the values
                check_declared(repr(name), found.size * found.dtype.itemsize, path)
                found[...]


def _hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path) as file:
        _group(file, path, depth=0, seen=set())


def _group(group: Any, path: Path, *, depth: int, seen: set[Any]) -> None:
    import h5py

    if depth > DEPTH:
        raise ValueError(f"its groups stand more than {DEPTH} deep in each other")
    for name in group:
        link = group.get(name, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            raise ValueError(f"{name!r} is in another file, {link.filename!r}; open that one")
        if isinstance(link, h5py.SoftLink):
            continue  # its target is visited under its own name, or does not exist
        item = group[name]
        if item.id in seen:
            continue
        seen.add(item.id)
        if len(seen) > N_NAMES:
            raise ValueError(f"it holds more than {N_NAMES} names")
        if isinstance(item, h5py.Group):
            _group(item, path, depth=depth + 1, seen=seen)
        elif isinstance(item, h5py.Dataset):
            _array(item, path)


def _array(found: Any, path: Path) -> None:
    if found.external or found.is_virtual:
        raise ValueError(
            f"the values of {found.name!r} are in other files; copy them into this one"
        )
    if found.shape is None or found.dtype.kind not in "iufb":
        return
    check_declared(repr(found.name), found.size * found.dtype.itemsize, path)
    if not found.shape:
        found[()]
        return
    rows = max(1, SLAB // max(1, found.size // max(1, found.shape[0])))
    starts = range(0, found.shape[0], rows)
    whole = found.size * found.dtype.itemsize <= READ_THROUGH
    for start in starts if whole else {0, starts[-1]}:
        found[start : start + rows]
    if found.chunks and whole:
        _chunks(found)


def _chunks(found: Any) -> None:
    """Raise ValueError unless the index leads to every chunk that it lists.

    Otherwise their values would read as if they had never been written.
    """
    places: list[tuple[int, ...]] = []
    found.id.chunk_iter(lambda chunk: places.append(chunk.chunk_offset))
    if len(set(places)) < len(places):
        raise ValueError(f"{found.name!r} is damaged: two of its chunks stand for the same values")
    for place in places:
        try:
            found.id.read_direct_chunk(place)
        except (OSError, RuntimeError) as error:
            raise ValueError(
                f"{found.name!r} is damaged: the index of its chunks does not lead to {place}"
            ) from error


def _limit(path: Path) -> None:
    try:
        import resource
    except ImportError:
        return  # Windows does not offer such limits
    most = MEMORY + 20 * path.stat().st_size
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))


def main() -> None:
    """Answer each input line with one line; whatever libraries print goes to standard error."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    for line in sys.stdin:
        name, reader = json.loads(line)
        path = Path(name)
        try:
            _limit(path)
            look_through(path, reader)
            said = ""
        except Exception as error:  # of any kind: it is reported to the process that asked
            said = str(error).strip() or type(error).__name__
        print(json.dumps(said), file=answers, flush=True)


if __name__ == "__main__":
    main()
