"""How far long work has come: its stages, told to whoever waits, as bars or not at all."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

from ep2sindy.runtime.screen import in_line

Piece = TypeVar("Piece")
Advance = Callable[[int], None]


def nothing(n_more: int) -> None:
    """The advance of work that nobody watches."""


@runtime_checkable
class Progress(Protocol):
    """Whoever watches long work. Write one for a bar of your own, and pass it as `progress=`.

    A stage is entered before its work begins, and left when it is over or has failed. It yields a
    function to be told of every number of pieces that are done. Stages may lie within stages.
    total: number of pieces; None where it is not known before. unit: what a piece is, a noun;
    empty for work that is not counted. label: what is computed.
    """

    def stage(
        self, total: int | None, unit: str, label: str = ""
    ) -> AbstractContextManager[Advance]: ...


@dataclass(frozen=True)
class Silent:
    """Nobody watches."""

    def stage(
        self, total: int | None, unit: str, label: str = ""
    ) -> AbstractContextManager[Advance]:
        return nullcontext(nothing)


SILENT = Silent()


@dataclass(frozen=True)
class Bars:
    """A bar per stage on the standard error, where that is a terminal or a notebook.

    A bar goes when its stage is over. Logs and pipes see nothing.
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
            miniters=1,  # slow pieces after fast ones are shown as they come
        ) as bar:
            yield lambda n_more: bar.update(n_more) and None


def _layout(total: int | None, unit: str, label: str) -> str:
    """What tqdm writes on a line."""
    if not unit:
        return "{desc} ... "
    if total is None:
        return ("{desc}: " if label else "") + "{n_fmt} {unit} [{elapsed}]"
    return "{l_bar}{bar}| {n_fmt}/{total_fmt} {unit} [{elapsed}<{remaining}]"


@dataclass(frozen=True)
class Told:
    """A function that is told of finished pieces, whatever they are."""

    advance: Advance

    def stage(
        self, total: int | None, unit: str, label: str = ""
    ) -> AbstractContextManager[Advance]:
        return nullcontext(self.advance)


def is_watched() -> bool:
    """Whether the standard error is read by people as it comes."""
    return "ipykernel" in sys.modules or (sys.stderr is not None and sys.stderr.isatty())


def as_progress(progress: Progress | Advance | bool) -> Progress:
    """True means bars, False nobody; a function is told of finished pieces."""
    if isinstance(progress, bool):
        return Bars() if progress else SILENT
    return progress if isinstance(progress, Progress) else Told(progress)


def count_pieces(
    progress: Progress, pieces: Collection[Piece], unit: str, label: str = ""
) -> Iterator[Piece]:
    """Every piece in turn, as a stage: one is done when the next is asked for."""
    with progress.stage(len(pieces), unit, label) as advance:
        for piece in pieces:
            yield piece
            advance(1)
