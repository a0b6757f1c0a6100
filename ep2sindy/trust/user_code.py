"""User code for configs: modules below the folder in which a run is started.

A config may come from anyone. It may therefore name only code of this package and code in that
folder, and of the latter only functions and classes that are marked for configs. The folder itself
may hold files by others that shadow module names, so nothing in it is imported unless it is named.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, chdir, contextmanager, nullcontext
from importlib.machinery import FileFinder, ModuleSpec, SourceFileLoader
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, TypeVar

PACKAGE = Path(__file__).resolve().parents[1]
MARK = "__offered_to_configs__"
SAFE = "PYTHONSAFEPATH"  # tells Python to import nothing from the current folder
Called = TypeVar("Called", bound=Callable[..., Any])

_OWN: dict[str, ModuleType] = {}  # first part of a dotted name -> its module


def leave_folder() -> None:
    """Stop imports from the current folder, unless it is a checkout of the package.

    Raises ValueError if the folder no longer exists.
    """
    try:
        here = Path.cwd()
    except FileNotFoundError as error:
        raise ValueError(
            "the folder that a run is started in must be there, but it has been removed; "
            "change to another: cd FOLDER"
        ) from error
    if here != PACKAGE.parent:
        sys.path[:] = [path for path in sys.path if Path(path).resolve() != here]


def away_from(settings: str) -> AbstractContextManager[None]:
    """Change the folder during an import that would read this settings file, if there is one."""
    return chdir(PACKAGE) if os.path.exists(settings) else nullcontext()


@contextmanager
def isolate_children() -> Iterator[None]:
    """Let Python processes started in this context import nothing from the current folder."""
    before = {SAFE: os.environ[SAFE]} if SAFE in os.environ else {}
    os.environ[SAFE] = "1"
    try:
        yield
    finally:
        del os.environ[SAFE]
        os.environ.update(before)


def for_configs(call: Called) -> Called:
    """Mark a function or class of your own, so that configs may name it: `@ep.for_configs`.

    A config can then use `_target_: my_module.crop_twice` for a function in my_module.py, which
    lies in the folder where the run is started.
    """
    setattr(call, MARK, call)  # refers to itself, so that derived classes do not count as marked
    return call


def identify(call: Callable[..., Any]) -> str:
    """Module and name of a function or of a callable's class, with a hash of the file it is from.

    A function that is not from a file (typed at a prompt) is known by its compiled code.
    Raises ValueError for what a source does not tell apart: a function that holds values of the one
    around it, and a callable whose class is no frozen dataclass, such as functools.partial.
    """
    is_function = inspect.isfunction(call)
    named: Any = call if is_function else type(call)
    settings = vars(named).get("__dataclass_params__")
    if not (call.__closure__ is None if is_function else settings and settings.frozen):
        raise ValueError(
            "a function must be known by its source, so it must hold no values of its own: "
            f"{call!r} came; write its numbers into it, or make it a frozen dataclass with __call__"
        )
    try:
        source = Path(inspect.getfile(named)).read_bytes()
    except (OSError, TypeError):
        code = (named if is_function else named.__call__).__code__
        source = repr((code.co_code, code.co_consts, code.co_names)).encode()
    defaults = repr(call.__defaults__) if is_function else ""
    digest = hashlib.sha256(source + defaults.encode()).hexdigest()[:16]
    return f"{named.__module__}.{named.__qualname__} {digest}"


def load_marked(name: str) -> Any:
    """A function or class that the user has marked, by its dotted name; see `load_user_module`.

    Raises ModuleNotFoundError or AttributeError if it is not there, ValueError if it is not marked.
    """
    module, _, last = name.rpartition(".")
    found = getattr(load_user_module(module), last)
    if getattr(found, MARK, None) is not found:
        raise ValueError(
            f"{name} must be for configs: mark it with @ep.for_configs where it is defined, if it "
            "is yours"
        )
    return found


def load_user_module(name: str) -> ModuleType:
    """Load a module from a file below the current folder, by its dotted name.

    Modules in a folder can import each other by its name: `from studies.tools import crop`.
    Raises ModuleNotFoundError, before anything is run, if there is no such file, or if the name
    belongs to an installed package or the standard library.
    """
    parts = name.split(".")
    here = Path.cwd()
    place = here.joinpath(*parts)
    if not all(part.isidentifier() for part in parts) or _file(place) is None:
        raise ModuleNotFoundError(f"{here} has no {'/'.join(parts)}.py", name=name)
    for k in range(1, len(parts) + 1):
        _load(".".join(parts[:k]), here.joinpath(*parts[:k]))
    return sys.modules[name]


def own_source(name: str) -> Path | None:
    """File or folder below the current folder that holds the code of a dotted name, or None."""
    root = Path.cwd() / name.partition(".")[0]
    return root if root.is_dir() else _file(root)


def own_packages() -> list[ModuleType]:
    """User modules that configs have named; other processes cannot import them by name."""
    return [module for name, module in _OWN.items() if sys.modules.get(name) is module]


def _file(place: Path) -> Path | None:
    """Source file of the module or package at a place, or None."""
    files = (place.with_suffix(".py"), place / "__init__.py")
    return next((file for file in files if file.is_file()), None)


def _load(name: str, place: Path) -> None:
    """Load a module from its source, ignoring bytecode beside it, which may differ."""
    known = find_spec(name)
    if known is not None and not _lies_at(known, place):
        raise ModuleNotFoundError(
            f"a module of yours must have a name of its own: {name!r} is another's; rename it",
            name=name,
        )
    if name in sys.modules:
        return
    # A module, a package, or a folder with modules.
    spec = FileFinder(str(place.parent), (_Source, [".py"])).find_spec(name)
    assert spec is not None
    module = sys.modules[name] = module_from_spec(spec)
    try:
        if spec.loader is not None:
            spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    parent, _, last = name.rpartition(".")
    if parent:
        setattr(sys.modules[parent], last, module)
    else:
        _OWN[name] = module


def _lies_at(spec: ModuleSpec, place: Path) -> bool:
    files = [spec.origin or "", *(spec.submodule_search_locations or ())]
    return any(Path(file).with_suffix("") in (place, place / "__init__") for file in files)


class _Source(SourceFileLoader):
    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)
