"""Draw the structure: subpackages of the package and who imports whom, from the imports themselves.

    python docs/structure.py        # writes docs/structure.svg; a test holds the drawing to the
    code

A subpackage stands above all that it imports. An arrow that a longer way implies is left out.
"""

from __future__ import annotations

import ast
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "ep2sindy"
DRAWING = ROOT / "docs" / "structure.svg"
WIDTH, GAP, LINE = 1080, 40, 15


def subpackages() -> dict[str, list[str]]:
    """Room -> its modules, both in order of their names."""
    found = {}
    for folder in sorted(path for path in PACKAGE.iterdir() if (path / "__init__.py").exists()):
        files = sorted(p.relative_to(folder) for p in folder.rglob("*.py"))
        found[folder.name] = [str(p.with_suffix("")) for p in files if p.name != "__init__.py"]
    return found


def arrows() -> dict[str, set[str]]:
    """Room -> the subpackages that any of its modules imports, at once or later."""
    found: dict[str, set[str]] = {}
    known = set(subpackages())
    for subpackage in subpackages():
        trees = [ast.parse(p.read_text("utf-8")) for p in (PACKAGE / subpackage).rglob("*.py")]
        names = {
            node.module or ""
            for tree in trees
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
        }
        there = {name.split(".")[1] for name in names if name.startswith("ep2sindy.")}
        found[subpackage] = there & known - {subpackage}
    return found


def direct(below: dict[str, set[str]]) -> dict[str, set[str]]:
    """Arrows without those that a longer way implies."""

    def reached(subpackage: str) -> set[str]:
        return below[subpackage].union(*(reached(each) for each in below[subpackage]))

    return {
        subpackage: {each for each in there if not any(each in reached(o) for o in there - {each})}
        for subpackage, there in below.items()
    }


def floors(below: dict[str, set[str]]) -> list[list[str]]:
    """Rooms by height: one above the highest that it imports."""
    height: dict[str, int] = {}
    while len(height) < len(below):
        for subpackage, there in below.items():
            if subpackage not in height and there <= set(height):
                height[subpackage] = 1 + max((height[each] for each in there), default=-1)
    return [
        sorted(subpackage for subpackage, h in height.items() if h == level)
        for level in range(max(height.values()) + 1)
    ]


def drawing() -> str:
    """The whole picture as SVG, the ground floor at the bottom."""
    inside, below = subpackages(), arrows()
    boxes: dict[str, tuple[float, float, float, float]] = {}
    y = 20.0
    for floor in reversed(floors(below)):
        width = min(640.0, (WIDTH - 20.0) / len(floor) - 20.0)
        tall = max(_height(inside[subpackage], width) for subpackage in floor)
        left = (WIDTH - len(floor) * (width + 20.0) + 20.0) / 2
        for k, subpackage in enumerate(floor):
            boxes[subpackage] = (left + k * (width + 20.0), y, width, tall)
        y += tall + GAP
    lines = [
        _arrow(boxes[a], boxes[b]) for a, there in direct(below).items() for b in sorted(there)
    ]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{y:.0f}" '
            'font-family="Helvetica, Arial, sans-serif" font-size="11">',
            '<rect width="100%" height="100%" fill="white"/>',
            '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
            'markerHeight="7" orient="auto"><path d="M0 0 8 4 0 8z" fill="#666"/></marker></defs>',
            *lines,
            *(_box(subpackage, inside[subpackage], boxes[subpackage]) for subpackage in inside),
            "</svg>\n",
        ]
    )


def _columns(width: float) -> int:
    return max(1, int(width // 150))


def _height(modules: list[str], width: float) -> float:
    rows = -(-len(modules) // _columns(width))
    return 30.0 + LINE * rows


def _box(subpackage: str, modules: list[str], box: tuple[float, float, float, float]) -> str:
    x, y, width, height = box
    n = _columns(width)
    names = "".join(
        f'<text x="{x + 10 + (k % n) * (width - 10) / n:.0f}" y="{y + 36 + LINE * (k // n):.0f}" '
        f'fill="#444">{escape(name)}</text>'
        for k, name in enumerate(modules)
    )
    return (
        f'<rect x="{x:.0f}" y="{y:.0f}" width="{width:.0f}" height="{height:.0f}" rx="4" '
        'fill="#eef4fa" stroke="#4a7bab"/>'
        f'<text x="{x + 10:.0f}" y="{y + 18:.0f}" font-weight="bold" font-size="13">'
        f"{escape(subpackage)}/</text>{names}"
    )


def _arrow(start: tuple[float, float, float, float], end: tuple[float, float, float, float]) -> str:
    x0, y0 = start[0] + start[2] / 2, start[1] + start[3]
    x1, y1 = end[0] + end[2] / 2, end[1] - 2.0
    bend = (y1 - y0) / 2
    return (
        f'<path d="M{x0:.0f} {y0:.0f} C{x0:.0f} {y0 + bend:.0f} {x1:.0f} {y1 - bend:.0f} '
        f'{x1:.0f} {y1:.0f}" fill="none" stroke="#999" marker-end="url(#tip)"/>'
    )


if __name__ == "__main__":
    DRAWING.write_text(drawing(), encoding="utf-8")
    print(DRAWING)
