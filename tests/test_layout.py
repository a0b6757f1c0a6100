"""Imports go one way, subpackages stay small, and each heavy dependency stays in its own."""

import ast
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from runpy import run_path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "ep2sindy"
# From the ground up: a subpackage may import only from itself and from those before it.
ROOMS = [
    "_stubs",
    "parallel",  # a stub alone
    "trust",
    "runtime",
    "library",
    "data",
    "datasets",
    "signals",
    "thruster",
    "model",
    "regression",
    "estimation",
    "forecasting",
    "systems",
    "refinement",
    "selection",
    "operating",
    "discovery",
    "figures",
    "report",
    "studies",
    "app",
]
TABLES = ("data", "thruster", "systems", "discovery", "operating", "figures", "studies", "app")
# What takes a second to import, and the modules that may load it, by themselves or through others.
HEAVY = {
    # In selection the rules that refine, and what they share.
    "torch": (
        "refinement",
        "selection.by_windows",
        "selection.free_run",
        "selection.systems",
        "selection.conserving",
        "operating.point_fits",
        "operating.law_fit",
        "operating.left_out",
        "discovery.several_points",
        "studies.points",
        "studies.point_tables",
        "studies.point_processes",
    ),
    "hydra": ("app",),
    "omegaconf": ("app",),
    "matplotlib": ("figures", "report", "studies", "app"),
    "h5py": (),
    "tensorboard": (),
    "pandas": (*TABLES, "report"),
    "xarray": TABLES,
}

MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def named(path: Path) -> str:
    """`search/front.py` -> `search.front`; an `__init__.py` bears its subpackage's name."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


PATHS = {named(path): path for path in MODULES}


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(path: Path, *, at_once: bool) -> frozenset[str]:
    """Modules that a file imports; at_once: only what importing the file itself loads."""
    found: set[str] = set()
    for node in _loaded(tree(path)) if at_once else ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: write imports in full"
            assert node.module is not None
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def _loaded(parent: ast.AST) -> Iterator[ast.AST]:
    """Statements that run at import: outside of functions and of `if TYPE_CHECKING`."""
    for node in ast.iter_child_nodes(parent):
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        yield node
        yield from _loaded(node)


def own(names: Iterable[str]) -> set[str]:
    """Those of our modules, without the package's name; a name from a module is that module."""
    inside = {name.removeprefix("ep2sindy.") for name in names if name.startswith("ep2sindy.")}
    return inside & set(PATHS)


@cache
def loaded(module: str) -> frozenset[str]:
    """Every module of ours that importing this one loads, itself included."""
    found = {module}
    stack = [module]
    while stack:
        for name in own(imports(PATHS[stack.pop()], at_once=True)) - found:
            found.add(name)
            stack.append(name)
    return frozenset(found)


def level(module: str) -> int:
    return ROOMS.index(module.split(".")[0])


def test_imports_go_one_way() -> None:
    upward = [
        f"{module} imports {name}"
        for module, path in PATHS.items()
        for name in sorted(own(imports(path, at_once=False)))
        if level(name) > level(module)
    ]
    assert not upward, "\n".join(upward)


def test_no_modules_import_each_other_in_a_circle() -> None:
    waiting = {m: own(imports(p, at_once=False)) - {m} for m, p in PATHS.items()}
    while ready := [m for m, needs in waiting.items() if not needs & set(waiting)]:
        for module in ready:
            del waiting[module]
    assert not waiting, f"circles among {sorted(waiting)}"


@pytest.mark.parametrize("package", HEAVY)
def test_heavy_packages_load_only_where_they_are_needed(package: str) -> None:
    """Through the imports of imports: a light module must not bring in a heavy one."""
    users = {
        module
        for module, path in PATHS.items()
        if any(name.split(".")[0] == package for name in imports(path, at_once=True))
    }
    heavy = [
        f"{module} loads {package} through {sorted(loaded(module) & users)}"
        for module in PATHS
        if not any(f"{module}.".startswith(f"{place}.") for place in HEAVY[package])
        and loaded(module) & users
    ]
    assert not heavy, "\n".join(heavy)


def test_every_subpackages_is_on_the_list() -> None:
    assert {module.split(".")[0] for module in PATHS} <= set(ROOMS)


def test_files_and_functions_stay_short() -> None:
    """An explanation makes neither long: docstrings do not count."""
    long: list[str] = []
    for module, path in PATHS.items():
        nodes = [
            node
            for node in ast.walk(tree(path))
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        ]
        n_lines = len(path.read_text(encoding="utf-8").splitlines()) - sum(map(n_docstring, nodes))
        if n_lines > 500:
            long.append(f"{module} holds {n_lines} lines, over 500")
        for node in nodes:
            if isinstance(node, ast.FunctionDef):
                n_lines = (node.end_lineno or node.lineno) - node.lineno + 1 - n_docstring(node)
                if n_lines > 50:
                    long.append(f"{module}.{node.name} takes {n_lines} lines, over 50")
    assert not long, "\n".join(long)


def n_docstring(node: ast.Module | ast.ClassDef | ast.FunctionDef) -> int:
    """Lines of a docstring."""
    return len((ast.get_docstring(node) or "").splitlines())


def test_a_class_name_stands_once() -> None:
    """But for the one that every experiment has."""
    names = Counter(
        node.name
        for path in PATHS.values()
        for node in tree(path).body
        if isinstance(node, ast.ClassDef)
    )
    twice = {name for name, count in names.items() if count > 1}
    assert twice == {"Study"}


def test_the_drawing_of_the_structure_is_what_the_imports_say() -> None:
    structure = run_path(str(PACKAGE.parent / "docs" / "structure.py"))
    assert structure["DRAWING"].read_text("utf-8") == structure["drawing"](), (
        "run python docs/structure.py"
    )
