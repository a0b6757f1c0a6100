"""Finished pieces of a run on disk, from which a run that was broken off goes on.

Every piece has a file, complete or absent, that says what it depends on. Values of the package are
written as arrays and text, and read back bit for bit. Pickles would run what a stranger's file
says; here only dataclasses, enumerations and named tuples of this package are made again, without
calling them, and plain values, containers and arrays.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from functools import reduce
from importlib import import_module
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable
from zipfile import BadZipFile

import numpy as np

from ep2sindy._stubs import PACKAGE
from ep2sindy.runtime.files import WriteError, replacing, sweep
from ep2sindy.runtime.parallel import ONE_BY_ONE, Workers

KEY = "key"  # of the arrays in the file of a piece, the one that says what they depend on


Once = Callable[[Callable[[], Any]], Any]  # does a piece of work, or reads its result back


def at_once(function: Callable[[], Any]) -> Any:
    """Do a piece of work, and keep nothing."""
    return function()


@runtime_checkable
class Named(Protocol):
    """A piece, with a name that serves in a file's name."""

    @property
    def name(self) -> str: ...


@dataclass(frozen=True)
class Piece:
    """A piece that has nothing but its name."""

    name: str


@dataclass(frozen=True)
class Kept:
    """Store of finished pieces in a folder; each file is complete or absent.

    key: of all that a result depends on, stored with every piece; a piece of another key counts as
    absent, and is replaced. None: `pointwise` takes the key of its search and of the field's axes
    (`search_key`), which does not look at the values of the field: give every field its own folder.
    """

    folder: Path
    key: str | None = None

    def __post_init__(self) -> None:
        sweep(self.folder)

    def holds(self, piece: Named) -> bool:
        """True if the piece is finished under this key."""
        return self._read(piece, names=[KEY]) is not None

    def read(self, piece: Named) -> dict[str, np.ndarray] | None:
        """Results of a finished piece, or None if there are none of this key that can be read."""
        return self._read(piece)

    def _read(self, piece: Named, names: Sequence[str] = ()) -> dict[str, np.ndarray] | None:
        """Some arrays of a finished piece, or all, but for its key; None as in `read`."""
        try:
            with np.load(self._path(piece), allow_pickle=False) as stored:
                found = {name: stored[name] for name in names or stored.files}
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):
            return None
        return found if str(found.pop(KEY, "")) == (self.key or "") else None

    def write(self, piece: Named, done: Mapping[str, np.ndarray]) -> None:
        """Store a finished piece. Raises OSError, naming the way out, if writing fails."""
        try:
            with replacing(self._path(piece)) as temporary:
                np.savez(temporary, **done, **{KEY: np.array(self.key or "")})  # type: ignore[arg-type]
        except WriteError as error:
            raise OSError(
                f"a finished piece must be kept on disk: writing to {self.folder} failed with "
                f"{error.reason!r}; the pieces before it are kept: mend that, and start "
                "the same run again"
            ) from error

    @property
    def n_pieces(self) -> int:
        """Number of files of pieces, whatever they depend on."""
        return len(self._files())

    def others(self) -> list[Path]:
        """Folders beside this one that hold pieces of other settings, data or code."""
        folders = sorted(self.folder.parent.glob("[!.]*/"))
        return [each for each in folders if each != self.folder and any(each.glob("[!.]*.npz"))]

    def clear(self) -> None:
        """Remove the finished pieces, once the whole result is written.

        The folder stays if another run of the same study is at work in it.
        """
        for path in self._files():
            path.unlink(missing_ok=True)
        with suppress(OSError):
            self.folder.rmdir()

    def _files(self) -> list[Path]:
        return list(self.folder.glob("[!.]*.npz"))  # leaves out files being written

    def _path(self, piece: Named) -> Path:
        return self.folder / f"{piece.name}.npz"


