"""How a library shows itself, on a screen or in a notebook."""

from __future__ import annotations

import html
from collections.abc import Sequence

from jaxtyping import Int
from numpy import ndarray

from ep2sindy.runtime.screen import N_LINES, cut, html_table, one_screen, wrapped


def library_text(
    variables: Sequence[str], names: Sequence[str], degrees: Int[ndarray, " terms"]
) -> str:
    """Terms by degree, on one screen."""
    lines = [f"Library of {len(names)} terms over {', '.join(variables)}"]
    by_degree = list(_by_degree(names, degrees).items())
    for k, (degree, found) in enumerate(by_degree):
        left = N_LINES - len(lines) - (len(by_degree) - k - 1)
        head = f"{len(found)} of degree {degree}:"
        lines += wrapped([head, *found], what="terms", n_lines=max(1, min(6, left)))
    return one_screen(lines)


def library_html(names: Sequence[str], degrees: Int[ndarray, " terms"]) -> str:
    """The same as a table."""
    rows = [
        [str(degree), str(len(found)), html.escape(cut(", ".join(found), 1000))]
        for degree, found in _by_degree(names, degrees).items()
    ]
    return html_table(["degree", "terms", ""], rows)


def _by_degree(names: Sequence[str], degrees: Int[ndarray, " terms"]) -> dict[int, list[str]]:
    found: dict[int, list[str]] = {degree: [] for degree in sorted(set(degrees.tolist()))}
    for name, degree in zip(names, degrees.tolist(), strict=True):
        found[degree].append(name)
    return found
