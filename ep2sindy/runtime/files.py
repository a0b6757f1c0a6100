"""Atomic writing of files, so that a final name never stands for a half-written file; reading.

Also the user's own folder for what can be made again.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import time
import uuid
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from shutil import rmtree
from typing import Any

from platformdirs import user_cache_path


class WriteError(OSError):
    """A file could not be written; the message says which, why, and what to do."""

    def __init__(self, path: Path, reason: OSError | str) -> None:
        self.reason = getattr(reason, "strerror", None) or str(reason) or type(reason).__name__
        super().__init__(
            f"{path} could not be written ({self.reason}); what was written before it is whole: "
            "make room there, or write elsewhere"
        )
        self._made_of = path, self.reason

    def __reduce__(self) -> tuple[Any, ...]:  # workers send their errors as pickles
        return WriteError, self._made_of


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an OSError raised within into a WriteError that names the file."""
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        raise WriteError(path, error) from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`; the file is renamed to `path` if the block succeeds.

    The temporary keeps the suffix, since writers choose the format by it. If the block ends early
    (an error, Ctrl-C), a file at `path` stays as it was. Raises WriteError, an OSError.
    """
    temporary = path.with_name(f".{path.stem}-{uuid.uuid4().hex}{path.suffix}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            _sync(temporary)  # a full disk may show only now; data must be safe before the name
            os.replace(temporary, path)
            with suppress(OSError):  # the file is complete; some file systems cannot sync folders
                _sync(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    number = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(number)
    finally:
        os.close(number)


TEMPORARY = re.compile(r"\..+-[0-9a-f]{32}(\.\w+)?")
LEFT_AFTER_S = 86400.0  # nobody writes on one file for a day


def sweep(folder: Path) -> None:
    """Remove half-written files, a day old or more, that killed processes left in a folder.

    Subfolders are swept as well.
    """
    for place, _, names in os.walk(folder):
        for path in (Path(place, name) for name in names if TEMPORARY.fullmatch(name)):
            with suppress(OSError):  # another process may sweep at the same time
                if time.time() - path.stat().st_mtime > LEFT_AFTER_S:
                    path.unlink()


def write_bytes(path: Path, content: bytes | memoryview) -> None:
    """Write bytes to `path`, completely or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text to `path`, completely or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON to `path`, completely or not at all; NaN and infinities become null."""
    write_text(path, json.dumps(_without_nan(content), indent=2, allow_nan=False) + "\n")


def _without_nan(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {key: _without_nan(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_without_nan(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content


def check_regular(path: Path) -> None:
    """Raise ValueError unless a path, and all below it, are files and folders, if it exists.

    To open a pipe would wait forever. Below it links to folders are refused: they lead anywhere.
    """
    below = (os.path.join(at, n) for at, *names in os.walk(path) for n in chain(*names))
    for place in chain([os.path.realpath(path)], below):
        is_folder = os.path.isdir(place) and not os.path.islink(place)
        if os.path.lexists(place) and not (os.path.isfile(place) or is_folder):
            raise ValueError(
                f"a file or a folder must come: {place} is a pipe, a socket, a device or a link "
                "that leads to no file; replace it by a file"
            )


def read_bytes(path: Path) -> bytes:
    """The content of a file. Raises ValueError for what is no file, OSError if it is not there."""
    check_regular(path)
    return path.read_bytes()


def read_json(text: str | bytes) -> Any:
    """Parse JSON.

    Raises ValueError for text that is not JSON, and for an object that has a key twice, of which
    Python's parser would silently drop the first; RecursionError for lists in lists without end.
    """
    return json.loads(text, object_pairs_hook=_each_once)


def _each_once(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        ((key, n),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"an object of JSON must have each key once: {key!r} comes {n} times")
    return content


def fingerprint(settings: str, *, sources: Path | Sequence[Path]) -> str:
    """Hash of settings and of the source code that uses them: sixteen hexadecimal digits.

    sources: Python files, or folders of them. They are included so that results of an old formula
    are not reused from disk after the formula has changed.
    """
    digest = hashlib.sha256(settings.encode())
    for place in [sources] if isinstance(sources, Path) else sources:
        for source in [place] if place.is_file() else sorted(place.rglob("*.py")):
            digest.update(source.name.encode() + source.read_bytes())
    return digest.hexdigest()[:16]


# The user's own folder for what can be made again: kernels, simulations, pieces of broken runs.
# Kernels and pieces are read by unpickling, which can run code, and a simulation is believed. So
# they are never looked for in the folder in which a program is started, which may be a stranger's.


STALE_DAYS = 30.0  # after which what nobody has used is removed

PLACE = "EP2SINDY_CACHE"  # the variable that names another folder


def cache_folder(kind: str, key: str) -> Path:
    """The folder, below that of a kind of things, of those that depend on what `key` stands for.

    It need not exist yet. If it does, it counts as used; if not, what is stale goes.
    Raises OSError if the user has no folder for caches that can be written.
    """
    try:
        place = Path(os.environ.get(PLACE) or user_cache_path("ep2sindy")) / kind
    except RuntimeError as error:
        raise OSError(f"this user has no home folder; {PLACE} names a folder") from error
    if not place.is_absolute():
        raise OSError(f"a cache needs an absolute folder, got {place}; {PLACE} names another")
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not os.access(place, os.W_OK):
            raise PermissionError("it cannot be written")
    except OSError as error:
        reason = error.strerror or error
        raise OSError(
            f"{place} cannot be a cache: {reason}; {PLACE} names another folder"
        ) from error
    folder = place / key
    with suppress(OSError):  # another process may use or remove the same at the same time
        if folder.exists():
            os.utime(folder)
            return folder
        for other in place.iterdir():
            if time.time() - other.stat().st_mtime > 86400.0 * STALE_DAYS:
                rmtree(other, ignore_errors=True)
    return folder
