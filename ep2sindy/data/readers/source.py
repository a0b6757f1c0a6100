"""`FileSource`, the common result of all readers, and helpers that readers share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.data.blocks import AT_ONCE, UNDECODED
from ep2sindy.data.numbers import count_dates
from ep2sindy.library.units import seconds_in
from ep2sindy.runtime.screen import words_of

PACKED_BY = ("scale_factor", "add_offset")

Form: TypeAlias = Literal["folder", "hdf5", "zip", "other"]


@dataclass(frozen=True)
class FileSource:
    """An open file: the names of its arrays, and a function that reads one of them.

    names: names of all arrays. read: reads the array of a name, whose attribute `units` is its
    unit. dims_named: True if the arrays' dimension names come from the file. aliases: further names
    that can be read, such as a column's number. step_s: time step in s, if the file gives it
    outside its arrays. words: notes on how the file was read, shown on inspection. is_table: True
    if the arrays are columns of a table. attributes: texts and numbers that describe the whole
    file, such as `channel_m`, see `channel_length_m`. steps: numbers of the steps of a run that was
    written step by step. kind: kind of file.
    """

    path: Path
    names: Sequence[str]
    read: Callable[[str], xr.DataArray]
    dims_named: bool = False
    aliases: Sequence[str] = ()
    step_s: float | None = None
    words: str = ""
    is_table: bool = False
    attributes: Mapping[str, str | float] = field(default_factory=dict)
    steps: Sequence[int] = ()
    kind: str = ""

    def __post_init__(self) -> None:
        if len(set(self.names)) < len(self.names):
            ((name, n),) = Counter(self.names).most_common(1)
            raise ValueError(
                f"arrays of a file must have names of their own: {name!r} comes {n} times; rename "
                "all but one"
            )

    @cached_property
    def known(self) -> frozenset[str]:
        """All names that can be read, aliases included."""
        return frozenset([*self.names, *self.aliases])

    def axis(self, name: str) -> xr.DataArray:
        """The coordinate of an axis. Raises ValueError for a name that is no vector."""
        vectors = [each for each in self.names if self.read(each).ndim == 1]
        if name not in vectors:
            raise ValueError(f"an axis of {self.path} must be one of {vectors}, got {name!r}")
        return self.read(name)

    def at(self, point: Mapping[str, float]) -> FileSource:
        """The same file at one value of each of some axes, by their names.

        If the file does not name the dimensions of its arrays, an axis is found by its length.
        Raises ValueError for a value that the axis has not.
        """
        source = self
        for axis, value in point.items():
            points = self.axis(axis)
            if value not in points.values:
                raise ValueError(f"{axis} must be one of {points.values.tolist()}, got {value!r}")
            place = int(np.flatnonzero(points.values == value)[0])
            source = replace(source, read=partial(source._read_at, points, place))
        return source

    def _read_at(self, points: xr.DataArray, place: int, name: str) -> xr.DataArray:
        array = self.read(name)
        alike = [dim for dim, n in array.sizes.items() if array.ndim > 1 and n == points.size]
        own = [dim for dim in array.dims if dim in points.dims] if self.dims_named else alike
        if len(own) > 1:
            sizes = f"{name!r} has shape {array.shape} and dimensions without names"
            raise ValueError(f"an axis of points must differ in length from others: {sizes}")
        return array.isel(dict.fromkeys(own, place))


@dataclass(frozen=True)
class Reader:
    """One kind of file: how it is recognised, and how it is opened.

    first_bytes: beginnings that no other kind of file has. form, endings: files without such a
    beginning are recognised by their form, together with one of the endings if there are any.
    package: the module of the extra `files` that it needs.
    """

    name: str
    open: Callable[[Path], FileSource]
    first_bytes: tuple[bytes, ...] = ()
    form: Form | None = None
    endings: tuple[str, ...] = ()
    package: str = ""

    def takes(self, form: Form, head: bytes, ending: str) -> bool:
        """True for a file with such a beginning, or of the form and with one of the endings."""
        fits = form == self.form and (not self.endings or ending in self.endings)
        return head.startswith(self.first_bytes) or fits


def look_at(path: Path) -> tuple[Form, bytes, str]:
    """What identifies a file's kind: its form, its first bytes (none of a folder), its ending.

    Raises OSError if it cannot be read.
    """
    import h5py

    ending = path.suffix.lower()
    if path.is_dir():
        return "folder", b"", ending
    with path.open("rb") as file:
        head = file.read(16)
    if head.startswith(b"PK"):
        return "zip", head, ending
    if not h5py.is_hdf5(path):
        return "other", head, ending
    with damage_named(path):
        check_inside(path)
    return "hdf5", head, ending


def check_inside(path: Path, above: frozenset[Path] = frozenset()) -> None:
    """Raise ValueError if an HDF5 file, or one it leads to, leads to what is no file.

    That may be a pipe, for which the library would wait without end. above: files that led here.
    """
    import h5py

    targets: set[str] = set()
    with h5py.File(path) as file:

        def look(name: str, link: object) -> None:
            if isinstance(link, h5py.ExternalLink):
                targets.add(link.filename)
            item = file[name] if isinstance(link, h5py.HardLink) else None
            if isinstance(item, h5py.Dataset):
                targets.update(name for name, *_ in item.external or ())
                targets.update(
                    s.file_name for s in (item.virtual_sources() if item.is_virtual else ())
                )

        file.visititems_links(look)
    beside = (folder / name for name in targets - {"."} for folder in (path.parent, Path()))
    for place in (each for each in beside if each.exists() and each not in {path, *above}):
        if not place.is_file():
            raise ValueError(f"values must lie in files: it leads to {place}; copy them into it")
        if h5py.is_hdf5(place):
            check_inside(place, above | {path})


def plain(value: Any) -> Any:
    """A number of NumPy, or an array of one element, as a plain value; others as they are."""
    return value.item() if isinstance(value, np.ndarray | np.generic) and value.size == 1 else value


@contextmanager
def damage_named(path: Path) -> Iterator[None]:
    """Turn any error of a parsing library into a ValueError of one line that names the file."""
    try:
        yield
    except Exception as error:  # a library may raise anything for a damaged file
        raise ValueError(f"{path} cannot be read: {words_of(error)}") from error


@contextmanager
def file_named(path: Path) -> Iterator[None]:
    """Add the file's name to any ValueError raised within, unless it is already there."""
    try:
        yield
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {error}") from error


