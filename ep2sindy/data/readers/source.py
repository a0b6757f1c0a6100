"""What every reader gives, and what readers share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr

from ep2sindy.data.fields import channel_length_m
from ep2sindy.trust.limits import ALWAYS, check_declared

# Time stays a number, whatever its attribute `units` says.
UNDECODED: Any = {"decode_times": False, "decode_timedelta": False}

PACKED_BY = ("scale_factor", "add_offset")

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


@dataclass(frozen=True)
class FileSource:
    """A file opened: the names it holds, and the array of one name.

    dims_named: whether the arrays' dimension names are the file's own. aliases: further names that
    it answers to, such as a column's number. units: name -> unit that all files of the kind have.
    step_s: of time, where the file says it elsewhere than in an array. channel_m: length of a
    thruster's channel, where the file says it. words: how it was read, for those who look into it.
    is_table: whether its arrays are columns. attributes: texts and numbers that are said of the
    file as a whole.
    """

    path: Path
    names: Sequence[str]
    read: Callable[[str], xr.DataArray]
    dims_named: bool = False
    aliases: Sequence[str] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    step_s: float | None = None
    channel_m: float | None = None
    words: str = ""
    is_table: bool = False
    attributes: Mapping[str, str | float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(set(self.names)) < len(self.names):
            ((name, n),) = Counter(self.names).most_common(1)
            raise ValueError(
                f"arrays of a file must have names of their own: {name!r} comes {n} times; rename "
                "all but one"
            )

    @cached_property
    def known(self) -> frozenset[str]:
        """All that may be read: names, and aliases."""
        return frozenset([*self.names, *self.aliases])


@dataclass(frozen=True)
class Look:
    """What tells a file's kind. head: its first 16 bytes, none of a folder."""

    form: Literal["folder", "hdf5", "other"]
    head: bytes
    ending: str


@dataclass(frozen=True)
class Reader:
    """One kind of file: how it is recognised, and how it is opened.

    first_bytes: beginnings that no other kind has. form, endings: otherwise a folder, HDF5 or any
    other file with one of these endings; without endings, all of that form which nobody claims by
    its ending. form None: recognised by its first bytes alone.
    """

    name: str
    open: Callable[[Path], FileSource]
    first_bytes: tuple[bytes, ...] = ()
    form: Literal["folder", "hdf5", "other"] | None = None
    endings: tuple[str, ...] = ()

    def claim(self, look: Look) -> int:
        """How surely the file is of this kind: 3 by its first bytes, 2 its ending, 1 its form."""
        if look.head.startswith(self.first_bytes):
            return 3
        if look.form != self.form:
            return 0
        return 2 * (look.ending in self.endings) if self.endings else 1


def look_at(path: Path) -> Look:
    """Raises OSError for a file that cannot be read."""
    ending = path.suffix.lower()
    if path.is_dir():
        return Look("folder", b"", ending)
    with path.open("rb") as file:
        head = file.read(16)
    return Look("hdf5" if _is_hdf5(path) else "other", head, ending)


def _is_hdf5(path: Path) -> bool:
    """Whether the signature stands at byte 0, 512 or a double of it, after a block of the user's.

    Source: HDF5 file format specification 3.0, II.A.
    """
    size, place = path.stat().st_size, 0
    with path.open("rb") as file:
        while place + len(HDF5_SIGNATURE) <= size:
            file.seek(place)
            if file.read(len(HDF5_SIGNATURE)) == HDF5_SIGNATURE:
                return True
            place = max(512, 2 * place)
    return False


@contextmanager
def damage_named(path: Path) -> Iterator[None]:
    """Turn what the parsing libraries raise into one error that names the file."""
    try:
        yield
    except Exception as error:  # of a damaged file a library may raise anything
        said = str(error).strip().removesuffix(".") or type(error).__name__
        raise ValueError(
            f"{path} cannot be read: {said}; the file may be cut short, or of another kind"
        ) from error


@contextmanager
def file_named(path: Path) -> Iterator[None]:
    """Let what is wrong with a file's values say which file it was."""
    try:
        yield
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {error}") from error


def check_packing(name: str, attributes: Mapping[str, Any]) -> None:
    """Raise ValueError for a scale or an offset that turns packed numbers into none."""
    for key in PACKED_BY:
        value = np.asarray(attributes.get(key, 1.0))
        is_number = value.size == 1 and value.dtype.kind in "iuf" and np.isfinite(value).all()
        if not is_number or (key == "scale_factor" and not value.all()):
            raise ValueError(
                f"{key} of {name!r} must be a finite number, and no zero scale: "
                f"{value.tolist()!r:.80} came; put the attribute right, or take it away to read "
                "the numbers as they are stored"
            )


def dataset_source(path: Path, dataset: xr.Dataset) -> FileSource:
    """Variables of a dataset as it is stored, whose dimensions the file names; unpacked here."""
    stored = {str(name): dict(variable.attrs) for name, variable in dataset.variables.items()}
    for variable in dataset.variables.values():
        for key in {*PACKED_BY} & {*variable.attrs}:
            packed_by = np.asarray(variable.attrs.pop(key))
            if packed_by.size == 1 and packed_by.dtype.kind in "iuf":
                variable.attrs[key] = packed_by.reshape(())[()]
    dataset = xr.decode_cf(dataset, decode_coords=False, **UNDECODED)
    length = channel_length_m(dataset.attrs)

    def read(name: str) -> xr.DataArray:
        check_packing(name, stored[name])
        array = dataset[name]
        check_declared(repr(name), array.nbytes, path)
        if array.nbytes <= ALWAYS:
            array.compute()  # damage is told here, with the file's name; the array stays on disk
        return array

    said = {str(k): v for k, v in dataset.attrs.items() if isinstance(v, str | int | float)}
    return FileSource(path, [*stored], read, dims_named=True, channel_m=length, attributes=said)


def leaves(node: Any, path: str = "") -> dict[str, Any]:
    """Nested dicts and lists of them as {"a.b.0": value}; a list of numbers is one value.

    Raises ValueError for two values of one such name, as {"a.b": 1, "a": {"b": 2}} has.
    """
    pairs = list(_leaves(node, path))
    found = dict(pairs)
    if len(found) < len(pairs):
        ((name, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"a name must mean one value: {name!r} means two; rename one")
    return found


def _leaves(node: Any, path: str) -> Iterator[tuple[str, Any]]:
    items: Iterable[tuple[Any, Any]]
    if isinstance(node, dict):
        items = node.items()
    elif isinstance(node, list) and any(isinstance(item, dict | list) for item in node):
        items = enumerate(node)
    else:
        yield path, node
        return
    for key, item in items:
        yield from _leaves(item, f"{path}.{key}" if path else str(key))
