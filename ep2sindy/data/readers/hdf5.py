"""HDF5 of any layout."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from ep2sindy.data.readers.source import Reader, Source


def read_hdf5(path: Path) -> Source:
    """HDF5; a name is the path of a data set, such as "group/n_i"."""
    import h5py

    def read(name: str) -> xr.DataArray:
        with h5py.File(path) as file:
            units = file[name].attrs.get("units", "")
            units = units.decode() if isinstance(units, bytes) else units
            return xr.DataArray(file[name][()], attrs={"units": units})

    return Source(path, names_in_hdf5(path), read)


def names_in_hdf5(path: Path) -> list[str]:
    """Paths of all data sets."""
    import h5py

    names: list[str] = []
    with h5py.File(path) as file:
        file.visititems(
            lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None
        )
    return names


HDF5 = Reader("HDF5", read_hdf5, form="hdf5")
