"""Open files of many kinds as fields, and write fields as NetCDF.

One mapping gives the name, unit and dimension order of each quantity in the file. Values are
converted to SI when a file is opened and nowhere else.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from math import isclose
from pathlib import Path

import xarray as xr

from ep2sindy.data.blocks import UNDECODED
from ep2sindy.data.fields import DIMS, check_field, mask_outside, write_netcdf
from ep2sindy.data.gaps import usual_step
from ep2sindy.data.inspection import Inspection
from ep2sindy.data.mapping import (
    Keys,
    Problems,
    Variable,
    assign_dims,
    describe_array,
    in_file,
    read_array,
    read_axes,
)
from ep2sindy.data.quantities import STEP_DOUBT, DoubtfulUnit, conversion, to_si
from ep2sindy.data.readers.arrays import NETCDF
from ep2sindy.data.readers.registry import reader_of
from ep2sindy.data.readers.source import FileSource, damage_named, file_named
from ep2sindy.data.recognition import recognise
from ep2sindy.data.steps import open_record
from ep2sindy.data.trajectory import CLOCK


def open_field(
    path: str | Path | Sequence[str | Path],
    *,
    variables: Mapping[str, Variable | Keys] | None = None,
    time: Variable | Keys | None = None,
    z: Variable | Keys | None = None,
    r: Variable | Keys | None = None,
    dt_s: float | None = None,
    mask: Variable | Keys | None = None,
    channel_m: float | None = None,
    units: Mapping[str, str] | None = None,
    plasma: bool = False,
    at: Mapping[str, float] | None = None,
    chunks: Mapping[str, int] | None = None,
) -> xr.Dataset:
    """Open a file as a field with the package's names, dimensions and units.

    The file may be of any kind listed in docs/data.md. Large variables of NetCDF, Zarr, HDF5 and
    MATLAB 7.3 files are read when they are used, and a zone is averaged over parts of them; with a
    mask they are read at once unless dask is installed. Other kinds of files are read at once.

    Parameters
    ----------
    path : str, Path or sequence of these
        The file. If a code writes one file per step, a pattern such as `dump_*.h5`, or a list of
        files. Steps are joined along time, also if one file holds them as groups.
    variables : mapping of str to Variable or keys, optional
        The package's name of each variable and its location in the file, as a `Variable` or as the
        same keys from a config. Those with name None are left out. None takes all variables that
        `inspect_file` recognises without doubt.
    time, z, r : Variable or keys, optional
        The coordinates. None, or a `Variable` with name None, means that the file has none.
    dt_s : float, optional
        Time step in s, used in place of `time`. For a run in numbered steps it is the time of one
        step.
    mask : Variable or keys, optional
        Array that is nonzero where there is plasma. Values elsewhere become NaN.
    channel_m : float, optional
        Length of the channel from z = 0, in m, stored as an attribute. None keeps the file's own.
    units : mapping of str to str, optional
        Unit by name where the file states none. Only without `variables`.
    plasma : bool, default False
        True if names such as Te mean a plasma's quantities even without a unit, and numbers without
        a unit are in SI. Only without `variables`.
    at : mapping of str to float, optional
        Value of each axis of the file besides time, z and r, such as {"V": 300.0}.
    chunks : mapping of str to int, optional
        Length by dimension, to stream data that exceed memory (needs dask).

    Returns
    -------
    Dataset
        The field over those of time, z and r that the file has, in SI.

    Raises
    ------
    ValueError
        If names are not in the file (one error lists all of them), shapes do not fit their
        dimensions, units cannot be converted, or the file is missing, damaged or of another kind.

    Warns
    -----
    DoubtfulUnit
        If `dt_s` contradicts the times in the file.

    Examples
    --------
    >>> field = ep.open_field("run.nc")  # its names, units and shapes leave no doubt
    >>> field["n_i"].attrs["units"]
    'm^-3'
    """
    source, problems = open_record(path).at(at or {}), Problems()
    axes: Mapping[str, Variable] = in_file({"time": time, "z": z, "r": r}, problems)
    times: Sequence[Variable] = [axes["time"]] if "time" in axes else []
    if variables is None:
        problems.check(source)
        found = recognise(source, dt_s=dt_s, given=axes, units=units, plasma=plasma).checked()
        variables, axes, dt_s, times = found.variables, found.axes, found.dt_s, found.replaced
    with file_named(source.path):
        field = _field(source, variables, axes, dt_s, mask, chunks, problems)
    if doubt := _step_doubt(source, times, field, dt_s):
        warnings.warn(doubt, DoubtfulUnit, stacklevel=2)
    attrs = {
        "channel_m": channel_m,
        "file": str(source.path),
        STEP_DOUBT: doubt,
    }
    return field.assign_attrs({name: value for name, value in attrs.items() if value})


def inspect_file(path: str | Path | Sequence[str | Path], *, plasma: bool = False) -> Inspection:
    """List the arrays of a file and recognise quantities by names, units and shapes.

    Every array is read once. The result prints as a table, followed by notes on what you must state
    and on missing information. `ep.open_field(path, variables=found.variables, time=found.time,
    z=found.z, r=found.r, dt_s=found.dt_s)` opens the recognised field.

    Parameters
    ----------
    path : str, Path or sequence of these
        The file, or a pattern or a list of the files of the steps of one run.
    plasma : bool, default False
        True if names such as Te mean a plasma's quantities even without a unit, and numbers without
        a unit are in SI.

    Returns
    -------
    Inspection
        The arrays, the recognised variables and coordinates, and the open questions.

    Raises
    ------
    ValueError
        If the file is missing, empty, damaged or of an unknown kind.

    Examples
    --------
    >>> found = ep.inspect_file("run.nc")
    >>> found.variables["n_i"].unit
    'm^-3'
    """
    return recognise(open_record(path), plasma=plasma)


def _step_doubt(
    source: FileSource, times: Sequence[Variable], field: xr.Dataset, dt_s: float | None
) -> str:
    """How a step contradicts the file's own times, whichever of these they are; "" if not at all.

    The mean step counts as well as the median: times may be rounded, or have gaps.
    """
    if dt_s is None or not times:
        return ""
    one, taken_s = describe_array(source, str(times[0].name)), usual_step(field["time"].values)
    if one.step is None or one.is_counter:
        return ""
    mean = (one.high - one.low) / (max(one.shape) - 1)
    factors = [conversion("time", each.unit)[0] for each in times]
    if any(isclose(f * s, taken_s, rel_tol=0.01) for f in factors for s in (one.step, mean)):
        return ""
    return (
        f"dt_s={dt_s:.6g} is taken, in s, and contradicts the file's own times {one.name!r}, which "
        f"go in steps of {factors[0] * one.step:.6g} s: leave dt_s out to take these; if dt_s is "
        "right, give a mapping with time.name=null, such as `ep2sindy inspect FILE --write` makes"
    )


def _field(
    source: FileSource,
    variables: Mapping[str, Variable | Keys],
    axes: Mapping[str, Variable],
    dt_s: float | None,
    mask: Variable | Keys | None,
    chunks: Mapping[str, int] | None,
    problems: Problems,
) -> xr.Dataset:
    """Build the field that a mapping describes; one error reports all faults of the mapping."""
    if chunks is not None and find_spec("dask") is None:
        raise ValueError("data.chunks needs dask: pip install 'ep2sindy[files]'")
    arrays: dict[str, xr.DataArray] = {}
    wanted = in_file(variables, problems)
    if not wanted and not problems.found:
        raise ValueError(f"a field needs a variable: none of {list(variables)} has a name")
    for ours, variable in wanted.items():
        with problems.noted():
            arrays[ours] = read_array(source, ours, str(variable.name))
        with problems.noted():
            attrs = arrays[ours].attrs if ours in arrays else {}
            to_si(xr.DataArray(0.0, attrs=attrs), ours, variable.unit, is_variable=True)
    points = read_axes(source, axes, dt_s, arrays, wanted, problems)
    if dt_s is None and "time" in points:
        points["time"].attrs[CLOCK] = axes["time"].unit
    file_dims = {str(p.dims[0]): axis for axis, p in points.items()} if source.dims_named else {}
    lengths = {axis: points[axis].size for axis in DIMS if axis in points}
    placed = {}
    for ours, array in arrays.items() if set(points) == {*axes, "time"} else ():
        with problems.noted():
            placed[ours] = assign_dims(array, ours, wanted[ours].dims, lengths, file_dims)
    problems.check(source)
    field = xr.Dataset(coords={axis: (axis, p.values, p.attrs) for axis, p in points.items()})
    for ours, array in placed.items():
        if chunks is not None:
            array = array.chunk({d: n for d, n in chunks.items() if d in array.dims})
        field[ours] = to_si(array, ours, wanted[ours].unit, is_variable=True)
    for ours, variable in in_file({"mask": mask}, problems).items():
        with problems.noted():
            array = read_array(source, ours, str(variable.name))
            inside = assign_dims(array, ours, variable.dims, lengths, file_dims)
            field = mask_outside(field, inside != 0)
    problems.check(source)
    check_field(field)
    return field.assign_attrs(source.attributes)


def write_field(field: xr.Dataset, path: str | Path) -> None:
    """Write a field as NetCDF; the file appears under its name only once it is complete.

    The file is built in memory, which must be large enough.

    Parameters
    ----------
    field : Dataset
        Field over time and z, r or both.
    path : str or Path
        The file to write.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    check_field(field)
    if Path(path).suffix != ".nc":
        raise ValueError(f"a field is written as NetCDF, to a name that ends in .nc, got {path}")
    write_netcdf(field.drop_encoding(), Path(path))


def read_field(path: str | Path) -> xr.Dataset:
    """Open a field that `write_field` wrote.

    Parameters
    ----------
    path : str or Path
        The NetCDF file.

    Returns
    -------
    Dataset
        The field. Its values are read when they are used.
    """
    if reader_of(Path(path)) is not NETCDF:
        raise ValueError(f"a written field is NetCDF: {path} is not; open others with open_field")
    with damage_named(Path(path)):
        field = xr.open_dataset(path, engine="h5netcdf", **UNDECODED)
    check_field(field)
    return field