@dataclass(frozen=True, eq=False)
class KeptWorkers:
    """Workers whose finished pieces are kept, and read back by a run that goes on.

    A piece is named by the number of the call of `run` that it belongs to, and by its own: the
    calls must come in the same order in every run of the same settings. A result is given as it is
    read back, in the first run as well, so that all that follows is the same to the last bit.
    refused: kinds of results that cannot be kept, and are computed again.
    """

    workers: Workers
    kept: Kept
    refused: dict[str, None] = field(default_factory=dict)
    _calls: Iterator[int] = field(default_factory=count)

    def run(
        self, function: Callable[[Any], Any], pieces: Iterable[Any]
    ) -> Iterator[tuple[int, Any]]:
        call, waiting = next(self._calls), list[tuple[int, Any]]()
        for number, piece in enumerate(pieces):
            done = self.kept.read(Piece(f"{call}_{number}"))
            try:
                if done is None:
                    raise ValueError("it is not kept")
                result = unpacked(done)
            except ValueError:
                waiting.append((number, piece))
            else:
                yield number, result
        for place, result in self.workers.run(function, [piece for _, piece in waiting]):
            number = waiting[place][0]
            yield number, self._keep(Piece(f"{call}_{number}"), result)

    def once(self, function: Callable[[], Any]) -> Any:
        """The result of one piece of work that is done in this process."""
        here = KeptWorkers(ONE_BY_ONE, self.kept, self.refused, self._calls)
        ((_, result),) = here.run(lambda _: function(), [None])
        return result

    def _keep(self, piece: Piece, result: Any) -> Any:
        try:
            arrays = packed(result)
        except UnpackableError as error:
            self.refused[str(error)] = None
            return result
        self.kept.write(piece, arrays)
        return unpacked(arrays)


# Values as arrays and text.


TREE = "tree"  # of the arrays, the one that holds the structure of the value, as text
PLAIN = (type(None), bool, int, float, str)


@runtime_checkable
class ByName(Protocol):
    """A value that has code, which is found again by its name."""

    @property
    def name(self) -> str: ...

    @classmethod
    def by_name(cls, name: str) -> Any: ...


class UnpackableError(TypeError):
    """A value holds something that cannot be written down, such as a function."""


def packed(value: Any) -> dict[str, np.ndarray]:
    """A value as arrays by name, one of which is text.

    What several places share is written once, and is shared again by `unpacked`.
    Raises UnpackableError for a value that holds more than this module names.
    """
    packer = _Packer()
    tree = packer.node(value)
    text = json.dumps({"tree": tree, "objects": packer.objects})
    return {f"a{k}": each for k, each in enumerate(packer.arrays)} | {TREE: np.array(text)}


def unpacked(arrays: Mapping[str, np.ndarray]) -> Any:
    """The value that `packed` wrote. Raises ValueError for arrays that it cannot have written."""
    try:
        content = json.loads(str(arrays[TREE]))
        return _Unpacker(arrays, content["objects"]).value(content["tree"])
    except (LookupError, TypeError, ValueError, AttributeError, ImportError) as error:
        raise ValueError(f"a packed value must be as it was written: {error!r}") from error


