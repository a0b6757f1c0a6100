"""The package's plain docstrings as Markdown, for the reference of the site."""

import re
from itertools import groupby
from typing import Any, NamedTuple

import griffe

CODE = re.compile(r"(`[^`]*`)")
STARTS = r"(?:Returns|Raises|Warns|Yields|Sources?:|For example)\b"
HEAD = r"\w+(?:, \w+)*:\s"  # `t: in s` or `time, z, r: the coordinates`
# Before a description or a paragraph of its own: where a line begins, or a sentence.
PLACES = re.compile(rf"(?:(?<=\.)\s+|\n\s*)(?={HEAD}|{STARTS})")


class PlainDocstrings(griffe.Extension):
    """Parameters become tables, `Returns` and `Raises` paragraphs; products are no emphasis."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = markdown_of(obj.docstring.value, names_of(obj))


class Part(NamedTuple):
    """A paragraph, or what a docstring says of the names before it."""

    names: str
    text: str


def names_of(obj: griffe.Object) -> set[str]:
    if isinstance(obj, griffe.Function):
        return {each.name for each in obj.parameters}
    return set(obj.members)


def first_sentence(text: str) -> str:
    """The summary line of a docstring, as Markdown for a cell of a table."""
    line = " ".join(text.split("\n\n")[0].split())
    return in_cell(re.split(r"(?<=\.) ", line)[0])


def markdown_of(text: str, names: set[str]) -> str:
    """One block of a docstring after the other; code blocks and examples as they are.

    names: what a line such as `t: (samples,) in s` may describe; each becomes a row of a table.
    """
    done: list[str] = []
    for block in re.split(r"\n\s*\n", text):
        if block.startswith(">>>"):
            done.append(f"```pycon\n{block.rstrip()}\n```")
        elif block.startswith("    "):
            done.append(block)
        else:
            done += _rendered(_parts(block, names))
    return "\n\n".join(done)


def _parts(block: str, names: set[str]) -> list[Part]:
    """Paragraphs and descriptions of names, in their order.

    Where the lines that continue a description are indented, a line that is not ends it.
    """
    found: list[Part] = []
    lines = [block] if "\n " not in block else re.split(r"\n(?=\S)", block)
    for line in lines:
        is_new = not found or bool(found[-1].names)
        for piece in PLACES.split(line):
            text = " ".join(piece.split())
            head = re.match(HEAD, text)
            if head and set(head[0][:-2].split(", ")) <= names:
                found.append(Part(head[0][:-2], text[head.end() :]))
            elif is_new or re.match(STARTS, text):
                found.append(Part("", text))
            else:
                found[-1] = Part(found[-1].names, f"{found[-1].text} {text}")
            is_new = False
    return found


def _rendered(parts: list[Part]) -> list[str]:
    """Paragraphs, and tables of the names that follow one another."""
    done: list[str] = []
    for is_table, group in groupby(parts, lambda part: bool(part.names)):
        if is_table:
            done.append("\n".join(["| name | meaning |", "|---|---|", *map(_row, group)]))
        else:
            done += [escaped(part.text) for part in group]
    return done


def _row(part: Part) -> str:
    names = ", ".join(f"`{name}`" for name in part.names.split(", "))
    return f"| {names} | {in_cell(part.text)} |"


def escaped(text: str) -> str:
    """What Markdown would take for emphasis, a link or HTML, outside of code."""
    return _outside_code(text, r"([*\[\]])")


def in_cell(text: str) -> str:
    """The same for a cell of a table, whose bars would end it. Bars in code do not."""
    return _outside_code(text, r"([*\[\]|])")


def _outside_code(text: str, signs: str) -> str:
    parts = CODE.split(text)
    for k in range(0, len(parts), 2):
        parts[k] = re.sub(signs, r"\\\1", parts[k]).replace("<", "&lt;")
    return "".join(parts)