def check_packing(name: str, attributes: Mapping[str, Any]) -> None:
    """Raise ValueError for a packing scale or offset that is not finite, or a scale of zero."""
    for key in PACKED_BY:
        value = np.asarray(attributes.get(key, 1.0))
        is_number = value.size == 1 and value.dtype.kind in "iuf" and np.isfinite(value).all()
        if not is_number or (key == "scale_factor" and not value.all()):
            raise ValueError(
                f"{key} of {name!r} must be a finite number, and no zero scale, got "
                f"{value.tolist()!r:.80}; put the attribute right, or take it away to read "
                "the numbers as they are stored"
            )


def dataset_source(path: Path, dataset: xr.Dataset) -> FileSource:
    """Source of the variables in a dataset as stored; packed numbers are unpacked here."""
    stored = {str(name): dict(variable.attrs) for name, variable in dataset.variables.items()}
    for variable in dataset.variables.values():
        for key in {*PACKED_BY} & {*variable.attrs}:
            packed_by = np.asarray(variable.attrs.pop(key))
            if packed_by.size == 1 and packed_by.dtype.kind in "iuf":
                variable.attrs[key] = packed_by.reshape(())[()]
    dataset = xr.decode_cf(dataset, decode_coords=False, **UNDECODED)

    def read(name: str) -> xr.DataArray:
        check_packing(name, stored[name])
        array = dataset[name]
        if array.nbytes <= AT_ONCE:
            array.compute()  # damage shows here, where the error names the file; result not kept
        return array

    attrs = {str(key): plain(value) for key, value in dataset.attrs.items()}
    attrs = {key: value for key, value in attrs.items() if isinstance(value, str | int | float)}
    return FileSource(path, [*stored], read, dims_named=True, attributes=attrs)


def column_array(column: pd.Series, unit: str) -> xr.DataArray:
    """A column with its unit; dates and durations as numbers in the unit of `count_dates`."""
    if column.dtype.kind in "mM":
        elapsed_s, unit = count_dates(column)
        return xr.DataArray(elapsed_s / seconds_in(unit), attrs={"units": unit})
    is_number = column.dtype.kind in "iufb"  # with masked ones, whose missing values become NaN
    values = column.to_numpy(np.float64, na_value=np.nan) if is_number else column.to_numpy(object)
    return xr.DataArray(values, attrs={"units": unit})


def leaves(node: Any) -> dict[str, Any]:
    """Flatten nested dicts and lists to {"a.b.0": value}; a list of numbers is one value.

    Raises ValueError if two values get the same name, as in {"a.b": 1, "a": {"b": 2}}.
    """
    pairs = list(_leaves(node))
    found = dict(pairs)
    if len(found) < len(pairs):
        ((name, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"a name must mean one value: {name!r} means two; rename one")
    return found


def _leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    is_nested = isinstance(node, list) and any(isinstance(item, dict | list) for item in node)
    inner = node if isinstance(node, dict) else dict(enumerate(node)) if is_nested else None
    if inner is None:
        yield path, node
    else:
        for key, item in inner.items():
            yield from _leaves(item, f"{path}.{key}" if path else str(key))
