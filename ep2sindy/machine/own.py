"""Code of the user's own: modules below the folder that a run is started in.

A config may come from anybody, and so may name no other code than the package's and that of this
folder, of which it may call only what is marked for it.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

MARK = "__offered_to_configs__"
Called = TypeVar("Called", bound=Callable[..., Any])


def for_configs(call: Called) -> Called:
    """Mark a function or class of your own, so that configs may name it: `@ep.for_configs`.

    A config then says `_target_: my_module.crop_twice`, of my_module.py in the folder that the
    run is started in.
    """
    setattr(call, MARK, call)  # itself: a class derived from it is not marked by that
    return call


def is_for_configs(value: object) -> bool:
    return getattr(value, MARK, None) is value


def own_module(name: str) -> ModuleType:
    """Import a module below the current folder, by its dotted name.

    Raises ModuleNotFoundError where there is no such file, before anything is imported: installed
    packages and the standard library are no one's own.
    """
    parts = name.split(".")
    here = Path.cwd()
    folder = here.joinpath(*parts)
    files = (folder.with_suffix(".py"), folder / "__init__.py")
    if not all(part.isidentifier() for part in parts) or not any(map(Path.is_file, files)):
        raise ModuleNotFoundError(f"{here} has no {'/'.join(parts)}.py", name=name)
    return import_module(name)
