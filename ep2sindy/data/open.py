"""Open files of many kinds as fields, and write fields as NetCDF.

One mapping says where each quantity sits in the file, in which unit and dimension order;
values become SI on the way in and nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ep2sindy.data.conversion import to_si
from ep2sindy.data.fields import CLOCK, DIMS, check_field, mask_outside
from ep2sindy.data.readers.netcdf import NETCDF
from ep2sindy.data.readers.registry import open_source, reader_of
from ep2sindy.data.readers.source import UNDECODED, Source, damage_named
from ep2sindy.library.names import check_variable
from ep2sindy.machine.files import replacing


@dataclass(frozen=True)
class Variable:
    """Where one quantity sits in a file.

    name: in the file; a path in HDF5 ("group/n_i"), a struct field in MATLAB ("data.n_i").
        None: the file has it not.
    unit: what the file's numbers count: "cm^-3", "km/s", "degC"; with a factor, "1e19 m^-3".
    dims: dimensions in the file's order, such as ("r", "z", "time"). None: as the file names
        them, or the one order in which the lengths fit.
    """

    name: str | None
    unit: str
    dims: Sequence[str] | None = None


Keys = Mapping[str, Any]


def open_field(
    path: str | Path,
    *,
    variables: Mapping[str, Variable | Keys],
    time: Variable | Keys | None = None,
    z: Variable | Keys | None = None,
    r: Variable | Keys | None = None,
    dt_s: float | None = None,
    mask: Variable | Keys | None = None,
    chunks: Mapping[str, int] | None = None,
) -> xr.Dataset:
    """Open a file as a field, with our names, dimensions and units.

    The kind of file shows in its content: NetCDF, HDF5, MATLAB v5 and v7.3, npz, Zarr; text
    is CSV or HallThruster.jl's JSON by its ending.
    variables: our name -> where it is in the file, as a `Variable` or the same keys from a
        config; those with name None are left out.
    time, z, r: the coordinates; None, or name None, where the file has none.
    dt_s: time step, for a file without time; taken instead of `time` where given.
    mask: nonzero where there is plasma; elsewhere values become NaN.
    chunks: our dimension -> length, to stream what exceeds memory (needs dask; NetCDF, Zarr).
    NetCDF and Zarr are read when values are asked for, variables in SI without a mask even
    without dask; the other kinds are read at once.
    Raises ValueError for a file that is missing, damaged or of another kind, a name it does
    not hold, a shape that does not fit its dimensions, or a unit that cannot be converted.
    """
    source = open_source(Path(path))
    wanted = _in_file(variables)
    if not wanted:
        raise ValueError(f"a field needs a variable: none of {list(variables)} has a name")
    arrays = {ours: _read(source, ours, variable) for ours, variable in wanted.items()}
    axes = _in_file({"time": time, "z": z, "r": r})
    points = _read_axes(source, axes, dt_s, _n_samples(arrays, wanted))
    file_dims = {str(p.dims[0]): axis for axis, p in points.items()} if source.dims_named else {}
    if dt_s is None:
        points["time"].attrs[CLOCK] = axes["time"].unit
    lengths = {axis: points[axis].size for axis in DIMS if axis in points}
    field = xr.Dataset(coords={axis: (axis, p.values, p.attrs) for axis, p in points.items()})
    for ours, array in arrays.items():
        placed = _place(array, ours, wanted[ours].dims, lengths, file_dims)
        if chunks is not None:
            placed = placed.chunk({d: n for d, n in chunks.items() if d in placed.dims})
        field[ours] = to_si(placed, ours, wanted[ours].unit)
    for ours, variable in _in_file({"mask": mask}).items():
        inside = _place(_read(source, ours, variable), ours, variable.dims, lengths, file_dims)
        field = mask_outside(field, inside != 0)
    check_field(field)
    return field


def _in_file(variables: Mapping[str, Variable | Keys | None]) -> dict[str, Variable]:
    """Those that the file has; a config's keys become a `Variable`."""
    found = {}
    for ours, value in variables.items():
        check_variable(ours)
        if isinstance(value, Mapping):
            if not {"name", "unit"} <= set(value) <= {"name", "unit", "dims"}:
                raise ValueError(f"{ours} needs a name, a unit, perhaps dims: {dict(value)} came")
            name = None if value["name"] is None else str(value["name"])
            value = Variable(name, str(value["unit"]), value.get("dims"))
        if value is not None and value.name is not None:
            found[ours] = value
    return found


