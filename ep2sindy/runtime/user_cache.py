"""The user's own folder for what can be made again: kernels, simulations, pieces of broken runs.

Kernels and pieces are read by unpickling, which can run code, and a simulation is believed. So they
are never looked for in the folder in which a program is started, which may be a stranger's.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from shutil import rmtree

from platformdirs import user_cache_path

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
