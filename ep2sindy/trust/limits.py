"""Limits on what a file may declare, checked before memory is allocated for it."""

from __future__ import annotations

from pathlib import Path

N_NAMES = 100_000  # largest number of arrays in one file
DEPTH = 64  # deepest nesting of groups

# Bytes that an array may take in memory: ALWAYS for any file, or PER_BYTE for each byte of the
# file if that is more. Deflate compresses zeros a thousandfold, but no file of real samples is so
# compressible.
ALWAYS, PER_BYTE = 2**28, 200


def check_kind(path: Path) -> None:
    """Raise ValueError for anything but a file or a folder: opening a pipe would wait forever."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError(f"a file or a folder must come: {path} is a pipe, a socket or a device")


def check_declared(what: str, n_bytes: int, path: Path) -> None:
    """Raise ValueError if an array is too large for the file that declares it."""
    most = max(ALWAYS, PER_BYTE * size_of(path))
    if n_bytes > most:
        raise ValueError(
            f"{what} would take {n_bytes:.3g} bytes, and a file of this size may hold "
            f"{most:.3g}: its header is damaged, or it was never written; copy what it holds into "
            "a file of its own"
        )


def size_of(path: Path) -> int:
    """Size in bytes of a file, or of all files in a folder."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    return sum(each.stat().st_size for each in files)
