"""The house rule: imports go one way, and heavy guests stay in their rooms."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "ep2sindy"
# From data to report; a module may import only from those before it.
ORDER = [
    "files",
    "parallel",
    "resampling",
    "units",
    "names",
    "kernels",
    "trajectory",
    "fields",
    "readers",
    "io",
    "spectrum",
    "thruster",
    "prepare",
    "smoothing",
    "kalman_kernels",
    "kalman",
    "library",
    "windows",
    "regression",
    "weak",
    "ambiguity",
    "search",
    "bootstraps",
    "pareto",
    "errors_in_variables",
    "selection",
    "model",
    "constraints",
    "constrained",
    "ensemble",
    "validation",
    "systems",
    "control_law",
    "discover",
    "joint",
    "tied",
    "ode",
    "integral",
    "refine",
    "together",
    "refined_score",
    "correction",
    "estimators",
    "studies",
    "plots",
    "setting_plots",
    "weak_plots",
    "study_plots",
    "map_panels",
    "map_plots",
    "parametric_plots",
    "report",
]
# PyTorch is slow to import and of no use to the search; `report` needs its TensorBoard writer.
ALLOWED = {
    "torch": {"ode", "integral", "refine", "correction", "report"},
    "hydra": set(),
    "omegaconf": set(),
    "matplotlib": {
        "parametric_plots",
        "plots",
        "study_plots",
        "report",
        "setting_plots",
        "weak_plots",
        "map_panels",
        "map_plots",
    },
}


def modules() -> list[Path]:
    return sorted(p for p in PACKAGE.rglob("*.py") if p.name != "__init__.py")


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: write imports in full"
            assert node.module is not None
            names.add(node.module)
            names |= {f"{node.module}.{a.name}" for a in node.names if node.module == "ep2sindy"}
    return names


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path: Path) -> None:
    for name in imported(path):
        parts = name.split(".")
        if parts[0] != "ep2sindy" or len(parts) == 1 or parts[1] == room(path):
            continue
        assert ORDER.index(parts[1]) < ORDER.index(room(path)), f"{room(path)} imports {name}"


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_heavy_packages_stay_in_their_rooms(path: Path) -> None:
    for package, rooms in ALLOWED.items():
        if any(name.split(".")[0] == package for name in imported(path)):
            assert room(path) in rooms, f"{room(path)} must not import {package}"


def test_every_room_is_on_the_list() -> None:
    assert {room(p) for p in modules()} <= set(ORDER)
