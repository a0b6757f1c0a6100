"""README and docs as tests read them: their blocks, commands, and what they say is printed."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"(±)?[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?")
PROGRAMS = (["ep2sindy"], ["python", "-m", "experiments.run"])


@dataclass(frozen=True)
class Block:
    """A fenced block and, where blocks of output follow at once, what it is said to print."""

    language: str
    text: str
    printed: str | None = None


def blocks(page: Path) -> list[Block]:
    """Blocks of code. Two in a row (columns of a table) are followed by two of output."""
    text = page.read_text("utf-8")
    fences = list(FENCE.finditer(text))
    follows = [False] + [
        not re.sub(r"</?t[rdh]>|\s", "", text[before.end() : after.start()])
        for before, after in pairwise(fences)
    ]
    found: list[Block] = []
    k = 0
    while k < len(fences):
        run = [k]
        while run[-1] + 1 < len(fences) and follows[run[-1] + 1]:
            run.append(run[-1] + 1)
        code = [j for j in run if fences[j][1] not in ("", "text")]
        output = [j for j in run if j not in code]
        is_paired = len(code) == len(output) and code == run[: len(code)]
        for i, j in enumerate(code):
            printed = fences[output[i]][2] if is_paired else None
            found.append(Block(fences[j][1], fences[j][2], printed))
        k = run[-1] + 1
    return found


def commands(block: Block) -> Iterator[list[str]]:
    """The commands of a block of bash, as lists of words, without comments."""
    for line in block.text.replace("\\\n", " ").splitlines():
        words = [word for word in shlex.split(line, comments=True) if word != "&"]
        if words:
            yield words


def arguments(words: list[str]) -> list[str] | None:
    """What the program is given, or None for another program."""
    for program in PROGRAMS:
        if words[: len(program)] == program:
            return words[len(program) :]
    return None


def difference(said: str, came: str) -> str:
    """The first line of what is said that did not come; empty if all did.

    A line `...` stands for any lines. Numbers agree to a twentieth, half-widths of intervals (±)
    to a factor of two: other machines round, draw and compile otherwise.
    """
    lines, at, is_free = came.strip().splitlines(), 0, False
    for line in said.strip().splitlines():
        if line.strip() == "...":
            is_free = True
            continue
        here = range(at, len(lines)) if is_free else range(at, min(at + 1, len(lines)))
        place = next((k for k in here if is_alike(line, lines[k])), None)
        if place is None:
            return f"{line!r} is said, {lines[at : at + 1]} came"
        at, is_free = place + 1, False
    return "" if is_free or at == len(lines) else f"{lines[at]!r} is not said"


def is_alike(said: str, came: str) -> bool:
    if " ".join(NUMBER.sub("#", said).split()) != " ".join(NUMBER.sub("#", came).split()):
        return False
    pairs = zip(NUMBER.finditer(said), NUMBER.finditer(came), strict=True)
    return all(is_near(a[0], b[0], is_width=a[1] is not None) for a, b in pairs)


def is_near(said: str, came: str, *, is_width: bool) -> bool:
    a, b = float(said.lstrip("±")), float(came.lstrip("±"))
    return abs(a - b) <= (0.5 if is_width else 0.05) * max(abs(a), abs(b))
