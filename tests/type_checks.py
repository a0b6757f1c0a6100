"""Shapes and types of the whole package are checked while the tests run: of outermost functions.

A closure would be checked anew each time that it is made: solvers make them by the thousand, and
the checks took more than half of the suite's time.
"""

import ast
import pkgutil
from pathlib import Path
from typing import Any

from beartype import beartype as checked  # a name of its own, so that its bytecode is kept apart
from jaxtyping import _import_hook, install_import_hook

PACKAGE = Path(__file__).resolve().parents[1] / "ep2sindy"
# Compiled by numba, which cannot look inside a checking wrapper.
COMPILED = ("kernels", "gram_fits")

__all__ = ["checked", "install"]


def install() -> None:
    """Before anything of the package is imported, but its face."""
    transformer: Any = _import_hook.JaxtypingTransformer
    visit = transformer.visit_FunctionDef

    def visit_outermost(self: Any, node: ast.FunctionDef) -> ast.AST:
        inside = any(isinstance(parent, ast.FunctionDef) for parent in self._parents)
        return node if inside else visit(self, node)

    transformer.visit_FunctionDef = visit_outermost
    install_import_hook(checked_modules(), "tests.type_checks.checked")


def checked_modules() -> list[str]:
    """Every module of the package but the compiled ones; hooking a package hooks all below it."""
    names = [m.name for m in pkgutil.walk_packages([str(PACKAGE)], prefix="ep2sindy.")]
    packages = {n for n in names if any(other.startswith(n + ".") for other in names)}
    return [n for n in names if n not in packages and n.rsplit(".", 1)[-1] not in COMPILED]
