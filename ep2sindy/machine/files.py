"""Write files so that a final name never stands for a half-written file."""

from __future__ import annotations

import hashlib
import json
import math
import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path`; it takes the final name only if the block succeeds.

    The temporary keeps the suffix, since writers tell formats by it. Whatever ends the block
    early (an error, Ctrl-C) leaves the final name as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}-{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


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


def fingerprint(settings: str, *, sources: Path) -> str:
    """Sixteen hexadecimal digits of some settings and of the source text that uses them.

    sources: a Python file, or a folder of them; what a changed formula would answer differently
    is not taken from what an old one left on disk.
    """
    digest = hashlib.sha256(settings.encode())
    for source in [sources] if sources.is_file() else sorted(sources.rglob("*.py")):
        digest.update(source.name.encode() + source.read_bytes())
    return digest.hexdigest()[:16]
