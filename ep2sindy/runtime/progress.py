"""Progress of long computations in stages: shown as bars, passed to a function, or not shown."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from typing import Protocol, TypeAlias, TypeVar, runtime_checkable

from ep2sindy.runtime.screen import in_line

Piece = TypeVar("Piece")
Advance = Callable[[int], None]
Stage: TypeAlias = AbstractContextManager[Advance]


def nothing(n_more: int) -> None:
    """Ignore the number of finished pieces."""


@runtime_checkable
class Progress(Protocol):
    """Interface of progress displays. Implement it for your own display, passed as `progress=`.

    A stage is a context: entered before its work begins, left when the work is over or has failed.
    It yields a function to be called with each number of newly finished pieces. Stages may be
    nested. total: number of pieces; None if it is not known in advance. unit: noun for a piece;
    empty for work that is not counted. label: name of the computation.
    """

    def stage(self, total: int | None, unit: str, label: str = "") -> Stage: ...


@dataclass(frozen=True)
class Bars:
    """Progress bars on standard error, one per stage, in a terminal or a notebook.

    A bar disappears when its stage is over. Nothing is written to logs and pipes.
    """

    @contextmanager
    def stage(self, total: int | None, unit: str, label: str = "") -> Iterator[Advance]:
        if not is_watched():
            yield nothing
            return
        from tqdm import tqdm

        with tqdm(
            total=total,
            desc=in_line(label) or None,
            unit=unit,
            bar_format=_layout(total, unit, label),
            leave=False,
            disable=False,
            miniters=1,  # update for every piece, also for slow pieces after fast ones
            **_usual_size(),
        ) as bar:
            yield lambda n_more: bar.update(n_more) and None


def _usual_size() -> dict[str, int]:
    """Size of a bar for tqdm where the terminal does not know its own; else empty.

    Such a terminal, as of a container or a remote shell, reports no rows, and tqdm shows nothing.
    """
    with suppress(OSError):
        if not all(os.get_terminal_size(sys.stderr.fileno())):
            return {"ncols": 79, "nrows": 24}
    return {}


def _layout(total: int | None, unit: str, label: str) -> str:
    """Format of a bar for tqdm."""
    if not unit:
        return "{desc} ... "
    if total is None:
        return ("{desc}: " if label else "") + "{n_fmt} {unit} [{elapsed}]"
    return "{l_bar}{bar}| {n_fmt}/{total_fmt} {unit} [{elapsed}<{remaining}]"


@dataclass(frozen=True)
class CallbackProgress:
    """Progress that is passed to a function, which receives the number of finished pieces."""

    advance: Advance

    def stage(self, total: int | None, unit: str, label: str = "") -> Stage:
        return nullcontext(self.advance)


SILENT = CallbackProgress(nothing)


def is_watched() -> bool:
    """True if standard error is a terminal or a notebook, where someone may be watching."""
    return "ipykernel" in sys.modules or (sys.stderr is not None and sys.stderr.isatty())


def as_progress(progress: Progress | Advance | bool) -> Progress:
    """Convert to a Progress: True gives bars, False none; a function receives finished pieces."""
    if isinstance(progress, bool):
        return Bars() if progress else SILENT
    return progress if isinstance(progress, Progress) else CallbackProgress(progress)


def count_pieces(
    progress: Progress, pieces: Collection[Piece], unit: str, label: str = ""
) -> Iterator[Piece]:
    """Yield every piece as part of a stage; a piece counts as done when the next is requested."""
    with progress.stage(len(pieces), unit, label) as advance:
        for piece in pieces:
            yield piece
            advance(1)
