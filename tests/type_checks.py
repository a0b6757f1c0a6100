"""Shapes and types of the whole package are checked while the tests run: of outermost functions.

jaxtyping's own hook would check arguments twice, before the call and again beside what it returned,
and would compile anew all that the package imports: its mark stays on while a module runs. A
closure would be checked anew each time that it is made: solvers make them by the thousand.
"""

import ast
import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial, wraps
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import cache_from_source
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, get_args
from unittest.mock import patch

from beartype import beartype
from jaxtyping import AbstractArray, jaxtyped

# Compiled by numba, which cannot look inside a checking wrapper.
COMPILED = ("kernels", "gram_fits")  # endings of names
MARK = "checked1"  # in names of kept bytecode: count on when `marked` changes
SCOPE = jaxtyped("context")  # of axis names; it holds nothing, so that one is enough


def install() -> None:
    """Before anything of the package is imported, but its face."""
    sys.meta_path.insert(0, Finder())


class Finder(MetaPathFinder):
    """Finds modules of the package, but its rooms' faces and what is compiled."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        names = fullname.split(".")
        if len(names) < 2 or names[0] != "ep2sindy" or names[-1].endswith(COMPILED):
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is None or spec.origin is None or Path(spec.origin).name == "__init__.py":
            return None
        spec.loader = Loader(fullname, spec.origin)
        return spec


class Loader(SourceFileLoader):
    """Loads a module as if each outermost function and each class bore a decorator."""

    def get_code(self, fullname: str) -> CodeType | None:
        aside = partial(cache_from_source, optimization=MARK)
        with patch("importlib._bootstrap_external.cache_from_source", aside):
            return super().get_code(fullname)

    def source_to_code(self, data: bytes, path: str, *, _optimize: int = -1) -> CodeType:
        tree = marked(ast.parse(data))
        return compile(tree, path, "exec", dont_inherit=True, optimize=_optimize)

    def exec_module(self, module: ModuleType) -> None:
        vars(module)["__checked__"] = checked
        super().exec_module(module)


def marked(tree: ast.Module) -> ast.Module:
    """With `@__checked__` under a function's decorators and over a class's."""
    for node in outermost(tree):
        mark = ast.copy_location(ast.Name("__checked__", ast.Load()), node)
        node.decorator_list.insert(0 if isinstance(node, ast.ClassDef) else sys.maxsize, mark)
    return tree


def outermost(node: ast.AST) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.ClassDef):
            yield child
        if not isinstance(child, ast.FunctionDef):
            yield from outermost(child)


def checked(target: Any) -> Any:
    """A function that checks what comes and what it returns; a dataclass that checks its fields."""
    if not isinstance(target, type):
        return checked_function(target)
    if dataclasses.is_dataclass(target) and "__init__" in vars(target):
        target.__init__ = checked_function(target.__init__)
    return target


def checked_function(function: FunctionType) -> Callable[..., Any]:
    """Made at the first call, when a class is known to its own methods; many are never called."""
    inner: Callable[..., Any] | None = None
    axes = False

    @wraps(function)
    def checking(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        nonlocal inner, axes
        if inner is None:
            unchecked = hasattr(checking, "__no_type_check__")
            function.__annotations__ = hints = {} if unchecked else hints_of(function)
            inner, axes = beartype(function), any(has_axes(hint) for hint in hints.values())
        if not axes:
            return inner(*args, **kwargs)
        with SCOPE:
            return inner(*args, **kwargs)

    return checking


def hints_of(function: FunctionType) -> dict[str, Any]:
    """Of what a module imports for type checkers alone, anything may come."""
    names = function.__globals__
    found: dict[str, Any] = {}
    for name, hint in function.__annotations__.items():
        try:
            while isinstance(hint, str):  # a string may name an alias that is a string
                hint = eval(hint, names)
            found[name] = hint
        except NameError:
            found[name] = Any
    return found


def has_axes(hint: Any) -> bool:
    """Whether an array with named axes is anywhere inside."""
    if isinstance(hint, list):
        return any(has_axes(part) for part in hint)
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    return any(has_axes(part) for part in get_args(hint))