class _Packer:
    """Numbers arrays and objects in the order in which they are met."""

    def __init__(self) -> None:
        self.arrays: list[np.ndarray] = []
        self.objects: list[dict[str, Any]] = []
        self._known: dict[int, Any] = {}  # id -> node, of what may be shared
        self._alive: list[Any] = []  # so that no id is used again

    def node(self, value: Any) -> Any:
        if type(value) in PLAIN:
            return value
        if isinstance(value, Enum):
            return {"enum": [_class_name(type(value)), value.name]}
        if id(value) not in self._known:
            self._alive.append(value)
            self._known[id(value)] = self._new(value)
        return self._known[id(value)]

    def _new(self, value: Any) -> dict[str, Any]:
        kind = type(value)
        if isinstance(value, np.ndarray | np.generic):
            return self._array(value)
        if kind in (list, tuple, set, frozenset):
            return {kind.__name__: [self.node(each) for each in value]}
        if kind is range:
            return {"range": [value.start, value.stop, value.step]}
        if kind in (dict, MappingProxyType):
            pairs = [[self.node(key), self.node(each)] for key, each in value.items()]
            return {"dict" if kind is dict else "mapping": pairs}
        if isinstance(value, tuple):
            return {"named": [_class_name(kind), [self.node(each) for each in value]]}
        if isinstance(value, ByName):
            return {"by_name": [_class_name(kind), value.name]}
        if is_dataclass(kind):
            number = len(self.objects)
            self.objects.append({})
            state = {f.name: self.node(getattr(value, f.name)) for f in fields(value)}
            self.objects[number] = {"class": _class_name(kind), "state": state}
            return {"object": number}
        raise UnpackableError(f"a {kind.__module__}.{kind.__qualname__} cannot be written down")

    def _array(self, value: Any) -> dict[str, Any]:
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise UnpackableError("an array of objects cannot be written down")
        by_columns = array.flags.f_contiguous and not array.flags.c_contiguous
        self.arrays.append(np.array(array, order="F" if by_columns else "C"))
        is_open = isinstance(value, np.ndarray) and array.flags.writeable
        kind = "array" if isinstance(value, np.ndarray) else "number"
        return {kind: [len(self.arrays) - 1, is_open]}


class _Unpacker:
    def __init__(self, arrays: Mapping[str, np.ndarray], objects: list[dict[str, Any]]) -> None:
        self._arrays, self._objects = arrays, objects
        self._made: dict[str, Any] = {}

    def value(self, node: Any) -> Any:
        if not isinstance(node, dict):
            return node
        ((kind, content),) = node.items()
        if kind in ("array", "object"):  # these may be shared
            name = f"{kind} {content[0] if kind == 'array' else content}"
            if name not in self._made:
                self._made[name] = self._array(content) if kind == "array" else None
                if kind == "object":
                    self._object(name, self._objects[content])
            return self._made[name]
        if kind == "number":
            return self._arrays[f"a{content[0]}"][()]
        if kind == "enum":
            return _class(content[0], Enum)[content[1]]
        if kind == "by_name":
            return _class(content[0], object).by_name(str(content[1]))
        if kind == "named":
            return _class(content[0], tuple)._make(map(self.value, content[1]))
        if kind == "range":
            return range(*content)
        if kind in ("dict", "mapping"):
            pairs = {self.value(key): self.value(each) for key, each in content}
            return pairs if kind == "dict" else MappingProxyType(pairs)
        makers = {"list": list, "tuple": tuple, "set": set, "frozenset": frozenset}
        return makers[kind](map(self.value, content))

    def _array(self, content: Any) -> np.ndarray:
        number, is_open = content
        array = self._arrays[f"a{number}"]
        array.flags.writeable = is_open
        return array

    def _object(self, name: str, content: Mapping[str, Any]) -> None:
        kind = _class(content["class"], object)
        if not is_dataclass(kind):
            raise TypeError(f"{content['class']} is no dataclass")
        known = {f.name for f in fields(kind)}
        plain: Any = kind
        made = self._made[name] = object.__new__(plain)
        for key, node in content["state"].items():
            if key not in known:
                raise KeyError(f"{content['class']} has no field {key!r}")
            object.__setattr__(made, key, self.value(node))


def _class_name(kind: type) -> str:
    name = f"{kind.__module__}:{kind.__qualname__}"
    if kind.__module__.partition(".")[0] != PACKAGE or "<" in name:
        raise UnpackableError(f"a {kind.__module__}.{kind.__qualname__} cannot be written down")
    return name


def _class(name: str, base: type) -> Any:
    """A class of this package by its name. Raises TypeError for anything else."""
    module, _, inner = name.partition(":")
    if module.partition(".")[0] != PACKAGE:
        raise TypeError(f"{name} is not of this package")
    found = reduce(getattr, inner.split("."), import_module(module))
    if not (isinstance(found, type) and issubclass(found, base)):
        raise TypeError(f"{name} is no {base.__name__}")
    return found
