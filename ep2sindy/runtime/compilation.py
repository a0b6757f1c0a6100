"""Compilation of numerical kernels with numba, their cache on disk, and an announcement of it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
from numba.core import config, cpu, event, options

from ep2sindy.runtime.screen import say
from ep2sindy.runtime.user_cache import cache_folder
from ep2sindy.trust.user_code import PACKAGE

THIS = Path(__file__)
IMPORT = re.compile(r"^from (ep2sindy(?:\.\w+)+) import", re.MULTILINE)

ANNOUNCEMENT = "ep2sindy: compiling its kernels, once after installation (half a minute) ..."


def _separate_arrays() -> dict[str, Any]:
    """The option that tells the compiler that a kernel's array arguments are separate ones.

    Numba's compiler has this flag, but its decorators do not offer it; {} where it has gone.
    """
    if not hasattr(options.TargetOptions, "Mapping"):
        return {}
    cpu.CPUTargetOptions.noalias = options.TargetOptions.Mapping("noalias")
    return {"noalias": True}


SEPARATE_ARRAYS = _separate_arrays()

# How kernels are compiled that are nothing but loops over separate arrays that they are given.
LOOPS: dict[str, Any] = {
    "fastmath": {"contract"},
    "error_model": "numpy",
    **SEPARATE_ARRAYS,
}

# The same for kernels that only kernels call, from several places: they are compiled once and then
# inlined. Where there is one place, `inline="always"` is faster to compile.
INNER = {**LOOPS, "no_cpython_wrapper": True, "forceinline": True}

# As LOOPS, for sums that may be taken in any order, which lets them fill the vector units.
REORDERED = {**LOOPS, "fastmath": {"reassoc", "contract"}}
INNER_REORDERED = {**INNER, **REORDERED}


def compiled(function: Callable | None = None, **options: Any) -> Any:
    """Compile by `numba.njit` with a cache on disk: `@compiled` or `@compiled(inline="always")`.

    Kernels release the GIL, so that a worker in a long call still notices that its run was killed.
    The functions that a kernel calls are compiled into it, and so are constants. A change in any
    file of its folder, or in a file from which kernels there import names, therefore triggers a
    new compilation: the cache lies in a folder that is named after them. Numba itself checks only
    the kernel's own file. Without a folder that can be written, every process compiles anew.
    """
    if function is None:
        return lambda each: compiled(each, **options)
    _listen()
    folder = _folder_of(Path(function.__code__.co_filename).parent)
    place: Any = config
    before, place.CACHE_DIR = place.CACHE_DIR, folder  # read where a function is decorated
    try:
        # No one calls kernels from C, and a wrapper for that would be compiled for each.
        settings = {"no_cfunc_wrapper": True} | options
        return numba.njit(cache=bool(folder), nogil=True, **settings)(function)
    finally:
        place.CACHE_DIR = before


@cache
def _folder_of(sources: Path) -> str:
    """Where the kernels of a folder of sources are cached; empty if they cannot be."""
    files = {*sources.glob("*.py"), *_imported(_kernels_in(sources)), THIS}
    try:
        return str(cache_folder("kernels", f"{sources.name}_{digest(files)}"))
    except OSError as error:
        _UNKEPT.append(f"; they are not kept, for {error}")
        return ""


def digest(files: Iterable[Path]) -> str:
    """Hash of the places, dates and sizes of files."""
    stats = [(str(file), file.stat()) for file in sorted(files)]
    found = [(name, stat.st_mtime_ns, stat.st_size) for name, stat in stats]
    return sha256(repr(found).encode()).hexdigest()[:16]


def sources() -> list[Path]:
    """Source files on which kernels depend.

    These are the files that define kernels, the files from which they import names, and this one,
    which sets how they are compiled.
    """
    kernels = _kernels_in(PACKAGE)
    return [*sorted({*kernels, *_imported(kernels)} - {THIS}), THIS]


def _kernels_in(folder: Path) -> list[Path]:
    """Files below a folder that define kernels, recognised by their names."""
    return [path for path in folder.rglob("*.py") if path.stem.endswith("kernels")]


def _imported(files: Iterable[Path]) -> set[Path]:
    """Files of the package from which these files import names, found in their source text."""
    names = {name for path in files for name in IMPORT.findall(path.read_text("utf-8"))}
    places = {PACKAGE.parent.joinpath(*name.split(".")).with_suffix(".py") for name in names}
    return {place for place in places if place.is_file()}


class _Listener(event.Listener):
    """Announces once per process that kernels are being compiled; cached ones cause no message."""

    def on_start(self, event: event.Event) -> None:
        if announce_once():  # numba reports every function
            say(ANNOUNCEMENT + "".join(_UNKEPT[:1]), error=True)

    def on_end(self, event: event.Event) -> None:
        pass


def announce_once() -> bool:
    """True at the first call of a process: the announcement is due then, or has been made."""
    _ANNOUNCED.append(True)
    return len(_ANNOUNCED) == 1


_ANNOUNCED: list[bool] = []
_UNKEPT: list[str] = []  # why kernels cannot be kept
_LISTENERS: list[_Listener] = []


def _listen() -> None:
    if not _LISTENERS:
        _LISTENERS.append(_Listener())
        event.register("numba:compile", _LISTENERS[0])
