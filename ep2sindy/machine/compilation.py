"""Compiled kernels: kept on disk after the first call, which says what it waits for."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numba
from numba.core import event


def compiled(function: Callable | None = None, **options: Any) -> Any:
    """`numba.njit` with its cache on; as `@compiled` or `@compiled(inline="always")`."""
    _announce()
    kernel = numba.njit(cache=True, **options)
    return kernel if function is None else kernel(function)


class _Announcer(event.Listener):
    """Says once per process that something is compiled; what the cache holds is not."""

    def on_start(self, event: event.Event) -> None:
        if not _ANNOUNCED:
            _ANNOUNCED.append(True)
            print(
                "ep2sindy: compiling its kernels, once after installation (some ten seconds) ...",
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
