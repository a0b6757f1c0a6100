"""What values show of themselves: a screen of text, or a table in a notebook."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

WIDTH, N_LINES = 100, 25

# Controls but tab and new line, marks of direction, signs without width, halves of signs.
_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u2069\ud800-\udfff\ufeff]"
)


def plain(text: str) -> str:
    """Text from anywhere as a terminal may be given it: what steers terminals is written out."""
    return _HIDDEN.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def in_line(text: str) -> str:
    """The same for what stands within a line."""
    return plain(text).replace("\n", "\\n").replace("\t", "\\t")


def say(text: str, *, error: bool = False) -> None:
    """A line for who watches; error: on standard error. See `on_screen`."""
    stream = sys.stderr if error else sys.stdout
    with on_screen(stream):
        print(plain(text), file=stream, flush=True)


@contextmanager
def on_screen(stream: Any) -> Iterator[None]:
    """Print to a stream within: a screen that has gone away (`| head`), or is full, ends nothing.

    What is printed after goes nowhere.
    """
    try:
        yield
    except OSError:
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def one_screen(lines: Sequence[str], *, n_lines: int = N_LINES) -> str:
    """Lines cut to the width of a screen, and to its height: `... 7 more lines`."""
    if len(lines) > n_lines:
        lines = [*lines[: n_lines - 1], f"... {len(lines) - n_lines + 1} more lines"]
    return "\n".join(cut(plain(line)) for line in lines)


def cut(text: str, width: int = WIDTH) -> str:
    return text if len(text) <= width else text[: width - 3] + "..."


def wrap(parts: Sequence[str], *, what: str, n_lines: int, indent: str = "    ") -> list[str]:
    """Parts joined by blanks into lines of a screen's width: at the end `... 7 more terms`."""
    lines, counts = [""], [0]
    for k, part in enumerate(parts):
        if lines[-1] and len(lines[-1]) + 1 + len(part) > WIDTH:
            lines.append(indent)
            counts.append(0)
        joint = " " if lines[-1].strip() else ""
        lines[-1] = cut(lines[-1] + joint + part)
        counts[-1] += k > 0  # the first part is the head of what follows
    if len(lines) > 1 >= n_lines:
        return [f"{parts[0]} ... {len(parts) - 1} {what}"]
    if len(lines) > n_lines:
        left = sum(counts[n_lines - 1 :])
        return [*lines[: n_lines - 1], f"{indent}... {left} more {what}"]
    return lines


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Columns side by side, each as wide as its longest cell."""
    cells = [[in_line(cell) for cell in row] for row in (header, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        "  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)).rstrip() for row in cells
    ]


def html_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML already: what may hold < or & must come escaped."""
    head = "".join(f"<th>{cell}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
