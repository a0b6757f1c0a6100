"""Reader of HDF5 files of any layout."""

from __future__ import annotations

from math import ceil, prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from ep2sindy.data.blocks import AT_ONCE, UNDECODED
from ep2sindy.data.readers.source import PACKED_BY, FileSource, Reader, check_packing, plain
from ep2sindy.trust.memory import check_memory

if TYPE_CHECKING:
    import h5py

UNITS = ("units", "Units", "UNITS", "unit", "Unit", "UNIT")

TIMES = ("time", "dt")  # attributes of a group

# Attributes of the grid of a mesh of openPMD, and base units in the order of its standard.
MESH = ("axisLabels", "gridSpacing", "gridGlobalOffset")
SI = ("m", "kg", "s", "A", "K", "mol", "cd")

# Attributes by which NetCDF, and other programs too, pack numbers and mark missing ones.
PACKING = (*PACKED_BY, "_FillValue", "missing_value")


def read_hdf5(path: Path) -> FileSource:
    """Read HDF5; a name is the path of a data set, such as "group/n_i".

    Numbers packed by `scale_factor` and `add_offset` are unpacked. Numbers equal to `_FillValue`,
    and numbers that were never written, are NaN. Numbers in the file's own attributes describe all
    of it. A group's attributes `time` and `dt` are arrays of
    one number, "group/time". Of openPMD, units and the grids of meshes are read too; of a mesh in
    azimuthal modes (thetaMode) the first, which is the average over the azimuth.
    """
    import h5py

    beside = _beside(path)

    def read(name: str) -> xr.DataArray:
        if name in beside:
            return beside[name]
        with h5py.File(path) as file:
            found = file[name]
            array, attrs = stored_array(path, found), _attributes(found, name)
            array = array[0] if _has_modes(found) else array
        unit = attrs.pop("units")
        packed = xr.Dataset({"it": array.assign_attrs(attrs)})
        decoded = xr.decode_cf(packed, decode_coords=False, **UNDECODED)["it"]
        return decoded.drop_attrs().assign_attrs(units=unit)

    names = names_in_hdf5(path)
    beside = {name: array for name, array in beside.items() if name not in names}
    with h5py.File(path) as file:
        attributes = {key: _plain(value) for key, value in file.attrs.items()}
    numbers = {key: value for key, value in attributes.items() if isinstance(value, int | float)}
    return FileSource(path, [*names, *beside], read, attributes=numbers)


def _beside(path: Path) -> dict[str, xr.DataArray]:
    """Times and steps in the attributes of groups, and the grids of openPMD's meshes."""
    import h5py

    found: dict[str, xr.DataArray] = {}

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        where = f"{name}/" if name else ""
        if isinstance(item, h5py.Group):
            unit_s = _plain(item.attrs.get("timeUnitSI"))
            unit = "s" if unit_s == 1.0 else f"{unit_s:.15g} s" if isinstance(unit_s, float) else ""
            for key in {*TIMES} & {*item.attrs}:
                if isinstance(value := _plain(item.attrs[key]), int | float):
                    found[where + key] = xr.DataArray(float(value), attrs={"units": unit})
        if {*MESH} <= {*item.attrs}:
            found.update(_mesh(name, item))

    with h5py.File(path) as file:
        look("", file)
        file.visititems(look)
    return found


def _mesh(name: str, item: h5py.Group | h5py.Dataset) -> dict[str, xr.DataArray]:
    """Coordinates of a mesh of openPMD in m, called as its axes, next to the mesh.

    Source: openPMD standard 1.1.0, mesh based records.
    """
    import h5py

    one = item if isinstance(item, h5py.Dataset) else next(iter(item.values()), None)
    if not isinstance(one, h5py.Dataset):
        return {}
    labels = [_plain(label) for label in item.attrs["axisLabels"]]
    unit_m = float(_plain(item.attrs.get("gridUnitSI", 1.0)))
    within = np.ravel(one.attrs.get("position", np.zeros(len(labels))))
    where, found = name.rpartition("/")[0], {}
    shape = one.shape[1:] if _has_modes(one) else one.shape
    numbers = (item.attrs["gridGlobalOffset"], item.attrs["gridSpacing"], within, shape)
    for label, offset, spacing, start, n in zip(labels, *numbers, strict=True):
        points = unit_m * (float(offset) + float(spacing) * (np.arange(n) + float(start)))
        found[f"{where}/{label}".lstrip("/")] = xr.DataArray(points, attrs={"units": "m"})
    return found


def _has_modes(found: h5py.Dataset) -> bool:
    """True for a record of openPMD whose first axis holds azimuthal modes."""
    geometries = (each.attrs.get("geometry") for each in (found, found.parent))
    return "thetaMode" in (_plain(geometry) for geometry in geometries)


