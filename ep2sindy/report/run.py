"""A run of a study: its folder, terminal, messages and progress."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ep2sindy.report.document import Text
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.screen import Screen, renderables
from ep2sindy.report.tensorboard import Board
from ep2sindy.runtime.files import replacing
from ep2sindy.runtime.progress import Advance, Bars, Progress


@dataclass(frozen=True, eq=False)
class Run:
    """One run of a study: name and seed, destinations of its results, and its messages.

    settings: the whole config as plain values. said: messages to be repeated on the page.
    warnings: messages about problems, for the page and the summary. provenance: version of the
    code, and the command. watch: receives the progress of the run. ends: what is done last.
    """

    title: str
    seed: int
    folder: RunFolder
    screen: Screen
    board: Board
    settings: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    watch: Progress = field(default_factory=Bars)
    ends: list[Callable[[], None]] = field(default_factory=list)

    def say(self, text: str, *, warning: bool = False) -> None:
        """Print a message at once, on the screen and in run.log, and repeat it on the page."""
        if not warning:
            self.said.append(text)
        self.screen.print(*renderables(Text(text, warning=warning)))

    def warn(self, text: str) -> None:
        """Print a warning at once, and repeat it on the page and in the summary."""
        self.warnings.append(text)
        self.say(text, warning=True)

    def when_written(self, end: Callable[[], None]) -> None:
        """Do something once all that was found is written, such as removing what is kept."""
        self.ends.append(end)

    def write(self, name: str, writer: Callable[[Path], None]) -> None:
        """Write a file of the study's own into the run folder, complete or not at all."""
        with replacing(self.folder.file(name)) as temporary:
            writer(temporary)

    def progress(
        self, total: int | None, unit: str, label: str = ""
    ) -> AbstractContextManager[Advance]:
        """A stage of the run, shown as a bar; see `Progress`."""
        return self.watch.stage(total, unit, label)
