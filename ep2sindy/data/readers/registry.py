"""List of all readers, and the choice of the reader for a file."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from ep2sindy.data.readers.arrays import HALLTHRUSTER, HDF5, MATLAB, NETCDF, NPZ, ZARR
from ep2sindy.data.readers.source import FileSource, Reader, damage_named, look_at
from ep2sindy.data.readers.tables import CSV, NPY, TDMS
from ep2sindy.runtime.files import check_regular
from ep2sindy.runtime.screen import joined
from ep2sindy.trust.memory import check_memory

# The first that takes a file reads it: those by their first bytes, then those by form and ending.
READERS = (MATLAB, NPY, TDMS, NETCDF, HDF5, NPZ, CSV, HALLTHRUSTER, ZARR)

READ_LATER = (MATLAB, NETCDF, HDF5, ZARR)  # large variables are read when they are used

SMALLER = "divide it, or save it as NetCDF, of which parts are read"


def open_source(path: Path) -> FileSource:
    """Open a file with the reader for its kind."""
    reader = reader_of(path)
    if reader.package and find_spec(reader.package) is None:
        raise ValueError(
            f"{path} is of the kind {reader.name}, which an extra reads: pip install "
            "'ep2sindy[files]', or save it as CSV"
        )
    if reader not in READ_LATER:  # its values take about as many bytes, or more
        check_memory(float(path.stat().st_size), f"{path}, which is read at once,", hint=SMALLER)
    with damage_named(path):
        return replace(reader.open(path), kind=reader.name)


def reader_of(path: Path) -> Reader:
    """Choose the reader of a file by its first bytes, or else by its ending.

    Raises ValueError for a file that is missing, empty or of no known kind; the last error lists
    the known kinds.
    """
    if not path.exists():
        raise ValueError(f"no such file: {path.absolute()}")
    if not path.is_dir():
        check_regular(path)
    if path.is_file() and path.stat().st_size == 0:
        raise ValueError(f"{path} is empty: it holds no bytes; was it written to the end?")
    form, head, ending = look_at(path)
    if takers := [reader for reader in READERS if reader.takes(form, head, ending)]:
        return takers[0]
    if form == "folder":
        folders = joined([e for r in READERS if r.form == "folder" for e in r.endings], "or")
        counts = Counter(each.suffix for each in path.iterdir() if each.is_file() and each.suffix)
        hint = ", with no files in it"
        if counts:
            (most, n), *_ = counts.most_common(1)
            hint = f"; take its {n} files that end in {most}, '{path}/*{most}'"
        raise ValueError(
            f"the path must be a file, or a folder that ends in {folders}: {path} is a folder{hint}"
        )
    by_ending = [r for r in READERS if r.form in ("other", "folder")]
    kinds = joined([r.name for r in READERS if r not in by_ending], "or")
    endings = joined([each for r in by_ending for each in r.endings], "or")
    raise ValueError(
        f"a file must be {kinds}, or end in {endings}: "
        f"{path} begins with {head!r}; its ending may be wrong, or its content damaged; a table of "
        "Excel or Parquet is saved as CSV, or its pandas.DataFrame given to ep.discover"
    )
