"""Compilation of numerical kernels with numba, their cache on disk, and an announcement of it."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

from ep2sindy.runtime.screen import say
from ep2sindy.trust.user_code import PACKAGE, away_from

SETTINGS = ".numba_config.yaml"  # read from the current folder, which may not be trustworthy

with away_from(SETTINGS):
    import numba
    from numba.core import config, cpu, event, options
config._config_fname = ""  # numba looks for the file again at every compilation

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

# For kernels that make no arrays but are given all: no references are counted, which halves the
# time to compile loops and often the time to run them. Numba's decorators keep it to themselves.
GIVEN_ARRAYS = {"_nrt": False} if hasattr(cpu.CPUTargetOptions, "_nrt") else {}

# How kernels are compiled that are nothing but loops over separate arrays that they are given.
LOOPS: dict[str, Any] = {
    "fastmath": {"contract"},
    "error_model": "numpy",
    **SEPARATE_ARRAYS,
    **GIVEN_ARRAYS,
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
    new compilation. Numba itself checks only the kernel's own file.
    """
    if function is None:
        return lambda each: compiled(each, **options)
    _listen()
    # No one calls kernels from C, and a wrapper for that would be compiled for each.
    kernel: Any = numba.njit(cache=True, nogil=True, **({"no_cfunc_wrapper": True} | options))(
        function
    )
    kept: Any = getattr(kernel._cache, "_cache_file", None)
    if hasattr(kept, "_source_stamp"):  # numba has no public interface for this
        kept._source_stamp = _stamp(Path(function.__code__.co_filename).parent)
        kept._load_index = partial(_index_or_none, kept._load_index)
    if hasattr(kernel._cache, "save_overload"):
        kernel._cache.save_overload = partial(_keep_if_room, kernel._cache.save_overload)
    return kernel


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


def cache_folder() -> Path:
    """Folder of the compiled kernels: beside this file, or where numba chose to keep them."""

    @numba.njit(cache=True)
    def probe() -> None:
        """Never called."""

    return Path(str(probe.stats.cache_path))


def tell_each_kernel(tell: Callable[[str], None]) -> None:
    """Call `tell` with the name of each kernel of the package once it is compiled.

    This replaces the announcement.
    """
    _listen()
    _TOLD.append(tell)


def _index_or_none(load: Callable[[], dict]) -> dict:
    """Index of compiled kernels; empty if it cannot be read, so that they are compiled again.

    An index holds the types of arguments. One of an earlier version may name a class that has been
    renamed since, and numba reads it before it compares the stamp.
    """
    try:
        return load()
    except (AttributeError, ImportError, EOFError, pickle.UnpicklingError):
        return {}


def _keep_if_room(save: Callable, *compiled: Any) -> None:
    """Save a kernel, ignoring errors: a full disk costs the next run half a minute, no results."""
    with suppress(OSError):
        save(*compiled)


@cache
def _stamp(folder: Path) -> tuple[tuple[str, float, int], ...]:
    """Names, dates and sizes of all files on which the kernels of a folder depend."""
    files = {*folder.glob("*.py"), *_imported(_kernels_in(folder)), THIS}
    stats = [(file.name, file.stat()) for file in sorted(files)]
    return tuple((name, stat.st_mtime, stat.st_size) for name, stat in stats)


class _Listener(event.Listener):
    """Announces once per process that kernels are being compiled; cached ones cause no message."""

    def on_start(self, event: event.Event) -> None:
        if not _TOLD:
            _TOLD.append(lambda name: None)  # numba reports every function; one message is enough
            say(ANNOUNCEMENT, error=True)

    def on_end(self, event: event.Event) -> None:
        kernel: Any = event.data.get("dispatcher")
        module = str(getattr(kernel, "__module__", ""))
        if module.startswith("ep2sindy."):
            for tell in _TOLD:
                tell(f"{module}.{kernel.__name__}")


_TOLD: list[Callable[[str], None]] = []  # receivers of kernel names; empty until one is needed
_LISTENERS: list[_Listener] = []


def _listen() -> None:
    if not _LISTENERS:
        _LISTENERS.append(_Listener())
        event.register("numba:compile", _LISTENERS[0])
