"""`ep2sindy compare RUN RUN ...`: run folders side by side, on the terminal and as a page."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ep2sindy.app.compare_view import compared, figures_of
from ep2sindy.app.read_run import read_run
from ep2sindy.report.page import TEMPLATES, page_html
from ep2sindy.report.screen import Screen
from ep2sindy.runtime.files import write_text
from ep2sindy.runtime.screen import say

ABOUT = """Compares runs: settings that differ, headline figures, equations with their intervals.
A run is the folder that it printed last, such as outputs/breathing/2025-01-31_101500."""


def main(arguments: Sequence[str]) -> None:
    """Raises ValueError for a folder that holds no run, or a template that is missing."""
    parser = argparse.ArgumentParser("ep2sindy compare", description=ABOUT)
    parser.add_argument("run", nargs="+", help="run folder; two or more")
    parser.add_argument("--page", default="compare.html", help="where the page goes")
    parser.add_argument("--template", help="a Jinja2 template of your own for the page")
    given = parser.parse_args(arguments)
    if len(given.run) < 2:
        raise ValueError(f"to compare takes two runs or more: {given.run} came")
    runs = [read_run(Path(path), k) for k, path in enumerate(given.run)]
    page = Path(given.page)
    template = Path(given.template) if given.template else TEMPLATES / "page.html"
    sections = compared(runs, beside=page.parent)
    html = page_html("Runs compared", sections, figures_of(runs), template=template)
    Screen().show(sections)
    write_text(page, html)
    say(str(page))
