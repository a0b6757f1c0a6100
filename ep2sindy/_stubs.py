"""The names that users see: read from the stubs (`.pyi`), loaded when they are first used.

A stub stands next to the package and next to each of its subpackages that has names for users. It
is the one text for this loader, for type checkers and editors, for the reference of the
documentation and for what configs may call. Of its lines are read

    # Data                                        a heading, which is a page of the reference
    from ep2sindy.data.open import write_field as write_field
    from ep2sindy.data.open import open_field as open_field  # for configs

and a config may call what is marked so and nothing else, for a config can come from anybody:
values, readers and simulators are marked; what writes where it is told, or runs what it is given,
must never be.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from os import path  # for pathlib takes as long as the rest of the import
from typing import Any, NamedTuple

PACKAGE = "ep2sindy"
MARK = "# for configs"


class Entry(NamedTuple):
    """What a stub says of one name: the module that defines it, and its name there."""

    module: str
    name: str
    heading: str
    for_configs: bool

    def load(self) -> Any:
        return getattr(import_module(self.module), self.name)


@cache
def read_stub(module: str) -> dict[str, Entry]:
    """Name -> what the stub of the package or of a subpackage says of it, in its order."""
    import ast  # here, for it takes longer than all else that `import ep2sindy` does

    with open(_stub_file(module), encoding="utf-8") as file:
        text = file.read()
    lines = text.splitlines()
    entries = {}
    for node in ast.parse(text).body:
        if isinstance(node, ast.ImportFrom):
            (alias,) = node.names  # one alone, for the mark is of the whole statement
            assert node.module is not None
            assert node.level == 0, f"write imports in full in the stub of {module}"
            before = reversed(lines[: node.lineno])
            heading = next((line[2:] for line in before if line.startswith("# ")), "")
            marked = lines[(node.end_lineno or node.lineno) - 1].endswith(MARK)
            name = alias.asname or alias.name
            entries[name] = Entry(node.module, alias.name, heading, marked)
    return entries


def _folder(module: str) -> str:
    return path.join(path.dirname(path.dirname(__file__)), *module.split("."))


def _stub_file(module: str) -> str:
    place = _folder(module)
    return path.join(place, "__init__.pyi") if path.isdir(place) else f"{place}.pyi"


def subpackages() -> list[str]:
    """The package and its subpackages that have names for users."""
    own = [name for name, entry in read_stub(PACKAGE).items() if entry.module == PACKAGE]
    return [PACKAGE, *(f"{PACKAGE}.{name}" for name in own)]


@cache
def dotted_names() -> dict[str, Entry]:
    """All names, in full: `ep2sindy.EBIC`, `ep2sindy.data.crop`; but for the subpackages."""
    return {
        f"{subpackage}.{name}": entry
        for subpackage in subpackages()
        for name, entry in read_stub(subpackage).items()
        if entry.module != PACKAGE
    }


def place_of(kind: type) -> str | None:
    """The name of a class in full, for users and configs; None for what is not theirs."""
    defined = (kind.__module__, kind.__qualname__)
    return next((name for name, e in dotted_names().items() if (e.module, e.name) == defined), None)


def attach(module: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a module that has a stub next to it.

    A name stays in the module once it is loaded.
    """

    def load(name: str) -> Any:
        entry = read_stub(module).get(name)
        if name == "__all__":
            return list(read_stub(module))
        if name == "__version__" and module == PACKAGE:
            from importlib.metadata import version

            return version(PACKAGE)
        if entry is None:
            near = _near(f"{module}.{name}")
            raise AttributeError(f"module {module!r} has no attribute {name!r}; {near}")
        if entry.module == module:
            return import_module(f"{module}.{name}")  # a subpackage
        value = entry.load()
        setattr(sys.modules[module], name, value)
        return value

    return load, lambda: sorted(read_stub(module))


def _near(absent: str) -> str:
    """Where to look for a name that a module has not."""
    module, _, name = absent.rpartition(".")
    look = f"see dir({module})"
    if name.startswith("_"):
        return look
    if module != PACKAGE and path.exists(path.join(_folder(module), f"{name}.py")):
        return f"{look}, or import {absent}"
    from difflib import get_close_matches

    known = {each: each.rpartition(".")[2].lower() for each in (*dotted_names(), *subpackages())}
    alike = get_close_matches(name.lower(), set(known.values()))
    near = [each for word in alike for each in known if known[each] == word]
    if not near:
        return look
    return f"{look} (did you mean {', '.join(near)}?)"
