"""Fields on a (time, z, r) grid as xarray datasets: checks, grid values, masks, NetCDF output.

A field has the dimension `time` and may have `z` and `r`, each with a coordinate in s or m.
Its variables may use fewer dimensions than the field: T_e_eV(time, z), I_d(time), B(z).
Values are SI unless the name carries a suffix (`T_e_eV`); the attribute `units` names the unit.
A cell outside the plasma is NaN at all times. A value that is missing only at some times is
refused, since an average over a changing set of cells is not an observable.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from ep2sindy.data.blocks import read_whole
from ep2sindy.data.quantities import COORDINATE_UNITS
from ep2sindy.data.trajectory import CLOCK, check_increasing, check_time
from ep2sindy.library.names import check_variable
from ep2sindy.library.units import Clock
from ep2sindy.runtime.files import read_json, write_bytes

DIMS = ("time", "z", "r")

SPACE = ("z", "r")


def check_field(field: xr.Dataset) -> None:
    """Raise ValueError unless `field` has a field's dimensions, coordinates, names, types, units.

    The variables' values are not read, so a lazy field stays on disk.
    """
    unknown = set(map(str, field.dims)) - set(DIMS)
    if unknown or "time" not in field.dims:
        raise ValueError(
            f"a field has the dimension time and may have z and r, got {list(field.dims)}; "
            "rename or reduce the others"
        )
    for axis in field.dims:
        if axis not in field.coords:
            raise ValueError(f"the dimension {axis!r} needs a coordinate of that name")
    check_time(np.asarray(field["time"].values, dtype=np.float64))
    for axis in SPACE:
        if axis in field.dims:
            check_increasing(axis, grid_points(field, axis), COORDINATE_UNITS[axis])
    for name, variable in field.data_vars.items():
        check_variable(str(name))
        if variable.dtype.kind not in "fiu":  # integers are accepted and read as real numbers
            raise ValueError(f"{name} must hold real numbers: its type is {variable.dtype}")
        if "units" not in variable.attrs:
            raise ValueError(f"{name} must name its unit in the attribute 'units' ('1' for none)")


def check_new(field: xr.Dataset, name: str) -> None:
    """Raise ValueError unless a variable of this name can be added to a field."""
    check_variable(name)
    if name in field:
        raise ValueError(f"a new variable needs a new name: the field already has {name!r}")


def clock_of(field: xr.Dataset) -> Clock:
    """Unit in which the field's times are displayed: the one that its file uses."""
    return Clock.of(str(field["time"].attrs.get(CLOCK, "s")))


def channel_length_m(attributes: Mapping[str, Any]) -> float | None:
    """Channel length in m from a field's attributes, or None.

    A field has one if it was opened with `channel_m` or comes from one of our simulations.
    """
    if "channel_m" in attributes:
        return float(attributes["channel_m"])
    try:
        return float(read_json(attributes["parameters"])["thruster"]["channel_length"])
    except (KeyError, TypeError, ValueError, RecursionError):
        return None


def grid_points(field: xr.Dataset, axis: str) -> Float[np.ndarray, " points"]:
    """Coordinate of one axis as float64, in s or m. Raises ValueError for what is no field."""
    if not isinstance(field, xr.Dataset):
        raise ValueError(
            "a field must be an xarray.Dataset, as ep.open_field returns it, got "
            f"{type(field).__name__}; prepare the field before trajectories are taken from it"
        )
    return np.asarray(field[axis].values, dtype=np.float64)


def grid_values(array: xr.DataArray) -> Float[np.ndarray, "time z r"]:
    """Load a variable as (time, z, r) in float64; a dimension it lacks has length 1.

    The array may be the variable's own: copy it before writing into it.
    Raises ValueError if it would take more memory than is free.
    """
    shape = tuple(array.sizes.get(axis, 1) for axis in DIMS)
    ordered = array.transpose(*(axis for axis in DIMS if axis in array.dims))
    return read_whole(ordered).reshape(shape).astype(np.float64, copy=False)


def mask_cells(array: xr.DataArray) -> Bool[np.ndarray, "1 z r"]:
    """Cells without plasma: NaN in the first sample (`check_samples` checks the other samples)."""
    return np.isnan(grid_values(array.isel(time=[0], missing_dims="ignore")))


def check_samples(
    array: xr.DataArray, values: Float[np.ndarray, "time z r"], masked: Bool[np.ndarray, "1 z r"]
) -> None:
    """Raise ValueError unless each cell is finite at all times, or masked at all times.

    values: `array` as `grid_values` returns it.
    The error names the variable, the time and the place.
    """
    bad = np.argwhere(np.isfinite(values) == masked)
    if bad.size:
        value = values[tuple(bad[0])]
        place = ", ".join(
            f"{axis} = {array[axis].values[k]:.6g} {COORDINATE_UNITS[axis]}"
            for axis, k in zip(DIMS, bad[0], strict=True)
            if axis in array.dims
        )
        raise ValueError(
            f"samples must be finite, or NaN at all times where there is no plasma: {array.name} = "
            f"{value:.6g}{' after NaN' if np.isfinite(value) else ''} at {place} ({len(bad)} such "
            "values); crop, mask or interpolate them first"
        )


def mask_outside(field: xr.Dataset, inside: xr.DataArray) -> xr.Dataset:
    """Set NaN where `inside` is false, in every variable that has all of its dimensions."""
    masked = {
        name: variable.where(inside)
        for name, variable in field.data_vars.items()
        if set(inside.dims) <= set(variable.dims)
    }
    if not masked:
        raise ValueError(f"no variable of the field has all dimensions of the mask, {inside.dims}")
    return field.assign(masked)


def cell_edges(points: Float[np.ndarray, " points"]) -> Float[np.ndarray, " edges"]:
    """Edges of the cells around grid points: midpoints inside, end cells symmetric."""
    middle = (points[1:] + points[:-1]) / 2
    return np.concatenate([[2 * points[0] - middle[0]], middle, [2 * points[-1] - middle[-1]]])


def cell_sizes(field: xr.Dataset, axis: str, *, axisymmetric: bool) -> Float[np.ndarray, " points"]:
    """Size of each cell along z or r; in r, if axisymmetric, its annulus area over 2 pi."""
    points = grid_points(field, axis)
    if axis == "r" and axisymmetric and points[0] < 0:
        raise ValueError(
            f"r must not be negative in an axisymmetric field: it begins at {points[0]:.6g} m; "
            "pass axisymmetric=False for a planar one"
        )
    if len(points) == 1:
        return np.ones(1)
    edges = cell_edges(points)
    if axis == "r" and axisymmetric:
        return np.diff(np.maximum(edges, 0.0) ** 2) / 2
    return np.diff(edges)


# NetCDF output by way of memory, because HDF5 must never write to a full disk itself.


def write_netcdf(
    dataset: xr.Dataset, path: Path, *, encoding: Mapping[str, Mapping[str, Any]] | None = None
) -> None:
    """Write a NetCDF file to `path`, completely or not at all.

    The file is built in memory, which must be large enough. If HDF5 itself runs out of disk space,
    it ends the whole program on closing the file.
    Raises OSError, naming the file, if it cannot be written.
    """
    content = dataset.to_netcdf(None, engine="h5netcdf", encoding=encoding)
    write_bytes(path, content)
