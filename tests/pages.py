"""README and docs as tests read them: their blocks, commands, and what they say is printed.

A block of output belongs to the block of code that it follows at once. Where it stands elsewhere,
the command that gives it stands before it, in a comment that readers do not see:

    <!-- ep2sindy +exp=breathing verbose=true -->

A number in the text is followed by its place in the `summary.json` of the first command that stands
on the page in this way, and by its format: `97 %<!-- models.simple.sustained.basin_stability .0%
-->`.
"""

import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"(±)?[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?")
COMMAND = re.compile(r"<!-- (ep2sindy .*?) -->")
QUOTED = re.compile(r"(-?[\d.]+(?:e-?\d+)?(?: %)?)<!-- (\S+) (\.\d[efg%]) -->")
RUN_FOLDER = re.compile(r"(?<=outputs/)(\w+)/[\d_-]+")
PROGRAMS = (["ep2sindy"], ["python", "-m", "experiments.run"])


@dataclass(frozen=True)
class Block:
    """A fenced block and, where its output is shown, what it is shown to print.

    language: `console` for a command that stands in a comment. place: of the output in the page.
    """

    language: str
    text: str
    printed: str | None = None
    place: tuple[int, int] = (0, 0)


def blocks(page: Path) -> list[Block]:
    return blocks_of(page.read_text("utf-8"))


def blocks_of(text: str) -> list[Block]:
    """Blocks of code. Two in a row (columns of a table) are followed by two of output."""
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
            shown = (fences[output[i]][2], fences[output[i]].span(2)) if is_paired else ()
            found.append(Block(fences[j][1], fences[j][2], *shown))
        before = text[: fences[k].start()].rstrip().rpartition("\n")[2]
        if not code and (command := COMMAND.fullmatch(before)):
            found.append(Block("console", command[1], fences[k][2], fences[k].span(2)))
        k = run[-1] + 1
    return found


def quoted(number: str, summary: Mapping, path: str, form: str) -> str:
    """A number of a summary in the format that the page asks for, such as `97 %` for `.0%`.

    path: keys, and places in lists, joined by dots. Raises KeyError for a path that is not there.
    """
    value: Any = summary
    for key in path.split("."):
        try:
            value = value[int(key)] if isinstance(value, list) else value[key]
        except (KeyError, IndexError, ValueError, TypeError) as error:
            raise KeyError(f"{number} is shown to be {path}: no {key} in the summary") from error
    return re.sub(r"e\+?(-?)0*(?=\d)", r"e\1", f"{value:{form}}").replace("%", " %")


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


def difference(shown: str, printed: str) -> str:
    """The first line of the page that was not printed; empty if all were.

    A line `...` stands for any lines. Numbers agree to a twentieth, half-widths of intervals (±)
    to a factor of two: other machines round, draw and compile otherwise.
    """
    lines, at, is_free = printed.strip().splitlines(), 0, False
    for line in shown.strip().splitlines():
        if line.strip() == "...":
            is_free = True
            continue
        here = range(at, len(lines)) if is_free else range(at, min(at + 1, len(lines)))
        place = next((k for k in here if is_alike(line, lines[k])), None)
        if place is None:
            return f"the page has {line!r}, got {lines[at : at + 1]}"
        at, is_free = place + 1, False
    return "" if is_free or at == len(lines) else f"{lines[at]!r} is not shown"


def is_alike(shown: str, printed: str) -> bool:
    if " ".join(NUMBER.sub("#", shown).split()) != " ".join(NUMBER.sub("#", printed).split()):
        return False
    pairs = zip(NUMBER.finditer(shown), NUMBER.finditer(printed), strict=True)
    return all(is_near(a[0], b[0], is_width=a[1] is not None) for a, b in pairs)


def is_near(shown: str, printed: str, *, is_width: bool) -> bool:
    a, b = float(shown.lstrip("±")), float(printed.lstrip("±"))
    return abs(a - b) <= (0.5 if is_width else 0.05) * max(abs(a), abs(b))


def updated(shown: str, printed: str) -> str:
    """What a page is to say: the printed lines in place of those that the page shows.

    After a line `...` follows the next line that is alike but for its numbers, else the most alike.
    Raises ValueError if there is none.
    """
    lines, at, is_free = printed.strip().splitlines(), 0, False
    found = []
    for line in shown.strip().splitlines():
        if line.strip() == "...":
            is_free = True
            found.append(line)
            continue
        place = _place(line, lines, at) if is_free else at
        if not at <= place < len(lines):
            raise ValueError(f"nothing printed is like {line!r}; put the page right by hand")
        found.append(lines[place].rstrip())
        at, is_free = place + 1, False
    return "\n".join(found if is_free else found + lines[at:]) + "\n"


def _place(shown: str, lines: list[str], at: int) -> int:
    """The line from `at` on that is most alike; -1 if none is."""
    shapes = [" ".join(NUMBER.sub("#", line).split()) for line in lines[at:]]
    near = get_close_matches(" ".join(NUMBER.sub("#", shown).split()), shapes, n=1)
    return at + shapes.index(near[0]) if near else -1
