"""The package's plain docstrings as Markdown, for the reference of the site."""

import re
from typing import Any

import griffe

CODE = re.compile(r"(`[^`]*`)")
STARTS = re.compile(r"^(Returns|Raises|Sources?:|For example)\b")


class PlainDocstrings(griffe.Extension):
    """Parameters become a list, `Returns` and `Raises` paragraphs; products are no emphasis."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = markdown_of(obj.docstring.value, names_of(obj))


def names_of(obj: griffe.Object) -> set[str]:
    if isinstance(obj, griffe.Function):
        return {each.name for each in obj.parameters}
    return set(obj.members)


def markdown_of(text: str, names: set[str]) -> str:
    """One line of a docstring after the other; code blocks and examples as they are.

    names: what a line such as `t: (samples,) in s` may describe.
    """
    done: list[str] = []
    for block in re.split(r"\n\s*\n", text):
        if block.startswith(">>>"):
            done.append(f"```pycon\n{block.rstrip()}\n```")
        elif block.startswith("    "):
            done.append(block)
        else:
            done.append("\n".join(t for line in block.splitlines() for t in _prose(line, names)))
    return "\n\n".join(done)


def _prose(line: str, names: set[str]) -> list[str]:
    line = " ".join(line.split())
    sentences = re.split(r"(?<=\.) (?=\w+: )", line)  # `t: in s. values: in u.` are two
    found = []
    for text in sentences:
        head = re.match(r"([\w, ]+): ", text)
        if head and set(head[1].split(", ")) <= names:
            found += ["", f"- **{escaped(head[1])}**: {escaped(text[head.end() :])}"]
        elif STARTS.match(text):
            found += ["", escaped(text)]
        else:
            found.append(escaped(text))
    return found


def escaped(text: str) -> str:
    """What Markdown would take for emphasis or HTML, outside of code."""
    parts = CODE.split(text)
    plain = [re.sub(r"([*<\[\]])", r"\\\1", p) if k % 2 == 0 else p for k, p in enumerate(parts)]
    return "".join(plain)
