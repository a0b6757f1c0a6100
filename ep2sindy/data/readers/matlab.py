"""Readers of MATLAB files (up to v7, and v7.3) and of NumPy's npz archives."""

from __future__ import annotations

from pathlib import Path
from zipfile import ZipFile

import numpy as np
import xarray as xr

from ep2sindy.data.readers.hdf5 import names_in_hdf5, stored_array
from ep2sindy.data.readers.source import FileSource, Reader, leaves
from ep2sindy.trust.memory import check_memory

V73 = b"MATLAB 7.3"


def read_matlab(path: Path) -> FileSource:
    """Read a MATLAB file of either format; a struct's field is named "data.n_i"."""
    with path.open("rb") as file:
        return _read_hdf5(path) if file.read(len(V73)) == V73 else _read_old(path)


def _read_hdf5(path: Path) -> FileSource:
    """Read MATLAB v7.3, which is HDF5 with reversed axes."""
    import h5py

    def read(name: str) -> xr.DataArray:
        with h5py.File(path) as file:
            found = file[name.replace(".", "/")]
            kind = found.attrs.get("MATLAB_class", b"object").decode()
            if "MATLAB_object_decode" in found.attrs or found.dtype.hasobject:
                raise ValueError(
                    f"{name!r} is a MATLAB {kind}, of which the file holds references: save its "
                    f"columns as arrays, or writetable({name}, 'run.csv')"
                )
            return stored_array(path, found).T

    names = [name for name in names_in_hdf5(path) if not name.startswith("#refs#")]
    return FileSource(path, [name.replace("/", ".") for name in names], read)


def _read_old(path: Path) -> FileSource:
    """Read MATLAB up to v7."""
    from scipy.io import loadmat

    content = loadmat(path, simplify_cells=True)
    arrays = leaves({name: value for name, value in content.items() if not name.startswith("__")})
    return FileSource(path, list(arrays), lambda name: xr.DataArray(np.asarray(arrays[name])))


MATLAB = Reader("MATLAB (v5, v7.3)", read_matlab, first_bytes=(b"MATLAB 5.0", V73))


# NumPy archives.


def read_npz(path: Path) -> FileSource:
    """Read NumPy arrays saved with `numpy.savez`; pickled objects are refused."""

    def read(name: str) -> xr.DataArray:
        with np.load(path, allow_pickle=False) as arrays:
            return xr.DataArray(arrays[name])

    with ZipFile(path) as archive:
        for member in archive.infolist():
            check_memory(float(member.file_size), repr(member.filename), hint="divide it")
            if not member.filename.endswith(".npy"):
                raise ValueError(
                    f"an archive must hold arrays of NumPy alone: it holds {member.filename!r}; "
                    "unpack it, and name the file in it"
                )
    with np.load(path, allow_pickle=False) as arrays:
        return FileSource(path, list(arrays), read)


NPZ = Reader("npz", read_npz, form="zip")
