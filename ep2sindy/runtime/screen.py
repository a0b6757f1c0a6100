"""Display of objects: text that fits a screen, an HTML table in a notebook, names in messages."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from typing import Any

WIDTH, N_LINES = 100, 25

# Control characters except tab and newline, direction marks, zero-width characters, surrogates.
_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u2069\ud800-\udfff\ufeff]"
)


def plain(text: str) -> str:
    """Make text from any source safe for a terminal: control characters are written as escapes."""
    return _HIDDEN.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def in_line(text: str) -> str:
    """Make text safe for a terminal as part of one line; newlines and tabs are escaped as well."""
    return plain(text).replace("\n", "\\n").replace("\t", "\\t")


# Errors whose words are about code, and tell nothing of a file.
_INTERNAL = (AssertionError, AttributeError, IndexError, NameError, RecursionError, TypeError)
_IN_PYTHON = re.compile(r"NoneType|zip\(\)|no attribute|values to unpack")


def words_of(error: BaseException) -> str:
    """What an error says of the file that was read, in one line and without words about code."""
    message = " ".join(str(error).split()).removesuffix(".")
    if isinstance(error, _INTERNAL) or " " not in message or _IN_PYTHON.search(message):
        return "it is damaged, or of another kind than its name says"
    return message


def say(text: str, *, error: bool = False) -> None:
    """Print a line; error: to standard error. A failing stream is ignored, see `on_screen`."""
    stream = sys.stderr if error else sys.stdout
    with on_screen(stream):
        print(plain(text), file=stream, flush=True)


def say_once(text: str) -> None:
    """Print a line to standard error, unless this program or this worker's program has done so."""
    if text not in SAID:
        SAID.add(text)
        say(text, error=True)


SAID: set[str] = set()


@contextmanager
def on_screen(stream: Any) -> Iterator[None]:
    """Print to a stream within this context, ignoring a closed pipe (`| head`) or a full disk.

    After such an error, everything else printed to the stream is discarded.
    """
    try:
        yield
    except OSError:
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def one_screen(lines: Sequence[str], *, n_lines: int = N_LINES) -> str:
    """Cut lines to the width and height of a screen, ending in `... 7 more lines` if needed."""
    if len(lines) > n_lines:
        lines = [*lines[: n_lines - 1], f"... {len(lines) - n_lines + 1} more lines"]
    return "\n".join(cut(plain(line)) for line in lines)


def cut(text: str, width: int = WIDTH) -> str:
    return text if len(text) <= width else text[: width - 3] + "..."


def wrap(parts: Sequence[str], *, what: str, n_lines: int, indent: str = "    ") -> list[str]:
    """Join parts by blanks into lines of a screen's width, at most `n_lines` of them.

    If parts are left out, the last line reads `... 7 more terms`, with `what` as the noun.
    """
    lines, counts = [""], [0]
    for k, part in enumerate(parts):
        if lines[-1] and len(lines[-1]) + 1 + len(part) > WIDTH:
            lines.append(indent)
            counts.append(0)
        joint = " " if lines[-1].strip() else ""
        lines[-1] = cut(lines[-1] + joint + part)
        counts[-1] += k > 0  # the first part is a heading and is not counted
    if len(lines) > 1 >= n_lines:
        return [f"{parts[0]} ... {len(parts) - 1} {what}"]
    if len(lines) > n_lines:
        left = sum(counts[n_lines - 1 :])
        return [*lines[: n_lines - 1], f"{indent}... {left} more {what}"]
    return lines


def sentences(text: str, *, n_lines: int = 3) -> list[str]:
    """Lines of a text that is longer than one, broken between words."""
    return wrap(text.split(" "), what="words", n_lines=n_lines)


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table in plain text; each column is as wide as its longest cell."""
    cells = [[in_line(cell) for cell in row] for row in (header, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        "  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)).rstrip() for row in cells
    ]


def html_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """HTML table of cells that are HTML already: < and & in plain text must be escaped before."""
    head = "".join(f"<th>{cell}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


# Names in messages.


def near_words(name: str, names: Iterable[str], *, form: str = "{}") -> str:
    """` (did you mean NAME?)`, of the similar ones among some names; empty if there are none.

    form: how a name is written.
    """
    near = get_close_matches(name, sorted(set(names)), n=3)
    return f" (did you mean {listed(near, form)}?)" if near else ""


def listed(names: Iterable[str], form: str = "{}") -> str:
    """`a, b, c`. form: how a name is written."""
    return ", ".join(form.format(name) for name in names)


def joined(names: Sequence[str], word: str = "and") -> str:
    """`a, b and c`, with this word before the last."""
    return f" {word} ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))
