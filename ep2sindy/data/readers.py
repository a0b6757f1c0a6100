"""Open files of many kinds: a small reader each, all giving a `Source`."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pandas as pd
import xarray as xr
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

# Time stays a number, whatever its attribute `units` says.
UNDECODED: Any = {"decode_times": False, "decode_timedelta": False}


# What the parsing libraries raise on damaged files beyond ValueError and OSError.
LIBRARY_ERRORS = (zipfile.BadZipFile, zlib.error, MatReadError)


@dataclass(frozen=True)
class Source:
    """A file opened: the names it holds, and the array of one name.

    dims_named: whether the arrays' dimension names are the file's own.
    """

    path: Path
    names: Sequence[str]
    read: Callable[[str], xr.DataArray]
    dims_named: bool = False


def open_source(path: Path) -> Source:
    """Open a file with the reader for its kind."""
    reader = reader_of(path)
    with damage_named(path):
        return reader(path)


def reader_of(path: Path) -> Callable[[Path], Source]:
    """Tell the kind of a file: by its first bytes where they say it, else by its ending."""
    suffix = path.suffix.lower()
    if not path.exists():
        raise ValueError(f"no such file: {path.absolute()}")
    if path.is_dir():
        if suffix == ".zarr":
            return read_zarr
        raise ValueError(f"a file must come, or a folder that ends in .zarr: {path} is a folder")
    with path.open("rb") as file:
        head = file.read(16)
    if head.startswith(b"MATLAB 7.3"):
        return read_matlab73
    if head.startswith(b"CDF") or (h5py.is_hdf5(path) and suffix in (".nc", ".nc4", ".cdf")):
        return read_netcdf
    if h5py.is_hdf5(path):
        return read_hdf5
    if head.startswith(b"MATLAB 5.0"):
        return read_matlab5
    if head.startswith(b"PK"):
        return read_npz
    if suffix in (".csv", ".json"):
        return read_csv if suffix == ".csv" else read_hallthruster
    raise ValueError(
        f"a file must be NetCDF, HDF5, MATLAB (v5, v7.3) or npz, or end in .csv, .json or .zarr: "
        f"{path} begins with {head!r}; its ending may be wrong, or its content damaged"
    )


@contextmanager
def damage_named(path: Path) -> Iterator[None]:
    """Turn what the parsing libraries raise into one error that names the file."""
    try:
        yield
    except (OSError, EOFError, ValueError, LookupError, TypeError, *LIBRARY_ERRORS) as error:
        raise ValueError(
            f"{path} cannot be read: {error}; the file may be cut short, or of another kind"
        ) from error


def read_netcdf(path: Path) -> Source:
    """NetCDF 3 and 4, read when asked for."""
    with path.open("rb") as file:
        classic = file.read(4) in (b"CDF\x01", b"CDF\x02")
    # The netCDF library fills what a cut classic file lacks with zeros; SciPy raises.
    engine: Literal["scipy", "netcdf4"] = "scipy" if classic else "netcdf4"
    return _dataset_source(path, xr.open_dataset(path, engine=engine, **UNDECODED))


def read_zarr(path: Path) -> Source:
    """Zarr store in a folder, with named dimensions as xarray writes it; read when asked for."""
    return _dataset_source(
        path, xr.open_dataset(path, engine="zarr", consolidated=False, **UNDECODED)
    )


def _dataset_source(path: Path, dataset: xr.Dataset) -> Source:
    names = [str(name) for name in dataset.variables]
    return Source(path, names, lambda name: dataset[name], dims_named=True)


def read_hdf5(path: Path) -> Source:
    """HDF5; a name is the path of a data set, such as "group/n_i"."""

    def read(name: str) -> xr.DataArray:
        with h5py.File(path) as file:
            units = file[name].attrs.get("units", "")
            units = units.decode() if isinstance(units, bytes) else units
            return xr.DataArray(file[name][()], attrs={"units": units})

    return Source(path, _hdf5_names(path), read)


def read_matlab73(path: Path) -> Source:
    """MATLAB v7.3, which is HDF5 with axes reversed; a struct's field is "data.n_i"."""

    def read(name: str) -> xr.DataArray:
        with h5py.File(path) as file:
            return xr.DataArray(file[name.replace(".", "/")][()].T)

    names = [name.replace("/", ".") for name in _hdf5_names(path) if not name.startswith("#refs#")]
    return Source(path, names, read)


def _hdf5_names(path: Path) -> list[str]:
    names: list[str] = []
    with h5py.File(path) as file:
        file.visititems(
            lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None
        )
    return names


def read_matlab5(path: Path) -> Source:
    """MATLAB up to v7; a struct's field is "data.n_i"."""
    content = loadmat(path, simplify_cells=True)
    arrays = leaves({name: value for name, value in content.items() if not name.startswith("__")})
    return Source(path, list(arrays), lambda name: xr.DataArray(np.asarray(arrays[name])))


def read_npz(path: Path) -> Source:
    """NumPy arrays saved with `numpy.savez`; pickled objects are refused."""

    def read(name: str) -> xr.DataArray:
        with np.load(path, allow_pickle=False) as arrays:
            return xr.DataArray(arrays[name])

    with np.load(path, allow_pickle=False) as arrays:
        return Source(path, list(arrays), read)


def read_csv(path: Path) -> Source:
    """CSV with a header line of names, one row per sample; lines from # on are left out."""
    frame = pd.read_csv(path, comment="#", skipinitialspace=True)
    frame.columns = frame.columns.str.strip()
    return Source(path, [*map(str, frame)], lambda name: xr.DataArray(frame[name].to_numpy()))


def read_hallthruster(path: Path) -> Source:
    """Time-resolved JSON output of HallThruster.jl, SI but for Tev in eV.

    A name is a path inside a frame, counted from 0: `ions.Xe.0.n` is the density of Xe+,
    `neutrals.Xe.n`, `Tev`, `discharge_current`, with time `t` and grid `z`. Layout of versions
    0.19 to 0.22 (output.frames); also read are 0.18 (`ni.0`) and earlier ones (a bare list of
    frames, `ni_1`).
    Source: https://um-pepl.github.io/HallThruster.jl (Use JSON for input and output).
    """
    content = json.loads(path.read_text(encoding="utf-8"))
    frames = content.get("output", {}).get("frames") if isinstance(content, dict) else content
    if not frames or not isinstance(frames[0], dict):
        raise ValueError("it holds no output.frames; run the simulation with save_time_resolved")

    def read(name: str) -> xr.DataArray:
        if name == "z":  # repeated in every frame, since the grid stays
            return xr.DataArray(np.array(frames[0]["z"], dtype=np.float64))
        rows = [reduce(_step_into, name.split("."), frame) for frame in frames]
        return xr.DataArray(np.array(rows, dtype=np.float64))

    return Source(path, list(leaves(frames[0])), read)


def _step_into(node: Any, key: str) -> Any:
    return node[int(key)] if isinstance(node, list) else node[key]


def leaves(node: Any, path: str = "") -> dict[str, Any]:
    """Nested dicts and lists of them as {"a.b.0": value}; a list of numbers is one value."""
    if isinstance(node, dict):
        items = list(node.items())
    elif isinstance(node, list) and any(isinstance(item, dict | list) for item in node):
        items = list(enumerate(node))
    else:
        return {path: node}
    found: dict[str, Any] = {}
    for key, item in items:
        found |= leaves(item, f"{path}.{key}" if path else str(key))
    return found
