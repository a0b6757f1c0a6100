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
    """One line of a docstring after the other, code blocks (four spaces after a blank) as they are.

    names: what a line such as `t: (samples,) in s` may describe.
    """
    done: list[str] = []
    is_code, after_blank = False, True
    for line in text.splitlines():
        if line.startswith("    ") and (after_blank or is_code):
            is_code = True
            done.append(line)
        else:
            is_code = is_code and not line
            done.extend(_prose(line, names, after_blank))
        after_blank = not line.strip()
    return "\n".join(done)


def _prose(line: str, names: set[str], after_blank: bool) -> list[str]:
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
