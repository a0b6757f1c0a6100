"""Write files so that a final name never stands for a half-written file; read JSON."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
import uuid
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil


class WriteError(OSError):
    """A file could not be written: which, why, and the way out."""

    def __init__(self, path: Path, reason: OSError | str) -> None:
        self.reason = getattr(reason, "strerror", None) or str(reason) or type(reason).__name__
        super().__init__(
            f"{path} could not be written ({self.reason}); what was written before it is whole: "
            "make room there, or write elsewhere"
        )
        self._made_of = path, self.reason

    def __reduce__(self) -> tuple[Any, ...]:  # workers send their errors
        return WriteError, self._made_of


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Let an error of the operating system say which file could not be written."""
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        raise WriteError(path, error) from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path`; it takes the final name only if the block succeeds.

    The temporary keeps the suffix, since writers tell formats by it. Whatever ends the block
    early (an error, Ctrl-C) leaves the final name as it was. Raises WriteError, an OSError.
    """
    temporary = path.with_name(f".{path.stem}-{_maker()}-{uuid.uuid4().hex[:8]}{path.suffix}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            _sync(temporary)  # the disk may be full only now, and a name outlives a power cut
            os.replace(temporary, path)
            with suppress(OSError):  # the file is whole; some file systems sync no folders
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


def _maker() -> str:
    """Machine and process, by which it is told whose a temporary file is."""
    return f"{zlib.crc32(platform.node().encode()):08x}-{os.getpid()}"


TEMPORARY = re.compile(r"\..+-([0-9a-f]{8})-(\d+)-[0-9a-f]{8}(\.\w+)?")


def sweep(folder: Path) -> None:
    """Remove what processes of this machine that were killed left half-written in a folder.

    Its folders are swept as well. A file of a living process, or of another machine, stays.
    """
    ours = _maker().partition("-")[0]
    for place, _, names in os.walk(folder):
        for name in names:
            found = TEMPORARY.fullmatch(name)
            if found and found[1] == ours and not psutil.pid_exists(int(found[2])):
                with suppress(OSError):  # another start may sweep at the same time
                    os.unlink(os.path.join(place, name))


def write_bytes(path: Path, content: bytes | memoryview) -> None:
    """Write bytes under `path`, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text under `path`, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON under `path`, whole or not at all; NaN becomes null: JSON has no word for it."""
    write_text(path, json.dumps(_without_nan(content), indent=2, allow_nan=False) + "\n")


def _without_nan(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {key: _without_nan(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_without_nan(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content


def read_json(text: str) -> Any:
    """What a text of JSON says.

    Raises ValueError for any other, and for a key that one object has twice: Python's reader
    forgets the first.
    """
    return json.loads(text, object_pairs_hook=_each_once)


def _each_once(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        ((key, n),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"an object of JSON must have each key once: {key!r} comes {n} times")
    return content


def fingerprint(settings: str, *, sources: Path) -> str:
    """Sixteen hexadecimal digits of some settings and of the source text that uses them.

    sources: a Python file, or a folder of them; what a changed formula would answer differently
    is not taken from what an old one left on disk.
    """
    digest = hashlib.sha256(settings.encode())
    for source in [sources] if sources.is_file() else sorted(sources.rglob("*.py")):
        digest.update(source.name.encode() + source.read_bytes())
    return digest.hexdigest()[:16]
