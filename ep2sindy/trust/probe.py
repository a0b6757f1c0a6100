"""The process that looks through a file first, for libraries in C may die of a damaged one.

Run as `python -m ep2sindy.trust.probe`: a path and the name of its reader come in as JSON,
one line for each file, and "" or what is wrong with the file goes out. It ends when its input does.
"""

from __future__ import annotations

import json
import os
import sys
from math import prod
from pathlib import Path
from typing import Any

from ep2sindy.trust.limits import DEPTH, N_NAMES, check_declared

SLAB = 2**24  # values read at once
READ_THROUGH = 2**30  # bytes of an array that are all read; of a longer one its ends

MEMORY = 2**31  # bytes of address space beyond twenty times the file


def look_through(path: Path, reader: str) -> None:
    """Read all that a file holds, as its reader would; raises what is wrong with it."""
    with path.open("rb") as file:
        head = file.read(10)
    if head.startswith(b"MATLAB 5.0"):
        _matlab(path)
    elif not head.startswith(b"CDF"):
        _hdf5(path)
    if reader == "NetCDF":
        _netcdf(path)


def _matlab(path: Path) -> None:
    from scipy.io import loadmat, whosmat

    for name, shape, kind in whosmat(path):
        is_nested = kind in ("struct", "cell", "object")  # whose elements are objects of Python
        check_declared(repr(name), prod(shape) * (256 if is_nested else 8), path)
    loadmat(path, simplify_cells=True)


def _netcdf(path: Path) -> None:
    import netCDF4

    with netCDF4.Dataset(path) as file:
        for name, found in file.variables.items():
            for attribute in found.ncattrs():
                found.getncattr(attribute)
            if not file.data_model.startswith("NETCDF4"):  # else HDF5 has read the values
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
            continue  # what it names is met under its own name, or is not there
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
    """What the index lists must be found by it, or values read as if nobody had written them."""
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
        return  # Windows has no limits of this kind
    most = MEMORY + 20 * path.stat().st_size
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))


def main() -> None:
    """Answer one line for each that comes; what libraries print goes elsewhere."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    for line in sys.stdin:
        name, reader = json.loads(line)
        path = Path(name)
        try:
            _limit(path)
            look_through(path, reader)
            said = ""
        except Exception as error:  # any: it goes to the one who asked
            said = str(error).strip() or type(error).__name__
        print(json.dumps(said), file=answers, flush=True)


if __name__ == "__main__":
    main()
