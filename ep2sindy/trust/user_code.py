"""User code for configs: modules below the folder in which a run is started.

A config may name code of this package and code in that folder, and of the latter only functions and
classes that are marked for configs.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module, invalidate_caches
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

PACKAGE = Path(__file__).resolve().parents[1]
MARK = "__offered_to_configs__"
Called = TypeVar("Called", bound=Callable[..., Any])

_OWN: dict[str, ModuleType] = {}  # first part of a dotted name -> its module


def for_configs(call: Called) -> Called:
    """Mark a function or class of your own, so that configs may name it.

    A config can then use `_target_: my_module.crop_twice` for a function in my_module.py, which
    lies in the folder where the run is started. Code without the mark is refused.

    Parameters
    ----------
    call : Called
        The function or class. Use it as a decorator.

    Returns
    -------
    Called
        The same function or class.

    Examples
    --------
    >>> @ep.for_configs
    ... def crop_twice(field):
    ...     return field.isel(time=slice(100, -100))
    >>> crop_twice.__name__
    'crop_twice'
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
            "a function must be known by its source, so it must hold no values of its own, got "
            f"{call!r}; write its numbers into it, or make it a frozen dataclass with __call__"
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

    The folder joins the end of the search path, so that modules in it can import each other by its
    name, and none takes the place of an installed one.
    Raises ModuleNotFoundError, before anything is run, if there is no such file, or if the name
    belongs to an installed package or the standard library.
    """
    here, own = Path.cwd(), own_source(name)
    if own is None:
        raise ModuleNotFoundError(f"{here} has no {name.replace('.', '/')}.py", name=name)
    if str(here) not in sys.path:
        sys.path.append(str(here))
        invalidate_caches()
    known = find_spec(own.stem)
    if known is None or str(own) not in (known.origin, *(known.submodule_search_locations or ())):
        raise ModuleNotFoundError(
            f"a module of yours must have a name of its own: {own.stem!r} is another's; rename it",
            name=name,
        )
    module = import_module(name)
    _OWN[own.stem] = sys.modules[own.stem]
    return module


def nodes_of(node: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """A node of plain settings and all below it, each with its dotted place."""
    yield place, node
    if isinstance(node, list):
        for k, each in enumerate(node):
            yield from nodes_of(each, f"{place}[{k}]")
    elif isinstance(node, Mapping):
        for key, each in node.items():
            yield from nodes_of(each, f"{place}.{key}" if place else str(key))


def own_source(name: str) -> Path | None:
    """File or folder below the current folder that holds the code of a dotted name, or None."""
    if not all(part.isidentifier() for part in name.split(".")):
        return None
    root = Path.cwd() / name.partition(".")[0]
    return next((path for path in (root, root.with_suffix(".py")) if path.exists()), None)


def own_packages() -> list[ModuleType]:
    """User modules that configs have named; other processes cannot import them by name."""
    return [module for name, module in _OWN.items() if sys.modules.get(name) is module]
