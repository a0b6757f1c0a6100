"""Output to the terminal and to run.log."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text as RichText

from ep2sindy.report.document import Block, Equation, Result, Section, Table, Text, cell_text
from ep2sindy.runtime.files import writing
from ep2sindy.runtime.screen import on_screen, plain

PAGE = "report.html"

WIDTH = 120  # columns of run.log, and of output that goes to a file


class Terminal(Console):
    def on_broken_pipe(self) -> None:
        """Raise an error instead of ending the program, as Rich would."""
        raise BrokenPipeError("the terminal has gone away")


class Screen:
    """Prints to the terminal and, without colours, to run.log if there is one."""

    def __init__(self, log: Path | None = None) -> None:
        self._path = log or Path()
        with writing(self._path):
            self._file = StringIO() if log is None else log.open("a", encoding="utf-8")
        self._terminal = Terminal()
        if not self._terminal.is_terminal:
            self._terminal.width = WIDTH
        self._log = Console(file=self._file, width=WIDTH, no_color=True, force_terminal=False)

    def print(self, *renderables: RenderableType) -> None:
        """Print text literally, without markup and emoji codes."""
        with on_screen(sys.stdout):
            _print(self._terminal, *renderables)
        self._write(*renderables)

    def _write(self, *renderables: RenderableType) -> None:
        """Write to run.log only."""
        with writing(self._path):
            _print(self._log, *renderables)
            self._file.flush()

    def log(self, text: str) -> None:
        """Write text to run.log only."""
        self._write(plain(text))

    def show(self, sections: Sequence[Section], *, on_terminal: bool = True) -> None:
        """Print every section that has content for the screen; else into run.log alone."""
        to = self.print if on_terminal else self._write
        for section in sections:
            shown = [each for block in section.blocks for each in renderables(block)]
            if shown:
                to(_text(f"\n{section.title}", "bold"))
                for each in shown:
                    to(each)

    def conclude(self, result: Result, folder: Path) -> None:
        """Print what was found, how to load it in Python, and the page to open."""
        self.print(_text(f"\n{result.title}", "bold green"))
        for block in result.blocks:
            self.print(*renderables(block))
        if result.load:
            self.print(_text(f"load: {result.load.format(folder)}"))
        self.print(_text(f"open: {folder / PAGE}"))

    def close(self) -> None:
        with writing(self._path):
            self._file.close()


def renderables(block: Block) -> Iterator[RenderableType]:
    """The parts of a block that a terminal shows."""
    match block:
        case Text(page_only=False):
            yield _text(block.text, "bold red" if block.warning else "")
        case Equation(on_screen=True):
            yield _text(block.text)
        case Table(page_only=False):
            yield rich_table(block)


def _print(console: Console, *renderables: RenderableType) -> None:
    console.print(*renderables, highlight=False, markup=False, emoji=False)


def _text(text: str, style: str = "") -> RichText:
    """Text without markup and without terminal control codes."""
    return RichText(plain(text), style)


def rich_table(table: Table) -> RichTable:
    numbers = [kind.kind in "iuf" for kind in table.rows.dtypes]
    cells = [
        [plain(cell_text(value)) for value in row] for row in table.rows.itertuples(index=False)
    ]
    lines = [list(map(str, table.rows.columns)), *cells]
    width = sum(max(len(line[k]) for line in lines) + 3 for k in range(len(lines[0])))
    rich = RichTable(
        title=_text(table.title, "table.title") if table.title else None,
        title_justify="left",
        caption=_text(table.note, "table.caption") if table.note else None,
        caption_justify="left",
        show_edge=False,
        padding=(0, 1) if width <= WIDTH else (0, 0),
    )
    for name, is_number in zip(table.rows.columns, numbers, strict=True):
        rich.add_column(_text(str(name)), justify="right" if is_number else "left")
    for k, row in enumerate(cells):
        style = "bold green" if k in table.bold else "italic" if k in table.italic else None
        rich.add_row(*map(Cell, row), style=style, end_section=k in table.breaks)
    return rich


@dataclass(frozen=True)
class Cell:
    """Text that, if too long for a line, breaks before a sign or a mark `<- selected`.

    A part that is still too long breaks between words as usual.
    """

    text: str

    def lines(self, width: int) -> list[str]:
        found: list[str] = []
        for part in re.split(r"(?= [+-] )|(?=  <- )", self.text):
            if found and len(found[-1]) + len(part) <= width:
                found[-1] += part
            else:
                found.append(part.lstrip() if found else part)
        return found

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield RichText("\n".join(self.lines(options.max_width)))

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement.get(console, options, RichText(self.text))
