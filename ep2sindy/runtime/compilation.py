"""Compiled kernels: kept on disk after the first call, which says what it waits for."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

from ep2sindy.runtime.screen import say
from ep2sindy.trust.user_code import PACKAGE, away_from

SETTINGS = ".numba_config.yaml"  # of the current folder, which may be anybody's

with away_from(SETTINGS):
    import numba
    from numba.core import config, event
config._config_fname = ""  # looked for again whenever something is compiled

THIS = Path(__file__)
IMPORT = re.compile(r"^from (ep2sindy(?:\.\w+)+) import", re.MULTILINE)

ANNOUNCEMENT = "ep2sindy: compiling its kernels, once after installation (half a minute) ..."


def compiled(function: Callable | None = None, **options: Any) -> Any:
    """`numba.njit` with its cache on; as `@compiled` or `@compiled(inline="always")`.

    Other threads go on meanwhile: a worker in a long call still sees that its run was killed.
    What a kernel calls is compiled into it, and so are constants: a change in any file of its
    folder, or in one that kernels there import names from, compiles it anew. Numba itself looks at
    the kernel's own file alone.
    """
    if function is None:
        return lambda each: compiled(each, **options)
    _listen()
    kernel = numba.njit(cache=True, nogil=True, **options)(function)
    kept: Any = getattr(kernel._cache, "_cache_file", None)
    if hasattr(kept, "_source_stamp"):  # numba has no public way
        kept._source_stamp = _stamp(Path(function.__code__.co_filename).parent)
    if hasattr(kernel._cache, "save_overload"):
        kernel._cache.save_overload = partial(_keep_if_room, kernel._cache.save_overload)
    return kernel


def sources() -> list[Path]:
    """Files that define kernels, those whose names they import, and this one, which says how they
    are compiled."""
    kernels = _kernels_in(PACKAGE)
    return [*sorted({*kernels, *_imported(kernels)} - {THIS}), THIS]


def _kernels_in(folder: Path) -> list[Path]:
    """Files that define kernels, below a folder."""
    return [path for path in folder.rglob("*.py") if path.stem.endswith(("kernels", "_fits"))]


def _imported(files: Iterable[Path]) -> set[Path]:
    """Files of the package that these import names from, by their texts."""
    names = {name for path in files for name in IMPORT.findall(path.read_text("utf-8"))}
    places = {PACKAGE.parent.joinpath(*name.split(".")).with_suffix(".py") for name in names}
    return {place for place in places if place.is_file()}


def cache_folder() -> Path:
    """The folder where compiled kernels are kept: beside this file, or where numba chose to."""

    @numba.njit(cache=True)
    def probe() -> None:
        """Never called."""

    return Path(str(probe.stats.cache_path))


def tell_each_kernel(tell: Callable[[str], None]) -> None:
    """Let `tell` hear the name of each kernel of the package once it is compiled, in place of
    the announcement."""
    _listen()
    _TOLD.append(tell)


def _keep_if_room(save: Callable, *compiled: Any) -> None:
    """A disk that takes no more costs the next run half a minute, not this one its results."""
    with suppress(OSError):
        save(*compiled)


@cache
def _stamp(folder: Path) -> tuple[tuple[str, float, int], ...]:
    """Names, dates and sizes of all that is compiled in a folder, and of what says how."""
    files = {*folder.glob("*.py"), *_imported(_kernels_in(folder)), THIS}
    stats = [(file.name, file.stat()) for file in sorted(files)]
    return tuple((name, stat.st_mtime, stat.st_size) for name, stat in stats)


class _Listener(event.Listener):
    """Says once per process that something is compiled; what the cache holds is not."""

    def on_start(self, event: event.Event) -> None:
        if not _TOLD:
            _TOLD.append(lambda name: None)  # numba tells of every function; people need it once
            say(ANNOUNCEMENT, error=True)

    def on_end(self, event: event.Event) -> None:
        kernel: Any = event.data.get("dispatcher")
        module = str(getattr(kernel, "__module__", ""))
        if module.startswith("ep2sindy."):
            for tell in _TOLD:
                tell(f"{module}.{kernel.__name__}")


_TOLD: list[Callable[[str], None]] = []  # whoever hears of kernels; none as long as all is cached
_LISTENERS: list[_Listener] = []


def _listen() -> None:
    if not _LISTENERS:
        _LISTENERS.append(_Listener())
        event.register("numba:compile", _LISTENERS[0])
