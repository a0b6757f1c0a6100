"""Assignment of an array's axes to time, z and r.

The dimension names of the user or of the file decide, or else the lengths of the axes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import permutations
from math import prod
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import xarray as xr

from ep2sindy.data.arrays import ArrayInfo
from ep2sindy.data.conversion import to_si
from ep2sindy.data.fields import DIMS
from ep2sindy.data.mapping import Problems, Variable, read_array
from ep2sindy.data.numbers import even_grid
from ep2sindy.data.readers.source import FileSource

Shaped: TypeAlias = xr.DataArray | ArrayInfo


def read_axis(source: FileSource, axis: str, variable: Variable) -> xr.DataArray:
    """Read the coordinate of one axis as a float64 vector in SI."""
    points = read_array(source, axis, str(variable.name))
    if points.ndim != 1:
        points = points.squeeze() if points.size > 1 else xr.DataArray(points.values.ravel())
    if points.ndim != 1:
        raise ValueError(
            f"{axis} must be a vector: {variable.name!r} has shape {points.shape} in {source.path}"
        )
    points = points.copy(data=even_grid(points.values)) if axis == "time" else points
    return to_si(points.astype(np.float64), axis, variable.unit)


def read_axes(
    source: FileSource,
    axes: Mapping[str, Variable],
    dt_s: float | None,
    arrays: Mapping[str, xr.DataArray],
    variables: Mapping[str, Variable],
    problems: Problems,
) -> dict[str, xr.DataArray]:
    """Read the file's coordinates, in SI; with `dt_s`, times are built from steps' numbers."""
    points = {}
    for axis, variable in axes.items():
        if axis != "time" or dt_s is None:
            with problems.noted():
                points[axis] = read_axis(source, axis, variable)
    if dt_s is None and "time" not in axes:
        problems.found.append(
            f"a field needs time: name the file's time or give its step dt_s; {source.path} holds "
            f"{list(source.names)}"
        )
    if dt_s is not None and not problems.found:
        dims = {ours: variable.dims for ours, variable in variables.items()}
        with problems.noted():
            n_samples, dim = time_length(arrays, points, dims, named=source.dims_named)
            numbers = source.steps if len(source.steps) == n_samples else range(n_samples)
            steps = xr.DataArray(dt_s * np.array(numbers), dims=dim, attrs={"units": "s"})
            return {"time": steps, **points}
    return points


def time_length(
    arrays: Mapping[str, Shaped],
    points: Mapping[str, Shaped],
    dims: Mapping[str, Sequence[str] | None] = MappingProxyType({}),
    *,
    named: bool,
) -> tuple[int, str]:
    """Number of samples and the file's name of the time dimension, for a file without times.

    points: coordinates. dims: the user's, which decide first. named: the arrays have the file's
    names of dimensions; time is then that which belongs to no coordinate. Otherwise it is the
    length that remains in most arrays once those of z and r are removed.
    """
    votes: Counter[tuple[int, str]] = Counter()
    known = {dim for each in points.values() for dim in each.dims}
    space = [prod(each.shape) for axis, each in points.items() if axis != "time"]
    for ours, array in arrays.items():
        longer = tuple(n for n in array.shape if n > 1)
        given = dims.get(ours)
        if given is not None:
            if "time" in given and longer:
                shape = array.shape if len(array.shape) == len(given) else longer
                return shape[list(given).index("time")], "time"
        elif named:
            sizes = zip(array.shape, array.dims, strict=True)
            votes.update((n, str(dim)) for n, dim in sizes if dim not in known)
        else:
            votes.update((n, "time") for n in _may_be_time(longer, space))
    if not votes:
        shapes = {ours: array.shape for ours, array in arrays.items()}
        raise ValueError(
            f"the samples must be countable: no axis of {shapes} is left for time beside z and r "
            f"of {space} points; name the coordinates, or give data.variables.NAME.dims"
        )
    (best, n_best), *others = votes.most_common()
    if others and others[0][1] == n_best:
        raise ValueError(
            f"the samples must be countable: time may have {best[0]} or {others[0][0][0]} of them; "
            "give data.variables.NAME.dims in the order of the file, such as [r,z,time]"
        )
    return best


def _may_be_time(shape: Sequence[int], space: Sequence[int]) -> set[int]:
    """Lengths over one that could be time: all other axes of the array are axes of space."""
    left = Counter(shape) - Counter(space)
    return {*(left or shape)} if left.total() < 2 else set()


def assign_dims(
    array: xr.DataArray,
    ours: str,
    dims: Sequence[str] | None,
    lengths: Mapping[str, int],
    file_dims: Mapping[str, str],
) -> xr.DataArray:
    """Name the dimensions of an array and bring them into the order time, z, r.

    dims: dimensions in the file's order, as the user gave them. None: the file's names decide, or
    else the lengths. Axes of length 1, which MATLAB adds and drops, may be missing on either side.
    """
    shape = tuple(n for n in array.shape if n > 1)
    if dims is None and array.dims and all(d in file_dims for d in array.dims):
        dims = [file_dims[str(d)] for d in array.dims]
    if dims is None:
        options = fitting(shape, lengths)
        dims = options[0] if len(options) == 1 else ()
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


def fitting(shape: Sequence[int], lengths: Mapping[str, int]) -> list[tuple[str, ...]]:
    """All orders of the dimensions whose lengths give this shape."""
    longer = tuple(n for n in shape if n > 1)
    return [
        option
        for option in permutations([d for d in lengths if lengths[d] > 1], len(longer))
        if tuple(lengths[d] for d in option) == longer
    ]
