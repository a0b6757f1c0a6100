"""What the package imports is what `pyproject.toml` declares."""

import ast
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]


def imported() -> set[str]:
    """Names of all modules from elsewhere that a file of the package imports."""
    names = set()
    for path in (ROOT / "ep2sindy").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {each.name.partition(".")[0] for each in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names.add(str(node.module).partition(".")[0])
    notebooks = {"IPython"}  # asked for only where it is loaded already
    return names - {"ep2sindy", "hydra_plugins"} - notebooks - sys.stdlib_module_names


def test_what_is_imported_is_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = [
        *project["dependencies"],
        *extras["cluster"],
        *extras["ray"],
        *extras["files"],
        *extras["benchmark"],
    ]
    declared = {Requirement(line).name.lower().replace("_", "-") for line in lines}
    found = {"ray": ["ray"]} | packages_distributions()  # no extra of the tests
    missing = {
        name: found.get(name)
        for name in imported()
        if not {each.lower().replace("_", "-") for each in found.get(name, [])} & declared
    }
    assert not missing
