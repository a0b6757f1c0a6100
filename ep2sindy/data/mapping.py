"""The arrays of a file: where our quantities lie in it, how they are read, and their axes.

A summary of an array says its shape, unit, range, missing values and spacing. Its axes are time, z
and r by the names of dimensions of the user or of the file, or else by their lengths.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import permutations
from math import prod
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
import xarray as xr

from ep2sindy.data.blocks import blocks_of
from ep2sindy.data.fields import DIMS
from ep2sindy.data.numbers import digits_of_rounded, even_grid, without_marks
from ep2sindy.data.quantities import counted_in, to_si
from ep2sindy.data.readers.source import FileSource, damage_named
from ep2sindy.data.readers.table_layout import unit_in_brackets
from ep2sindy.library.names import check_variable
from ep2sindy.runtime.screen import near_words
from ep2sindy.trust.memory import check_memory

N_MARKS = "n_marks"  # attribute of an array: number of samples that were marks of overload

N_LISTED = 100  # largest number of names listed in an error

# `probe[:, 1]`: part of an array, counted from 0.
PART = re.compile(r"(.+?)\s*\[([\d:,\s-]+)\]")


@dataclass(frozen=True)
class Variable:
    """Location and unit of one quantity in a file.

    Parameters
    ----------
    name : str or None
        Name in the file. It may be a path in HDF5 ("group/n_i"), a struct field in MATLAB
        ("data.n_i"), the number of a column in a table ("2"), or part of an array ("probe[:, 1]");
        both count from 0. None means that the file does not hold the quantity.
    unit : str
        Unit of the numbers in the file: "cm^-3", "km/s", "degC"; with a factor, "1e19 m^-3".
    dims : sequence of str, optional
        Dimensions in the file's order, such as ("r", "z", "time"). None takes the names in the
        file, or else the only order that fits the lengths.
    """

    name: str | None
    unit: str
    dims: Sequence[str] | None = None


Keys = Mapping[str, Any]


@dataclass(frozen=True)
class Problems:
    """Errors found in a mapping, collected so that one message names them all."""

    found: list[str] = field(default_factory=list)

    @contextmanager
    def noted(self) -> Iterator[None]:
        try:
            yield
        except ValueError as error:
            self.found.append(str(error))

    def check(self, source: FileSource) -> None:
        """Raise ValueError if there are errors; if a name is missing, list the file's arrays."""
        if not self.found:
            return
        one, held = len(self.found) == 1, ""
        if any(" no variable " in each for each in self.found):
            held = f"{'; it' if one else '. It'} holds {list_arrays(source)}; set the name, or null"
            held += " if the file has it not"
        if one:
            raise ValueError(f"the mapping must be put right: {self.found[0]}{held}")
        lines = "".join(f"\n  - {each}" for each in self.found)
        raise ValueError(
            f"{len(self.found)} things must be put right for {source.path}:{lines}{held}"
        )


def in_file(
    variables: Mapping[str, Variable | Keys | None], problems: Problems
) -> dict[str, Variable]:
    """Select the variables that the file holds; keys from a config become a `Variable`."""
    found = {}
    for ours, value in variables.items():
        with problems.noted():
            check_variable(ours)
        if isinstance(value, Mapping):
            if not {"name", "unit"} <= set(value) <= {"name", "unit", "dims"}:
                problems.found.append(
                    f"{ours} needs a name, a unit, perhaps dims, got {dict(value)}"
                )
                continue
            value = Variable(value["name"], str(value["unit"]), value.get("dims"))
        if value is not None and value.name is not None:
            found[ours] = replace(value, name=str(value.name))
    return found


def read_array(source: FileSource, ours: str, name: str) -> xr.DataArray:
    """Read one array of the file, or part of one, as real numbers in the file's unit and shape."""
    whole, part = _split_selection(source, name)
    if whole is None:
        near = near_words(name, source.names, form="{!r}")
        raise ValueError(f"{source.path} has no variable {name!r} (wanted as {ours}){near}")
    with damage_named(source.path):
        array = source.read(whole)
        n_bytes = 8.0 * array.size if array.ndim < 2 else 0.0  # others are read in parts
        check_memory(n_bytes, repr(name), hint="copy the part that you need into a file")
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name!r} in {source.path} must be real numbers, not {array.dtype}")
    try:
        array = array[part] if part else array
    except IndexError as error:
        raise ValueError(
            f"{name!r} (wanted as {ours}) must lie inside its array: {whole!r} has shape "
            f"{array.shape}, counted from 0"
        ) from error
    array = array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)
    if not source.is_table:
        return array
    values = without_marks(array.values)
    n_marks = int(np.isnan(values).sum() - np.isnan(array.values).sum())
    return array.copy(data=values).assign_attrs({N_MARKS: n_marks} if n_marks else {})


def _split_selection(source: FileSource, name: str) -> tuple[str | None, tuple[int | slice, ...]]:
    """Split a name into an array of the file and an index; the array is None if there is none."""
    if name in source.known:
        return name, ()
    found = PART.fullmatch(name)
    if found is None or found[1] not in source.known:
        return None, ()
    parts = [part.strip() for part in found[2].split(",")]
    if not all(re.fullmatch(r":|-?\d+", part) for part in parts):
        raise ValueError(f"part of an array is written like [:, 1], got {name!r}")
    return found[1], tuple(slice(None) if part == ":" else int(part) for part in parts)


