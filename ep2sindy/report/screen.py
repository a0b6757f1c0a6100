"""The terminal and run.log."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console, RenderableType

WIDTH = 120  # columns of run.log, and of output that goes to a file


class Screen:
    """Prints to the terminal and, without colours, to run.log."""

    def __init__(self, log: Path) -> None:
        self._log = log.open("a", encoding="utf-8")
        terminal = Console()
        if not terminal.is_terminal:
            terminal.width = WIDTH
        self._consoles = (terminal, Console(file=self._log, width=WIDTH, no_color=True))

    def print(self, *renderables: RenderableType) -> None:
        for console in self._consoles:
            console.print(*renderables, highlight=False)
        self._log.flush()

    def log(self, text: str) -> None:
        """Into run.log alone."""
        self._consoles[1].print(text, highlight=False, markup=False)

    def close(self) -> None:
        self._log.close()
