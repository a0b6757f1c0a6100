"""Finished pieces of work in the user's own cache, from which a run that was broken off goes on.

They are pickles, as joblib writes them: each is complete or absent. So they are never read from
the folder in which a program is started, which may be a stranger's.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from shutil import rmtree
from typing import Any

from joblib import Memory
from platformdirs import user_cache_path

STALE_DAYS = 30.0  # after which the pieces of a broken run are removed


def folder_of_pieces(key: str) -> Path:
    """The folder of all pieces that depend on what `key` stands for; old ones of others go.

    Raises OSError if the user has no folder for caches that can be written.
    """
    place = user_cache_path("ep2sindy") / "pieces"
    if not place.is_absolute():
        raise OSError(f"a cache needs an absolute folder: {place} came; set HOME")
    place.mkdir(mode=0o700, parents=True, exist_ok=True)
    for other in place.iterdir():
        if time.time() - other.stat().st_mtime > 86400.0 * STALE_DAYS:
            rmtree(other, ignore_errors=True)
    return place / key


def kept(folder: Path, piece: tuple[int, int], function: Callable[[Any], Any], value: Any) -> Any:
    """`function(value)`, or what it returned when this piece was done before.

    piece: numbers of the piece's call and of the piece in it.
    """
    return Memory(folder, verbose=0).cache(_done, ignore=["function", "value"])(
        piece, function, value
    )


def _done(piece: tuple[int, int], function: Callable[[Any], Any], value: Any) -> Any:
    return function(value)
