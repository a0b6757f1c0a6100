"""Compilation of numerical kernels with numba, their cache on disk, and an announcement of it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.compiler import Compiler

from ep2sindy.runtime.files import cache_folder
from ep2sindy.runtime.screen import say_once
from ep2sindy.trust.user_code import PACKAGE

THIS = Path(__file__)
IMPORT = re.compile(r"^from (ep2sindy(?:\.\w+)+) import", re.MULTILINE)

ANNOUNCEMENT = "ep2sindy: compiling its kernels, once after installation (half a minute) ..."


def not_kept(error: OSError) -> str:
    return f"ep2sindy: compiled kernels are not kept: {error}"


class SeparateArrays(Compiler):
    """Numba's compiler with its flag that a kernel's array arguments are separate ones.

    Numba's decorators do not offer the flag.
    """

    def define_pipelines(self) -> Any:
        self.state.flags.noalias = True
        return super().define_pipelines()


SEPARATE_ARRAYS: dict[str, Any] = {"pipeline_class": SeparateArrays}

# How kernels are compiled that are nothing but loops over separate arrays that they are given.
LOOPS: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy", **SEPARATE_ARRAYS}

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
    # No one calls kernels from C, and a wrapper for that would be compiled for each.
    kernel: Any = numba.njit(nogil=True, **{"no_cfunc_wrapper": True} | options)(function)
    kernel._cache = _KernelCache(function)
    return kernel


class _Place(_CacheLocator):
    """Where a kernel is kept: a folder whose name holds what numba would ask for as a stamp."""

    def __init__(self, function: Callable, file: str) -> None:
        self.line = function.__code__.co_firstlineno
        self.folder = _folder_of(Path(file).parent)

    def get_cache_path(self) -> str:
        return self.folder

    def get_source_stamp(self) -> str:
        return ""

    def get_disambiguator(self) -> str:
        return str(self.line)

    @classmethod
    def from_function(cls, function: Callable, file: str) -> _Place:
        return cls(function, file)


class _KeptKernel(CompileResultCacheImpl):
    _locator_classes: Any = (_Place,)


class _KernelCache(FunctionCache):
    """Numba's cache of one function, in our folder.

    A compilation is announced, and a kernel that cannot be kept is compiled all the same.
    """

    _impl_class = _KeptKernel

    def __init__(self, function: Callable) -> None:
        super().__init__(function)
        if not self.cache_path:
            self.disable()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        kernel = super().load_overload(sig, target_context)
        if kernel is None:
            say_once(ANNOUNCEMENT)
        return kernel

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            UNKEPT.append(error)
        for first in UNKEPT[:1]:
            say_once(not_kept(first))


@cache
def _folder_of(sources: Path) -> str:
    """Where the kernels of a folder of sources are cached; empty if they cannot be."""
    files = {*sources.glob("*.py"), *_imported(_kernels_in(sources)), THIS}
    try:
        return str(cache_folder("kernels", f"{sources.name}_{digest(files)}"))
    except OSError as error:
        UNKEPT.append(error)
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


UNKEPT: list[OSError] = []  # why kernels cannot be kept