def _read(source: Source, ours: str, variable: Variable) -> xr.DataArray:
    """One array of the file as real numbers, in the file's unit and shape."""
    name = str(variable.name)
    if name not in source.names:
        raise ValueError(
            f"{source.path} has no variable {name!r} (wanted as {ours}); it holds "
            f"{list(source.names)}; set the name, or set it to null if the file has none"
        )
    with damage_named(source.path):
        array = source.read(name)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name!r} in {source.path} must be real numbers, not {array.dtype}")
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


def _read_axes(
    source: Source,
    axes: Mapping[str, Variable],
    dt_s: float | None,
    n_samples: int,
) -> dict[str, xr.DataArray]:
    """Coordinates the file has, in SI; the time is counted in steps where they are given."""
    if dt_s is None and "time" not in axes:
        raise ValueError(
            f"a field needs time: name the file's time or give its step dt_s; "
            f"{source.path} holds {list(source.names)}"
        )
    if dt_s is None:
        return {axis: _read_axis(source, axis, v) for axis, v in axes.items()}
    steps = xr.DataArray(dt_s * np.arange(n_samples), attrs={"units": "s"})
    space = {axis: _read_axis(source, axis, v) for axis, v in axes.items() if axis != "time"}
    return {"time": steps, **space}


def _read_axis(source: Source, axis: str, variable: Variable) -> xr.DataArray:
    """Coordinate of one axis as a float64 vector in SI."""
    points = _read(source, axis, variable).astype(np.float64)
    if points.ndim != 1:
        points = points.squeeze() if points.size > 1 else xr.DataArray(points.values.ravel())
    if points.ndim != 1:
        raise ValueError(
            f"{axis} must be a vector: {variable.name!r} has shape {points.shape} in {source.path}"
        )
    return to_si(points, axis, variable.unit)


def _n_samples(arrays: Mapping[str, xr.DataArray], variables: Mapping[str, Variable]) -> int:
    """Length of time by the arrays: the first one's, along its time or else its first axis."""
    for ours, array in arrays.items():
        dims = variables[ours].dims or ("time",)
        if "time" in dims and array.size > 1:
            shape = array.shape if array.ndim == len(dims) else array.squeeze().shape
            return shape[list(dims).index("time")]
    raise ValueError("a field needs a variable with more than one sample; name one")


def _place(
    array: xr.DataArray,
    ours: str,
    dims: Sequence[str] | None,
    lengths: Mapping[str, int],
    file_dims: Mapping[str, str],
) -> xr.DataArray:
    """Name the dimensions of an array and bring them into the order time, z, r.

    dims: as the user gave them, or None: as the file names them, or by their lengths. Axes of
    length 1, which MATLAB adds and drops, may be missing on either side.
    """
    shape = tuple(n for n in array.shape if n > 1)
    if dims is None and array.dims and all(d in file_dims for d in array.dims):
        dims = [file_dims[str(d)] for d in array.dims]
    if dims is None:
        fitting = [
            option
            for option in permutations([d for d in lengths if lengths[d] > 1], len(shape))
            if tuple(lengths[d] for d in option) == shape
        ]
        dims = fitting[0] if len(fitting) == 1 else ()
    sizes = tuple(lengths.get(d, 0) for d in dims)
    if tuple(n for n in sizes if n != 1) != shape or len(set(dims)) < len(dims):
        raise ValueError(
            f"{ours} must fit the grid: the file has shape {array.shape} and the grid {lengths}, "
            f"dims given: {list(dims) or None}; give data.variables.{ours}.dims in the order of "
            "the file, such as [z,time]"
        )
    if array.shape == sizes:
        named = array.drop_vars(list(array.coords)).rename(dict(zip(array.dims, dims, strict=True)))
    else:
        named = xr.DataArray(array.values.reshape(sizes), dims=list(dims), attrs=array.attrs)
    return named.transpose(*[d for d in DIMS if d in dims])


def write_field(field: xr.Dataset, path: str | Path) -> None:
    """Write a field as NetCDF; the final name appears only when the file is whole."""
    check_field(field)
    if Path(path).suffix != ".nc":
        raise ValueError(f"a field is written as NetCDF, to a name that ends in .nc: {path} came")
    with replacing(Path(path)) as temporary:
        field.drop_encoding().to_netcdf(temporary, engine="h5netcdf")


def read_field(path: str | Path) -> xr.Dataset:
    """Open what `write_field` wrote; values are read when asked for."""
    if reader_of(Path(path)) is not NETCDF:
        raise ValueError(f"a written field is NetCDF: {path} is not; open others with open_field")
    with damage_named(Path(path)):
        field = xr.open_dataset(path, engine="h5netcdf", **UNDECODED)
    check_field(field)
    return field