def _openpmd_unit(attributes: h5py.AttributeManager) -> str:
    """Unit of a record of openPMD, such as `1e+18 m^-3`; "" for a pure number."""
    if "unitSI" not in attributes:
        return ""
    powers = dict(zip(SI, np.ravel(attributes.get("unitDimension", [])), strict=False))
    base = " ".join(f"{unit}^{power:g}" for unit, power in powers.items() if power)
    return f"{float(_plain(attributes['unitSI'])):.15g} {base}" if base else ""


def names_in_hdf5(path: Path) -> list[str]:
    """Paths of all data sets."""
    import h5py

    names: list[str] = []
    with h5py.File(path) as file:
        file.visititems(
            lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None
        )
    return names


class _Stored(BackendArray):
    """Values of a data set, read when they are used; those that were never written are NaN."""

    def __init__(self, path: Path, found: h5py.Dataset) -> None:
        self.path, self.name, self.shape = path, found.name, found.shape
        self.written, self.chunks = _written(found)
        self.dtype = found.dtype if self.written.all() else np.dtype(np.float64)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> np.ndarray:
        support = indexing.IndexingSupport.OUTER_1VECTOR
        return indexing.explicit_indexing_adapter(key, self.shape, support, self._read)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        import h5py

        with h5py.File(self.path) as file:
            values = np.asarray(file[self.name][key])
        if self.written.all():
            return values
        chunk_of = (np.arange(n) // c for n, c in zip(self.shape, self.chunks, strict=True))
        places = [np.ravel(of[k]) for of, k in zip(chunk_of, key, strict=True)]
        return np.where(self.written[np.ix_(*places)].reshape(values.shape), values, np.nan)


def stored_array(path: Path, found: h5py.Dataset) -> xr.DataArray:
    """Values of a data set, read when they are used if they are many.

    Where nothing was written, HDF5 gives zeros, and this NaN.
    Raises ValueError if nothing was ever written, and for a null dataspace, which cannot hold any
    values.
    """
    if found.shape is None:
        raise ValueError(f"{found.name!r} is empty: its dataspace is null, and holds no values")
    if found.dtype.kind not in "iufb":
        return xr.DataArray(found[()])
    # One mark for each chunk says if it was written.
    n_bytes = float(prod(_counts(found)))
    check_memory(n_bytes, repr(found.name), hint="copy the part that you need into a file")
    stored = _Stored(path, found)
    if not stored.written.any():
        raise ValueError(f"{found.name!r} was never written: the file holds its shape alone")
    dims = [f"dim_{k}" for k in range(found.ndim)]
    chunks = {} if found.chunks is None else dict(zip(dims, found.chunks, strict=True))
    lazy = indexing.LazilyIndexedArray(stored)
    array = xr.DataArray(xr.Variable(dims, lazy, encoding={"preferred_chunks": chunks}))
    return array if array.nbytes > AT_ONCE else array.load()


def _written(found: h5py.Dataset) -> tuple[np.ndarray, tuple[int, ...]]:
    """Which chunks of a data set were written, over the grid of its chunks, and their shape."""
    chunks = found.chunks or tuple(max(n, 1) for n in found.shape)
    written = np.ones(_counts(found), dtype=bool)
    if not found.size or not found.shape or found.dtype.kind not in "iuf" or found.is_virtual:
        return written, chunks
    if found.chunks is None:
        written[...] = found.id.get_storage_size() > 0
    elif found.id.get_num_chunks() < written.size:
        written[...] = False
        starts: list[tuple[int, ...]] = []
        found.id.chunk_iter(lambda chunk: starts.append(chunk.chunk_offset))
        for start in starts:
            written[tuple(k // step for k, step in zip(start, chunks, strict=True))] = True
    return written, chunks


def _counts(found: h5py.Dataset) -> list[int]:
    """Number of chunks along each axis; one where the values are not divided into chunks."""
    chunks = found.chunks or tuple(max(n, 1) for n in found.shape)
    return [ceil(n / step) for n, step in zip(found.shape, chunks, strict=True)]


def _attributes(found: h5py.Dataset, name: str) -> dict[str, Any]:
    """Unit and packing attributes of a data set.

    An empty attribute means no unit; raises ValueError for an empty packing attribute.
    """
    given = {key: _plain(found.attrs[key]) for key in (*PACKING, *UNITS) if key in found.attrs}
    attrs = {key: given[key] for key in PACKING if key in given}
    if empty := [key for key, value in attrs.items() if value is None]:
        raise ValueError(
            f"{empty[0]} of {name!r} must be a number: the attribute is empty, its dataspace is "
            "null; give it a value, or take it away"
        )
    check_packing(name, attrs)
    units = next((given[key] or "" for key in UNITS if key in given), "")
    return attrs | {"units": units or _openpmd_unit(found.attrs)}


def _plain(value: Any) -> Any:
    """Convert an attribute, or an array of one element, to a plain value, bytes to text.

    None for a null dataspace.
    """
    import h5py

    if isinstance(value, h5py.Empty):
        return None
    value = plain(value)
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


HDF5 = Reader("HDF5", read_hdf5, form="hdf5")
