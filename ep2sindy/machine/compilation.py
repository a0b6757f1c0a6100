"""Compiled kernels: kept on disk after the first call, which says what it waits for."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

import numba
from numba.core import event


def compiled(function: Callable | None = None, **options: Any) -> Any:
    """`numba.njit` with its cache on; as `@compiled` or `@compiled(inline="always")`.

    Other threads go on meanwhile: a worker in a long call still sees that its run was killed.
    What a kernel calls is compiled into it, so a change in any kernel of its folder, or in the
    columns that they share, compiles it anew: numba itself looks at the kernel's own file alone.
    """
    if function is None:
        return lambda each: compiled(each, **options)
    _announce()
    kernel = numba.njit(cache=True, nogil=True, **options)(function)
    kept: Any = getattr(kernel._cache, "_cache_file", None)
    if hasattr(kept, "_source_stamp"):  # numba has no public way
        kept._source_stamp = _stamp(Path(function.__code__.co_filename).parent)
    if hasattr(kernel._cache, "save_overload"):
        kernel._cache.save_overload = partial(_kept_if_room, kernel._cache.save_overload)
    return kernel


def _kept_if_room(save: Callable, *compiled: Any) -> None:
    """A disk that takes no more costs the next run half a minute, not this one its results."""
    with suppress(OSError):
        save(*compiled)


@cache
def _stamp(folder: Path) -> tuple[tuple[str, float, int], ...]:
    """Names, dates and sizes of all that is compiled in a folder, and of what says how."""
    sources = [*sorted(folder.glob("*.py")), *sorted(folder.parent.glob("closures.py"))]
    stats = [(source.name, source.stat()) for source in [*sources, Path(__file__)]]
    return tuple((name, stat.st_mtime, stat.st_size) for name, stat in stats)


class _Announcer(event.Listener):
    """Says once per process that something is compiled; what the cache holds is not."""

    def on_start(self, event: event.Event) -> None:
        if not _ANNOUNCED:
            _ANNOUNCED.append(True)
            print(
                "ep2sindy: compiling its kernels, once after installation (half a minute) ...",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: event.Event) -> None:
        pass


_ANNOUNCED: list[bool] = []  # numba tells listeners of every function; people need it once
_LISTENERS: list[_Announcer] = []


def _announce() -> None:
    if not _LISTENERS:
        _LISTENERS.append(_Announcer())
        event.register("numba:compile", _LISTENERS[0])