def list_arrays(source: FileSource) -> str:
    """List the file's arrays with shapes and units: `ni (6, 4, 3) cm^-3, t (6)`."""
    texts = []
    for name in source.names[:N_LISTED]:
        try:
            array = source.read(name)
        except Exception:  # raised by a library for a damaged array; list its name all the same
            texts.append(name)
            continue
        shape = f"({', '.join(map(str, array.shape))})"
        texts.append(f"{name} {shape} {array.attrs.get('units', '')}".rstrip())
    n_more = len(source.names) - len(texts)
    texts += [f"and {n_more} more"] if n_more else []
    return ", ".join(texts) or "nothing"


# Summary of an array.


MIN_GAP = 3.0  # steps; a shorter one may be a delayed sample

TEXT = "text or objects"  # problem of arrays that are not numbers


@dataclass(frozen=True)
class ArrayInfo:
    """Summary of one array in a file: shape, unit, range, missing values, spacing.

    unit: "" if the file states none. low, high: range of the finite values. n_missing: number of
    NaN or infinite values. n_marks: of these, marks of overload or absence. step: median step of an
    increasing vector, else None. even: True if the steps are equal. digits: to how many the times
    of equal steps were rounded, so that some repeat, else None. gap: where steps that are otherwise
    even leave out samples, in words. falls: where and how often a vector does not increase, in
    words. problem: reason why the array cannot be used, or "".
    """

    name: str
    shape: tuple[int, ...] = ()
    unit: str = ""
    dims: tuple[str, ...] = ()
    low: float = np.nan
    high: float = np.nan
    n_missing: int = 0
    n_marks: int = 0
    step: float | None = None
    even: bool = False
    digits: int | None = None
    gap: str = ""
    falls: str = ""
    problem: str = ""

    @property
    def lengths(self) -> tuple[int, ...]:
        """Lengths of the axes that have more than one point."""
        return tuple(n for n in self.shape if n > 1)

    @property
    def is_counter(self) -> bool:
        """True for a vector without a unit that may number the samples, from 0, 1 or 22."""
        return self.even and self.step == 1.0 and self.low % 1.0 == 0.0 and self.unit in ("", "1")


def describe_array(source: FileSource, name: str) -> ArrayInfo:
    """Read one array, block by block, and summarise it."""
    try:
        array = read_array(source, name, name)
        with damage_named(source.path):
            low, high, n_missing = _range(array)
    except ValueError as error:  # its reason, without the file's name
        reason = str(error).removeprefix(f"{source.path} cannot be read: ")
        return ArrayInfo(name, problem=TEXT if "real numbers" in reason else reason)
    attribute = str(array.attrs.get("units", ""))
    unit = counted_in(attribute) if attribute else unit_in_brackets(name)
    dims = tuple(map(str, array.dims)) if source.dims_named else ()
    is_vector = array.size in array.shape
    points = np.asarray(array.values, dtype=np.float64).ravel() if is_vector else np.empty(0)
    digits = digits_of_rounded(points)
    steps = np.diff(points if digits is None else even_grid(points))
    falls = _fall(points, steps)
    steps = steps if steps.size > 1 and not falls else np.empty(0)
    return ArrayInfo(
        name, array.shape, unit, dims, low, high, n_missing,
        int(array.attrs.get(N_MARKS, 0)),
        float(np.median(steps)) if steps.size else None,
        bool(steps.size and np.ptp(steps) <= 1e-3 * steps.mean()),
        digits,
        _gap(steps),
        falls,
    )  # fmt: skip


def _range(array: xr.DataArray) -> tuple[float, float, int]:
    """Least and largest finite value, NaN without any, and the number of the other values."""
    lows, highs, n_missing = [np.inf], [-np.inf], 0
    for where in blocks_of(array):
        values = array.isel(where).values
        ends = values.min(initial=np.inf), values.max(initial=-np.inf)
        if not np.isfinite(ends).all():  # seldom: a NaN makes both ends NaN
            finite = values[np.isfinite(values)]
            n_missing += values.size - finite.size
            ends = finite.min(initial=np.inf), finite.max(initial=-np.inf)
        lows.append(float(ends[0]))
        highs.append(float(ends[1]))
    low, high = min(lows), max(highs)
    return (low, high, n_missing) if low <= high else (np.nan, np.nan, n_missing)


def _fall(points: np.ndarray, steps: np.ndarray) -> str:
    """Where points first do not increase, and how often, in words; empty if they do."""
    falls = np.flatnonzero(~(steps > 0.0))
    if not falls.size:
        return ""
    k, n_repeats = int(falls[0]), int((steps == 0.0).sum())
    first = f"{points[k + 1]:.9g} follows {points[k]:.9g} at row {k + 2}"
    return f"{first}; {n_repeats} repeat the one before, {falls.size - n_repeats} run back"


def _gap(steps: np.ndarray) -> str:
    """The longest gap in steps of which nine in ten are alike, in words; empty if there is none."""
    if not steps.size:
        return ""
    usual, k = float(np.median(steps)), int(steps.argmax())
    are_alike = np.mean(np.abs(steps - usual) <= 0.1 * usual) >= 0.9
    if not are_alike or steps[k] < MIN_GAP * usual:
        return ""
    return f"{steps[k]:.4g} pass after row {k + 1}, where steps are {usual:.4g}"


# Assignment of axes to time, z and r.


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
            f"the samples must be countable: no axis of {shapes} is left for time next to z and r "
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
    if array.shape != sizes and array.squeeze().shape == sizes:
        array = array.squeeze()
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
