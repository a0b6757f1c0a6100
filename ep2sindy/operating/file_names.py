"""Operating points by the names of their files, such as `runs/V{V_D_V}_m{mdot_mg_s}.csv`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from glob import escape, glob
from pathlib import Path

NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
# A number in a name. A sign counts only behind `_`, `=`, `/` or `(`, for `-` also separates.
_IN_NAME = re.compile(r"(?:(?<=[_=/(])[+-])?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
# What people call the two operating quantities of a thruster in the names of files.
KNOWN = {
    "V_D_V": ("v", "vd", "u", "ud", "volt", "volts", "voltage"),
    "mdot_mg_s": ("m", "md", "mdot", "mg", "mgs", "mgps", "flow", "massflow"),
}
DATA = "data"  # key of a point's data, and so no name of a quantity
MOST_SHOWN = 3  # names of files in an error


@dataclass(frozen=True)
class FilePattern:
    """Pattern of the names of files that hold one operating point each.

    text: a path in which `{NAME}` stands for the number that the quantity NAME has at the point.
    `*` and `?` stand for any characters, as in a shell, but for `/`.
    Raises ValueError for a pattern without a placeholder, or one that is no word.

    >>> FilePattern("runs/V{V_D_V}_m{mdot_mg_s}.csv").names
    ('V_D_V', 'mdot_mg_s')
    """

    text: str

    def __post_init__(self) -> None:
        example = "'points.files=runs/V{V_D_V}_m{mdot_mg_s}.csv'"
        if not self.names or re.search(r"[{}]", _PLACEHOLDER.sub("", self.text)):
            raise ValueError(
                "the files of operating points need a pattern with a placeholder for each "
                f"quantity, like {example}: {self.text!r} came"
            )
        if wrong := [name for name in self.names if not name.isidentifier() or name == DATA]:
            raise ValueError(
                "a placeholder must be the name of a quantity, of letters, digits and _, and not "
                f"{DATA!r}, like {example}: {wrong[0]!r} came in {self.text!r}"
            )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The quantities, in the order of their placeholders."""
        return tuple(dict.fromkeys(_PLACEHOLDER.findall(self.text)))

    def points(self) -> tuple[dict[str, dict[str, float]], list[str]]:
        """Files by the pattern, each with its quantities, in their order; and the other files.

        The others fit the pattern with some text in the place of a number.
        Raises ValueError if no file fits.
        """
        parts = _PLACEHOLDER.split(self.text)
        shape = "".join("*" if k % 2 else _for_glob(part) for k, part in enumerate(parts))
        reads = re.compile(_expression(parts), re.DOTALL)
        files = {file: reads.fullmatch(file) for file in sorted(glob(shape))}
        found = {
            file: {name: float(match[name]) for name in self.names}
            for file, match in files.items()
            if match
        }
        others = [file for file, match in files.items() if not match]
        if not found:
            near = others or sorted(glob(str(Path(escape(str(Path(self.text).parent)), "*"))))
            shown = f": {', '.join(near[:MOST_SHOWN])} ..." if near else ""
            raise ValueError(
                f"no file fits the pattern {self.text!r} in {Path.cwd()}, a number in the place "
                f"of each {{NAME}}; there are {len(near)} files beside it{shown}"
            )
        ordered = sorted(found.items(), key=lambda pair: tuple(pair[1].values()))
        return dict(ordered), others


def _for_glob(text: str) -> str:
    """Text of a pattern for a glob: `*` and `?` keep their meaning."""
    return text.replace("[", "[[]")


def _expression(parts: Sequence[str]) -> str:
    """Regular expression of the pattern that texts and names make by turns."""
    found, seen = "", set[str]()
    for k, part in enumerate(parts):
        if k % 2:
            found += f"(?P={part})" if part in seen else f"(?P<{part}>{NUMBER})"
            seen.add(part)
        else:
            found += re.escape(part).replace(r"\*", "[^/]*").replace(r"\?", "[^/]")
    return found


def propose_pattern(paths: Sequence[str]) -> FilePattern | None:
    """The pattern of which files are operating points; None if their names tell none.

    Names must differ in numbers alone. Each number that differs is a quantity: V_D_V and mdot_mg_s
    by what people call these, others by the letters before the number.

    >>> propose_pattern(["a/V200_m4.5.csv", "a/V300_m5.csv"]).text
    'a/V{V_D_V}_m{mdot_mg_s}.csv'
    """
    if len({_IN_NAME.sub("0", path) for path in paths}) != 1 or len(paths) < 2:
        return None
    if any(sign in path for path in paths for sign in "{}*?["):
        return None
    numbers = [[match[0] for match in _IN_NAME.finditer(path)] for path in paths]
    varied = [k for k, column in enumerate(zip(*numbers, strict=True)) if len({*column}) > 1]
    texts = _IN_NAME.split(paths[0])
    names: dict[int, str] = {}
    for k in varied:
        names[k] = _quantity(texts[k], texts[k + 1], taken=list(names.values()))
    inner = [f"{{{names[k]}}}" if k in names else number for k, number in enumerate(numbers[0])]
    pieces = [piece for pair in zip(texts, [*inner, ""], strict=True) for piece in pair]
    pattern = FilePattern("".join(pieces)) if names else None
    return pattern if pattern and len(pattern.points()[0]) == len(paths) else None


def _quantity(before: str, after: str, *, taken: Sequence[str]) -> str:
    """A name for the quantity of a number, by the letters before it, or else behind it."""
    chunks = re.split(r"[^A-Za-z]+", before.rpartition("/")[2].rstrip("_=- "))
    words = [word for word in (chunks[-1], re.split(r"[^A-Za-z]+", after)[0]) if word]
    if after.startswith("."):
        words = words[:1]
    for word in words:
        for name, called in KNOWN.items():
            if word.lower() in called and name not in taken:
                return name
    base = next((word for word in words if word != DATA), "p")
    free = (f"{base}{k}" if k else base for k in range(len(taken) + 1))
    return next(name for name in free if name not in taken)
