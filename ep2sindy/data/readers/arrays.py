"""Readers of files of named arrays: HDF5 of any layout, NetCDF, Zarr, MATLAB, NumPy's npz and JSON.

Values are read when they are used, except those of old MATLAB files and of JSON.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from math import ceil, prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from zipfile import ZipFile

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from ep2sindy.data.blocks import AT_ONCE, unpack
from ep2sindy.data.readers.source import (
    PACKED_BY,
    FileSource,
    Reader,
    check_packing,
    dataset_source,
    leaves,
    plain,
)
from ep2sindy.runtime.files import check_regular, read_json
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
    of it. A group's attributes `time` and `dt` are arrays of one number, "group/time". Of openPMD,
    units and the grids of meshes are read too; of a mesh in azimuthal modes (thetaMode) the first,
    which is the average over the azimuth.
    """
    import h5py

    names, beside = names_in_hdf5(path)

    def read(name: str) -> xr.DataArray:
        if name in beside:
            return beside[name]
        with h5py.File(path) as file:
            found = file[name]
            array, attrs = stored_array(path, found), _attributes(found, name)
            array = array[0] if _has_modes(found) else array
        unit = attrs.pop("units")
        return unpack(array, attrs).assign_attrs(units=unit)

    with h5py.File(path) as file:
        attributes = {key: _plain(value) for key, value in file.attrs.items()}
    numbers = {key: value for key, value in attributes.items() if isinstance(value, int | float)}
    return FileSource(path, [*names, *beside], read, attributes=numbers)


def names_in_hdf5(path: Path) -> tuple[list[str], dict[str, xr.DataArray]]:
    """Paths of all data sets, and what else the file holds as arrays by other names.

    These are times and steps in the attributes of groups, and the grids of openPMD's meshes.
    """
    import h5py

    names: list[str] = []
    beside: dict[str, xr.DataArray] = {}

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        where = f"{name}/" if name else ""
        if isinstance(item, h5py.Dataset):
            names.append(name)
        elif isinstance(item, h5py.Group):
            unit_s = _plain(item.attrs.get("timeUnitSI"))
            unit = "s" if unit_s == 1.0 else f"{unit_s:.15g} s" if isinstance(unit_s, float) else ""
            for key in {*TIMES} & {*item.attrs}:
                if isinstance(value := _plain(item.attrs[key]), int | float):
                    beside[where + key] = xr.DataArray(float(value), attrs={"units": unit})
        if {*MESH} <= {*item.attrs}:
            one = item if isinstance(item, h5py.Dataset) else next(iter(item.values()), None)
            beside.update(_mesh(name, item, one) if isinstance(one, h5py.Dataset) else {})

    with h5py.File(path) as file:
        look("", file)
        file.visititems(look)
    return names, {name: array for name, array in beside.items() if name not in names}


def _mesh(name: str, item: h5py.Group | h5py.Dataset, one: h5py.Dataset) -> dict[str, xr.DataArray]:
    """Coordinates of a mesh of openPMD in m, called as its axes, next to the mesh.

    one: the mesh, or one of its components.
    Source: openPMD standard 1.1.0, mesh based records.
    """
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
    counts = [ceil(n / step) for n, step in zip(found.shape, chunks, strict=True)]
    # One mark for each chunk says if it was written.
    hint = "copy the part that you need into a file"
    check_memory(float(prod(counts)), repr(found.name), hint=hint)
    written = np.ones(counts, dtype=bool)
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


# NetCDF and Zarr.


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


# MATLAB, up to v7 and v7.3.


V73 = b"MATLAB 7.3"


def read_matlab(path: Path) -> FileSource:
    """Read a MATLAB file of either format; a struct's field is named "data.n_i"."""
    with path.open("rb") as file:
        return _read_v73(path) if file.read(len(V73)) == V73 else _read_old(path)


