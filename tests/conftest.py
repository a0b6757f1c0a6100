"""Shapes and types of the whole package are checked while the tests run."""

import pkgutil
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

from tests.warm import compile_kernels

PACKAGE = Path(__file__).resolve().parents[1] / "ep2sindy"
# Compiled by numba, which cannot look inside a checking wrapper.
COMPILED = ("kernels", "gram_fits")


def checked_modules() -> list[str]:
    """Every module of the package but the compiled ones; hooking a package hooks all below it."""
    names = [m.name for m in pkgutil.walk_packages([str(PACKAGE)], prefix="ep2sindy.")]
    packages = {n for n in names if any(other.startswith(n + ".") for other in names)}
    return [n for n in names if n not in packages and n.rsplit(".", 1)[-1] not in COMPILED]


install_import_hook(checked_modules(), "beartype.beartype")


def pytest_configure(config: pytest.Config) -> None:
    """Before workers start; a run of one process compiles as it goes."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        compile_kernels()
