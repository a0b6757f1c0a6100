"""How much a file may ask for: what it declares is counted before it is believed."""

from __future__ import annotations

from pathlib import Path

N_NAMES = 100_000  # arrays in one file
DEPTH = 64  # of groups in groups

# Bytes that an array may have in memory whatever its file is, and per byte of the file: deflate
# packs zeros a thousandfold, but no file of samples holds so little.
ALWAYS, PER_BYTE = 2**28, 200


def check_kind(path: Path) -> None:
    """Raise ValueError for what is neither a file nor a folder: opening a pipe waits for ever."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError(f"a file or a folder must come: {path} is a pipe, a socket or a device")


def check_declared(what: str, n_bytes: int, path: Path) -> None:
    """Raise ValueError for an array that is too large for the file it is said to be in."""
    most = max(ALWAYS, PER_BYTE * size_of(path))
    if n_bytes > most:
        raise ValueError(
            f"{what} would take {n_bytes:.3g} bytes, and a file of this size may hold "
            f"{most:.3g}: its header is damaged, or it was never written; copy what it holds into "
            "a file of its own"
        )


def size_of(path: Path) -> int:
    """Bytes of a file, or of all in a folder."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    return sum(each.stat().st_size for each in files)