def _read_v73(path: Path) -> FileSource:
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

    names = [name for name in names_in_hdf5(path)[0] if not name.startswith("#refs#")]
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


# HallThruster.jl's output.


JULIA_UNITS = {
    "t": "s", "z": "m", "grid": "m", "cell_centers": "m", "n": "m^-3", "ni": "m^-3", "nn": "m^-3",
    "ne": "m^-3", "u": "m/s", "ui": "m/s", "ue": "m/s", "Tev": "eV", "B": "T", "E": "V/m",
    "potential": "V", "thrust": "N", "discharge_current": "A", "discharge_voltage": "V",
    "ion_current": "A", "electron_current": "A",
}  # fmt: skip


def read_hallthruster(path: Path) -> FileSource:
    """Read time-resolved JSON output of HallThruster.jl, or JSON that holds plain columns.

    Values are in SI, except Tev in eV. A name is a path inside a frame, with indices from 0:
    `ions.Xe.0.n` (density of Xe+), `neutrals.Xe.n`, `Tev`, `discharge_current`, time `t`, grid `z`.
    Supported layouts: versions 0.19 to 0.22 (output.frames); frames with `t` and `grid` next to
    them; 0.18 (`ni.0`, `ui.0`, `nn`) and earlier (`ni_1`), a bare list of frames; without frames,
    plain columns. Data next to the frames are named by their path from the top.
    Source: https://um-pepl.github.io/HallThruster.jl (Use JSON for input and output).
    """
    content = read_json(path.read_text(encoding="utf-8-sig"))
    frames, beside = _split_frames(content)
    columns = {name: v for name, v in leaves(beside).items() if _is_column(v)}
    if not frames and not columns:
        raise ValueError("it holds no output.frames; run the simulation with save_time_resolved")
    flat = [leaves(frame) for frame in frames]
    inside = [*flat[0]] if flat else []

    def read(name: str) -> xr.DataArray:
        if name not in inside:
            values = columns[name]
        else:  # the fixed grid is repeated in every frame
            values = flat[0][name] if name == "z" else [frame[name] for frame in flat]
        return xr.DataArray(np.array(values, dtype=np.float64), attrs={"units": _unit(name)})

    names = [*inside, *(name for name in columns if name not in inside)]
    words = f"{len(frames)} frames" if frames else "columns, no frames"
    return FileSource(path, names, read, words=words, attributes=_channel(content))


def _split_frames(content: Any) -> tuple[Sequence[Mapping[str, Any]], Any]:
    """Split the content into the frames and the data next to them."""
    if isinstance(content, list):
        frames, beside = content, {}
    else:
        output = content.get("output", {})
        holder = output if isinstance(output, dict) and "frames" in output else content
        frames = holder.get("frames") or []
        # The input and the averages describe the whole run and are not samples.
        beside = {k: v for k, v in holder.items() if k not in ("frames", "input", "average")}
        beside.pop("output", None)
    if not all(isinstance(frame, dict) for frame in frames):
        return [], beside
    return frames, beside


def _is_column(value: Any) -> bool:
    """True for a list, or nested lists, of at least two numbers."""
    with suppress(TypeError, ValueError):
        array = np.array(value, dtype=np.float64)
        return array.ndim > 0 and array.size > 1
    return False


def _unit(name: str) -> str:
    """Unit in HallThruster.jl's output, by the last part of a path that is not an index."""
    return JULIA_UNITS.get([part for part in name.split(".") if not part.isdigit()][-1], "")


def _channel(content: Any) -> dict[str, float]:
    """Length of the channel in m, from the input that newer versions store with the output."""
    with suppress(KeyError, TypeError):
        node = content["input"]["config"]["thruster"]["geometry"]["channel_length"]
        return {"channel_m": float(node)} if isinstance(node, int | float) else {}
    return {}


HALLTHRUSTER = Reader("HallThruster.jl", read_hallthruster, form="other", endings=(".json",))
